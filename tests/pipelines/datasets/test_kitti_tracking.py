"""KITTI tracking: choosing a sequence, the chain of calibrations, oxts, and labels as truth.

Real labels and calibration of all 21 sequences serve where they are at hand.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.datasets.kitti_labels import read_label_rows
from pipelines.datasets.kitti_tracking import KittiTrackingSequence
from pipelines.datasets.oxts import poses_of_oxts
from pipelines.errors import DatasetError
from pipelines.geometry import invert_T, transform_points

Write = Callable[[str], Path]


def add_sequence(root: Path, name: str) -> None:
    for folder in ("image_02", "image_03"):
        shutil.copytree(root / folder / "0003", root / folder / name)
    shutil.copy(root / "calib/0003.txt", root / f"calib/{name}.txt")


def test_one_sequence_needs_no_name_and_several_do(write_tree: Write) -> None:
    root = write_tree("kitti_tracking")
    assert open_sequence(root).name == "0003"
    add_sequence(root, "0011")
    with pytest.raises(DatasetError, match=r"--sequence to choose, found 0003, 0011; name one"):
        open_sequence(root)
    assert open_sequence(root, name="0011").name == "0011"
    assert open_sequence(root, name="3").name == "0003"
    with pytest.raises(DatasetError, match="expected sequence '0012', found 0003, 0011"):
        open_sequence(root, name="0012")
    by_path = open_sequence(root / "image_02/0011")
    assert (by_path.name, by_path.dataset, by_path.root) == ("0011", "kitti_tracking", root)


def test_camera_is_the_left_colour_one(write_tree: Write) -> None:
    sequence = open_sequence(write_tree("kitti_tracking"))
    assert (sequence.camera.bf, sequence.camera.is_rgbd) == (25.0, False)
    np.testing.assert_allclose(sequence.timestamps_s, [0.0, 0.1, 0.2, 0.3])
    truth = sequence.ground_truth()
    assert truth is not None
    # P2's fourth column of 3 px * m puts the left colour camera 6 cm to the left of camera 0.
    np.testing.assert_allclose(truth.Ts_world_camera[0, :3, 3], [-3.0 / 50.0, 0, 0], atol=1e-9)


def test_objects_are_in_the_world_by_the_centre_of_their_box(write_tree: Write) -> None:
    truth = open_sequence(write_tree("kitti_tracking")).ground_truth()
    assert truth is not None
    objects = truth.objects
    assert objects is not None
    assert objects.class_name.tolist() == ["car", "person"] * 4  # DontCare is no object
    assert objects.object_id.tolist() == [1, 12] * 4
    assert objects.moving.tolist() == [True, False] * 4
    # The car 10 m ahead gains 0.3 m a frame on a camera that drives 0.5 m a frame.
    car = objects.Ts_world_object[objects.object_id == 1]
    np.testing.assert_allclose(np.diff(car[:, 2, 3]), 0.8, atol=1e-5)
    np.testing.assert_allclose(car[0, :3, 3], [1.0, 1.5 - 1.4 / 2, 10.0], atol=1e-5)
    np.testing.assert_allclose(car[0, :3, 0], [0, 0, 1], atol=1e-9)  # its length points ahead
    person = objects.Ts_world_object[objects.object_id == 12]
    np.testing.assert_allclose(person[:, :3, 3] - person[0, :3, 3], 0, atol=1e-5)
    np.testing.assert_array_equal(objects.boxes_px[2], [21, 10, 32, 19])


def test_labels_without_ego_poses_are_no_truth(
    write_tree: Write, caplog: pytest.LogCaptureFixture
) -> None:
    root = write_tree("kitti_tracking")
    (root / "oxts/0003.txt").unlink()
    assert open_sequence(root).ground_truth() is None
    assert "no ego poses" in caplog.text


@pytest.mark.parametrize("pose_camera", [0, 2])
def test_pose_files_take_the_place_of_oxts(
    write_tree: Write, tmp_path: Path, pose_camera: int
) -> None:
    root = write_tree("kitti_tracking")
    (root / "oxts/0003.txt").unlink()
    rows = np.tile(np.eye(4)[:3].ravel(), (4, 1))
    rows[:, 11] = 0.5 * np.arange(4)
    np.savetxt(tmp_path / "any.txt", rows)
    truth = KittiTrackingSequence.open(
        root, poses=tmp_path / "any.txt", pose_camera=pose_camera
    ).ground_truth()
    assert truth is not None
    x_m = -0.06 if pose_camera == 0 else 0.0
    np.testing.assert_allclose(truth.Ts_world_camera[3, :3, 3], [x_m, 0, 1.5], atol=1e-9)
    numbered = np.column_stack([np.arange(4), rows, np.tile([0, 0, 0, 1], (4, 1))])
    (root / "poses").mkdir()
    np.savetxt(root / "poses/0003.txt", numbered)
    found = open_sequence(root).ground_truth()
    assert found is not None
    np.testing.assert_allclose(found.Ts_world_camera[3, :3, 3], [-0.06, 0, 1.5], atol=1e-9)


def test_both_spellings_of_the_calibration_are_read(write_tree: Write) -> None:
    root = write_tree("kitti_tracking")
    truth = open_sequence(root).ground_truth()
    text = (root / "calib/0003.txt").read_text()
    spelt = {"R_rect ": "R0_rect: ", "Tr_velo_cam ": "Tr_velo_to_cam: "}
    for one, other in (spelt | {"Tr_imu_velo ": "Tr_imu_to_velo: "}).items():
        assert one in text
        text = text.replace(one, other)
    (root / "calib/0003.txt").write_text(text)
    again = open_sequence(root).ground_truth()
    assert truth is not None
    assert again is not None
    np.testing.assert_array_equal(truth.Ts_world_camera, again.Ts_world_camera)
    (root / "calib/0003.txt").write_text(text.replace("Tr_velo_to_cam", "Tr_other"))
    with pytest.raises(DatasetError, match="Tr_velo_cam or Tr_velo_to_cam, found none"):
        open_sequence(root).ground_truth()


def test_a_damaged_label_names_its_line(write_tree: Write) -> None:
    root = write_tree("kitti_tracking")
    with (root / "label_02/0003.txt").open("a") as file:
        file.write("3 1 Car 0 0\n")
    with pytest.raises(DatasetError, match=r"0003\.txt, line 13: expected frame, track, type"):
        open_sequence(root).ground_truth()


def test_oxts_agrees_with_a_walk_on_the_earth() -> None:
    """Independent of Mercator: metres along a meridian and a parallel of a sphere."""
    radius_m, latitude = 6378137.0, np.radians(49.0)
    north_m, east_m = 120.0, -80.0
    rows = np.zeros((2, 30))
    rows[:, 0] = 49.0, 49.0 + np.degrees(north_m / radius_m)
    rows[:, 1] = 8.4, 8.4 + np.degrees(east_m / (radius_m * np.cos(latitude)))
    rows[:, 2] = 110.0, 113.0
    roll, pitch, yaw = 0.1, -0.2, 0.7
    rows[1, 3:6] = roll, pitch, yaw
    Ts = poses_of_oxts(rows)
    walked = Ts[1, :3, 3] - Ts[0, :3, 3]
    np.testing.assert_allclose(walked, [east_m, north_m, 3.0], atol=5e-3)
    assert np.linalg.norm(walked - [east_m, north_m, 3.0]) > 1e-9  # a plane is no sphere
    x_axis = np.array([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), -np.sin(pitch)])
    np.testing.assert_allclose(Ts[1, :3, 0], x_axis, atol=1e-12)
    np.testing.assert_allclose(Ts[1, 2, 1], np.cos(pitch) * np.sin(roll), atol=1e-12)
    np.testing.assert_array_equal(Ts[0, :3, :3], np.eye(3))


def test_oxts_rows_are_numbered_as_the_images(write_tree: Write) -> None:
    """Frames 1 and 3 alone take rows 1 and 3, not the first two."""
    root = write_tree("kitti_tracking")
    for folder in ("image_02", "image_03"):
        for number in (0, 2):
            (root / folder / f"0003/{number:06d}.png").unlink()
    truth = open_sequence(root).ground_truth()
    assert truth is not None
    np.testing.assert_allclose(truth.timestamps_s, [0.1, 0.3])
    np.testing.assert_allclose(np.diff(truth.Ts_world_camera[:, 2, 3]), 1.0, atol=1e-4)


def real_sequence(source: Path, root: Path, name: str) -> KittiTrackingSequence:
    """Real labels, calibration and ego poses of all frames; one real image stands for them all."""
    (image, *_) = sorted((source / "image_02_few_frames" / name).iterdir())
    poses = source / "orbslam3_poses" / name / "CameraTrajectory.txt"
    for folder in ("image_02", "image_03"):
        (root / folder / name).mkdir(parents=True)
        for k in range(len(poses.read_text().splitlines())):
            (root / folder / name / f"{k:06d}.png").symlink_to(image)
    for folder in ("calib", "label_02"):
        (root / folder).mkdir()
        shutil.copy(source / folder / f"{name}.txt", root / folder)
    return KittiTrackingSequence.open(root, poses=poses, pose_camera=2)


def corner_boxes(sequence, truth, rows: np.ndarray) -> np.ndarray:
    """Boxes (M, 4) px around the projected corners of all objects, by the truth's poses."""
    camera, boxes = sequence.camera, []
    for m in range(len(truth.objects)):
        height, width, length = rows[m, 9:12]
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
        corners = signs * [length / 2, height / 2, width / 2]
        T_world_camera = truth.Ts_world_camera[truth.objects.frame_index[m]]
        T = invert_T(T_world_camera) @ truth.objects.Ts_world_object[m]
        x, y, z = transform_points(T, corners).T
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        boxes.append([u.min(), v.min(), u.max(), v.max()])
    return np.array(boxes)


