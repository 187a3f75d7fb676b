"""The command line's words: verbs, flags and examples, and which function runs each verb.

Owns the parser. Standard library only, so that help comes at once and before any set-up; the
functions behind the verbs are imported when called.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module

from app import bootstrap
from app.environment import CORE, DEVELOPMENT, NOTEBOOK, TORCH

PROGRAM = "python3 -m app"
LATEST = "results/latest"


@dataclass(frozen=True)
class Verb:
    """One word of the command line: the function it runs, and what must be installed for it."""

    function: str
    summary: str
    examples: str
    sections: tuple[str, ...] = (CORE,)


VERBS = {
    "demo": Verb(
        "app.runs:demo",
        "run a small simulated sequence from start to pictures",
        "demo                            # needs nothing but Python: sets itself up",
    ),
    "run": Verb(
        "app.runs:run",
        "run a sequence and write a result folder",
        """\
run DATA                        # the layout is guessed from the folder
run DATA --dataset tum_rgbd --frames 100 --stride 2
run simulated:street --degrade --seed 7
run DATA --set orb.n_features=1500 --output my_result
run DATA --viewer meshcat       # watch it in the browser
run DATA --save-map my_map      # and later, where the map is known:
run DATA --load-map my_map --localize""",
    ),
    "eval": Verb(
        "app.runs:evaluate",
        "compute a result folder's errors anew from its files",
        """\
eval                            # the latest result
eval RESULT""",
    ),
    "optimize": Verb(
        "app.runs:optimize",
        "optimise a result folder: cameras, map and objects of the whole run at once",
        """\
optimize                        # the latest result
optimize RESULT --set batch.acceleration_mps2=0.5
optimize RESULT --set batch.method=partial""",
    ),
    "render": Verb(
        "app.runs:render",
        "draw a result folder's map and trajectory, without a display",
        """\
render                          # the latest result
render RESULT --size 1920x1080 --views top""",
    ),
    "view": Verb(
        "app.viewing:view",
        "show a result folder in the browser, with a time slider",
        """\
view                            # the latest result, on this machine alone
view RESULT --export my_scene.html
view RESULT --host 0.0.0.0      # for others, who need the token in its address""",
    ),
    "prepare": Verb(
        "app.preparation:prepare",
        "write depth, flow and masks of a sequence, so that later runs reuse them",
        """\
prepare DATA                    # what is there is kept; after a stop it goes on
prepare DATA --what depth,flow --frames 100
prepare DATA --set flow.preset=fast --output my_folder --overwrite""",
    ),
    "doctor": Verb(
        "app.doctor:doctor",
        "say whether this machine, or a data folder, is fit",
        """\
doctor                          # this machine
doctor DATA                     # and a data folder""",
        (),
    ),
    "config": Verb(
        "app.listings:config",
        "print every setting with its value, unit and meaning",
        """\
config > my.yaml                # edit it, then: run DATA --config my.yaml
config --set orb.n_features=1500""",
    ),
    "datasets": Verb(
        "app.listings:datasets",
        "list the data layouts that can be read",
        """\
datasets                        # names and expected files
datasets vdo""",
    ),
    "models": Verb(
        "app.models:models",
        "list the networks' files, fetch, add or make them; train a vocabulary of places",
        """\
models                          # which there are, which are at hand, licences
models fetch mask_rcnn          # download torchvision's weights, and make the file
models add yolo_seg yolov8n-seg.onnx
models export mask_rcnn --weights my.pth --unchecked
models train-vocabulary IMAGES simulated:room --output my_words.npz""",
    ),
    "test": Verb(
        "app.checks:test",
        "run the linters, the type checker and the tests",
        """\
test                            # everything
test -k config -x               # pytest's flags""",
        (CORE, DEVELOPMENT, NOTEBOOK, TORCH),
    ),
}

_FIRST_EXAMPLES = """\
demo                            # sets itself up, runs, draws, tells what to do next
run DATA                        # your own stereo or RGB-D sequence
render                          # pictures of the latest result
doctor DATA                     # what is missing, in words
VERB --help                     # more examples"""


class _Parser(argparse.ArgumentParser):
    """A parser whose help begins with examples, and whose errors are one sentence."""

    examples = ""

    def format_help(self) -> str:
        lines = "\n".join(f"  {PROGRAM} {line}" for line in self.examples.splitlines())
        return f"Examples:\n{lines}\n\n{super().format_help()}"

    def error(self, message: str) -> None:  # type: ignore[override]
        self.exit(2, f"dyob-slam: {message}; see '{self.prog} --help'\n")


