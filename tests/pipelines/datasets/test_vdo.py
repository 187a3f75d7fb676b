"""VDO-SLAM's layout: what its files mean, and what its settings leave unsaid."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.datasets.vdo import VdoSequence
from pipelines.errors import DatasetError
from pipelines.types import ObjectTruth

Write = Callable[[str], Path]
WIDTH, HEIGHT, BF = 64, 48, 25.0


def write_settings(root: Path, **changes: float | None) -> None:
    """The tree's settings with keys changed, or left out where None."""
    lines = (root / "settings.yaml").read_text().splitlines()
    kept = [line for line in lines if line.split(":")[0].split(".")[-1] not in changes]
    prefix = {"fps": "Camera.", "bf": "Camera.", "width": "Camera."}
    added = [f"{prefix.get(k, '')}{k}: {v}" for k, v in changes.items() if v is not None]
    (root / "settings.yaml").write_text("\n".join([*kept, *added]) + "\n")


def objects_of(sequence: VdoSequence) -> ObjectTruth:
    truth = sequence.ground_truth()
    assert truth is not None
    assert truth.objects is not None
    return truth.objects


def test_camera_and_depth_follow_the_settings(write_tree: Write) -> None:
    sequence = VdoSequence.open(write_tree("vdo"))
    camera = sequence.camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (50.0, 51.0, 31.0, 23.0)
    assert (camera.width, camera.height, camera.bf) == (WIDTH, HEIGHT, BF)
    depth = sequence.read(2).depth_m
    assert depth is not None
    assert np.isnan(depth[:4, :4]).all()
    v, u = np.mgrid[4:HEIGHT, 4:WIDTH]
    np.testing.assert_allclose(depth[4:, 4:], 4.2 + 0.02 * u + 0.01 * v, rtol=5e-4)


def test_flow_of_a_frame_is_the_file_before_it(write_tree: Write) -> None:
    sequence = VdoSequence.open(write_tree("vdo"))
    assert sequence.read(0).flow_prev_to_curr_px is None
    flow = sequence.read(2).flow_prev_to_curr_px
    assert flow is not None
    assert np.all(flow == [2.0, 0.25])  # flow/000001.flo


def test_masks_are_text_or_images(write_tree: Write) -> None:
    root = write_tree("vdo")
    as_text = VdoSequence.open(root).read(1).instance_labels
    for path in sorted((root / "semantic").glob("*.txt")):
        cv2.imwrite(str(path.with_suffix(".png")), np.loadtxt(path).astype(np.uint8))
        path.unlink()
    as_image = VdoSequence.open(root).read(1).instance_labels
    assert as_text is not None
    assert as_image is not None
    assert set(np.unique(as_text)) == {0, 1, 12}
    np.testing.assert_array_equal(as_text, as_image)


def test_missing_mask_and_flow_of_one_frame(
    write_tree: Write, caplog: pytest.LogCaptureFixture
) -> None:
    root = write_tree("vdo")
    (root / "semantic/000002.txt").unlink()
    (root / "flow/000001.flo").unlink()
    frame = VdoSequence.open(root).read(2)
    assert frame.instance_labels is None
    assert frame.flow_prev_to_curr_px is None
    assert frame.depth_m is not None
    assert sum("frame 2 has no" in message for message in caplog.messages) == 2


@pytest.mark.parametrize(
    ("data", "stated", "raw_factor"),
    [(2, 100.0, 100.0), (None, 100.0, 256.0), (None, None, 256.0)],
)
def test_factor_of_disparities(
    data: int | None, stated: float | None, raw_factor: float, write_tree: Write
) -> None:
    """VDO-SLAM's settings state it; its predecessor's (no ChooseData) state one it never used."""
    root = write_tree("vdo")
    write_settings(root, ChooseData=data, DepthMapFactor=stated)
    raw = np.full((HEIGHT, WIDTH), 5.0 * raw_factor, np.uint16)
    cv2.imwrite(str(root / "depth/000000.png"), raw)
    depth = VdoSequence.open(root).read(0).depth_m
    np.testing.assert_allclose(depth, BF / 5.0, rtol=1e-5)


