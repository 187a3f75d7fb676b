"""Oxford Multimotion Dataset: two clocks, three calibrations, two cameras."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.datasets import matching_datasets, open_sequence
from pipelines.errors import DatasetError

Write = Callable[[str], Path]


def test_colour_and_depth_go_by_number_and_clock(write_tree: Write) -> None:
    sequence = open_sequence(write_tree("omd"))
    assert sequence.camera.is_rgbd
    assert (sequence.camera.fx, sequence.camera.cy) == (50.0, 23.0)
    np.testing.assert_allclose(np.diff(sequence.timestamps_s), 0.033, atol=1e-6)
    frame = sequence.read(2)
    assert frame.depth_m is not None
    assert frame.depth_m[20, 30] == pytest.approx(4.0 + 0.6 + 0.2 + 0.2, abs=0.001)
    assert np.isnan(frame.depth_m[0, 0])


def test_the_camera_sits_on_the_rig_by_all_three_calibrations(write_tree: Write) -> None:
    truth = open_sequence(write_tree("omd")).ground_truth()
    assert truth is not None
    T = truth.Ts_world_camera[0]
    # The left camera is 0.1 m above the rig; cam2 is 0.12 to its right and 0.05 back to the left.
    np.testing.assert_allclose(T[:3, 3], [0.12 - 0.05, 0, 1.1], atol=1e-9)
    np.testing.assert_allclose(T[:3, 2], [0, 1, 0], atol=1e-9)  # it looks along y
    np.testing.assert_allclose(T[:3, 1], [0, 0, -1], atol=1e-9)


def test_objects_are_vicons_at_the_times_of_the_images(write_tree: Write) -> None:
    truth = open_sequence(write_tree("omd")).ground_truth()
    assert truth is not None
    objects = truth.objects
    assert objects is not None
    assert objects.object_id.tolist() == [3, 7] * 4
    assert set(objects.class_name.tolist()) == {"box"}
    assert objects.moving.tolist() == [True, False] * 4
    assert np.isnan(objects.boxes_px).all()
    # Images lie between Vicon's ticks of 5 ms, and are not snapped to them.
    moved = np.diff(objects.Ts_world_object[objects.object_id == 3, 1, 3])
    np.testing.assert_allclose(moved, 0.8, atol=1e-5)
    box7 = objects.Ts_world_object[objects.object_id == 7]
    np.testing.assert_allclose(box7[0, :2, 0], [0.28, 0.96], atol=1e-9)  # 2 atan(0.6 / 0.8) about z


def test_the_offset_of_the_clocks_can_be_stated(write_tree: Write) -> None:
    root = write_tree("omd")
    plain, late = (
        open_sequence(root, vicon_offset_s=offset_s).ground_truth() for offset_s in (0.0, 0.0033)
    )
    assert plain is not None
    assert late is not None
    shift = late.Ts_world_camera[:3, 1, 3] - plain.Ts_world_camera[:3, 1, 3]
    np.testing.assert_allclose(shift, 0.05, atol=1e-4)
    np.testing.assert_array_equal(late.timestamps_s, plain.timestamps_s)


def test_no_truth_without_the_calibration_of_the_rig(
    write_tree: Write, caplog: pytest.LogCaptureFixture
) -> None:
    root = write_tree("omd")
    (root / "vicon.yaml").unlink()
    assert open_sequence(root).ground_truth() is None
    assert "no vicon.yaml" in caplog.text


def test_calibration_may_lie_one_folder_up_with_its_date(write_tree: Write) -> None:
    root = write_tree("omd")
    for name in ("kalibr", "manufacturer", "vicon"):
        (root / f"{name}.yaml").rename(root.parent / f"{name}_2019_06_14.yaml")
    sequence = open_sequence(root)
    assert sequence.camera.fx == 50.0
    assert sequence.ground_truth() is not None


def test_masks_and_flow_beside_it(write_tree: Write) -> None:
    root = write_tree("omd")
    for name in ("optical_flow", "instance_masks"):
        (root / name).mkdir()
    for k in range(4):
        labels = np.full((48, 64), k, np.uint8)
        assert cv2.imwrite(str(root / f"instance_masks/{k:06d}.png"), labels)
        flow = np.full((48, 64, 2), k, np.float32)
        cv2.writeOpticalFlow(str(root / f"optical_flow/{k:06d}.flo"), flow)
    frame = open_sequence(root).read(3)
    assert frame.instance_labels is not None
    assert frame.instance_labels[0, 0] == 3
    assert frame.flow_prev_to_curr_px is not None
    assert frame.flow_prev_to_curr_px[0, 0, 0] == 2.0  # from 000002.flo


def make_stereo(root: Path, tilt: str = "1") -> None:
    (root / "rgbd").rename(root / "stereo")
    for path in sorted((root / "stereo").iterdir()):
        name = path.name.replace("color", "left").replace("aligned_depth", "right")
        path.rename(path.with_name(name.replace("rgbd", "stereo")))
    for path in (root / "stereo").glob("*_right.png"):
        shutil.copy(path.with_name(path.name.replace("right", "left")), path)
    text = (root / "kalibr.yaml").read_text()
    text = text.replace("1280, 960", "64, 48").replace("900, 900, 640, 480", "50, 50, 31, 23")
    (root / "kalibr.yaml").write_text(text.replace("[0, 1, 0, 0]", f"[0, {tilt}, 0, 0]", 1))
    (root / "stereo/stereo.csv").rename(root / "stereo.csv")


def test_a_rectified_stereo_pair(write_tree: Write) -> None:
    root = write_tree("omd")
    make_stereo(root)
    assert matching_datasets(root) == ["omd"]
    sequence = open_sequence(root)
    assert sequence.camera.baseline_m == pytest.approx(0.12)
    assert not sequence.camera.is_rgbd
    np.testing.assert_allclose(np.diff(sequence.timestamps_s), 0.033, atol=1e-6)
    assert sequence.read(1).image_right is not None
    truth = sequence.ground_truth()
    assert truth is not None
    np.testing.assert_allclose(truth.Ts_world_camera[0, :3, 3], [0, 0, 1.1], atol=1e-9)


def test_a_pair_that_is_not_rectified_is_refused(write_tree: Write) -> None:
    root = write_tree("omd")
    make_stereo(root)
    text = (root / "kalibr.yaml").read_text()
    (root / "kalibr.yaml").write_text(text.replace("[0, 0, 0, 0]", "[-0.3, 0, 0, 0]", 1))
    with pytest.raises(DatasetError, match=r"expected a rectified pair, found .* lens distortion"):
        open_sequence(root)


def test_damaged_lists_name_their_line(write_tree: Write) -> None:
    root = write_tree("omd")
    with (root / "vicon.csv").open("a") as file:
        file.write("1,2,box3,0,0\n")
    with pytest.raises(DatasetError, match=r"vicon\.csv, line 83: expected time_sec"):
        open_sequence(root).ground_truth()
    (root / "rgbd/rgbd.csv").write_text("frame_num,time_sec,time_nsec\n0,1\n")
    with pytest.raises(DatasetError, match=r"rgbd\.csv, line 2: expected number, time_sec"):
        open_sequence(root)


def test_without_the_list_times_are_the_cameras_rate(
    write_tree: Write, caplog: pytest.LogCaptureFixture
) -> None:
    root = write_tree("omd")
    (root / "rgbd/rgbd.csv").unlink()
    np.testing.assert_allclose(open_sequence(root).timestamps_s, np.arange(4) / 30)
    assert "no rgbd.csv" in caplog.text
