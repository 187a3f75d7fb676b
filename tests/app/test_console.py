"""What is printed where there is no terminal: plain lines that a log or a pipe can take."""

from __future__ import annotations

import io
import logging
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from app import console
from pipelines.types import TrackingStatus

CURSOR_HIDDEN, CURSOR_SHOWN = "\x1b[?25l", "\x1b[?25h"  # while a bar is drawn, and after it
METRICS = {
    "run": {"sequence": "street", "frames": 3, "tracked": 2, "lost": 1, "interrupted": True},
    "camera": {"ate_rmse_m": 0.0123},
}
SEQUENCE = SimpleNamespace(
    name="street", dataset="simulated", camera=SimpleNamespace(width=640, height=192)
)


@pytest.fixture(params=[False, True], ids=["pipe", "terminal"])
def screen(request, monkeypatch) -> io.StringIO:
    """Everything that goes to either stream, without colours."""
    text = io.StringIO()
    for name in ("stdout", "stderr"):
        drawn = Console(file=text, force_terminal=request.param, width=120, color_system=None)
        monkeypatch.setattr(console, name, drawn)
    return text


def test_progress_counts_frames_and_losses(screen) -> None:
    bar = console.Progress()
    bar.start(SEQUENCE, 3, None, None)
    for status in (TrackingStatus.OK, TrackingStatus.LOST, TrackingStatus.OK):
        bar.frame(None, SimpleNamespace(status=status))
    bar.finish()
    text = screen.getvalue()
    assert "street (simulated): 3 frames, 640x192" in text
    assert "1 lost" in text
    assert "fps" in text


def test_a_run_that_ends_early_closes_the_bar(screen) -> None:
    bar = console.Progress()
    bar.start(SEQUENCE, 3, None, None)
    bar.finish()
    said = screen.getvalue()
    assert said.count(CURSOR_HIDDEN) == said.count(CURSOR_SHOWN) == int(console.stderr.is_terminal)
    bar.finish()
    assert screen.getvalue() == said


def test_counting_shows_how_far_something_is(screen) -> None:
    with console.counting("rendering") as show:
        for done in range(1, 4):
            show(done, 3)
    assert "rendering" in screen.getvalue()
    assert "3 of 3" in screen.getvalue() or "3/3" in screen.getvalue()


def test_counting_is_silent_without_a_call_and_where_asked(screen) -> None:
    with console.counting("rendering", quiet=True) as show:
        show(3, 3)
    assert "rendering" not in screen.getvalue()


def test_metrics_come_with_units_and_tell_of_an_interruption(screen) -> None:
    console.metrics(METRICS, {}, "results/x")
    text = screen.getvalue()
    row = next(line for line in text.splitlines() if "ATE" in line)
    assert "0.0123" in row
    assert " m" in row
    assert "results/x" in text
    assert "Stopped before the end" in text


def test_rows_keep_words_in_brackets(screen) -> None:
    console.rows([("own data:", "run [PATH]"), ("x:", "y")])
    assert "run [PATH]" in screen.getvalue()


def test_next_steps_are_commands_to_type(screen) -> None:
    console.next_steps({"pictures": "render results/x"})
    assert "python3 -m app render results/x" in screen.getvalue()


def test_warnings_are_shown_inside_the_block_only(screen, capsys) -> None:
    logger = logging.getLogger("dyob.test")
    with console.warnings():
        logger.warning("frame 3 cannot be read")
        logger.info("nothing to see")
    logger.warning("later")
    said = screen.getvalue() + capsys.readouterr().err
    assert "frame 3 cannot be read" in said
    assert "nothing to see" not in said
    assert logging.getLogger("dyob").handlers == []


class _Closed(io.StringIO):
    """A pipe whose reader is gone."""

    def write(self, text: str) -> int:
        raise BrokenPipeError


def test_a_closed_stdout_ends_the_program_by_its_own_error(monkeypatch) -> None:
    monkeypatch.setattr(console, "stdout", type(console.stdout)(file=_Closed()))
    with pytest.raises(BrokenPipeError):
        console.say("a line")


@pytest.mark.parametrize("verb", ["config", "datasets"])
def test_a_reader_that_leaves_early_is_no_error(verb: str) -> None:
    child = subprocess.Popen(
        [sys.executable, "-m", "app", verb],
        cwd=Path(__file__).resolve().parents[2],
        env={**os.environ, "DYOB_NO_SETUP": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    assert child.stdout is not None
    child.stdout.close()
    _, said = child.communicate()
    assert (child.returncode, said) == (0, b"")


def test_remarks_that_nobody_reads_do_not_end_the_work() -> None:
    """In a child, since its stderr is closed for good."""
    program = (
        "from app import console\n"
        "for k in range(3): console.stderr.print('remark', k)\n"
        "console.say('done')\n"
    )
    child = subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=Path(__file__).resolve().parents[2],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert child.stderr is not None
    child.stderr.close()
    said, _ = child.communicate()
    assert (child.returncode, said) == (0, "done\n")


def test_paths_are_shortened_inside_the_working_folder(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert console.shorten(tmp_path / "results" / "x") == "results/x"
    assert console.shorten(Path("/")) == "/"