def main(argv: Sequence[str]) -> int:
    """Parse, make sure that the verb's packages are there, run it; the exit code."""
    parser = build_parser()
    arguments, extra = parser.parse_known_args(argv)
    if arguments.verb is None:
        sys.stdout.write(parser.format_help())
        return 0
    if arguments.verb == "test":
        # argparse would tear flags from their values, which it takes for its own words.
        words = argv[list(argv).index("test") + 1 :]
        arguments.pytest_arguments = [word for word in words if word != "--debug"]
    elif extra:
        parser.error(f"'{arguments.verb}' does not know {' '.join(extra)}")
    verb = VERBS[arguments.verb]
    if verb.sections:
        bootstrap.prepare(argv, verb.sections)
    else:
        bootstrap.enter_if_ready(argv)
    module, _, function = verb.function.partition(":")
    return int(getattr(import_module(module), function)(arguments))


def build_parser() -> argparse.ArgumentParser:
    """The whole command line; parsing it imports nothing beyond the standard library."""
    parser = _Parser(
        prog=PROGRAM,
        description="DyOb-SLAM: camera trajectory and static map from stereo or RGB-D sequences "
        "in which things move.",
        allow_abbrev=False,
    )
    parser.examples = _FIRST_EXAMPLES
    parser.set_defaults(verb=None)
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", title="verbs")
    adders = {
        "demo": _add_demo,
        "run": _add_run,
        "eval": _add_result,
        "optimize": _add_optimize,
        "render": _add_render,
        "view": _add_view,
        "prepare": _add_prepare,
        "doctor": _add_doctor,
        "config": _add_settings,
        "datasets": _add_datasets,
        "models": _add_models,
        "test": _add_test,
    }
    for name, verb in VERBS.items():
        sub = verbs.add_parser(
            name,
            help=verb.summary,
            description=f"{verb.summary[0].upper()}{verb.summary[1:]}.",
            allow_abbrev=False,
        )
        sub.examples = verb.examples
        sub.add_argument("--debug", action="store_true", help="show the traceback of an error")
        adders[name](sub)
    return parser


def _add_demo(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--frames", type=_positive, metavar="N", help="stop after N frames")
    _add_output(parser)


def _add_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "path", metavar="PATH", help="data folder, or simulated:NAME such as simulated:street"
    )
    parser.add_argument("--dataset", metavar="NAME", help="layout, where the guess is wrong")
    parser.add_argument("--sequence", metavar="NAME", help="which sequence, where PATH holds many")
    parser.add_argument("--start", type=_not_negative, default=0, metavar="K", help="first frame")
    parser.add_argument("--frames", type=_positive, metavar="N", help="stop after N frames")
    parser.add_argument("--stride", type=_positive, default=1, metavar="S", help="every S-th frame")
    parser.add_argument("--seed", type=_not_negative, metavar="N", help="of all random choices")
    parser.add_argument(
        "--degrade",
        nargs="?",
        const="all",
        metavar="WHAT",
        help="simulated sequences: noisy, worn inputs; all of them, or for example flow,masks",
    )
    parser.add_argument(
        "--provide",
        metavar="WHAT",
        help="simulated sequences: which inputs come, of depth,flow,masks,right; 'right' alone is "
        "a stereo camera and nothing else (default: depth,flow,masks)",
    )
    parser.add_argument("--viewer", metavar="NAME", help="watch the run: meshcat, in the browser")
    _add_server(parser)
    _add_maps(parser)
    _add_settings(parser)
    _add_output(parser)