def iou(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    low, high = np.maximum(a[:, :2], b[:, :2]), np.minimum(a[:, 2:], b[:, 2:])
    shared = np.prod(np.clip(high - low, 0, None), axis=1)
    areas = [np.prod(box[:, 2:] - box[:, :2], axis=1) for box in (a, b)]
    return shared / (areas[0] + areas[1] - shared)


@pytest.mark.parametrize("name", ["0001", "0016"])
def test_real_boxes_project_onto_the_real_labels(real_data, tmp_path: Path, name: str) -> None:
    source = real_data("kitti_tracking_gt_all21")
    sequence = real_sequence(source, tmp_path, name)
    assert sequence.read(0).image.shape == (sequence.camera.height, sequence.camera.width, 3)
    truth = sequence.ground_truth()
    assert truth is not None
    assert truth.objects is not None
    types, rows = read_label_rows(source / f"label_02/{name}.txt")
    assert len(rows) == len(truth.objects)
    clear = (np.array(types) == "Car") & (rows[:, 2] == 0) & (rows[:, 3] == 0)
    assert clear.sum() > 100
    projected = corner_boxes(sequence, truth, rows)[clear]
    labelled = truth.objects.boxes_px[clear]
    overlap = iou(projected, labelled)
    assert 0.9 < np.median(overlap) < 0.9999
    # Camera 0 in place of the left colour camera would be 45 / z px off to one side.
    off_px = (projected[:, ::2].mean(1) - labelled[:, ::2].mean(1)) * rows[clear, 14]
    assert abs(np.median(off_px)) < 15.0
    # The bottom in place of the centre would be half a height off.
    down_px = projected[:, 1::2].mean(1) - labelled[:, 1::2].mean(1)
    heights_px = labelled[:, 3] - labelled[:, 1]
    assert abs(np.median(down_px / heights_px)) < 0.1


def test_real_labels_name_detector_classes(real_data, tmp_path: Path) -> None:
    truth = real_sequence(real_data("kitti_tracking_gt_all21"), tmp_path, "0016").ground_truth()
    assert truth is not None
    assert truth.objects is not None
    assert set(truth.objects.class_name.tolist()) == {"car", "person", "bicycle"}
