"""Motion by geometry alone: a scene of two planes with analytic truth, a rendered street, KITTI."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.config import Config, GeometryConfig
from pipelines.datasets import open_sequence
from pipelines.datasets.sequence import Sequence
from pipelines.detection.geometry import MultiViewGeometry
from pipelines.detection.geometry_view import GeometryView
from pipelines.dyob_slam import DyObSlam
from pipelines.object_types import Detections
from pipelines.types import Frame, StereoCamera, TrackingStatus

CAMERA = StereoCamera(320, 240, 300.0, 300.0, 159.5, 119.5, 150.0)
WALL_M, BOX_M = 12.0, 5.0
BOX_SIZE_PX = (80, 60)
STEP = np.array([0.04, 0.0, 0.0])  # m per frame, of the camera
DT_S = 0.1


def box_corner(k: int, box_step_m: float) -> tuple[int, int]:
    """First column and row of the box in frame k: it moves sideways, the camera too."""
    return round(110 + k * 300.0 * (box_step_m - STEP[0]) / BOX_M), 90


def two_planes(k: int, box_step_m: float) -> tuple[GeometryView, np.ndarray]:
    """Frame k before a wall, with a box in front that moves by `box_step_m` a frame; and its mask.

    Steps are such that all moves by whole pixels: disparity, flow and image are exact.
    """
    H, W = CAMERA.height, CAMERA.width
    rng = np.random.default_rng(5)
    wall_texture = cv2.resize(rng.integers(30, 220, (120, 260)).astype(np.uint8), (1040, H))
    box_texture = cv2.resize(rng.integers(30, 220, (15, 20)).astype(np.uint8), BOX_SIZE_PX)
    wall_flow = -300.0 * STEP[0] / WALL_M
    box_flow = 300.0 * (box_step_m - STEP[0]) / BOX_M
    start = 300 - round(k * wall_flow)
    gray = wall_texture[:, start : start + W].copy()
    mask = np.zeros((H, W), bool)
    u, v = box_corner(k, box_step_m)
    mask[v : v + BOX_SIZE_PX[1], u : u + BOX_SIZE_PX[0]] = True
    gray[mask] = box_texture.ravel()
    before = np.zeros((H, W), bool)
    u, v = box_corner(k - 1, box_step_m)
    before[v : v + BOX_SIZE_PX[1], u : u + BOX_SIZE_PX[0]] = True
    flow = np.zeros((H, W, 2), np.float32)
    flow[..., 0] = np.where(before, box_flow, wall_flow)
    disparity = np.where(mask, CAMERA.bf / BOX_M, CAMERA.bf / WALL_M).astype(np.float32)
    T = np.eye(4)
    T[:3, 3] = k * STEP
    view = GeometryView(
        k, k * DT_S, gray, disparity, T, np.zeros((6, 6)), flow if k else None, 0.05, 0.1
    )
    return view, mask


def segment_frames(
    n: int, box_step_m: float, change: Callable[[GeometryView], GeometryView] = lambda view: view
) -> tuple[Detections, np.ndarray]:
    """The answer to the last of n frames with nothing known, and the box's true mask."""
    geometry = MultiViewGeometry(CAMERA, GeometryConfig())
    found, mask = nothing(), np.zeros(0, bool)
    for k in range(n):
        view, mask = two_planes(k, box_step_m)
        found = geometry.segment(change(view), nothing())
    return found, mask


def nothing() -> Detections:
    return Detections.empty((CAMERA.height, CAMERA.width))


def known_mask(mask: np.ndarray, label: int = 7, name: str = "car") -> Detections:
    return Detections(
        np.where(mask, label, 0).astype(np.int32),
        np.array([label], np.int32),
        np.array([name]),
        np.array([0.9]),
    )


def iou(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max(1, (a | b).sum()))


@pytest.mark.parametrize("box_step_m", [-0.1, 0.1 + 0.04, 0.24])
def test_a_moving_box_is_found_whole_by_its_second_frame(box_step_m: float) -> None:
    found, mask = segment_frames(3, box_step_m)
    assert len(found) == 1
    assert found.class_names[0] == "object"
    assert 0.5 < found.scores[0] <= 1
    assert iou(found.labels == found.label_ids[0], mask) > 0.9


