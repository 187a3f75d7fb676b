"""What every data set of the table promises, on a tiny sequence in its layout."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.datasets import DATASETS, load_dataset, matching_datasets, open_sequence
from pipelines.datasets.sequence import Sequence
from pipelines.errors import DatasetError, FrameError
from pipelines.types import Frame

# Data set: its images, and the depth or right images beside them.
FILES = {
    "vdo": ("image_0/*", "depth/*"),
    "kitti_odometry": ("image_0/*", "image_1/*"),
    "kitti_tracking": ("image_02/0003/*", "image_03/0003/*"),
    "virtual_kitti2": ("frames/rgb/Camera_0/*", "frames/depth/Camera_0/*"),
    "omd": ("rgbd/*_color.png", "rgbd/*_aligned_depth.png"),
    "tum_rgbd": ("rgb/*", "depth/*"),
    "folder": ("images/*", "depth/*"),
}
FROM_FOLDERS = list(FILES)
TRUTH_FILES = (
    *("pose_gt.txt", "object_pose.txt", "poses.txt", "groundtruth.txt", "vicon.csv"),
    *("oxts/0003.txt", "label_02/0003.txt", "extrinsic.txt", "pose.txt", "bbox.txt"),
)
CALIBRATIONS = {
    "vdo": ("settings.yaml",),
    "kitti_odometry": ("calib.txt",),
    "kitti_tracking": ("calib/0003.txt",),
    "virtual_kitti2": ("intrinsic.txt",),
    "omd": ("kalibr.yaml", "manufacturer.yaml"),
}
Write = Callable[[str], Path]


def images_of(dataset: str, root: Path) -> list[Path]:
    return sorted(root.glob(FILES[dataset][0]))


def partners_of(dataset: str, root: Path) -> list[Path]:
    return sorted(root.glob(FILES[dataset][1]))


def same(a: Frame, b: Frame) -> bool:
    """Whether two frames are equal in every field, NaN equal to NaN."""
    for field in fields(Frame):
        one, other = getattr(a, field.name), getattr(b, field.name)
        if (one is None) != (other is None):
            return False
        if isinstance(one, dict):
            if one != other:
                return False
        elif one is not None and not np.array_equal(one, other, equal_nan=np.ndim(one) > 0):
            return False
    return True


def test_every_layout_keeps_the_contract() -> None:
    assert set(DATASETS) - {"simulated", "video"} == set(FILES)


@pytest.mark.parametrize("dataset", DATASETS)
def test_class_says_what_it_expects(dataset: str) -> None:
    loaded = load_dataset(dataset)
    assert issubclass(loaded, Sequence)
    assert loaded.dataset == dataset
    assert len(loaded.layout) > 20
    assert "\n" not in loaded.layout


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_layout_is_guessed_without_doubt(dataset: str, write_tree: Write) -> None:
    assert matching_datasets(write_tree(dataset)) == [dataset]


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_frames_keep_the_contract(dataset: str, write_tree: Write) -> None:
    sequence = open_sequence(write_tree(dataset))
    assert len(sequence) == 4
    assert sequence.dataset == dataset
    assert sequence.name == ("0003" if dataset == "kitti_tracking" else f"{dataset}_tree")
    assert np.all(np.diff(sequence.timestamps_s) > 0)
    camera = sequence.camera
    for k in range(len(sequence)):
        frame = sequence.read(k)
        assert (frame.index, frame.timestamp_s) == (k, sequence.timestamps_s[k])
        assert frame.image.shape[:2] == (camera.height, camera.width)
        assert frame.depth_m is not None or frame.image_right is not None
        if frame.depth_m is not None:
            assert frame.depth_m.dtype == np.float32
            assert np.nanmin(frame.depth_m) > 0
        assert (frame.flow_prev_to_curr_px is None) or k > 0
    for outside in (-1, len(sequence)):
        with pytest.raises(IndexError):
            sequence.read(outside)


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_truth_has_one_pose_per_frame(dataset: str, write_tree: Write) -> None:
    sequence = open_sequence(write_tree(dataset))
    truth = sequence.ground_truth()
    assert truth is not None
    Ts = truth.Ts_world_camera
    assert Ts.shape == (len(sequence), 4, 4)
    np.testing.assert_array_equal(truth.timestamps_s, sequence.timestamps_s)
    ahead = (np.linalg.inv(Ts[:-1]) @ Ts[1:])[:, :3, 3]  # whatever the world
    np.testing.assert_allclose(ahead, [[0, 0, 0.5]] * 3, atol=1e-5)


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_deleted_truth_changes_no_frame(dataset: str, write_tree: Write) -> None:
    root = write_tree(dataset)
    bare = root.with_name("bare") / root.name
    shutil.copytree(root, bare)
    deleted = [name for name in TRUTH_FILES if (bare / name).exists()]
    assert deleted
    for name in deleted:
        (bare / name).unlink()
    with_truth, without = open_sequence(root), open_sequence(bare)
    assert without.dataset == dataset
    assert without.ground_truth() is None
    assert without.camera == with_truth.camera
    np.testing.assert_array_equal(without.timestamps_s, with_truth.timestamps_s)
    for k in range(len(with_truth)):
        assert same(with_truth.read(k), without.read(k))


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_damaged_truth_is_not_read_before_it_is_asked_for(dataset: str, write_tree: Write) -> None:
    root = write_tree(dataset)
    for name in TRUTH_FILES:
        if (root / name).exists():
            (root / name).write_text("this is no truth\n")
    sequence = open_sequence(root)
    assert sequence.read(1).index == 1
    with pytest.raises(DatasetError, match="expected"):
        sequence.ground_truth()


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_unreadable_image_fails_its_frame_alone(dataset: str, write_tree: Write) -> None:
    root = write_tree(dataset)
    damaged = images_of(dataset, root)[0]
    damaged.write_bytes(damaged.read_bytes()[:50])
    sequence = open_sequence(root)
    with pytest.raises(FrameError, match="cannot be decoded") as error:
        sequence.read(0)
    assert damaged.name in str(error.value)
    assert sequence.read(1).index == 1


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_image_of_wrong_size_fails_its_frame_alone(dataset: str, write_tree: Write) -> None:
    root = write_tree(dataset)
    wrong = images_of(dataset, root)[1]
    assert cv2.imwrite(str(wrong), np.zeros((20, 30, 3), np.uint8))
    sequence = open_sequence(root)
    with pytest.raises(FrameError, match=r"expected image of 64 x 48.*found 30 x 20"):
        sequence.read(1)
    assert sequence.read(2).index == 2


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_missing_depth_or_right_image_of_one_frame(
    dataset: str, write_tree: Write, caplog: pytest.LogCaptureFixture
) -> None:
    root = write_tree(dataset)
    lost, damaged = partners_of(dataset, root)[1:3]
    lost.unlink()
    damaged.write_bytes(b"not an image")
    sequence = open_sequence(root)
    caplog.clear()
    for k, path in ((1, lost), (2, damaged)):
        frame = sequence.read(k)
        assert frame.depth_m is None
        assert frame.image_right is None
        assert f"frame {k} " in caplog.messages[-1]
        assert path.name in caplog.messages[-1]
    last = sequence.read(3)
    assert last.depth_m is not None or last.image_right is not None


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_missing_calibration_says_what_to_add(dataset: str, write_tree: Write) -> None:
    root = write_tree(dataset)
    for name in CALIBRATIONS.get(dataset, ("camera.yaml",)):
        (root / name).unlink()
    with pytest.raises(DatasetError, match=r"missing calibration.*Expected: .*Found: "):
        open_sequence(root)


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_missing_images_say_what_tree_was_expected(dataset: str, write_tree: Write) -> None:
    root = write_tree(dataset)
    for path in {*images_of(dataset, root), *root.glob("image_1/*"), *root.glob("image_03/*/*")}:
        path.unlink()
    with pytest.raises(DatasetError, match=r"no images.*Expected: .*Found: "):
        open_sequence(root, dataset)


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_unknown_option_names_the_known(dataset: str, write_tree: Write) -> None:
    with pytest.raises(DatasetError, match="unknown option 'depth_scal'"):
        open_sequence(write_tree(dataset), depth_scal=3.0)


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_black_images_and_empty_depth_are_frames_too(dataset: str, write_tree: Write) -> None:
    root = write_tree(dataset)
    for path in images_of(dataset, root) + partners_of(dataset, root):
        pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert cv2.imwrite(str(path), np.zeros_like(pixels))
    frame = open_sequence(root).read(1)
    assert not frame.image.any()
    if frame.depth_m is not None:
        assert np.isnan(frame.depth_m).all()
