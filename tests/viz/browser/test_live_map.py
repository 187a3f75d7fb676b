"""What a live view knows: frames and points that follow when keyframes are moved."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipelines.frame_observations import FrameObservations, Sightings
from pipelines.geometry import exp_se3, make_T, transform_points
from pipelines.types import FrameResult, MotionHypothesis, TrackingStatus
from viz.browser.live_map import LiveFrames, LiveMap

IMAGE = np.zeros((50, 80, 3), np.uint8)
IMAGE[:, 40:] = (200, 100, 50)
KEYFRAMES = (0, 2, 4)


def place(k: int) -> np.ndarray:
    return make_T(np.eye(3), np.array([0.1 * k, 0.0, 0.5 * k]))


def frame(k: int, objects, status=TrackingStatus.OK) -> FrameResult:
    return FrameResult(
        k, 0.1 * k, status, place(k), np.zeros((6, 6)), MotionHypothesis.CONSTANT_VELOCITY,
        k in KEYFRAMES, np.empty((0, 2)), np.empty(0, np.int64), np.empty(0, bool), 0.1,
        objects[objects.frame_index == k],
    )  # fmt: skip


def seen(k: int, points_m: np.ndarray, of_objects: int = 0) -> FrameObservations:
    """The world's points as frame k sees them, the last ones of which are an object's."""
    n = len(points_m)
    owner = np.where(np.arange(n) >= n - of_objects, 7, 0)
    uv = np.column_stack([np.where(np.arange(n) % 2, 60.0, 10.0), np.full(n, 20.0)])
    one = np.ones(n)
    in_camera = transform_points(np.linalg.inv(place(k)), points_m)
    sights = Sightings(np.full(n, k), owner, np.arange(n), uv, one, one, one, in_camera)
    return FrameObservations(k, 0.1 * k, True, place(k), sights)


def test_points_seen_often_enough_have_place_and_colour(objects):
    points = np.random.default_rng(0).uniform([-4, -2, 4], [4, 2, 9], (40, 3))
    frames, live_map = LiveFrames(), LiveMap(min_sightings=3)
    for k in range(3):
        assert len(live_map.cloud(frames.Ts_world_camera)[0]) == 0
        frames.add(frame(k, objects))
        live_map.add(seen(k, points[: 40 if k else 30], of_objects=0 if k else 5), frames, IMAGE)
        assert live_map.changed
    cloud, colors = live_map.cloud(frames.Ts_world_camera)
    assert not live_map.changed
    np.testing.assert_allclose(cloud, points[:25], atol=1e-9)  # the others were seen twice
    np.testing.assert_array_equal(colors[1], (200, 100, 50))
    np.testing.assert_array_equal(colors[0], (0, 0, 0))


def test_frames_boxes_and_points_follow_their_keyframes(objects):
    points = np.random.default_rng(0).uniform([-4, -2, 4], [4, 2, 9], (40, 3))
    frames, live_map = LiveFrames(), LiveMap(min_sightings=1)
    for k in range(6):
        frames.add(frame(k, objects))
    live_map.add(seen(3, points), frames, IMAGE)
    before = frames.list[3].boxes[0].T_world_box
    C = exp_se3(np.array([0.0, 0.05, 0.0, 0.3, 0.0, -0.2]))
    now = np.array([place(0), C @ place(2), place(4), place(9)])
    # The map may have a keyframe of an earlier run before ours, and one of a frame yet to come.
    index = np.array([4, 0, 2, 4, 6])
    assert frames.follow(index, np.concatenate([place(77)[None], now]))
    for k in (0, 1, 4, 5):
        np.testing.assert_allclose(frames.list[k].T_world_camera, place(k), atol=1e-9)
    for k in (2, 3):
        np.testing.assert_allclose(frames.list[k].T_world_camera, C @ place(k), atol=1e-9)
    np.testing.assert_allclose(frames.list[3].boxes[0].T_world_box, C @ before, atol=1e-9)
    cloud, _ = live_map.cloud(frames.Ts_world_camera)
    np.testing.assert_allclose(cloud, transform_points(C, points), atol=1e-9)
    assert not frames.follow(index[1:4], now[:3])  # nothing is new in that


def test_a_lost_frame_stays_where_the_camera_was_last(objects):
    frames = LiveFrames()
    frames.add(frame(0, objects))
    lost = frames.add(frame(1, objects, TrackingStatus.LOST))
    np.testing.assert_allclose(lost.T_world_camera, place(0))
    assert not lost.is_tracked and len(lost.boxes) == 2
    late = frame(5, objects)
    assert frames.add(replace(late, is_keyframe=False)).keyframe == 1
