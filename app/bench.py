"""The verb `bench`: sequences run one after another, their times and errors in tables and figures.

Owns what is told on the way, and what Ctrl-C leaves. The work is in `pipelines.bench`.
"""

from __future__ import annotations

import signal
from argparse import Namespace
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from app import bootstrap, console
from app.runs import INTERRUPTED, keep_freed_memory

FAILED = 1  # exit code: some run has no result


def bench(arguments: Namespace) -> int:
    """`bench [PATH ...]`: 0; 1 where a run failed; 130 after Ctrl-C, which leaves what was done."""
    from pipelines.bench.benchmark import DONE, RESULTS_NAME, Benchmark
    from pipelines.io.config import load_config
    from pipelines.io.folder import create_result_folder
    from pipelines.runner import RESULTS

    config = load_config(arguments.config, arguments.overrides)
    if config.flow.name == "pwc_net":
        bootstrap.ensure_torch()
    cases = _cases(arguments)
    folder = arguments.output or create_result_folder(RESULTS, RESULTS_NAME, is_latest=False)
    benchmark = Benchmark(folder, cases, config, runs=arguments.runs, frames=arguments.frames)
    keep_freed_memory()
    states = []
    with console.warnings(), _hearing_ctrl_c() as ctrl_c:
        try:
            for case, seed in benchmark.pending():
                states.append(_run_one(benchmark, case, seed, arguments))
                benchmark.write(stopped=bool(ctrl_c))
                if ctrl_c:
                    break
        except KeyboardInterrupt:
            pass
    benchmark.write(stopped=bool(ctrl_c))
    _show(benchmark, arguments.quiet)
    if ctrl_c:
        return INTERRUPTED
    return 0 if all(state == DONE for state in states) else FAILED


def _cases(arguments: Namespace) -> tuple[Any, ...]:
    from pipelines.bench.cases import DEFAULT_CASES, BenchCase
    from pipelines.errors import ConfigError

    inputs = {"degrade": arguments.degrade, "provide": arguments.provide}
    if arguments.paths:
        return tuple(BenchCase(path, arguments.dataset, **inputs) for path in arguments.paths)
    for flag, value in {**inputs, "dataset": arguments.dataset}.items():
        if value:
            raise ConfigError(
                f"--{flag} is of the sequences that are named, and none is: leave --{flag} out, or "
                "name some, such as simulated:street"
            )
    return DEFAULT_CASES


def _run_one(benchmark: Any, case: int, seed: int, arguments: Namespace) -> str:
    quiet = arguments.quiet
    if not quiet:
        of = f", run {seed + 1} of {arguments.runs}" if arguments.runs > 1 else ""
        console.remark(f"{benchmark.label(case)}{of}")
    rendering = console.counting("rendering the scene", quiet)
    optimising = console.counting("optimising", quiet)
    with rendering as rendered, optimising as optimised:
        state = benchmark.run(
            case,
            seed,
            sinks=[] if quiet else [console.Progress()],
            rendering=rendered,
            optimising=optimised,
        )
    return str(state)


@contextmanager
def _hearing_ctrl_c() -> Iterator[list[int]]:
    """A list that grows by each Ctrl-C: a run and its batch answer it themselves, and go on."""
    heard: list[int] = []

    def note(number: int, frame: Any) -> None:
        heard.append(number)
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, note)
    try:
        yield heard
    finally:
        signal.signal(signal.SIGINT, before)


def _show(benchmark: Any, quiet: bool) -> None:
    """The tables on stdout, the figures as files, and where all of it lies."""
    from pipelines.bench.report import bench_text
    from viz.bench_plots import plot_bench

    figures = plot_bench(benchmark.folder)
    if quiet:
        console.say(console.shorten(benchmark.folder))
        return
    console.tables(bench_text(benchmark.content))
    console.say(f"\nResult: {console.shorten(benchmark.folder)}")
    console.pictures(figures)
