"""The verbs that make and read result folders: demo, run, eval, optimize, render.

Owns what a person is told about them. The work is in `pipelines` and `viz`.
"""

from __future__ import annotations

import ctypes
from argparse import Namespace
from contextlib import suppress
from pathlib import Path
from typing import Any

from app import bootstrap, console, viewing
from app.arguments import VIEWS
from pipelines.errors import ConfigError, DyObError

SIMULATED = "simulated"
VIDEO = "video.mp4"
INTERRUPTED = 130
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # of glibc's mallopt


def run(arguments: Namespace) -> int:
    """`run PATH`: 0 when all frames were tried, 130 after Ctrl-C (the result is valid then)."""
    from pipelines.datasets import open_sequence
    from pipelines.io.config import load_config
    from pipelines.lasting_map import LastingMap

    viewer = viewing.live_viewer(arguments)
    maps = LastingMap(arguments.load_map, arguments.save_map, arguments.localize)
    overrides = list(arguments.overrides)
    if arguments.seed is not None:
        overrides.append(f"tracking.seed={arguments.seed}")
    config = load_config(arguments.config, overrides)
    if config.flow.name == "pwc_net":
        bootstrap.ensure_torch()
    options = _simulation_options(arguments)
    counting = console.counting("rendering the scene", arguments.quiet)
    with console.warnings(), counting as progress:
        if _is_simulated(arguments):
            options["progress"] = progress
        sequence = open_sequence(arguments.path, arguments.dataset, arguments.sequence, **options)
    span = {"start": arguments.start, "frames": arguments.frames, "stride": arguments.stride}
    result = _process(
        sequence,
        config,
        arguments,
        span,
        viewer=viewer,
        lasting_map=maps,
        resume=arguments.resume,
        checkpoint_every=arguments.checkpoint,
    )
    folder = console.shorten(result.folder)
    if arguments.quiet:
        console.say(folder)
    else:
        console.next_steps(
            {
                "in the browser": f"view {folder}",
                "pictures": f"render {folder}",
                "errors again": f"eval {folder}",
            }
        )
    return _code(result)


def demo(arguments: Namespace) -> int:
    """`demo`: a small simulated sequence, its result, its pictures, and what to do next."""
    from pipelines.datasets import open_sequence
    from pipelines.io.config import load_config
    from pipelines.io.folder import SCENE
    from viz.plots import plot_result
    from viz.render import render_result
    from viz.report import write_report

    quiet = arguments.quiet
    with console.counting("rendering the scene", quiet) as progress:
        sequence = open_sequence(f"{SIMULATED}:demo", progress=progress)
    span = {"frames": arguments.frames}
    result = _process(sequence, load_config(), arguments, span)
    if result.metrics["run"]["interrupted"]:
        return INTERRUPTED
    with console.warnings(), console.working("drawing the map and the trajectory", quiet):
        pictures = render_result(result.folder) + plot_result(result.folder)
        pictures += [write_report(result), result.folder / SCENE]
    console.pictures(pictures)
    if not quiet:
        if arguments.pictures:
            console.say(f"{console.shorten(result.folder / 'frames')}/ with each frame annotated")
        console.next_steps(
            {
                "in the browser": f"view {console.shorten(result.folder)}",
                "a video of it": f"render {console.shorten(result.folder)} --video",
                "your own data": "run PATH",
                "is it fit?": "doctor PATH",
                "layouts": "datasets",
                "settings": "config",
            }
        )
    return _code(result)


def evaluate(arguments: Namespace) -> int:
    """`eval RESULT`: renew metrics.json and metrics.txt from the trajectories, and show them."""
    from pipelines.evaluation import evaluate_result
    from pipelines.io.folder import REPORT
    from pipelines.io.result import load_result
    from viz.report import write_report

    metrics = evaluate_result(arguments.result, with_bound=True)
    result = load_result(arguments.result)
    if (result.folder / REPORT).exists():  # else `render` will write it
        write_report(result)
    console.metrics(metrics, result.timings, console.shorten(result.folder))
    return 0


