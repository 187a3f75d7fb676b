"""The flags of each verb, and how their values are read.

Owns what may be typed after a verb. Standard library only, as `cli` beside it.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable

LATEST = "results/latest"
VIEWS = ("top", "iso", "chase")
SIZES_PX = (160, 8192)  # smaller pictures hold no text; larger ones no renderer makes
KINDS = ("depth", "flow", "masks")  # of files that prepare makes


def _add_demo(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--frames", type=_positive, metavar="N", help="stop after N frames")
    _add_output(parser)


def _add_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "path", metavar="PATH", help="data folder, or simulated:NAME such as simulated:street"
    )
    _add_layout(parser)
    parser.add_argument("--start", type=_not_negative, default=0, metavar="K", help="first frame")
    parser.add_argument("--frames", type=_positive, metavar="N", help="stop after N frames")
    parser.add_argument("--stride", type=_positive, default=1, metavar="S", help="every S-th frame")
    parser.add_argument("--seed", type=_not_negative, metavar="N", help="of all random choices")
    _add_simulation(parser)
    parser.add_argument("--viewer", metavar="NAME", help="watch the run: meshcat, in the browser")
    _add_server(parser)
    _add_maps(parser)
    _add_resume(parser)
    _add_settings(parser)
    _add_output(parser)


def _add_layout(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--dataset", metavar="NAME", help="layout, where the guess is wrong")
    parser.add_argument("--sequence", metavar="NAME", help="which sequence, where PATH holds many")


def _add_resume(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on with the interrupted run in --output (default: the latest), as if it had not "
        "been; data and settings must be the same",
    )
    parser.add_argument(
        "--checkpoint",
        type=_not_negative,
        default=50,
        metavar="N",
        help="write what --resume needs every N frames and at Ctrl-C (default: 50; 0: never)",
    )


def _add_simulation(parser: argparse.ArgumentParser) -> None:
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
    parser.add_argument(
        "--view",
        nargs="+",
        action="extend",
        choices=VIEWS,
        metavar="VIEW",
        help="top: from above, to scale; iso: three-quarter; chase: from behind the camera at one "
        "frame, with the objects' boxes (default: all)",
    )
    parser.add_argument(
        "--frame", type=_not_negative, metavar="K", help="of chase (default: the most telling one)"
    )
    parser.add_argument(
        "--video",
        nargs="?",
        const="chase",
        choices=VIEWS,
        metavar="VIEW",
        help="an MP4 as well: annotated frames above, the map below (default view: chase)",
    )
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


def _add_prepare(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", metavar="PATH", help="data folder or video")
    _add_layout(parser)
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


def _add_bench(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "paths",
        metavar="PATH",
        nargs="*",
        help="data folders and simulated:NAME (default: some simulated ones, rendered at first "
        "use)",
    )
    parser.add_argument(
        "--runs", type=_positive, default=1, metavar="N", help="of each, with the seeds 0 to N-1"
    )
    parser.add_argument("--frames", type=_positive, metavar="N", help="the first N frames of each")
    parser.add_argument("--dataset", metavar="NAME", help="layout, where the guess is wrong")
    _add_simulation(parser)
    _add_settings(parser)
    parser.add_argument(
        "--output", metavar="DIR", help="folder to fill (default: a new one in results/)"
    )
    parser.add_argument("--quiet", action="store_true", help="no progress and no tables")


def _add_doctor(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("path", metavar="PATH", nargs="?", help="a data folder to look at")
    _add_layout(parser)


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
        lines = parser.examples.splitlines()
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


def _add_notebook(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "name", metavar="NAME", nargs="?", help="which one, by how its name begins (default: 01)"
    )
    parser.add_argument("--no-browser", action="store_true", help="only print the address")
    parser.add_argument("--port", type=_positive, metavar="N", help="default: the first free one")


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


ADDERS: dict[str, Callable[[argparse.ArgumentParser], None]] = {
    "demo": _add_demo,
    "run": _add_run,
    "eval": _add_result,
    "optimize": _add_optimize,
    "render": _add_render,
    "view": _add_view,
    "bench": _add_bench,
    "prepare": _add_prepare,
    "doctor": _add_doctor,
    "config": _add_settings,
    "datasets": _add_datasets,
    "models": _add_models,
    "notebook": _add_notebook,
    "test": _add_test,
}
