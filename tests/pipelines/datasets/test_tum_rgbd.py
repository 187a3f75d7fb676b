"""TUM RGB-D's layout: pairing by time, calibration, the scale of depth."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.datasets.tum_rgbd import TumRgbdSequence, find_depth_scale
from pipelines.errors import DatasetError

Write = Callable[[str], Path]


def resize_all(root: Path, size: tuple[int, int]) -> None:
    for path in root.glob("*/*.png"):
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(path), cv2.resize(pixels, size, interpolation=cv2.INTER_NEAREST))


def test_pairs_by_time_and_truth_between_its_stamps(write_tree: Write) -> None:
    sequence = TumRgbdSequence.open(write_tree("tum_rgbd"))
    assert len(sequence) == 4  # the fifth colour image has no depth within 0.02 s
    np.testing.assert_allclose(sequence.timestamps_s, 100 + np.arange(4) / 30, atol=1e-6)
    depth = sequence.read(1).depth_m
    assert depth is not None
    assert depth[20, 30] == pytest.approx(4.0 + 0.6 + 0.2 + 0.1, rel=1e-3)
    truth = sequence.ground_truth()
    assert truth is not None
    # Truth stamps are 3 ms early: 0.09 of a step is added to each.
    np.testing.assert_allclose(
        truth.Ts_world_camera[:, 2, 3], 0.5 * (np.arange(4) + 0.09), atol=1e-4
    )


def test_associations_file(write_tree: Write) -> None:
    root = write_tree("tum_rgbd")
    colours, depths = sorted((root / "rgb").iterdir()), sorted((root / "depth").iterdir())
    rows = [f"{k} rgb/{colours[k].name} {k} depth/{depths[k].name}" for k in (2, 0, 1)]
    (root / "associations.txt").write_text("\n".join(rows))
    sequence = TumRgbdSequence.open(root)
    np.testing.assert_array_equal(sequence.timestamps_s, [0, 1, 2])
    np.testing.assert_array_equal(sequence.read(2).image, cv2.imread(str(colours[2]))[..., ::-1])
    (root / "associations.txt").write_text("0.0 rgb/a.png\n")
    with pytest.raises(DatasetError, match="line 1: expected time file time file"):
        TumRgbdSequence.open(root)


@pytest.mark.parametrize(
    ("name", "fx"),
    [
        ("rgbd_dataset_freiburg1_desk", 517.306408),
        ("rgbd_dataset_freiburg3_walking_xyz", 535.433105),
        ("rgbd_bonn_balloon", 542.822841),
    ],
)
def test_published_calibrations(write_tree: Write, name: str, fx: float) -> None:
    root = write_tree("tum_rgbd")
    (root / "camera.yaml").unlink()
    resize_all(root, (640, 480))
    with pytest.raises(DatasetError, match=r"missing calibration.*Add camera\.yaml with"):
        TumRgbdSequence.open(root)
    sequence = TumRgbdSequence.open(root.rename(root.with_name(name)))
    assert (sequence.camera.fx, sequence.camera.bf) == (fx, 40.0)


def test_calibration_as_a_matrix(write_tree: Write) -> None:
    root = write_tree("tum_rgbd")
    (root / "camera.yaml").unlink()
    (root / "camera-intrinsics_color.txt").write_text("55 0 32\n0 56 24\n0 0 1\n")
    camera = TumRgbdSequence.open(root, bf=20.0).camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy, camera.bf) == (55, 56, 32, 24, 20)
    (root / "camera-intrinsics_color.txt").write_text("55 0 32\n")
    with pytest.raises(DatasetError, match="expected a 3 x 3 matrix"):
        TumRgbdSequence.open(root)


@pytest.mark.parametrize(("metres", "factor"), [(9.5, 1000), (2.6, 1000), (2.6, 5000), (6.0, 5000)])
def test_scale_of_depth_by_its_farthest_readings(
    tmp_path: Path, metres: float, factor: int
) -> None:
    depth = np.linspace(0.6, metres, 48 * 64).reshape(48, 64) * factor
    depth[0], depth[1] = 0, 65535  # both say: no reading
    path = tmp_path / "0.png"
    assert cv2.imwrite(str(path), depth.astype(np.uint16))
    assert find_depth_scale(tmp_path, [path]) == factor


def test_scale_of_tums_own_folders_and_by_option(write_tree: Write) -> None:
    root = write_tree("tum_rgbd")
    assert find_depth_scale(root, []) == 5000
    one = TumRgbdSequence.open(root).read(0).depth_m
    other = TumRgbdSequence.open(root, depth_scale=2500.0).read(0).depth_m
    assert one is not None
    np.testing.assert_allclose(other, 2 * one, rtol=1e-6)


def test_lists_that_name_no_pair(write_tree: Write) -> None:
    root = write_tree("tum_rgbd")
    (root / "depth.txt").write_text("900.0 depth/x.png\n")
    with pytest.raises(DatasetError, match="no pairs of colour and depth"):
        TumRgbdSequence.open(root)


def test_real_redkitchen(real_data: Callable[[str], Path]) -> None:
    sequence = open_sequence(real_data("7scenes_redkitchen_200f"))
    assert (sequence.dataset, len(sequence)) == ("tum_rgbd", 200)
    camera = sequence.camera
    assert (camera.fx, camera.cx, camera.cy, camera.bf) == (525, 320, 240, 40)
    frame = sequence.read(100)
    assert frame.image.shape == (480, 640, 3)
    assert frame.depth_m is not None
    assert 1.0 < np.nanmedian(frame.depth_m) < 3.0  # a kitchen, in metres
    assert 0.6 < np.isfinite(frame.depth_m).mean() < 0.85
    truth = sequence.ground_truth()
    assert truth is not None
    first = truth.Ts_world_camera[0, :3, 3]
    np.testing.assert_allclose(first, [-0.3165422, 0.0093614, 0.3024787], atol=1e-7)
    assert np.isfinite(truth.Ts_world_camera).all()