def optimize(arguments: Namespace) -> int:
    """`optimize RESULT`: the batch, from what the run recorded; a table of before and after."""
    from pipelines.io.config import load_config
    from pipelines.io.folder import CONFIG, open_result_folder
    from pipelines.io.result import load_result
    from pipelines.optimisation import optimise_result

    folder = open_result_folder(arguments.result)
    own = folder / CONFIG
    path = arguments.config or (own if own.exists() else None)
    config = load_config(path, arguments.overrides)
    counting = console.counting("optimising", arguments.quiet)
    with console.warnings(), counting as progress:
        metrics = optimise_result(folder, config.batch, progress)
    if not arguments.quiet:
        result = load_result(folder)
        console.metrics(metrics, result.timings, console.shorten(folder))
    return 0


def render(arguments: Namespace) -> int:
    """`render RESULT`: pictures in the result folder, the scene as a page, a video on demand."""
    from pipelines.io.folder import SCENE, open_result_folder
    from pipelines.io.result import load_result
    from viz.plots import plot_result
    from viz.render import render_result
    from viz.report import write_report

    folder = open_result_folder(arguments.result)
    options = {"size": arguments.size, "background": arguments.background}
    with console.warnings(), console.working(f"drawing {console.shorten(folder)}"):
        pictures = render_result(
            folder, **options, views=tuple(arguments.view or VIEWS), frame=arguments.frame
        )
        pictures += plot_result(folder)
    if arguments.video:
        pictures.append(_video(folder, arguments))
    pictures += [write_report(load_result(folder)), folder / SCENE]
    console.pictures(pictures)
    return 0


def _video(folder: Path, arguments: Namespace) -> Path:
    from pipelines.io.result import load_result
    from viz.render import renders_folder
    from viz.video import write_video

    result = load_result(folder)
    with console.warnings(), console.counting("drawing the video") as progress:
        return write_video(
            result,
            renders_folder(result) / VIDEO,
            view=arguments.video,
            width=arguments.size[0],
            background=arguments.background,
            progress=progress,
        )


def keep_freed_memory() -> None:
    """Let glibc keep the pages of freed images for the next frame's, a tenth of its time.

    By default each image is mapped anew and its pages are faulted in one by one.
    """
    with suppress(OSError, AttributeError):  # another C library
        libc = ctypes.CDLL(None)
        libc.mallopt(_M_MMAP_THRESHOLD, 1 << 30)
        libc.mallopt(_M_TRIM_THRESHOLD, (1 << 31) - 1)


def _process(
    sequence: Any,
    config: Any,
    arguments: Namespace,
    span: dict[str, Any],
    *,
    viewer: Any = None,
    **more: Any,
) -> Any:
    from pipelines.runner import run as run_sequence
    from viz.overlay import FrameWriter

    keep_freed_memory()
    sinks: list[Any] = [] if arguments.quiet else [console.Progress()]
    if arguments.pictures:
        sinks.append(FrameWriter(every=arguments.pictures))
    if viewer is not None:
        sinks.insert(0, viewer)  # before the others, as its port may be taken
    with console.warnings(), console.counting("optimising", arguments.quiet) as optimising:
        result = run_sequence(
            sequence,
            config,
            arguments.output,
            **span,
            **more,
            sinks=sinks,
            batch_progress=optimising,
        )
    if not arguments.quiet:
        console.metrics(result.metrics, result.timings, console.shorten(result.folder))
    return result


def _code(result: Any) -> int:
    """The exit code; a run without one tracked frame is a failure that a script must see."""
    counts = result.metrics["run"]
    if counts["interrupted"]:
        return INTERRUPTED
    if counts["tracked"] == 0:
        raise DyObError(
            f"no frame could be tracked (see {console.shorten(result.folder)}/run.log); "
            "'python3 -m app doctor PATH' says whether the data are fit"
        )
    return 0


def _is_simulated(arguments: Namespace) -> bool:
    named = arguments.path == SIMULATED or arguments.path.startswith(f"{SIMULATED}:")
    return named or arguments.dataset == SIMULATED


def _simulation_options(arguments: Namespace) -> dict[str, Any]:
    """Options that only simulated sequences take."""
    if not _is_simulated(arguments):
        for flag in ("degrade", "provide"):
            if getattr(arguments, flag):
                raise ConfigError(
                    f"--{flag} alters the inputs of simulated sequences, and {arguments.path} is "
                    f"none: leave --{flag} out or run simulated:street"
                )
        return {}
    given = {
        "degrade": arguments.degrade,
        "seed": arguments.seed,
        "provide": arguments.provide,
    }
    return {name: value for name, value in given.items() if value is not None}
