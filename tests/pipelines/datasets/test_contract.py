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

FROM_FOLDERS = ["vdo", "kitti_odometry", "tum_rgbd", "folder"]
TRUTH_FILES = ("pose_gt.txt", "object_pose.txt", "poses.txt", "groundtruth.txt")
Write = Callable[[str], Path]


def same(a: Frame, b: Frame) -> bool:
    """Whether two frames are equal in every field, NaN equal to NaN."""
    for field in fields(Frame):
        one, other = getattr(a, field.name), getattr(b, field.name)
        if (one is None) != (other is None):
            return False
        if one is not None and not np.array_equal(one, other, equal_nan=np.ndim(one) > 0):
            return False
    return True


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
    assert sequence.name == f"{dataset}_tree"
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
    np.testing.assert_allclose(np.diff(Ts[:, 2, 3]), 0.5, atol=1e-5)


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
    folder = next(root / name for name in ("image_0", "rgb", "images") if (root / name).is_dir())
    damaged = sorted(folder.iterdir())[0]
    damaged.write_bytes(damaged.read_bytes()[:50])
    sequence = open_sequence(root)
    with pytest.raises(FrameError, match="cannot be decoded") as error:
        sequence.read(0)
    assert damaged.name in str(error.value)
    assert sequence.read(1).index == 1


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_image_of_wrong_size_fails_its_frame_alone(dataset: str, write_tree: Write) -> None:
    root = write_tree(dataset)
    folder = next(root / name for name in ("image_0", "rgb", "images") if (root / name).is_dir())
    wrong = sorted(folder.iterdir())[1]
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
    folder = root / ("image_1" if dataset == "kitti_odometry" else "depth")
    lost, damaged = sorted(folder.iterdir())[1:3]
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
    files = {"vdo": "settings.yaml", "kitti_odometry": "calib.txt"}
    (root / files.get(dataset, "camera.yaml")).unlink()
    with pytest.raises(DatasetError, match=r"missing calibration.*Expected: .*Found: "):
        open_sequence(root)


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_missing_images_say_what_tree_was_expected(dataset: str, write_tree: Write) -> None:
    root = write_tree(dataset)
    for name in ("image_0", "image_1", "rgb", "images"):
        shutil.rmtree(root / name, ignore_errors=True)
    with pytest.raises(DatasetError, match=r"no images.*Expected: .*Found: "):
        open_sequence(root, dataset)


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_unknown_option_names_the_known(dataset: str, write_tree: Write) -> None:
    with pytest.raises(DatasetError, match="unknown option 'depth_scal'"):
        open_sequence(write_tree(dataset), depth_scal=3.0)


@pytest.mark.parametrize("dataset", FROM_FOLDERS)
def test_black_images_and_empty_depth_are_frames_too(dataset: str, write_tree: Write) -> None:
    root = write_tree(dataset)
    for name in ("image_0", "image_1", "rgb", "images", "depth"):
        for path in sorted((root / name).glob("*.png")):
            pixels = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
            assert cv2.imwrite(str(path), np.zeros_like(pixels))
    frame = open_sequence(root).read(1)
    assert not frame.image.any()
    if frame.depth_m is not None:
        assert np.isnan(frame.depth_m).all()
