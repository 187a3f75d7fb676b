"""Short stretches of the real sequences: all frames tracked, errors within about twice what we had.

The lower bounds stand for the noise of these sequences' truth, which nobody can be better than.
The bars of whole sequences are the business of `python -m app bench` and `eval`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.geometry import invert_T, rotation_angle_deg
from pipelines.runner import run
from tests.pipelines.result_files import estimates

KITCHEN = {  # RGB-D of a Kinect at 6 frames a second
    "rpe_trans_rmse_m": (0.002, 0.022),
    "rpe_rot_rmse_deg": (0.1, 1.0),
    "ate_rmse_m": (0.002, 0.06),
    "step_length_ratio": (0.9, 1.1),
}
STREET = {  # grey stereo pairs: depth is the project's own
    "rpe_trans_rmse_m": (0.002, 0.021),
    "rpe_rot_rmse_deg": (0.01, 0.2),
    "ate_rmse_m": (0.002, 0.04),
    "step_length_ratio": (0.99, 1.01),
}


@pytest.mark.parametrize(
    ("name", "frames", "bars"),
    [("7scenes_redkitchen_200f", 40, KITCHEN), ("kitti_odom06_000-050_stereo", 15, STREET)],
)
def test_a_short_stretch_is_tracked_within_the_bars(
    name: str, frames: int, bars: dict[str, tuple[float, float]], real_data, tmp_path
) -> None:
    result = run(open_sequence(real_data(name)), output=tmp_path / "result", frames=frames)
    counts, found = result.metrics["run"], result.metrics["camera"]
    assert counts["tracked"] == counts["frames"] == found["frames_matched"] == frames
    assert counts["map_points"] > 500
    for error, (low, high) in bars.items():
        assert low < found[error] < high, error


class PointsOnObjects:
    """A sink that counts measured points inside the masks."""

    def __init__(self) -> None:
        self.inside = self.n_points = self.n_masked = 0

    def start(self, *_: Any) -> None: ...

    def frame(self, frame: Any, result: Any) -> None:
        x, y = np.rint(result.keypoints_px).astype(int).T
        self.inside += int((frame.instance_labels[y, x] > 0).sum())
        self.n_points += len(x)
        self.n_masked += int((frame.instance_labels > 0).sum())

    def finish(self) -> None: ...


def test_overtaking_car_that_is_masked(real_data, tmp_path) -> None:
    """Masks, flow and disparity of files. Its truth jitters by 6 cm, so the mean step counts."""
    folder = real_data("kitti_tracking_0003_vdo_format_10f")
    watch = PointsOnObjects()
    result = run(open_sequence(folder), output=tmp_path / "result", sinks=[watch])
    assert result.metrics["run"]["tracked"] == 10
    found = result.metrics["camera"]
    assert 0.975 < found["step_length_ratio"] < 1.025
    assert 0.02 < found["rpe_trans_rmse_m"] < 0.12
    assert 0.005 < found["rpe_rot_rmse_deg"] < 0.12
    assert watch.n_masked > 0
    assert watch.n_points > 1000
    assert watch.inside == 0


def test_own_data_in_a_folder(real_data, tmp_path) -> None:
    """Five frames of Redwood with a camera.yaml, as a user would bring them."""
    source, folder = real_data("redwood_open3d_5f"), tmp_path / "own"
    folder.mkdir()
    for name in ("color", "depth"):
        (folder / name).symlink_to(source / name, target_is_directory=True)
    intrinsics = json.loads((source / "camera_primesense.json").read_text())
    fx, _, _, _, fy, _, cx, cy, _ = intrinsics["intrinsic_matrix"]
    (folder / "camera.yaml").write_text(
        f"fx: {fx}\nfy: {fy}\ncx: {cx}\ncy: {cy}\nfps: 30\ndepth_scale: 1000\n"
    )
    result = run(open_sequence(folder), output=tmp_path / "result")
    assert result.metrics["run"]["tracked"] == 5
    E = invert_T(invert_T(result.Ts_world_camera[0]) @ result.Ts_world_camera[-1])
    E = E @ invert_T(_redwood_T(source, 0)) @ _redwood_T(source, 4)
    assert 1e-5 < np.linalg.norm(E[:3, 3]) < 0.02
    assert 1e-3 < rotation_angle_deg(E) < 0.6


def _redwood_T(source: Path, index: int) -> np.ndarray:
    """Camera-to-world pose `index` of a .log trajectory: a line of numbers, then 4 x 4."""
    lines = (source / "trajectory.log").read_text().splitlines()
    return np.array([[float(x) for x in line.split()] for line in lines[5 * index + 1 :][:4]])


@pytest.mark.parametrize(
    ("name", "truth", "n_objects"),
    [
        ("kitti_odom06_000-050_stereo", {"poses.txt"}, 0),
        ("kitti_tracking_0003_vdo_format_10f", {"pose_gt.txt", "object_pose.txt"}, 5),
    ],
)
def test_truth_of_real_data_changes_no_byte(
    name: str, truth: set[str], n_objects: int, real_data, tmp_path
) -> None:
    blind = tmp_path / name
    blind.mkdir()
    assert truth <= {entry.name for entry in real_data(name).iterdir()}
    for entry in real_data(name).iterdir():
        if entry.name not in truth:
            (blind / entry.name).symlink_to(entry, target_is_directory=entry.is_dir())
    with_truth = run(open_sequence(real_data(name)), output=tmp_path / "with", frames=5)
    without = run(open_sequence(blind), output=tmp_path / "without", frames=5)
    assert "camera" in with_truth.metrics
    assert "camera" not in without.metrics
    assert len(without.objects) >= n_objects
    assert estimates(with_truth.folder) == estimates(without.folder)
