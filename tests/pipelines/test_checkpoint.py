"""Checkpoints: when they are written and removed, and which ones a run refuses to go on from."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path

import numpy as np
import pytest

from pipelines import checkpoint
from pipelines.checkpoint import Checkpoints
from pipelines.errors import FormatError, FrameError
from pipelines.io.config import load_config
from pipelines.runner import run
from pipelines.types import Frame
from tests.pipelines.interruption import QUICK, Interrupter


def test_a_finished_run_says_so_and_is_left_alone(short_street, tmp_path, caplog) -> None:
    config = load_config(None, QUICK)
    folder = run(short_street, config, tmp_path / "result", frames=3).folder
    assert not (folder / "checkpoint").exists()
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    again = run(short_street, config, folder, frames=3, resume=True)
    assert again.folder == folder
    assert "this run is finished, there is nothing to resume" in caplog.text
    assert before == {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_a_new_run_in_the_folder_forgets_the_checkpoint(short_street, tmp_path) -> None:
    config, folder = load_config(None, QUICK), tmp_path / "result"
    run(short_street, config, folder, sinks=[Interrupter(2)])
    run(short_street, config, folder, frames=2, checkpoint_every=0, sinks=[Interrupter(0)])
    assert not list(folder.glob("checkpoint/*"))
    with pytest.raises(FormatError, match="expected the checkpoint of an interrupted run"):
        run(short_street, config, folder, frames=2, resume=True)


def test_keyframes_and_results_are_written_once(short_street, tmp_path, monkeypatch) -> None:
    sizes = []
    write = Checkpoints._write

    def measured(checkpoints: Checkpoints, state) -> None:
        write(checkpoints, state)
        sizes.append([path.stat().st_size for path in checkpoints._stores()])

    monkeypatch.setattr(Checkpoints, "_write", measured)
    run(short_street, load_config(None, QUICK), tmp_path / "result", checkpoint_every=4)
    assert [len(files) for files in sizes] == [1, 2, 3]
    assert sizes[-1][:2] == sizes[-2]  # nobody touched the earlier ones
    assert max(sizes[-1]) < 3 * min(sizes[-1])


@pytest.fixture
def stopped(short_street, tmp_path) -> Path:
    """The folder of a run that was interrupted."""
    folder = tmp_path / "result"
    config = load_config(None, QUICK)
    return run(short_street, config, folder, sinks=[Interrupter(3)], checkpoint_every=2).folder


def test_other_settings_are_an_error_that_names_them(short_street, stopped) -> None:
    config = load_config(None, [*QUICK, "orb.n_features=700", "tracking.seed=3"])
    with pytest.raises(FormatError, match=r"orb\.n_features 1500 then and 700 now") as raised:
        run(short_street, config, stopped, resume=True)
    assert "tracking.seed 0 then and 3 now" in str(raised.value)
    assert "without --resume" in str(raised.value)
    run(short_street, load_config(None, QUICK), stopped, resume=True)  # nothing was lost by trying


@pytest.mark.parametrize(
    ("options", "named"),
    [({"frames": 7}, "frames.stop"), ({"stride": 2}, "frames.stride")],
)
def test_other_frames_are_an_error(short_street, stopped, options, named) -> None:
    with pytest.raises(FormatError, match=named):
        run(short_street, load_config(None, QUICK), stopped, resume=True, **options)


def test_other_data_are_an_error(short_street, other_place, stopped, altered) -> None:
    config = load_config(None, QUICK)
    with pytest.raises(FormatError, match=r"data\.timestamps"):
        run(other_place, config, stopped, resume=True)

    def other(frame: Frame) -> Frame:
        return dataclasses.replace(frame, depth_m=frame.depth_m * np.float32(1.01))

    with pytest.raises(FormatError, match="found another frame 3; give --resume the same data"):
        run(altered(short_street, other), config, stopped, resume=True)

    def gone(frame: Frame) -> Frame:
        raise FrameError("no such file")

    with pytest.raises(FormatError, match="frame 3 as the interrupted run saw it"):
        run(altered(short_street, gone), config, stopped, resume=True)


def test_another_version_of_the_program_is_an_error(short_street, stopped, monkeypatch) -> None:
    monkeypatch.setattr(checkpoint, "_program", lambda: "another")
    with pytest.raises(FormatError, match="in this version of the program"):
        run(short_street, load_config(None, QUICK), stopped, resume=True)


def test_no_folder_or_one_of_something_else_is_an_error(short_street, tmp_path) -> None:
    with pytest.raises(FormatError, match="no such folder"):
        run(short_street, output=tmp_path / "none", resume=True)
    with pytest.raises(FormatError, match=r"no run\.log in it"):
        run(short_street, output=tmp_path, resume=True)


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-100])


def change(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def test_a_damaged_checkpoint_is_a_sentence(short_street, stopped) -> None:
    for name, damage in itertools.product(("state.npz", "000000.npz"), (cut, change, Path.unlink)):
        path = stopped / "checkpoint" / name
        before = path.read_bytes()
        damage(path)
        with pytest.raises(FormatError, match=r"without --resume") as raised:
            run(short_street, load_config(None, QUICK), stopped, resume=True)
        assert "\n" not in str(raised.value)
        assert str(path if path.exists() else "checkpoint") in str(raised.value)
        path.write_bytes(before)


def test_a_lost_log_of_observations_is_an_error(short_street, tmp_path, monkeypatch) -> None:
    from pipelines.io import observations

    monkeypatch.setattr(observations, "FRAMES_A_CHUNK", 2)
    config, folder = load_config(None, QUICK), tmp_path / "result"
    run(short_street, config, folder, sinks=[Interrupter(5)])
    (folder / "observations" / "000001.npz").unlink()
    with pytest.raises(FormatError, match="expected what the frames done so far saw"):
        run(short_street, config, folder, resume=True)
