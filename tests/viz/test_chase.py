"""Views that follow the camera: behind and above it, calm, and the frame that tells the most."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.geometry import exp_se3
from viz.chase import chase_views, telling_frame, view_reach_m
from viz.ground import grid_step_m, ground_levels_m
from viz.playback import build_playback
from viz.smoothing import smoothed

SIZE = (640, 360)


def eyes(views) -> np.ndarray:
    return np.array([-v.T_view_world[:3, :3].T @ v.T_view_world[:3, 3] for v in views])


def test_the_eye_is_behind_and_above_and_sees_camera_and_car(short_run):
    playback = build_playback(short_run)
    views = chase_views(playback, SIZE)
    centers = playback.Ts_world_camera[:, :3, 3]
    from_camera = eyes(views) - centers
    assert (from_camera[:, 2] < -1.0).all() and (from_camera[:, 1] < -1.0).all()  # y is down
    np.testing.assert_allclose(from_camera, from_camera[:1].repeat(8, 0), atol=1e-6)  # no lag
    for view, center, boxes in zip(views, centers, playback.boxes, strict=True):
        uv, depth = view.project(np.stack([center, boxes[0].T_world_box[:3, 3]]))
        assert (depth > 0).all() and ((uv > 0) & (uv < SIZE)).all()
        assert uv[0, 1] > uv[1, 1]  # what is ahead is higher up in the picture


def test_a_shaking_camera_is_followed_calmly(short_run):
    rng = np.random.default_rng(1)
    Ts = short_run.Ts_world_camera @ [exp_se3(0.1 * rng.normal(size=6)) for _ in range(8)]
    views = chase_views(build_playback(replace(short_run, Ts_world_camera=Ts)), SIZE)
    shaken = np.abs(np.diff(Ts[:, :3, 3], n=2, axis=0)).max()
    assert np.abs(np.diff(eyes(views), n=2, axis=0)).max() < 0.3 * shaken


@pytest.mark.parametrize("pitch_rad", [np.pi / 2, -np.pi / 2])
def test_a_camera_that_looks_straight_down_or_up_has_views(short_run, pitch_rad):
    Ts = short_run.Ts_world_camera @ exp_se3(np.array([pitch_rad, 0, 0, 0, 0, 0]))
    views = chase_views(build_playback(replace(short_run, Ts_world_camera=Ts)), SIZE)
    assert all(np.isfinite(view.T_view_world).all() for view in views)


def test_the_telling_frame_has_the_most_that_moves(short_run):
    objects = short_run.objects
    state = objects.state.astype("U16")
    state[:] = "stopped"
    state[2] = "moving"
    playback = build_playback(replace(short_run, objects=replace(objects, state=state)))
    views = chase_views(playback, SIZE)
    assert telling_frame(playback, views) == 2
    still = build_playback(replace(short_run, objects=objects[:0]))
    assert telling_frame(still, views) == 7  # nothing moves: the more of the path the better


def test_the_ground_is_found_beneath_the_camera(short_run):
    playback = build_playback(short_run)
    reach_m = view_reach_m(playback)
    assert 3.0 < reach_m < 20.0
    np.testing.assert_allclose(ground_levels_m(playback, reach_m), -1.5, atol=0.15)
    nothing = build_playback(replace(short_run, static_points_m=np.empty((0, 3))))
    assert np.isnan(ground_levels_m(nothing, 1.0)).all()


@pytest.mark.parametrize(("reach_m", "step_m"), [(25.0, 5.0), (2.2, 0.5), (1000.0, 200.0)])
def test_the_grid_has_round_steps(reach_m, step_m):
    assert grid_step_m(reach_m) == step_m


def test_smoothing_keeps_what_is_even_and_takes_what_shakes():
    t = np.arange(30) * 0.1
    even = np.stack([3.0 * t, -t], 1)
    np.testing.assert_allclose(smoothed(even, t), even, atol=1e-9)
    shaken = even + 0.2 * (np.arange(30)[:, None] % 2)
    assert np.abs(np.diff(smoothed(shaken, t), n=2, axis=0)).max() < 0.02
    assert smoothed(even[:1], t[:1]).tolist() == even[:1].tolist()