def _add_maps(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--save-map", metavar="DIR", help="folder to leave the map in at the end")
    parser.add_argument(
        "--load-map", metavar="DIR", help="map to begin with and continue, in its world"
    )
    parser.add_argument(
        "--localize", action="store_true", help="with --load-map: the map stays as it is"
    )


def _add_output(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--output", metavar="DIR", help="result folder (default: a new one in results/)"
    )
    parser.add_argument(
        "--pictures",
        type=_not_negative,
        default=1,
        metavar="N",
        help="annotate every N-th frame in frames/ (default: 1; 0: none, for timing)",
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar and no tables")


def _add_settings(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", metavar="FILE", help="YAML file with some or all settings")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="A.B=C",
        dest="overrides",
        help="one setting; may be given often, and wins over --config",
    )


def _add_result(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "result", metavar="RESULT", nargs="?", default=LATEST, help=f"default: {LATEST}"
    )


def _add_optimize(parser: argparse.ArgumentParser) -> None:
    _add_result(parser)
    _add_settings(parser)
    parser.add_argument("--quiet", action="store_true", help="no progress bar and no table")


def _add_render(parser: argparse.ArgumentParser) -> None:
    _add_result(parser)
    parser.add_argument(
        "--size", type=_size, default=(1280, 720), metavar="WxH", help="default: 1280x720"
    )
    parser.add_argument("--views", nargs="+", choices=VIEWS, default=list(VIEWS), metavar="VIEW")
    parser.add_argument("--background", choices=("white", "black"), default="white")


def _add_view(parser: argparse.ArgumentParser) -> None:
    _add_result(parser)
    _add_server(parser)
    parser.add_argument(
        "--export", metavar="FILE", help="write one self-contained page instead of serving"
    )


def _add_server(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--host",
        metavar="ADDRESS",
        help="where the viewer listens (default: this machine alone; others need its token)",
    )
    parser.add_argument(
        "--port", type=_positive, metavar="N", help="default: the first free one from 7000 on"
    )
    parser.add_argument("--no-open", action="store_true", help="start no browser")


VIEWS = ("top", "perspective")
SIZES_PX = (160, 8192)  # smaller pictures hold no text; larger ones no renderer makes


KINDS = ("depth", "flow", "masks")  # of files that prepare makes


def _add_prepare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", metavar="PATH", help="data folder or video")
    parser.add_argument("--dataset", metavar="NAME", help="layout, where the guess is wrong")
    parser.add_argument("--sequence", metavar="NAME", help="which sequence, where PATH holds many")
    parser.add_argument(
        "--output",
        metavar="DIR",
        help="folder to fill (default: PATH itself where it is a `folder`, else prepared/NAME)",
    )
    parser.add_argument(
        "--what", type=_kinds, default=KINDS, metavar="KINDS", help=f"default: {','.join(KINDS)}"
    )
    parser.add_argument("--frames", type=_positive, metavar="N", help="the first N frames alone")
    parser.add_argument(
        "--overwrite", action="store_true", help="make anew what prepare has made before"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress bar and no table")
    _add_settings(parser)


def _add_doctor(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", metavar="PATH", nargs="?", help="a data folder to look at")
    parser.add_argument("--dataset", metavar="NAME", help="layout, where the guess is wrong")
    parser.add_argument("--sequence", metavar="NAME", help="which sequence, where PATH holds many")


def _add_datasets(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("name", metavar="NAME", nargs="?", help="only this layout")


def _add_models(parser: argparse.ArgumentParser) -> None:
    parser.set_defaults(action="list")
    actions = parser.add_subparsers(dest="action", metavar="ACTION", title="actions")
    actions.add_parser("fetch", help="download a file, checked", allow_abbrev=False)
    add = actions.add_parser("add", help="copy a file of your own in, checked", allow_abbrev=False)
    export = actions.add_parser(
        "export", help="make an ONNX file from weights (installs torch)", allow_abbrev=False
    )
    train = actions.add_parser(
        "train-vocabulary", help="learn the words that tell places apart", allow_abbrev=False
    )
    for name, action in actions.choices.items():
        lines = VERBS["models"].examples.splitlines()
        action.examples = "\n".join(line for line in lines if line.startswith(f"models {name}"))
        action.add_argument("--debug", action="store_true", help="show the traceback of an error")
        if action is not train:
            action.add_argument("name", metavar="NAME", help="as `models` lists them")
    add.add_argument("file", metavar="FILE")
    export.add_argument("--weights", metavar="FILE", help="default: the published ones, fetched")
    export.add_argument("--output", metavar="FILE", help="default: where `run` looks for it")
    export.add_argument(
        "--unchecked", action="store_true", help="take weights that are not the published ones"
    )
    _add_train_vocabulary(train)


def _add_train_vocabulary(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "images",
        metavar="IMAGES",
        nargs="*",
        help="images, folders of images, or sequences as `run` takes them (default: those that "
        "the shipped vocabulary is made of, which takes minutes)",
    )
    parser.add_argument("--output", metavar="FILE", required=True, help="to write, a .npz")
    parser.add_argument(
        "--stride", type=_positive, default=1, metavar="S", help="every S-th image of each source"
    )
    parser.add_argument(
        "--branching", type=_positive, default=32, metavar="K", help="children of a node at most"
    )
    parser.add_argument(
        "--depth", type=_positive, default=3, metavar="L", help="levels of the tree"
    )
    parser.add_argument(
        "--seed", type=_not_negative, default=0, metavar="N", help="of the centroids"
    )


def _add_test(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "pytest_arguments", metavar="ARGUMENT", nargs="*", help="handed on to pytest"
    )


def _positive(text: str) -> int:
    value = _not_negative(text)
    if value == 0:
        raise argparse.ArgumentTypeError("expected a whole number of at least 1, found '0'")
    return value


def _not_negative(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"expected a whole number, found '{text}'")
    return int(text)


def _kinds(text: str) -> tuple[str, ...]:
    kinds = tuple(word.strip() for word in text.split(","))
    unknown = [kind for kind in kinds if kind not in KINDS]
    if unknown:
        raise argparse.ArgumentTypeError(f"expected some of {','.join(KINDS)}, found '{text}'")
    return kinds


def _size(text: str) -> tuple[int, int]:
    width, cross, height = text.lower().partition("x")
    if not (cross and width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"expected WIDTHxHEIGHT as in 1280x720, found '{text}'")
    low, high = SIZES_PX
    if not all(low <= int(side) <= high for side in (width, height)):
        raise argparse.ArgumentTypeError(
            f"expected sides of {low} to {high} pixels, found '{text}'"
        )
    return int(width), int(height)
