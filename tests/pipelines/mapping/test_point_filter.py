"""Points under repeated observation: errors shrink as they should and are as large as is said."""

import numpy as np
import pytest

from pipelines.frontend.disparity_offset import corrected, offset_share
from pipelines.geometry import (
    backproject,
    exp_se3,
    invert_T,
    make_T,
    project_stereo,
    transform_points,
)
from pipelines.mapping.point_filter import backprojection_covariance, make_points, refine_points
from pipelines.observations import StereoObservations
from pipelines.types import StereoCamera

CAMERA = StereoCamera(1242, 375, 721.5, 721.5, 609.6, 172.9, 387.6)
SIGMA_UV_PX, SIGMA_DISPARITY_PX = 0.3, 0.4
T_FIRST = exp_se3(np.array([0.05, 0.3, -0.02, 4.0, -1.0, 7.0]))
NO_POSE_ERROR = np.zeros((6, 6))


def true_points(rng, n, low_m, high_m):
    uv = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (n, 2))
    return transform_points(T_FIRST, backproject(CAMERA, uv, rng.uniform(low_m, high_m, n)))


def measure(rng, T, points, noise=1.0):
    """Noisy pixels (N, 2) and disparities (N,) of world points."""
    uvr = project_stereo(CAMERA, transform_points(invert_T(T), points))
    uv = uvr[:, :2] + noise * rng.normal(0, SIGMA_UV_PX, (len(points), 2))
    disparity = uvr[:, 0] - uvr[:, 2] + noise * rng.normal(0, SIGMA_DISPARITY_PX, len(points))
    return uv, disparity


def observations_of(points, covariances, uv, disparity):
    n = len(points)
    uvr = np.column_stack([uv, uv[:, 0] - disparity])
    sigma_uv, sigma_d = np.full(n, SIGMA_UV_PX), np.full(n, SIGMA_DISPARITY_PX)
    return StereoObservations(points, covariances, uvr, sigma_uv, sigma_d)


def track(rng, truth, Ts, mono=False, pose_covariance=NO_POSE_ERROR):
    """Points and covariances of `truth` made at the first of the poses, refined at the others.

    The camera really is where its pose says, give or take `pose_covariance`.
    """
    uv, disparity = measure(rng, Ts[0], truth)
    points, covariances = make_points(
        CAMERA, Ts[0], uv, disparity, SIGMA_UV_PX, np.full(len(truth), SIGMA_DISPARITY_PX)
    )
    slopes = np.zeros_like(points)
    for T in Ts[1:]:
        twist = rng.multivariate_normal(np.zeros(6), pose_covariance)
        uv, disparity = measure(rng, T @ exp_se3(-twist), truth)
        disparity = np.full(len(truth), np.nan) if mono else disparity
        observations = observations_of(points, covariances, uv, disparity)
        points, covariances, slopes = refine_points(
            CAMERA, T, pose_covariance, observations, slopes
        )
    return points, covariances


def nees(points, covariances, truth):
    error = points - truth
    return np.einsum("ni,ni->n", error, np.linalg.solve(covariances, error[..., None])[..., 0])


def test_new_points_lie_where_they_were_seen():
    rng = np.random.default_rng(0)
    truth = true_points(rng, 50, 3, 40)
    uv, disparity = measure(rng, T_FIRST, truth, noise=0.0)
    points, covariances = make_points(CAMERA, T_FIRST, uv, disparity, 0.1, np.full(50, 0.2))
    np.testing.assert_allclose(points, truth, atol=1e-8)
    assert (np.linalg.eigvalsh(covariances) > 0).all()


def test_covariance_of_a_new_point_is_the_spread_of_its_noise():
    rng = np.random.default_rng(1)
    uv, disparity = np.array([900.0, 90.0]), 20.0  # about 19 m
    n = 40000
    noisy_uv = uv + rng.normal(0, SIGMA_UV_PX, (n, 2))
    noisy_d = disparity + rng.normal(0, SIGMA_DISPARITY_PX, n)
    samples = backproject(CAMERA, noisy_uv, CAMERA.bf / noisy_d)
    point = backproject(CAMERA, uv[None], np.array([CAMERA.bf / disparity]))
    said = backprojection_covariance(
        CAMERA, point, np.array([SIGMA_UV_PX]), np.array([SIGMA_DISPARITY_PX])
    )[0]
    whitened = np.linalg.solve(np.linalg.cholesky(said), samples.T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(3), atol=0.05)