@pytest.mark.parametrize("form", ["metric", "disparity"])
def test_form_of_other_data_is_seen_in_its_planes(form: str, write_tree: Write) -> None:
    root = write_tree("vdo")
    write_settings(root, ChooseData=1, DepthMapFactor=1000.0)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    depth = 1 / (0.2 + 0.004 * u + 0.003 * v)  # a plane
    raw = 1000 * (depth if form == "metric" else BF / depth)
    for k in range(4):
        cv2.imwrite(str(root / f"depth/{k:06d}.png"), np.round(raw).astype(np.uint16))
    read = VdoSequence.open(root).read(1).depth_m
    np.testing.assert_allclose(read, depth, rtol=2e-3)


def test_options_override_the_rule(write_tree: Write) -> None:
    root = write_tree("vdo")
    cv2.imwrite(str(root / "depth/000000.png"), np.full((HEIGHT, WIDTH), 3000, np.uint16))
    sequence = VdoSequence.open(root, depth_form="metric", depth_factor=500.0)
    np.testing.assert_allclose(sequence.read(0).depth_m, 6.0, rtol=1e-6)
    with pytest.raises(DatasetError, match="'metric' or 'disparity'"):
        VdoSequence.open(root, depth_form="inverse")


def test_right_images_replace_depth(write_tree: Write) -> None:
    root = write_tree("vdo")
    (root / "image_0").rename(root / "image")
    for k in range(4):
        (root / "image_1").mkdir(exist_ok=True)
        cv2.imwrite(str(root / f"image_1/{k:06d}.png"), np.full((HEIGHT, WIDTH, 3), k, np.uint8))
    assert VdoSequence.open(root).read(2).image_right is None
    frame = VdoSequence.open(root, depth_source="stereo").read(2)
    assert frame.depth_m is None
    assert frame.image_right is not None
    assert (frame.image_right == 2).all()


def test_times_that_contradict_the_frame_rate(
    write_tree: Write, caplog: pytest.LogCaptureFixture
) -> None:
    root = write_tree("vdo")
    (root / "times.txt").write_text("0000\n5e-02\n1e-01\n1.5e-01\n2e-01\n")
    np.testing.assert_allclose(VdoSequence.open(root).timestamps_s, [0.0, 0.1, 0.2, 0.3])
    assert "0.05 s a frame, the settings say 0.1 s" in caplog.text


def test_objects_in_kittis_form(write_tree: Write) -> None:
    objects = objects_of(VdoSequence.open(write_tree("vdo")))
    assert len(objects) == 8
    driving = objects.object_id == 1
    assert objects.moving[driving].all()
    assert not objects.moving[~driving].any()
    np.testing.assert_allclose(objects.boxes_px[driving][2], [22, 10, 33, 19])
    T = objects.Ts_world_object[driving]
    np.testing.assert_allclose(np.diff(T[:, 2, 3]), 0.8, atol=1e-6)  # own speed, not the camera's
    np.testing.assert_allclose(T[0, :3, :3] @ [1, 0, 0], [0, 0, 1], atol=1e-6)  # heads forward
    np.testing.assert_allclose(objects.Ts_world_object[~driving][:, :3, 3], [[-2, 1.5, 9]] * 4)


def test_exact_objects_go_before_text(write_tree: Write) -> None:
    root = write_tree("vdo")
    poses = np.tile(np.eye(4), (2, 5, 1, 1))
    poses[0, :, 0, 3] = np.arange(5)
    np.savez(root / "gt_objects.npz", ids=np.array([1, 7]), moving=np.array([1]), poses=poses)
    objects = objects_of(VdoSequence.open(root))
    assert len(objects) == 8
    np.testing.assert_allclose(objects.Ts_world_object[objects.object_id == 1][:, 0, 3], range(4))
    assert (objects.moving == (objects.object_id == 1)).all()
    np.testing.assert_allclose(objects.boxes_px[objects.object_id == 1][3], [23, 10, 34, 19])
    assert objects.n_pixels[objects.object_id == 1].tolist() == [120] * 4  # of the masks, 12 x 10
    assert not objects.n_pixels[objects.object_id == 7].any()
    assert np.isnan(objects.boxes_px[objects.object_id == 7]).all()  # out of sight