def test_a_standing_box_is_not_found() -> None:
    for n in (2, 5, 9):
        found, _ = segment_frames(n, 0.0)
        assert len(found) == 0
        assert not found.labels.any()


def test_motion_along_the_view_is_seen_by_disparity_alone() -> None:
    """A thing whose flow is that of a still one, but that comes nearer by 0.3 m a frame."""

    def nearer(view: GeometryView) -> GeometryView:
        box = view.disparity_px > 20
        depth = BOX_M - 0.3 * view.frame_index
        return replace(
            view, disparity_px=np.where(box, CAMERA.bf / depth, view.disparity_px).astype("f4")
        )

    geometry = MultiViewGeometry(CAMERA, GeometryConfig())
    for k in range(3):
        view, _ = two_planes(k, 0.0)
        evidence = geometry._gather(nearer(view))
        geometry._remember(nearer(view), evidence, [])
    assert evidence.flow is not None
    box = evidence.cells.disparity_px > 20
    inner = cv2.erode(box.astype(np.uint8), np.ones((3, 3))) > 0
    assert np.mean(evidence.flow.strength[inner] > 1) > 0.9
    wall = cv2.dilate(box.astype(np.uint8), np.ones((15, 15))) == 0
    assert np.nanmax(evidence.flow.strength[wall]) < 0.5


def test_its_motion_is_measured_in_metres() -> None:
    geometry = MultiViewGeometry(CAMERA, GeometryConfig())
    for k in range(2):
        view, mask = two_planes(k, 0.24)
        evidence = geometry._gather(view)
        geometry._remember(view, evidence, [])
    cells = mask[2::4, 2::4]
    motion = evidence.motion_of(cells & evidence.flow.valid)
    assert motion is not None
    assert 1e-9 < np.linalg.norm(motion.translation_m - [0.24, 0, 0]) < 0.005
    assert motion.agreement > 0.9


@pytest.mark.parametrize(("box_step_m", "expected"), [(0.0, 0), (0.24, 1)])
def test_an_offset_learned_late_counts_for_older_views_too(
    box_step_m: float, expected: int
) -> None:
    """Disparities that all measure 0.6 px short, which is known from the third frame on."""
    short = 0.6
    geometry = MultiViewGeometry(CAMERA, GeometryConfig())
    for k in range(6):
        view, _ = two_planes(k, box_step_m)
        measured = view.disparity_px - np.float32(short)
        view = replace(view, disparity_px=measured, disparity_offset_px=short if k > 1 else 0.0)
        found = geometry.segment(view, nothing())
        assert len(found) == expected or k < 2


def test_older_views_saw_through_where_a_thing_is_now() -> None:
    geometry = MultiViewGeometry(CAMERA, GeometryConfig())
    for k in range(9):
        view, mask = two_planes(k, 0.24)
        evidence = geometry._gather(view)
        geometry._remember(view, evidence, [])
    cells = mask[2::4, 2::4]
    oldest = max(evidence.comparisons, key=lambda comparison: comparison.age_s)
    inner = cv2.erode(cells.astype(np.uint8), np.ones((3, 3))) > 0
    assert oldest.was_empty[inner].mean() > 0.9
    assert not oldest.was_empty[~cells].any()
    # What the box has left is farther now than it was: no sign of a thing
    away = cv2.dilate(cells.astype(np.uint8), np.ones((5, 5))) == 0
    assert oldest.agrees[away & np.isfinite(evidence.cells.disparity_px)].mean() > 0.6


