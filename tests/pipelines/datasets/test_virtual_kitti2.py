"""Virtual KITTI 2: its coding of depth, flow and masks, its options, its truth."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.datasets.virtual_kitti2 import VirtualKitti2Sequence
from pipelines.errors import DatasetError, FrameError

Write = Callable[[str], Path]


def test_depth_is_centimetres_and_the_sky_has_none(write_tree: Write) -> None:
    frame = open_sequence(write_tree("virtual_kitti2")).read(2)
    assert frame.depth_m is not None
    assert np.isnan(frame.depth_m[:4, :4]).all()
    assert frame.depth_m[20, 30] == pytest.approx(4.0 + 0.6 + 0.2 + 0.2, abs=0.0051)
    assert frame.image_right is None


def test_flow_comes_from_the_frame_before(write_tree: Write) -> None:
    sequence = open_sequence(write_tree("virtual_kitti2"))
    assert sequence.read(0).flow_prev_to_curr_px is None
    flow = sequence.read(3).flow_prev_to_curr_px  # of flow_00002.png: du = 3, dv = 0.25
    assert flow is not None
    assert flow.dtype == np.float32
    assert np.isnan(flow[0, 0]).all()
    np.testing.assert_allclose(flow[1:, :, 0], 3.0, atol=63 / 65535)
    np.testing.assert_allclose(flow[1:, :, 1], 0.25, atol=47 / 65535)


def test_a_gap_in_the_images_has_no_flow(write_tree: Write) -> None:
    root = write_tree("virtual_kitti2")
    (root / "frames/rgb/Camera_0/rgb_00001.jpg").unlink()
    sequence = open_sequence(root)
    np.testing.assert_allclose(sequence.timestamps_s, [0.0, 0.2, 0.3])
    assert sequence.read(1).flow_prev_to_curr_px is None
    assert sequence.read(2).flow_prev_to_curr_px is not None
    truth = sequence.ground_truth()
    assert truth is not None
    np.testing.assert_allclose(truth.Ts_world_camera[:, 2, 3], [0.0, 1.0, 1.5])


def test_flow_of_another_form_is_named(write_tree: Write) -> None:
    root = write_tree("virtual_kitti2")
    path = root / "frames/forwardFlow/Camera_0/flow_00000.png"
    cv2.imwrite(str(path), np.zeros((48, 64, 3), np.uint8))
    with pytest.raises(FrameError, match="expected a 16-bit image of three channels"):
        open_sequence(root).read(1)


def test_masks_name_their_classes(write_tree: Write) -> None:
    root = write_tree("virtual_kitti2")
    frame = open_sequence(root).read(1)
    assert frame.instance_labels is not None
    assert set(np.unique(frame.instance_labels)) == {0, 1, 12}
    assert (frame.instance_labels == 1).sum() == 120
    assert frame.instance_classes == {1: "car", 12: "truck"}
    (root / "info.txt").unlink()
    assert open_sequence(root).read(1).instance_classes is None


def test_stereo_in_place_of_depth(write_tree: Write) -> None:
    root = write_tree("virtual_kitti2")
    sequence = open_sequence(root, depth_source="stereo")
    frame = sequence.read(0)
    assert frame.depth_m is None
    assert frame.image_right is not None
    assert frame.image_right.shape == frame.image.shape
    assert sequence.camera.baseline_m == pytest.approx(0.532725)
    shutil.rmtree(root / "frames/depth")
    assert open_sequence(root).read(0).image_right is not None
    with pytest.raises(DatasetError, match="no such depth"):
        open_sequence(root, depth_source="files")
    with pytest.raises(DatasetError, match="depth_source: expected files or stereo"):
        open_sequence(root, depth_source="lidar")


def test_the_other_camera_has_its_own_truth(write_tree: Write) -> None:
    root = write_tree("virtual_kitti2")
    left, right = (open_sequence(root, camera=camera) for camera in (0, 1))
    assert not np.array_equal(left.read(0).image, right.read(0).image)
    truths = [sequence.ground_truth() for sequence in (left, right)]
    assert truths[0] is not None
    assert truths[1] is not None
    apart = truths[1].Ts_world_camera[:, :3, 3] - truths[0].Ts_world_camera[:, :3, 3]
    np.testing.assert_allclose(apart, [[0.5, 0, 0]] * 4, atol=1e-9)


def test_objects_have_the_labels_of_the_masks(write_tree: Write) -> None:
    truth = open_sequence(write_tree("virtual_kitti2")).ground_truth()
    assert truth is not None
    objects = truth.objects
    assert objects is not None
    assert objects.object_id.tolist() == [1, 12] * 4
    assert objects.class_name.tolist() == ["car", "truck"] * 4
    assert objects.moving.tolist() == [True, False] * 4
    np.testing.assert_array_equal(objects.boxes_px[2], [21, 10, 32, 19])
    # The centre is half a height (1.4 m) above the bottom, and y points down.
    np.testing.assert_allclose(objects.Ts_world_object[4, :3, 3], [1.0, 0.8, 11.6], atol=1e-9)
    np.testing.assert_allclose(objects.Ts_world_object[4, :3, 0], [0, 0, 1], atol=1e-9)


def test_scenes_and_variations_are_found(write_tree: Write, tmp_path: Path) -> None:
    tree = write_tree("virtual_kitti2")
    root = tmp_path / "vkitti2"
    for place in ("Scene01/clone", "Scene01/fog", "Scene20/15-deg-left"):
        shutil.copytree(tree, root / place)
    assert open_sequence(root / "Scene01").name == "Scene01_clone"
    assert open_sequence(root / "Scene01", variation="fog").name == "Scene01_fog"
    assert open_sequence(root / "Scene20").name == "Scene20_15-deg-left"
    assert open_sequence(root, name="Scene01").name == "Scene01_clone"
    assert open_sequence(root, name="Scene01/fog").name == "Scene01_fog"
    assert VirtualKitti2Sequence.matches(root)
    shutil.copytree(tree, root / "Scene02/clone")
    with pytest.raises(DatasetError, match=r"one sequence, found Scene01/clone, Scene02/clone;"):
        open_sequence(root)
    with pytest.raises(DatasetError, match="expected one sequence, found clone, fog"):
        open_sequence(root / "Scene01", variation="rain")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("intrinsic.txt", "expected 6 numbers"),
        ("info.txt", "expected trackID, label"),
        ("pose.txt", "expected 19 numbers"),
    ],
)
def test_a_damaged_table_names_its_line(write_tree: Write, name: str, message: str) -> None:
    root = write_tree("virtual_kitti2")
    with (root / name).open("a") as file:
        file.write("torn row\n")
    n_lines = len((root / name).read_text().splitlines())
    with pytest.raises(DatasetError, match=rf"{name}, line {n_lines}: {message}"):
        open_sequence(root).ground_truth()