def test_objects_in_the_world_take_boxes_from_masks(write_tree: Write) -> None:
    root = write_tree("vdo")
    rows = [[k, 1, 0.5 * k, -1.0, 2.0, 0.0, np.pi / 2, 0.0, 0, 0] for k in range(4)]
    np.savetxt(root / "object_pose.txt", rows)
    objects = objects_of(VdoSequence.open(root))
    np.testing.assert_allclose(objects.Ts_world_object[3, :3, 3], [1.5, -1.0, 2.0])
    np.testing.assert_allclose(objects.Ts_world_object[3, :3, 0], [0, 0, -1], atol=1e-9)
    np.testing.assert_allclose(objects.boxes_px[3], [23, 10, 34, 19])


def test_masks_that_cannot_be_read_cost_only_their_frames_pixels(write_tree: Write) -> None:
    root = write_tree("vdo")
    masks = sorted((root / "semantic").iterdir())
    masks[1].write_bytes(b"damaged")
    objects = objects_of(VdoSequence.open(root))
    assert objects.n_pixels[objects.object_id == 1].tolist() == [120, 0, 120, 120]
    np.testing.assert_allclose(objects.boxes_px[objects.object_id == 1][2], [22, 10, 33, 19])
    for path in masks:
        path.unlink()
    assert objects_of(VdoSequence.open(root)).n_pixels is None


def test_truth_is_found_by_frame_number(write_tree: Write) -> None:
    root = write_tree("vdo")
    for folder, suffix in (("image_0", "png"), ("depth", "png"), ("flow", "flo")):
        (root / folder / f"000000.{suffix}").unlink()
    sequence = VdoSequence.open(root)
    truth = sequence.ground_truth()
    assert truth is not None
    np.testing.assert_allclose(truth.Ts_world_camera[:, 2, 3], [0.5, 1.0, 1.5])
    assert truth.objects is not None
    assert truth.objects.frame_index.max() == 2


def test_pose_that_the_truth_does_not_have_is_nan(write_tree: Write) -> None:
    root = write_tree("vdo")
    lines = (root / "pose_gt.txt").read_text().splitlines()
    (root / "pose_gt.txt").write_text("\n".join(lines[:2] + lines[3:]) + "\n")
    truth = VdoSequence.open(root).ground_truth()
    assert truth is not None
    assert np.isnan(truth.Ts_world_camera).any(axis=(1, 2)).tolist() == [False, False, True, False]


def test_real_kitti_0003(real_data: Callable[[str], Path]) -> None:
    sequence = open_sequence(real_data("kitti_tracking_0003_vdo_format_10f"))
    assert (sequence.dataset, len(sequence)) == ("vdo", 10)
    assert (sequence.camera.width, sequence.camera.height) == (1242, 375)
    np.testing.assert_allclose(np.diff(sequence.timestamps_s), 0.1)
    frame = sequence.read(3)
    depth, labels = frame.depth_m, frame.instance_labels
    assert depth is not None
    assert labels is not None
    assert set(np.unique(labels)) == {0, 1, 3}
    assert isinstance(sequence, VdoSequence)
    truth = sequence.ground_truth()
    assert truth is not None
    objects = objects_of(sequence)
    np.testing.assert_allclose(truth.Ts_world_camera[0], np.eye(4), atol=1e-9)
    step_m = np.linalg.norm(np.diff(truth.Ts_world_camera[:, :3, 3], axis=0), axis=1)
    assert 1.15 < step_m.mean() < 1.25
    assert set(objects.object_id[objects.moving]) == {1}
    # The near car's surface lies within its own length of its labelled centre.
    row = np.flatnonzero((objects.object_id == 1) & (objects.frame_index == 3))[0]
    p_camera = np.linalg.inv(truth.Ts_world_camera[3]) @ objects.Ts_world_object[row, :, 3]
    assert abs(np.nanmedian(depth[labels == 1]) - p_camera[2]) < 2.5
