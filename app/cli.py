"""The command line's verbs: what each is for, its examples, and which function runs it.

Owns the parser; the flags are in `arguments`. Standard library only, so that help comes at once and
before any set-up; the functions behind the verbs are imported when called.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module

from app import bootstrap
from app.arguments import ADDERS
from app.environment import CORE, DEVELOPMENT, NOTEBOOK, TORCH

PROGRAM = "python3 -m app"


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
run DATA --output my_result --resume    # after Ctrl-C, or a crash
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
        "draw a result folder's map, paths, objects and a video, without a display",
        """\
render                          # the latest result
render RESULT --view top iso --size 1920x1080
render RESULT --view chase --frame 40 --background black
render RESULT --video           # an MP4 as well, for any browser""",
    ),
    "view": Verb(
        "app.viewing:view",
        "show a result folder in the browser, with a time slider",
        """\
view                            # the latest result, on this machine alone
view RESULT --export my_scene.html
view RESULT --host 0.0.0.0      # for others, who need the token in its address""",
    ),
    "bench": Verb(
        "app.bench:bench",
        "run sequences, compare times and errors, with published figures beside ours",
        """\
bench                           # some simulated sequences: nothing to download
bench --runs 5                  # the paper's table of errors and chart of speed errors
bench DATA simulated:crossing --frames 100
bench simulated:kitti_0003 --degrade --set flow.preset=fast""",
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
    "notebook": Verb(
        "app.notebook:notebook",
        "open the notebooks in JupyterLab",
        """\
notebook                        # the walk-through; its address is printed
notebook 02 --no-browser""",
        (CORE, NOTEBOOK),
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
    for name, verb in VERBS.items():
        sub = verbs.add_parser(
            name,
            help=verb.summary,
            description=f"{verb.summary[0].upper()}{verb.summary[1:]}.",
            allow_abbrev=False,
        )
        sub.examples = verb.examples
        sub.add_argument("--debug", action="store_true", help="show the traceback of an error")
        ADDERS[name](sub)
    return parser