def test_depth_uncertainty_grows_with_the_square_of_the_depth():
    points = np.array([[0.0, 0.0, 10.0], [0.0, 0.0, 20.0]])
    near, far = backprojection_covariance(CAMERA, points, np.full(2, 0.3), np.full(2, 0.4))
    assert np.sqrt(far[2, 2] / near[2, 2]) == pytest.approx(4.0)
    assert np.sqrt(far[0, 0] / near[0, 0]) == pytest.approx(2.0)


def test_error_shrinks_with_the_root_of_the_number_of_observations():
    rng = np.random.default_rng(2)
    truth = true_points(rng, 400, 5, 20)
    rmse = {}
    for n in (1, 4, 16):
        points, _ = track(rng, truth, [T_FIRST] * n)
        rmse[n] = np.sqrt(((points - truth) ** 2).sum(1).mean())
    assert rmse[1] / rmse[4] == pytest.approx(2.0, rel=0.15)
    assert rmse[4] / rmse[16] == pytest.approx(2.0, rel=0.15)


@pytest.mark.parametrize("mono", [False, True])
def test_errors_are_as_large_as_the_covariances_say(mono):
    """Normalised squared errors, three degrees of freedom, of a camera that drives by."""
    rng = np.random.default_rng(3)
    truth = true_points(rng, 600, 8, 25)
    Ts = [T_FIRST @ make_T(np.eye(3), np.array([0.05 * k, 0, 0.4 * k])) for k in range(10)]
    points, covariances = track(rng, truth, Ts, mono=mono)
    found = nees(points, covariances, truth)
    assert 2.6 < found.mean() < 3.6
    assert 2.0 < np.median(found) < 2.8  # 2.37 for chi-square of three


def test_pose_errors_count_as_noise():
    rng = np.random.default_rng(4)
    truth = true_points(rng, 400, 8, 25)
    pose_covariance = np.diag([2e-3, 2e-3, 2e-3, 0.05, 0.05, 0.05]) ** 2
    found = []
    for _ in range(8):  # points of one run share their pose errors
        points, covariances = track(rng, truth, [T_FIRST] * 6, pose_covariance=pose_covariance)
        found.append(nees(points, covariances, truth).mean())
    assert 2.2 < np.mean(found) < 4.0


def test_a_very_poor_pose_moves_no_point():
    rng = np.random.default_rng(5)
    truth = true_points(rng, 50, 5, 20)
    uv, disparity = measure(rng, T_FIRST, truth)
    sigma = np.full(50, SIGMA_DISPARITY_PX)
    points, covariances = make_points(CAMERA, T_FIRST, uv, disparity, SIGMA_UV_PX, sigma)
    wrong_T = T_FIRST @ exp_se3(np.array([0.02, 0.0, 0.0, 0.3, 0.0, 0.0]))
    observations = observations_of(points, covariances, uv, disparity)
    moved = {}
    for doubt in (1e-6, 1e4):
        after, *_ = refine_points(
            CAMERA, wrong_T, doubt * np.eye(6), observations, np.zeros((50, 3))
        )
        moved[doubt] = np.linalg.norm(after - points, axis=1).mean()
    assert moved[1e-6] > 0.05
    assert moved[1e4] < 1e-3


def test_far_points_with_half_their_depth_unknown_converge_by_parallax():
    """The first depth is off by up to half; only pixels are seen after, from a passing car."""
    rng = np.random.default_rng(6)
    n = 200
    uv = rng.uniform([200, 50], [1000, 330], (n, 2))
    depth = rng.uniform(60, 110, n)
    truth = backproject(CAMERA, uv, depth)
    guessed = CAMERA.bf / depth * (1 + rng.uniform(-0.4, 0.4, n))
    uv = uv + rng.normal(0, 0.05, (n, 2))
    points, covariances = make_points(CAMERA, np.eye(4), uv, guessed, 0.05, 0.5 * guessed)
    relative_before = np.abs(points[:, 2] - truth[:, 2]) / depth
    slopes = np.zeros_like(points)
    for k in range(1, 30):
        T = make_T(np.eye(3), np.array([0.4 * k, 0.0, 0.8 * k]))
        seen, _ = measure(rng, T, truth)
        observations = observations_of(points, covariances, seen, np.full(n, np.nan))
        points, covariances, slopes = refine_points(CAMERA, T, NO_POSE_ERROR, observations, slopes)
    relative = np.abs(points[:, 2] - truth[:, 2]) / depth
    assert np.median(relative_before) > 0.15
    assert 1e-4 < np.median(relative) < 0.01
    assert relative.max() < 0.05
    assert 2.0 < np.median(nees(points, covariances, truth)) < 3.2


