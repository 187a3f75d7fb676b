"""What a person sees while something runs and after: progress, warnings, tables, next steps.

Owns all printing of the verbs. Rich on a terminal; plain lines where the output is a file or a
pipe. Results go to stdout, progress and warnings to stderr.
"""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.logging import RichHandler
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
from rich.progress import Progress as RichProgress
from rich.text import Text

PLAIN_EVERY_S = 5.0  # between progress lines where there is no terminal
PROGRAM = "python3 -m app"


class _Output(Console):
    """stdout, whose closed pipe ends the program in `app.__main__`, not in the middle of rich."""

    def on_broken_pipe(self) -> None:
        raise BrokenPipeError


class _Remarks(Console):
    """stderr: where nobody reads it any more, the work goes on in silence."""

    def on_broken_pipe(self) -> None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())
        self.quiet = True


stdout: Console = _Output()
stderr: Console = _Remarks(stderr=True)


class Progress:
    """A sink of the run loop: frames done, frames per second, status of the camera."""

    def __init__(self) -> None:
        self._bar: RichProgress | None = None
        self._task: Any = None
        self._n_frames = self._done = self._lost = 0
        self._started_s = self._printed_s = 0.0

    def start(self, sequence: Any, n_frames: int, config: Any, folder: Any) -> None:
        self._n_frames = n_frames
        self._started_s = self._printed_s = time.monotonic()
        camera = sequence.camera
        stderr.print(
            f"{sequence.name} ({sequence.dataset}): {n_frames} "
            f"{'frame' if n_frames == 1 else 'frames'}, {camera.width}x{camera.height}",
            highlight=False,
        )
        if stderr.is_terminal:
            self._bar = RichProgress(
                TextColumn("tracking"),
                BarColumn(),
                MofNCompleteColumn(),
                TextColumn("{task.fields[rate]}"),
                TextColumn("{task.fields[status]}"),
                TimeRemainingColumn(),
                console=stderr,
            )
            self._task = self._bar.add_task("", total=n_frames, rate="", status="")
            self._bar.start()

    def frame(self, frame: Any, result: Any) -> None:
        self._done += 1
        status = str(result.status)
        self._lost += status != "OK"
        now = time.monotonic()
        rate = f"{self._done / max(now - self._started_s, 1e-6):.1f} fps"
        if self._bar is not None:
            colour = "green" if status == "OK" else "red"
            shown = f"[{colour}]{status}[/]" + (f", {self._lost} lost" if self._lost else "")
            self._bar.update(self._task, completed=self._done, rate=rate, status=shown)
        elif now - self._printed_s >= PLAIN_EVERY_S or self._done == self._n_frames:
            self._printed_s = now
            lost = f", {self._lost} lost" if self._lost else ""
            stderr.print(
                f"  {self._done} of {self._n_frames} frames, {rate}{lost}", highlight=False
            )

    def go_on(self, n_done: int) -> None:
        stderr.print(f"  resumed after {n_done} frames", highlight=False)
        self._done = n_done
        if self._bar is not None:
            self._bar.update(self._task, completed=n_done)

    def finish(self) -> None:
        if self._bar is not None:
            self._bar.stop()
            self._bar = None


@contextmanager
def warnings() -> Iterator[None]:
    """Within the block, warnings of the library appear on stderr (above the progress bar)."""
    logger = logging.getLogger("dyob")
    handler: logging.Handler
    if stderr.is_terminal:
        handler = RichHandler(console=stderr, show_time=False, show_path=False)
    else:
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(logging.Formatter("warning: %(message)s"))
    handler.setLevel(logging.WARNING)
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


@contextmanager
def working(what: str, quiet: bool = False) -> Iterator[None]:
    """Say that something without frames is under way."""
    if quiet:
        yield
    elif stderr.is_terminal:
        with stderr.status(f"{what} ..."):
            yield
    else:
        stderr.print(f"{what} ...", highlight=False)
        yield


@contextmanager
def counting(what: str, quiet: bool = False) -> Iterator[Callable[[int, int], None]]:
    """A function (done, total) that shows how far something is; nothing appears before its call."""
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    printed_s = time.monotonic()
    bar = RichProgress(*columns, console=stderr, transient=True)
    task: Any = None

    def show(done: int, total: int) -> None:
        nonlocal task, printed_s
        if quiet:
            return
        if stderr.is_terminal:
            if task is None:
                bar.start()
                task = bar.add_task("", total=total)
            bar.update(task, completed=done)
        elif done == total or time.monotonic() - printed_s >= PLAIN_EVERY_S:
            printed_s = time.monotonic()
            stderr.print(f"  {what}: {done} of {total}", highlight=False)

    try:
        yield show
    finally:
        if task is not None:
            bar.stop()


def metrics(metrics: dict[str, Any], timings: dict[str, Any], folder: str) -> None:
    """What a run gave, as metrics.txt says it: counts, errors with units, times."""
    from pipelines.evaluation.table import HEADINGS, metrics_text

    for line in metrics_text(metrics, timings).splitlines():
        heading = line.startswith(HEADINGS)
        stdout.print(Text(line, style="bold" if heading else ""), soft_wrap=True)
    say(f"\nResult: {folder}")
    if metrics.get("run", {}).get("interrupted"):
        stdout.print(
            "Stopped before the end: the result holds the frames until then; the same command with "
            "--resume goes on.", **_PLAIN
        )  # fmt: skip


_PLAIN: dict[str, Any] = {"highlight": False, "markup": False, "soft_wrap": True}


def rows(cells: Iterable[tuple[str, ...]]) -> None:
    """Aligned columns without borders, never wrapped: a command must stay whole to be copied."""
    cells = [tuple(row) for row in cells]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for row in cells:
        say("  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip())


def tables(text: str) -> None:
    """Markdown whose tables are aligned already: the headings stand out, the rest as it is."""
    for line in text.splitlines():
        words = line.lstrip("#").strip() if line.startswith("#") else line
        stdout.print(Text(words, style="bold" if words != line else ""), soft_wrap=True)


def remark(text: str) -> None:
    """One line on stderr: what goes on, not what comes out."""
    stderr.print(text, **_PLAIN)


def pictures(files: Iterable[Path]) -> None:
    """Name the files that were drawn."""
    for file in files:
        say(shorten(file))


def next_steps(steps: dict[str, str]) -> None:
    """What to type next: purpose -> verb and arguments."""
    say("")
    rows((f"{purpose}:", f"{PROGRAM} {command}") for purpose, command in steps.items())


def say(text: str) -> None:
    """One line on stdout, as it is."""
    stdout.print(text, **_PLAIN)


def shorten(path: Path) -> str:
    """`path` from the working folder where it lies in it, for messages."""
    path = Path(path).resolve()
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)
