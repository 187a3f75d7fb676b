"""Pictures of the stages: each shows what it is given, and says by colour what it is."""

import numpy as np
import pytest

from pipelines.frontend.view import PreparedFrame
from pipelines.geometry import make_T
from pipelines.object_types import Detections, ObjectEstimates
from pipelines.types import (
    Features,
    Frame,
    FrameResult,
    MotionHypothesis,
    StereoCamera,
    TrackingStatus,
)
from viz import stages, style

CAMERA = StereoCamera(64, 48, 60.0, 60.0, 31.5, 23.5, 6.0)
IMAGE = np.full((48, 64, 3), 128, np.uint8)
SCALE = round(stages.LEAST_WIDTH_PX / 64)
SQUARE = np.zeros((48, 64), np.int32)
SQUARE[14:34, 10:30] = 3


def near(picture, color, tolerance=40):
    """How many pixels have about this colour."""
    return int((np.abs(picture.astype(int) - color).sum(axis=2) < tolerance).sum())


def at(picture, u, v):
    """The colour at a pixel of the small image."""
    return picture[int((v + 0.5) * SCALE), int((u + 0.5) * SCALE)].astype(int)


def an_object(T_step) -> ObjectEstimates:
    nan = np.full((1, 3), np.nan)
    return ObjectEstimates(
        np.array([1]), np.array([0.1]), np.array([3]), np.array(["car"]), np.ones(1),
        np.array(["moving"]), np.full((1, 4), np.nan), np.array([50]), np.eye(4)[None],
        T_step[None], np.full((1, 6, 6), np.nan), nan, np.ones(1), np.ones(1), nan, np.ones(1), nan,
    )  # fmt: skip


def a_result(T, objects=None, uv=None, inliers=None) -> FrameResult:
    uv = np.empty((0, 2)) if uv is None else uv
    inliers = np.zeros(len(uv), bool) if inliers is None else inliers
    return FrameResult(
        1, 0.1, TrackingStatus.OK, T, np.eye(6), MotionHypothesis.NONE, False, uv,
        np.arange(len(uv)), inliers, 0.3, objects or ObjectEstimates.empty(),
    )  # fmt: skip


def a_frame(disparity_px) -> PreparedFrame:
    gray = np.full((48, 64), 128, np.uint8)
    return PreparedFrame(Frame(0, 0.0, IMAGE), gray, disparity_px, Features.empty())


def test_depth_is_warm_nearby_cold_far_away_and_dark_where_unknown():
    depth = np.tile(np.linspace(2.0, 40.0, 64), (48, 1))
    depth[:, :5] = np.nan
    picture = stages.depth_picture(depth)
    assert picture.shape == (48 * SCALE + stages.SCALE_PX, 64 * SCALE, 3)
    assert at(picture, 2, 20).tolist() == list(stages.VOID)
    close, far = at(picture, 6, 20), at(picture, 60, 20)
    assert close[0] > close[2] + 50 and far[2] > far[0] + 50
    assert (stages.depth_picture(np.full((48, 64), np.nan)) == stages.VOID).all()


def test_the_hue_of_flow_is_its_direction_and_its_strength_the_length():
    flow = np.zeros((48, 64, 2), np.float32)
    flow[:, 32:48, 0], flow[:, 48:, 0] = 8.0, -8.0
    flow[40:] = np.nan
    picture = stages.flow_picture(flow, most_px=8.0)
    still, right, left = (at(picture, u, 30) for u in (20, 40, 60))
    assert still.min() > 250
    assert right[0] > right[2] + 100 and left[2] > left[0] + 100
    assert at(picture, 20, 44).tolist() == list(stages.VOID)
    half = at(stages.flow_picture(flow, most_px=16.0), 40, 30)
    assert np.ptp(right) > np.ptp(half) > 50


def test_masks_are_tinted_and_named():
    found = Detections(SQUARE, np.array([3], np.int32), np.array(["car"]), np.ones(1))
    picture = stages.masks_picture(IMAGE, found)
    inside, outside = at(picture, 12, 16), at(picture, 50, 40)
    assert np.ptp(inside) > 30 and np.ptp(outside) == 0
    assert near(picture, style.object_color(3)) > 1000  # the label
    assert np.ptp(stages.masks_picture(IMAGE, None).reshape(-1, 3), axis=0).max() == 0


def test_features_have_rings_and_what_may_move_is_dark():
    features = Features(
        np.array([[50.0, 10.0], [50.0, 38.0]]), np.array([0, 6], np.int32),
        np.zeros(2, np.float32), np.ones(2, np.float32), np.zeros((2, 32), np.uint8), np.ones(2),
    )  # fmt: skip
    picture = stages.features_picture(IMAGE, features, SQUARE > 0)
    assert at(picture, 20, 20).max() < 80 < at(picture, 40, 44).min()
    upper, lower = picture[: 24 * SCALE], picture[24 * SCALE :]
    assert near(lower, style.INLIER) > 1.5 * near(upper, style.INLIER) > 50


def test_labels_travel_with_the_flow():
    flow = np.zeros((48, 64, 2), np.float32)
    flow[..., 0] = 30.0
    picture = stages.association_picture(IMAGE, SQUARE, flow, np.zeros_like(SQUARE))
    color = style.object_color(3)
    assert near(picture[:, 40 * SCALE :], color) > 300
    assert near(picture[:, : 38 * SCALE], color) == 0


def test_a_pose_has_rings_where_points_agree_and_crosses_where_not():
    uv = np.array([[10.0, 10.0], [50.0, 10.0]])
    picture = stages.pose_picture(
        IMAGE, a_result(np.eye(4), uv=uv, inliers=np.array([True, False]))
    )
    left, right = picture[:, : 32 * SCALE], picture[:, 32 * SCALE :]
    assert near(left, style.INLIER) > 10 and near(left, style.OUTLIER) == 0
    assert near(right, style.OUTLIER) > 10 and near(right, style.INLIER) == 0


def test_scene_flow_beyond_the_threshold_is_red():
    uv = np.array([[10.0, 10.0], [50.0, 10.0], [30.0, 40.0]])
    flow = np.array([[0.0, 0, 0.05], [0.3, 0, 0], [np.nan] * 3])
    picture = stages.scene_flow_picture(IMAGE, uv, flow, 0.12)[: 48 * SCALE]
    left, right = picture[:, : 32 * SCALE], picture[:, 32 * SCALE :]
    assert near(left, stages.STILL) > 5 and near(left, stages.MOVES) == 0
    assert near(right, stages.MOVES) > 5 and near(right, stages.STILL) == 0


@pytest.mark.parametrize("step_m", [1.5, -1.5])
def test_arrows_go_where_the_motion_leads(step_m):
    """The square moves sideways: arrows stand on the side of it that it goes to, none elsewhere."""
    H = make_T(np.eye(3), np.array([step_m, 0.0, 0.0]))
    before = a_frame(np.full((48, 64), 0.6, np.float32))  # 10 m away: 9 px a step
    results = a_result(np.eye(4)), a_result(np.eye(4), an_object(H))
    picture = stages.motion_picture(CAMERA, IMAGE, before, SQUARE, results)
    columns = np.flatnonzero(
        (np.abs(picture.astype(int) - style.object_color(3)).sum(2) < 40).any(0)
    )
    low, high = columns.min() / SCALE, columns.max() / SCALE
    assert (8 < low < 16 and 34 < high < 41) if step_m > 0 else (0 < low < 6 and 24 < high < 32)
