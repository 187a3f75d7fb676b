"""What is printed where there is no terminal: plain lines that a log or a pipe can take."""

from __future__ import annotations

import io
import logging
from pathlib import Path
from types import SimpleNamespace

import pytest
from rich.console import Console

from app import console
from pipelines.types import TrackingStatus

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
    bar.finish()


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


def test_paths_are_shortened_inside_the_working_folder(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert console.shorten(tmp_path / "results" / "x") == "results/x"
    assert console.shorten(Path("/")) == "/"