@pytest.mark.parametrize("error_px", [-40.0, -5.0, 5.0, 40.0])
def test_wild_observations_move_no_point_behind_the_camera(error_px):
    rng = np.random.default_rng(7)
    truth = true_points(rng, 200, 20, 150)
    uv, disparity = measure(rng, T_FIRST, truth, noise=0.0)
    points, covariances = make_points(CAMERA, T_FIRST, uv, disparity, SIGMA_UV_PX, 0.5 * disparity)
    slopes = np.zeros_like(points)
    for _ in range(5):
        observations = observations_of(points, covariances, uv, disparity + error_px)
        points, covariances, slopes = refine_points(
            CAMERA, T_FIRST, NO_POSE_ERROR, observations, slopes
        )
        depth = transform_points(invert_T(T_FIRST), points)[:, 2]
        assert np.isfinite(points).all() and np.isfinite(covariances).all()
        assert (depth > 0.05).all()
    assert (
        np.linalg.eigvalsh(covariances) > -1e-9 * np.trace(covariances, axis1=1, axis2=2)[:, None]
    ).all()


def test_covariances_shrink_and_stay_symmetric():
    rng = np.random.default_rng(8)
    truth = true_points(rng, 100, 5, 20)
    _, once = track(rng, truth, [T_FIRST])
    _, twice = track(rng, truth, [T_FIRST] * 2)
    np.testing.assert_array_equal(twice, twice.transpose(0, 2, 1))
    volume = np.linalg.det(twice) / np.linalg.det(once)
    assert 0.05 < np.median(volume) < 0.25  # an eighth of the squared volume


def test_sensitivities_say_how_points_move_with_a_disparity_offset():
    """The slope after an update equals the difference of two filters, one fed with an offset."""
    rng = np.random.default_rng(9)
    truth = true_points(rng, 60, 8, 20)
    Ts = [T_FIRST @ make_T(np.eye(3), np.array([0.05 * k, 0, 0.3 * k])) for k in range(5)]
    seen = [measure(rng, T, truth) for T in Ts]
    sigma, h = np.full(60, SIGMA_DISPARITY_PX), 1e-3

    def run(offset_px):
        uv, disparity = seen[0][0], corrected(CAMERA, seen[0][1], offset_px)
        points, P = make_points(CAMERA, Ts[0], uv, disparity, SIGMA_UV_PX, sigma)
        slopes = (Ts[0][:3, 3] - points) / disparity[:, None]
        slopes *= offset_share(CAMERA, disparity)[:, None]
        for T, (uv, measured) in zip(Ts[1:], seen[1:], strict=True):
            now = corrected(CAMERA, measured, offset_px)
            observations = observations_of(points, P, uv, now)
            points, P, slopes = refine_points(CAMERA, T, NO_POSE_ERROR, observations, slopes)
        return points, slopes

    slope = (run(h)[0] - run(-h)[0]) / (2 * h)
    said = run(0.0)[1]
    scale = np.linalg.norm(slope, axis=1)
    assert np.median(scale) > 0.1
    assert np.median(np.linalg.norm(said - slope, axis=1) / scale) < 0.1


def test_input_is_not_changed():
    rng = np.random.default_rng(10)
    truth = true_points(rng, 20, 5, 20)
    uv, disparity = measure(rng, T_FIRST, truth)
    points, P = make_points(CAMERA, T_FIRST, uv, disparity, 0.3, np.full(20, 0.4))
    disparity[::3] = np.nan
    observations = observations_of(points, P, uv, disparity)
    slopes = np.ones((20, 3))
    copies = [getattr(observations, name).copy() for name in observations.__slots__]
    refine_points(CAMERA, T_FIRST, NO_POSE_ERROR, observations, slopes)
    for name, copy in zip(observations.__slots__, copies, strict=True):
        np.testing.assert_array_equal(getattr(observations, name), copy, err_msg=name)
    assert (slopes == 1).all()
