"""Folders that a user may hand in by mistake, and the program on them: one clear sentence each.

Frames and masks that are damaged are in `test_bad_frames` and `test_bad_masks`; files that are only
wrong in one layout are tested beside that layout.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from pipelines.datasets import open_sequence
from pipelines.errors import DatasetError
from pipelines.io.result import load_result
from tests.pipelines.damage import blacken, camera_errors_m, rewrite

ROOT = Path(__file__).resolve().parents[2]


def start_app(*words: str | Path) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "app", *map(str, words)],
        cwd=ROOT,
        env={**os.environ, "DYOB_NO_SETUP": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_a_missing_folder_is_named(tmp_path) -> None:
    with pytest.raises(DatasetError, match="no such folder") as raised:
        open_sequence(tmp_path / "stret")
    assert str(tmp_path / "stret") in str(raised.value)


def test_an_empty_folder_is_told_what_was_expected(tmp_path) -> None:
    with pytest.raises(DatasetError, match="empty") as raised:
        open_sequence(tmp_path)
    for layout in ("vdo", "kitti_odometry", "tum_rgbd", "folder"):
        assert layout in str(raised.value)


@pytest.mark.parametrize("dataset", ["vdo", "kitti_odometry", "tum_rgbd", "folder"])
def test_an_empty_folder_of_a_named_layout_is_an_error(dataset: str, tmp_path) -> None:
    with pytest.raises(DatasetError, match=rf"as {dataset}: .*[Ff]ound: an empty folder"):
        open_sequence(tmp_path, dataset)


@pytest.mark.parametrize(
    ("fixture", "file"),
    [
        ("vdo_folder", "settings.yaml"),
        ("tum_folder", "camera.yaml"),
        ("kitti_folder", "calib.txt"),
    ],
)
def test_missing_calibration_is_named(fixture: str, file: str, request) -> None:
    folder = request.getfixturevalue(fixture)
    dataset = open_sequence(folder).dataset
    (folder / file).unlink()
    with pytest.raises(DatasetError, match="missing calibration"):
        open_sequence(folder, dataset)


def test_a_calibration_without_its_baseline_names_it(vdo_folder) -> None:
    settings = vdo_folder / "settings.yaml"
    lines = settings.read_text().splitlines(keepends=True)
    settings.write_text("".join(line for line in lines if "bf" not in line))
    with pytest.raises(DatasetError, match=r"missing calibration.*no Camera\.bf"):
        open_sequence(vdo_folder)


def test_bad_input_reaches_a_user_as_one_sentence(tmp_path) -> None:
    with start_app("run", tmp_path / "no-such-folder") as process:
        out, error = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "no such folder" in error
    assert "Traceback" not in out + error


def test_the_program_fails_in_words_where_no_frame_could_be_tracked(vdo_folder) -> None:
    for image in (vdo_folder / "image_0").iterdir():
        rewrite(image, blacken)
    output = vdo_folder.parent / "result"
    with start_app("run", vdo_folder, "--output", output, "--quiet") as process:
        out, error = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "no frame could be tracked" in error
    assert "Traceback" not in out + error
    assert json.loads((output / "metrics.json").read_text())["run"]["lost"] == 10


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs named pipes to stop a run at a frame")
def test_a_signal_leaves_a_valid_partial_result(vdo_folder) -> None:
    """SIGINT while frame 6 is awaited: its depth is a pipe that nothing comes out of."""
    from evo.tools import file_interface

    depth, output = vdo_folder / "depth/000006.png", vdo_folder.parent / "result"
    content = depth.read_bytes()
    depth.unlink()
    os.mkfifo(depth)
    with start_app("run", vdo_folder, "--output", output) as process:
        log, deadline = output / "run.log", time.monotonic() + 120
        while not (log.exists() and "frame 5 OK" in log.read_text()):
            assert process.poll() is None, process.communicate()
            assert time.monotonic() < deadline, "did not reach frame 5"
            time.sleep(0.01)
        process.send_signal(signal.SIGINT)
        time.sleep(0.2)
        with depth.open("wb") as pipe:  # lets the reading thread end
            pipe.write(content)
        out, error = process.communicate(timeout=120)
    assert process.returncode == 130, out + error
    assert "Traceback" not in out + error
    result = load_result(output)
    assert result.metrics["run"]["interrupted"] is True
    assert result.metrics["run"]["frames"] == 6
    assert file_interface.read_tum_trajectory_file(output / "camera_tum.txt").num_poses == 6
    assert len(file_interface.read_kitti_poses_file(output / "camera_kitti.txt").poses_se3) == 6
    assert len(result.static_points_m) > 100
    assert 1e-5 < camera_errors_m(result)[0] < 4e-3
