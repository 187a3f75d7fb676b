"""Bundle adjustment against a known world: how near it comes, what it drops, what it leaves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.backend.bundle_adjustment import BundleProblem, adjust_bundle
from pipelines.backend.point_tracks import PointTracks
from pipelines.geometry import exp_se3, invert_T, project_stereo, transform_points
from pipelines.types import StereoCamera

CAMERA = StereoCamera(640, 480, 500.0, 500.0, 320.0, 240.0, 100.0)
SIGMA_UV_PX, FIRST_UV_PX, SIGMA_DISPARITY_PX = 0.2, 0.05, 0.4
WRONG = np.repeat([0.003, 0.03], 3)  # rad and m that the poses are off by at first


def make_problem(seed=0, n_keyframes=6, n_points=200, n_held=2):
    """A straight drive, pixels drifting along their tracks; the problem, true poses and points."""
    rng = np.random.default_rng(seed)
    Ts = np.stack([exp_se3(np.array([0, 0.01 * k, 0, 0, 0, 0.5 * k])) for k in range(n_keyframes)])
    points = rng.uniform((-6, -3, 6), (6, 3, 20), (n_points, 3))
    uvr = np.stack([project_stereo(CAMERA, transform_points(invert_T(T), points)) for T in Ts], 1)
    shape = (n_points, n_keyframes)
    steps = rng.normal(0, SIGMA_UV_PX, (*shape, 2))
    steps[:, 0] *= FIRST_UV_PX / SIGMA_UV_PX
    uv = uvr[..., :2] + np.cumsum(steps, axis=1)
    disparity = uvr[..., 0] - uvr[..., 2] + rng.normal(0, SIGMA_DISPARITY_PX, shape)
    disparity[rng.random(shape) < 0.2] = np.nan
    point, keyframe = (a.ravel() for a in np.indices(shape))
    followed = keyframe > 0
    held = np.arange(n_keyframes) < n_held
    start = Ts @ exp_se3(rng.normal(size=(n_keyframes, 6)) * WRONG)
    start[held] = Ts[held]
    tracks = PointTracks(
        keyframe,
        point,
        followed.astype(np.float64),
        uv.reshape(-1, 2),
        disparity.ravel(),
        np.where(followed, SIGMA_UV_PX, FIRST_UV_PX),
        np.full(len(point), SIGMA_DISPARITY_PX),
        n_points,
        n_keyframes,
    )
    wrong = points + rng.normal(0, 0.1, points.shape)
    return BundleProblem(CAMERA, start, held, wrong, tracks), Ts, points


def position_rmse_m(Ts, truth):
    return float(np.sqrt(((Ts[:, :3, 3] - truth[:, :3, 3]) ** 2).sum(1).mean()))


def test_poses_and_points_come_near_the_truth_as_noise_allows() -> None:
    errors, points_m = [], []
    for seed in range(4):
        problem, Ts, points = make_problem(seed)
        solution = adjust_bundle(problem)
        free = ~problem.held
        errors.append(position_rmse_m(solution.Ts_world_camera[free], Ts[free]))
        points_m.append(np.median(np.linalg.norm(solution.points_m - points, axis=1)))
        assert solution.error_after < 0.5 * solution.error_before
    # 200 points of 0.2 px at 12 m: some millimetres; not nought, as the pixels are noisy
    assert 0.0005 < np.mean(errors) < 0.006
    assert 0.003 < np.mean(points_m) < 0.08


def test_the_error_left_is_that_of_the_noise() -> None:
    """Squared residuals sum up to observations less unknowns, here within a tenth."""
    problem, _, _ = make_problem(1)
    solution = adjust_bundle(problem, rounds=3)
    measured = np.where(np.isnan(problem.tracks.disparity_px), 2, 3)[solution.inliers].sum()
    unknowns = 6 * (~problem.held).sum() + 3 * len(problem.points_m)
    # Half the sum, without the 1 % that chi-square cuts off and what Huber's loss makes less of
    assert 0.85 < solution.error_after / (0.5 * (measured - unknowns)) < 1.05
    assert 0.95 < solution.inliers.mean() < 1.0


def test_held_poses_stay_to_the_bit() -> None:
    problem, _, _ = make_problem(2, n_held=3)
    solution = adjust_bundle(problem)
    np.testing.assert_array_equal(solution.Ts_world_camera[:3], problem.Ts_world_camera[:3])
    assert np.abs(solution.Ts_world_camera[3:] - problem.Ts_world_camera[3:]).max() > 1e-3


def test_outliers_are_dropped_and_do_no_harm() -> None:
    """Points that jump to other places, from which they are followed on: steps that are wrong."""
    problem, Ts, _ = make_problem(3)
    rng = np.random.default_rng(9)
    tracks = problem.tracks
    wrong = tracks.is_followed & (rng.random(len(tracks)) < 0.03)
    jumps = rng.choice([-1, 1], (wrong.sum(), 2)) * rng.uniform(6, 20, (wrong.sum(), 2))
    step = np.zeros((len(tracks), 2))
    step[wrong] = jumps
    drift = np.cumsum(step.reshape(tracks.n_tracks, -1, 2), axis=1).reshape(-1, 2)
    bad = replace(problem, tracks=replace(tracks, uv_px=tracks.uv_px + drift))
    solution = adjust_bundle(bad)
    assert solution.inliers[wrong].mean() < 0.02
    assert solution.inliers[~wrong].mean() > 0.85
    assert 0.0005 < position_rmse_m(solution.Ts_world_camera, Ts) < 0.01


def test_the_same_question_has_the_same_answer() -> None:
    problem, _, _ = make_problem(4, n_points=80)
    a, b = adjust_bundle(problem), adjust_bundle(problem)
    np.testing.assert_array_equal(a.Ts_world_camera, b.Ts_world_camera)
    np.testing.assert_array_equal(a.points_m, b.points_m)


def test_of_a_point_that_jumps_about_no_step_is_believed() -> None:
    problem, _, _ = make_problem(5, n_points=60)
    lonely = problem.tracks.track == 7
    uv = np.where(lonely[:, None], -1e4 * problem.tracks.view[:, None] ** 3, problem.tracks.uv_px)
    disparity = np.where(lonely, np.nan, problem.tracks.disparity_px)
    bad = replace(problem, tracks=replace(problem.tracks, uv_px=uv, disparity_px=disparity))
    assert not adjust_bundle(bad).inliers[lonely & (problem.tracks.view > 0)].any()


def test_shapes_are_checked() -> None:
    problem, _, _ = make_problem(0, n_points=10)
    with pytest.raises(ValueError, match="points_m"):
        replace(problem, points_m=problem.points_m[:-1])