@pytest.mark.parametrize("wear", ["eroded", "half", "shifted"])
def test_a_worn_mask_is_repaired(wear: str) -> None:
    geometry = MultiViewGeometry(CAMERA, GeometryConfig())
    for k in range(3):
        view, mask = two_planes(k, 0.24)
        worn = mask.copy()
        if wear == "eroded":
            worn = cv2.erode(mask.astype(np.uint8), np.ones((13, 13))) > 0
        elif wear == "half":
            worn[:, : box_corner(k, 0.24)[0] + BOX_SIZE_PX[0] // 2] = False
        else:
            worn = np.roll(mask, (8, 8), (0, 1))
        found = geometry.segment(view, known_mask(worn))
    assert list(found.label_ids) == [7]
    assert found.class_names[0] == "car" and found.scores[0] == 0.9
    assert iou(worn, mask) < 0.75
    assert iou(found.labels == 7, mask) > 0.9


def test_masks_of_standing_things_are_left_alone() -> None:
    geometry = MultiViewGeometry(CAMERA, GeometryConfig())
    for k in range(4):
        view, mask = two_planes(k, 0.0)
        known = known_mask(np.roll(mask, (3, 5), (0, 1)))
        found = geometry.segment(view, known)
        assert np.array_equal(found.labels, known.labels)


def test_known_instances_are_never_merged() -> None:
    geometry = MultiViewGeometry(CAMERA, GeometryConfig())
    for k in range(3):
        view, mask = two_planes(k, 0.24)
        columns = np.arange(CAMERA.width) < box_corner(k, 0.24)[0] + BOX_SIZE_PX[0] // 2
        labels = np.where(mask, np.where(columns, 900, 4), 0).astype(np.int32)
        ids, names = np.array([900, 4], np.int32), np.array(["car", "car"])
        found = geometry.segment(view, Detections(labels, ids, names, np.array([0.5, 0.6])))
    assert list(found.label_ids) == [900, 4]
    for label in (900, 4):
        assert iou(found.labels == label, labels == label) > 0.8


def test_a_nameless_mask_on_a_standing_thing_fades() -> None:
    geometry = MultiViewGeometry(CAMERA, GeometryConfig())
    lives = []
    for k in range(14):
        view, mask = two_planes(k, 0.0)
        known = known_mask(mask, 3, "object") if k == 0 or lives[-1] else nothing()
        lives.append(len(geometry.segment(view, known)) > 0)
    assert lives[0] and not lives[-1]


def test_new_labels_are_new() -> None:
    geometry = MultiViewGeometry(CAMERA, GeometryConfig())
    far = np.zeros((CAMERA.height, CAMERA.width), bool)
    far[:30, :30] = True
    for k in range(3):
        view, _ = two_planes(k, 0.24)
        found = geometry.segment(view, known_mask(far, 41))
    assert len(found) == 2 and found.label_ids[0] == 41 and found.label_ids[1] > 41


@pytest.mark.parametrize("fault", ["no flow", "no depth", "flow of NaN", "tiny mask", "gap"])
def test_bad_input_gives_no_false_instance(fault: str) -> None:
    geometry = MultiViewGeometry(CAMERA, GeometryConfig())
    tiny = np.zeros((CAMERA.height, CAMERA.width), bool)
    tiny[50, 50:53] = True
    for k in range(4):
        view, _ = two_planes(k, 0.0)
        if fault == "no flow":
            view = replace(view, flow_prev_to_curr_px=None)
        elif fault == "no depth":
            view = replace(view, disparity_px=np.full_like(view.disparity_px, np.nan))
        elif fault == "flow of NaN" and k:
            flow = np.full_like(view.flow_prev_to_curr_px, np.nan)
            view = replace(view, flow_prev_to_curr_px=flow)
        elif fault == "gap":
            view = replace(view, frame_index=3 * k)
        known = known_mask(tiny, 12) if fault == "tiny mask" else nothing()
        found = geometry.segment(view, known)
        assert np.array_equal(found.labels, known.labels)
        geometry.add_keyframe()


def test_wrong_sizes_are_said() -> None:
    geometry = MultiViewGeometry(CAMERA, GeometryConfig())
    view = replace(two_planes(0, 0.0)[0], flow_prev_to_curr_px=None)
    with pytest.raises(ValueError, match="disparity_px: expected shape"):
        smaller = {"gray": view.gray[:100], "disparity_px": view.disparity_px[:100]}
        geometry.segment(replace(view, **smaller), nothing())
    with pytest.raises(ValueError, match="labels: expected shape"):
        geometry.segment(view, Detections.empty((10, 10)))


# ------------------------------------------------------------------ sequences


def run(sequence: Sequence, n: int, known_from_last: bool = True) -> list[Detections]:
    """What geometry alone finds, with the front-end's poses and no masks at all."""
    slam = DyObSlam(sequence.camera, Config())
    geometry = MultiViewGeometry(sequence.camera, GeometryConfig())
    found: list[Detections] = []
    for k in range(n):
        frame: Frame = replace(sequence.read(k), instance_labels=None)
        prepared = slam.prepare(frame)
        result = slam.process(prepared)
        assert result.status is TrackingStatus.OK
        known = Detections.empty(prepared.gray.shape)
        if known_from_last and found:
            known = carried(found[-1], frame.flow_prev_to_curr_px)
        view = GeometryView(
            k,
            frame.timestamp_s,
            prepared.gray,
            prepared.disparity_px,
            result.T_world_camera,
            result.pose_covariance,
            frame.flow_prev_to_curr_px,
            slam.sensor.noise.sigma_disparity_px,
            slam.sensor.noise.sigma_uv_px["flow"],
            slam.sensor.offset.offset_px,
        )
        found.append(geometry.segment(view, known))
        if result.is_keyframe:
            geometry.add_keyframe()
    return found


def carried(last: Detections, flow: np.ndarray) -> Detections:
    """The last frame's masks, moved pixel by pixel along the flow."""
    v, u = np.nonzero(last.labels)
    du = np.nan_to_num(flow[v, u], nan=1e6)
    x, y = np.rint(u + du[:, 0]).astype(int), np.rint(v + du[:, 1]).astype(int)
    H, W = last.labels.shape
    there = (x >= 0) & (y >= 0) & (x < W) & (y < H)
    labels = np.zeros_like(last.labels)
    labels[y[there], x[there]] = last.labels[v[there], u[there]]
    return replace(last, labels=labels)


def test_the_moving_car_of_a_rendered_street_is_found(street: Sequence) -> None:
    n = 8
    found = run(street, n)
    truth = street.ground_truth().objects
    movers = {int(i) for i in truth.object_id[truth.moving]}
    scores, false = [], 0
    for k in range(2, n):
        labels = street.read(k).instance_labels
        largest = max(movers, key=lambda i: int((labels == i).sum()))
        masks = [found[k].labels == i for i in found[k].label_ids]
        scores.append(max((iou(mask, labels == largest) for mask in masks), default=0.0))
        on_movers = np.isin(labels, list(movers))
        false += sum(bool(m.any()) and on_movers[m].mean() < 0.3 for m in masks)
    assert 0.6 < np.median(scores) < 0.999
    assert false == 0


@pytest.mark.slow
def test_nothing_moves_in_a_still_street(render_cache: Path) -> None:
    options = {"frames": 20, "scale": 0.4, "cache": render_cache, "degrade": "all"}
    for found in run(open_sequence("simulated:static", **options), 20):
        assert len(found) == 0


def test_the_overtaking_car_of_kitti_is_found_and_parked_ones_are_not(real_data) -> None:
    sequence = open_sequence(real_data("kitti_tracking_0003_vdo_format_10f"))
    found = run(sequence, 10)
    for k in range(2, 10):
        labels = sequence.read(k).instance_labels
        masks = [found[k].labels == i for i in found[k].label_ids]
        best = max(iou(mask, labels == 1) for mask in masks)
        assert 0.5 < best < 0.999, f"frame {k}"
        for mask in masks:
            assert (labels[mask] == 1).mean() > 0.5, f"frame {k}: a false mover"


def test_beliefs_follow_their_instances_to_other_labels():
    """A nameless instance that stands fades from where it was, under whatever label it goes on."""

    def frames_until_dropped(new_label: int, told: bool) -> int:
        geometry = MultiViewGeometry(CAMERA, GeometryConfig())
        for k in range(6):  # it moves, and is found
            found = geometry.segment(two_planes(k, 0.16)[0], nothing())
        assert len(found) == 1
        old = int(found.label_ids[0])
        labels = np.where(found.labels == old, new_label, 0).astype(np.int32)
        if told:
            geometry.rename({old: new_label})
        known = Detections(labels, np.array([new_label], np.int32), found.class_names, np.ones(1))
        still, _ = two_planes(5, 0.16)
        flow = np.zeros((CAMERA.height, CAMERA.width, 2), np.float32)
        for k in range(6, 30):
            view = replace(still, frame_index=k, timestamp_s=k * DT_S, flow_prev_to_curr_px=flow)
            known = geometry.segment(view, known)
            if len(known) == 0:
                return k
        return 30

    told = frames_until_dropped(5, True)
    assert told == frames_until_dropped(41, True)
    assert frames_until_dropped(5, False) != told  # else its old belief is lost
