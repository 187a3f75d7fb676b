"""KITTI odometry's layout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.datasets.kitti_odometry import KittiOdometrySequence
from pipelines.errors import DatasetError

Write = Callable[[str], Path]


def test_stereo_pair_camera_and_times(write_tree: Write) -> None:
    sequence = KittiOdometrySequence.open(write_tree("kitti_odometry"))
    camera = sequence.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.bf) == (50, 51, 31, 23, 25)
    np.testing.assert_allclose(sequence.timestamps_s, 0.104 * np.arange(4))
    frame = sequence.read(1)
    assert frame.depth_m is None
    assert frame.image_right is not None
    assert not np.array_equal(frame.image, frame.image_right)


def test_colour_pair_stands_beside_camera_0(write_tree: Write) -> None:
    root = write_tree("kitti_odometry")
    for grey, colour in (("image_0", "image_2"), ("image_1", "image_3")):
        (root / grey).rename(root / colour)
    sequence = KittiOdometrySequence.open(root)
    assert sequence.camera.bf == pytest.approx(25.0)
    truth = sequence.ground_truth()
    assert truth is not None
    # P2 has 3 px m: its camera is 3 / fx to the left of camera 0.
    np.testing.assert_allclose(truth.Ts_world_camera[2, :3, 3], [-3 / 50, 0, 1.0], atol=1e-9)


def test_calibration_without_tags(write_tree: Write) -> None:
    root = write_tree("kitti_odometry")
    lines = (root / "calib.txt").read_text().splitlines()[:2]
    (root / "calib.txt").write_text("\n".join(line.split(":")[1].strip() for line in lines))
    assert KittiOdometrySequence.open(root).camera.bf == 25.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("P0: 1 2 3\n", r"line 1: expected the 12 numbers .* found 3"),
        ("P0: a b c\n", "found other text"),
        ("P2: 50 0 31 0 0 51 23 0 0 0 1 0\n", "expected P0 and P1, found P2"),
        ("", "found none"),
        ("P0: 50 0 900 0 0 51 23 0 0 0 1 0\nP1: 50 0 31 -25 0 51 23 0 0 0 1 0", "principal point"),
    ],
)
def test_wrong_calibration(write_tree: Write, text: str, message: str) -> None:
    root = write_tree("kitti_odometry")
    (root / "calib.txt").write_text(text)
    with pytest.raises(DatasetError, match=message):
        KittiOdometrySequence.open(root)


def test_one_camera_alone_is_not_enough(write_tree: Write) -> None:
    root = write_tree("kitti_odometry")
    (root / "image_1").rename(root / "depth_source")
    with pytest.raises(DatasetError, match="stereo is needed, but image_0/ comes without image_1/"):
        open_sequence(root)
    import cv2

    (root / "depth").mkdir()
    for k in range(4):
        values = np.full((48, 64), 5 * 256, np.uint16)
        assert cv2.imwrite(str(root / f"depth/{k:06d}.png"), values)
    np.testing.assert_allclose(open_sequence(root).read(0).depth_m, 5.0)


def test_fewer_poses_than_frames(write_tree: Write) -> None:
    root = write_tree("kitti_odometry")
    lines = (root / "poses.txt").read_text().splitlines()
    (root / "poses.txt").write_text("\n".join(lines[:3]))
    truth = KittiOdometrySequence.open(root).ground_truth()
    assert truth is not None
    assert np.isnan(truth.Ts_world_camera[3]).all()
    assert np.isfinite(truth.Ts_world_camera[:3]).all()


def test_real_odometry_06(real_data: Callable[[str], Path]) -> None:
    sequence = open_sequence(real_data("kitti_odom06_000-050_stereo"))
    assert (sequence.dataset, len(sequence)) == ("kitti_odometry", 51)
    assert sequence.camera.bf == pytest.approx(379.8145)
    assert 0.09 < np.median(np.diff(sequence.timestamps_s)) < 0.11
    frame = sequence.read(50)
    assert frame.image.shape == (370, 1226)
    assert frame.image_right is not None
    truth = sequence.ground_truth()
    assert truth is not None
    np.testing.assert_allclose(truth.Ts_world_camera[0], np.eye(4), atol=1e-6)
    path_m = np.linalg.norm(np.diff(truth.Ts_world_camera[:, :3, 3], axis=0), axis=1).sum()
    assert path_m == pytest.approx(59.9, abs=0.2)
