"""Motion-only bundle adjustment against true poses: precision, its own covariance, robustness."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.frontend.motion_only_ba import (
    CHI2_95_2DOF,
    CHI2_95_3DOF,
    estimate_camera_pose,
    estimate_poses,
    observation_covariance,
    whitening,
)
from pipelines.geometry import (
    backproject,
    exp_se3,
    invert_T,
    project_stereo,
    rotation_angle_deg,
    transform_points,
)
from pipelines.observations import StereoObservations
from pipelines.types import StereoCamera

CAMERA = StereoCamera(1242, 375, 721.5, 721.5, 609.6, 172.9, 387.6)
T_TRUE = exp_se3(np.array([0.1, 0.4, -0.05, 3.0, -0.5, 12.0]))
GUESS = T_TRUE @ exp_se3(np.array([0.01, -0.02, 0.005, 0.2, -0.1, 0.6]))
SIGMA_UV_PX, SIGMA_DISPARITY_PX = 0.4, 0.3


def observe(rng, n, noise=1.0, point_noise=0.0):
    """Observations from T_TRUE; noise and point_noise scale errors *and* what is said of them."""
    uv = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (n, 2))
    points = transform_points(T_TRUE, backproject(CAMERA, uv, rng.uniform(4, 50, n)))
    uvr = project_stereo(CAMERA, transform_points(invert_T(T_TRUE), points))
    sigma_uv, sigma_d = noise * SIGMA_UV_PX, noise * SIGMA_DISPARITY_PX
    error = rng.normal(size=(n, 3)) * [sigma_uv, sigma_uv, sigma_d]
    uvr += np.stack([error[:, 0], error[:, 1], error[:, 0] - error[:, 2]], -1)
    A = point_noise * rng.normal(size=(n, 3, 3)) * [1.0, 1.0, 3.0]
    return StereoObservations(
        points + (A @ rng.normal(size=(n, 3, 1)))[..., 0],
        A @ A.transpose(0, 2, 1),
        uvr,
        np.full(n, max(sigma_uv, 1e-3)),
        np.full(n, max(sigma_d, 1e-3)),
    )


def without_disparity(observations, which):
    uvr = observations.uvr_px.copy()
    uvr[which, 2] = np.nan
    return replace(observations, uvr_px=uvr)


def twist_error(T):
    """(6,) right perturbation [omega, v] from the truth to a near T."""
    E = invert_T(T_TRUE) @ T
    return np.r_[Rotation.from_matrix(E[:3, :3]).as_rotvec(), E[:3, 3]]


def error_m_deg(T):
    E = invert_T(T_TRUE) @ T
    return np.linalg.norm(E[:3, 3]), float(rotation_angle_deg(E))


@pytest.mark.parametrize("mono_share", [0.0, 0.5, 1.0])
def test_exact_observations_give_the_exact_pose(mono_share):
    observations = observe(np.random.default_rng(0), 80, noise=0.0)
    observations = without_disparity(observations, np.arange(80) < 80 * mono_share)
    estimate = estimate_camera_pose(CAMERA, GUESS, observations)
    metres, degrees = error_m_deg(estimate.T_world_camera)
    assert metres < 1e-6 and degrees < 1e-6
    assert estimate.n_inliers == 80 and estimate.inliers.all()
    assert np.isnan(estimate.residuals_px).sum() == 80 * mono_share


@pytest.mark.parametrize(
    ("mono_share", "point_noise"), [(0.0, 0.0), (0.6, 0.0), (0.0, 0.02), (1.0, 0.0)]
)
def test_errors_are_as_large_as_the_covariance_says(mono_share, point_noise):
    """Normalised squared errors of 150 runs: 6 degrees of freedom, mean 6 +- 0.28 if exact.

    Rejection at 95 % costs some efficiency that the covariance does not know of, hence the
    wider upper side.
    """
    rng = np.random.default_rng(1)
    nees, spread = [], []
    for _ in range(150):
        observations = observe(rng, 120, point_noise=point_noise)
        observations = without_disparity(observations, rng.random(120) < mono_share)
        estimate = estimate_camera_pose(CAMERA, GUESS, observations)
        error = twist_error(estimate.T_world_camera)
        nees.append(error @ np.linalg.solve(estimate.covariance, error))
        spread.append(estimate.inliers.mean())
    assert 5.2 < np.mean(nees) < 8.0
    assert 4.0 < np.median(nees) < 7.2
    assert 0.92 < np.mean(spread) < 0.98  # 95 % of good observations pass the test


def test_covariance_halves_with_four_times_the_points():
    few, many = (
        estimate_camera_pose(CAMERA, GUESS, observe(np.random.default_rng(2), n))
        for n in (150, 600)
    )
    ratio = np.sqrt(np.diag(few.covariance) / np.diag(many.covariance))
    assert (ratio > 1.5).all() and (ratio < 2.6).all()


def test_a_third_of_outliers_changes_little():
    rng = np.random.default_rng(3)
    errors, kept_bad, kept_good = [], [], []
    for _ in range(20):
        observations = observe(rng, 200)
        bad = np.arange(200) < 60
        uvr = observations.uvr_px.copy()
        uvr[bad] += rng.choice([-1, 1], (60, 3)) * rng.uniform(8, 60, (60, 3))
        estimate = estimate_camera_pose(CAMERA, GUESS, replace(observations, uvr_px=uvr))
        errors.append(error_m_deg(estimate.T_world_camera))
        kept_bad.append(estimate.inliers[bad].mean())
        kept_good.append(estimate.inliers[~bad].mean())
    metres, degrees = np.mean(errors, axis=0)
    assert 1e-3 < metres < 0.03
    assert 1e-3 < degrees < 0.05
    assert np.max(kept_bad) < 0.05
    assert np.mean(kept_good) > 0.9


def test_an_object_that_moves_as_one_does_not_take_the_camera_along():
    """A quarter of the points share one wrong motion of half a metre: consistent outliers."""
    observations = observe(np.random.default_rng(4), 240)
    moved = np.arange(240) < 60
    points = observations.points_world_m + np.where(moved[:, None], [0.5, 0.0, 0.2], 0.0)
    estimate = estimate_camera_pose(CAMERA, GUESS, replace(observations, points_world_m=points))
    metres, degrees = error_m_deg(estimate.T_world_camera)
    assert metres < 0.08 and degrees < 0.08
    assert estimate.inliers[~moved].mean() > 0.85
    assert estimate.inliers[moved].mean() < 0.5


@pytest.mark.parametrize("point_noise", [0.0, 0.1])
def test_points_behind_the_camera_are_no_inliers_and_do_no_harm(point_noise):
    observations = observe(np.random.default_rng(5), 120, point_noise=point_noise)
    behind = np.arange(120) < 20
    mirrored = transform_points(invert_T(T_TRUE), observations.points_world_m)
    mirrored[:, 2] *= np.where(behind, -1.0, 1.0)
    observations = replace(observations, points_world_m=transform_points(T_TRUE, mirrored))
    estimate = estimate_camera_pose(CAMERA, GUESS, observations)
    assert not estimate.inliers[behind].any()
    assert np.isinf(estimate.chi2[behind]).all() and np.isfinite(estimate.chi2[~behind]).all()
    assert estimate.inliers[~behind].mean() > 0.85
    metres, degrees = error_m_deg(estimate.T_world_camera)
    assert metres < 0.06 and degrees < 0.08


@pytest.mark.parametrize("n", [0, 1, 5])
def test_too_few_points_say_that_nothing_is_known(n):
    estimate = estimate_camera_pose(CAMERA, GUESS, observe(np.random.default_rng(6), n))
    assert np.isnan(estimate.covariance).all()
    assert np.isfinite(estimate.T_world_camera).all()
    assert estimate.inliers.shape == (n,) and estimate.residuals_px.shape == (n, 3)


def test_nothing_but_wrong_points_leaves_few_inliers():
    rng = np.random.default_rng(7)
    observations = observe(rng, 100)
    shuffled = replace(observations, uvr_px=rng.permutation(observations.uvr_px))
    estimate = estimate_camera_pose(CAMERA, GUESS, shuffled)
    assert estimate.n_inliers < 15
    assert np.isfinite(estimate.T_world_camera).all()


def test_inliers_are_what_chi_square_allows():
    observations = without_disparity(observe(np.random.default_rng(8), 200), np.arange(200) < 100)
    estimate = estimate_camera_pose(CAMERA, GUESS, observations)
    limit = np.where(np.arange(200) < 100, CHI2_95_2DOF, CHI2_95_3DOF)
    np.testing.assert_array_equal(estimate.inliers, estimate.chi2 <= limit)
    predicted = project_stereo(
        CAMERA,
        transform_points(invert_T(estimate.T_world_camera), observations.points_world_m),
    )
    np.testing.assert_allclose(
        estimate.residuals_px, observations.uvr_px - predicted, atol=1e-9, equal_nan=True
    )


def test_input_is_not_changed():
    observations = observe(np.random.default_rng(9), 60)
    copies = [getattr(observations, n).copy() for n in observations.__slots__]
    guess = GUESS.copy()
    estimate_camera_pose(CAMERA, guess, observations)
    for name, copy in zip(observations.__slots__, copies, strict=True):
        np.testing.assert_array_equal(getattr(observations, name), copy, err_msg=name)
    np.testing.assert_array_equal(guess, GUESS)


def test_observation_covariance_is_the_spread_of_the_residuals():
    """Against residuals drawn 20000 times for two points."""
    rng = np.random.default_rng(10)
    n, draws = 2, 20000
    observations = observe(rng, n, point_noise=0.02)
    S = observation_covariance(CAMERA, T_TRUE, observations)
    root = np.linalg.cholesky(observations.point_covariances_m2 + 1e-15 * np.eye(3))
    moved = observations.points_world_m + (root @ rng.normal(size=(draws, n, 3, 1)))[..., 0]
    seen = project_stereo(CAMERA, transform_points(invert_T(T_TRUE), moved.reshape(-1, 3)))
    error = rng.normal(size=(draws, n, 3)) * [SIGMA_UV_PX, SIGMA_UV_PX, SIGMA_DISPARITY_PX]
    noise = np.stack([error[..., 0], error[..., 1], error[..., 0] - error[..., 2]], -1)
    residual = seen.reshape(draws, n, 3) + noise
    for i in range(n):
        whitened = np.linalg.solve(np.linalg.cholesky(S[i]), residual[:, i].T)
        np.testing.assert_allclose(np.cov(whitened), np.eye(3), atol=0.05)


def test_whitening_turns_covariances_into_the_identity():
    A = np.random.default_rng(11).normal(size=(50, 3, 3)) * [[1.0], [3.0], [0.2]]
    S = A @ A.transpose(0, 2, 1) + 0.01 * np.eye(3)
    W = whitening(S)
    np.testing.assert_allclose(
        W @ S @ W.transpose(0, 2, 1), np.broadcast_to(np.eye(3), S.shape), atol=1e-8
    )
    assert (np.triu(W, 1) == 0).all()


def test_observations_are_chosen_by_index_or_mask():
    observations = observe(np.random.default_rng(12), 6)
    for which in (np.array([5, 0]), np.arange(6) > 3):
        chosen = observations[which]
        assert len(chosen) == 2
        np.testing.assert_array_equal(chosen.uvr_px, observations.uvr_px[which])
        np.testing.assert_array_equal(chosen.points_world_m, observations.points_world_m[which])


@pytest.mark.parametrize(("scale", "x"), [(0.1, 100.0), (10.0, 10.0), (10.0, 1000.0)])
def test_one_vague_point_behind_the_camera_spoils_no_pose(scale, x):
    """Its covariance in the image is of rank 1 in double precision: it must count for nothing."""
    observations = observe(np.random.default_rng(1), 120)
    points = transform_points(invert_T(T_TRUE), observations.points_world_m)
    points[0] = [x, 1.0, -0.5]
    covariances = observations.point_covariances_m2.copy()
    covariances[0] = np.outer(points[0], points[0]) * scale**2
    observations = replace(
        observations,
        points_world_m=transform_points(T_TRUE, points),
        point_covariances_m2=covariances,
    )
    estimate = estimate_camera_pose(CAMERA, GUESS, observations)
    assert error_m_deg(estimate.T_world_camera)[0] < 0.02
    assert estimate.n_inliers > 100


def test_a_guess_with_far_points_behind_it_still_moves():
    """Half-known depths (the mapping's far points) and a guess turned by 57 degrees."""
    observations = observe(np.random.default_rng(0), 120)
    points = transform_points(invert_T(T_TRUE), observations.points_world_m)
    far = points[:, 2] > 30
    ray = points @ T_TRUE[:3, :3].T
    C = observations.point_covariances_m2.copy()
    C[far] = 0.25 * np.einsum("ni,nj->nij", ray[far], ray[far])
    estimate = estimate_camera_pose(
        CAMERA,
        T_TRUE @ exp_se3(np.array([0, 1.0, 0, 0, 0, 0])),
        replace(observations, point_covariances_m2=C),
    )
    assert np.isfinite(estimate.covariance).all() or estimate.n_inliers == 0
    assert error_m_deg(estimate.T_world_camera)[1] < 50  # at least some step was taken


def test_a_gate_keeps_a_crowd_that_moves_alike_from_dragging_the_pose():
    """40 % of the points move together by 10 px: a bus, say, without a mask."""
    observations = observe(np.random.default_rng(5), 200)
    uvr = observations.uvr_px.copy()
    uvr[:80] += [10.0, 0.0, 10.0]
    moved = replace(observations, uvr_px=uvr)
    near = T_TRUE @ exp_se3(np.array([0.001, -0.001, 0.0005, 0.01, 0.005, 0.01]))
    gated = estimate_camera_pose(CAMERA, near, moved, gate_px=4.0)
    still = estimate_camera_pose(CAMERA, near, observations[np.arange(80, 200)])
    assert error_m_deg(gated.T_world_camera)[0] < 1.5 * error_m_deg(still.T_world_camera)[0] + 1e-3
    assert not gated.inliers[:80].any()


# ----------------------------------------------------------------- many bodies


def join(parts):
    names = parts[0].__slots__
    rows = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return replace(parts[0], **rows), np.array([len(part) for part in parts])


def bodies(rng, sizes):
    """Observations of bodies of these sizes, their guesses, and what each is when solved alone."""
    parts = [observe(rng, n, point_noise=0.02) for n in sizes]
    parts = [without_disparity(part, rng.random(len(part)) < 0.3) for part in parts]
    guesses = np.stack([GUESS @ exp_se3(rng.normal(0, 0.01, 6)) for _ in sizes])
    alone = [estimate_camera_pose(CAMERA, T, part) for T, part in zip(guesses, parts, strict=True)]
    return parts, guesses, alone


def assert_same(found, sizes, j, alone):
    """Body j of many is what it is when solved alone."""
    end = int(np.sum(sizes[: j + 1]))
    rows = slice(end - int(sizes[j]), end)
    pairs = {
        "pose": (found.Ts_body_camera[j], alone.T_world_camera),
        "covariance": (found.covariances[j], alone.covariance),
        "chi2": (found.chi2[rows], alone.chi2),
        "residuals": (found.residuals_px[rows], alone.residuals_px),
    }
    for name, (ours, theirs) in pairs.items():
        np.testing.assert_allclose(ours, theirs, rtol=1e-7, atol=1e-9, err_msg=name)
    np.testing.assert_array_equal(found.inliers[rows], alone.inliers)
    assert found.n_inliers[j] == alone.n_inliers


@pytest.mark.parametrize("sizes", [(80, 40, 150), (60, 0, 3, 30), (1, 2, 3, 4, 5, 50), (7,)])
def test_many_bodies_at_once_are_each_as_alone(sizes):
    """Empty bodies and such of some points neither fail nor disturb the others."""
    parts, guesses, alone = bodies(np.random.default_rng(20), sizes)
    observations, n = join(parts)
    found = estimate_poses(CAMERA, guesses, observations, n)
    for j, one in enumerate(alone):
        assert_same(found, n, j, one)
        assert np.isnan(found.covariances[j]).any() == (sizes[j] < 6)
    assert np.isfinite(found.Ts_body_camera).all()


def test_no_body_at_all():
    observations = observe(np.random.default_rng(21), 0)
    found = estimate_poses(CAMERA, np.empty((0, 4, 4)), observations, np.empty(0, np.int64))
    assert found.Ts_body_camera.shape == (0, 4, 4) and found.covariances.shape == (0, 6, 6)


@pytest.mark.parametrize("harm", ["shuffled", "behind", "nan points", "nan pixels", "far guess"])
def test_one_body_that_diverges_does_not_disturb_the_others(harm):
    rng = np.random.default_rng(22)
    parts, guesses, alone = bodies(rng, (60, 40, 50))
    bad = parts[1]
    points, uvr = bad.points_world_m.copy(), bad.uvr_px.copy()
    if harm == "shuffled":
        uvr = rng.permutation(uvr)
    elif harm == "behind":
        points = transform_points(T_TRUE, -transform_points(invert_T(T_TRUE), points))
    elif harm == "nan points":
        points[::2] = np.nan
    elif harm == "nan pixels":
        uvr[::2] = np.nan
    else:
        guesses[1] = exp_se3(np.array([0.0, 3.0, 0.0, 500.0, 0.0, -900.0]))
    parts[1] = replace(bad, points_world_m=points, uvr_px=uvr)
    observations, n = join(parts)
    found = estimate_poses(CAMERA, guesses, observations, n)
    assert_same(found, n, 0, alone[0])
    assert_same(found, n, 2, alone[2])
    if harm.startswith("nan"):  # the other half of its points is as good as ever
        assert 15 <= found.n_inliers[1] <= 20
        assert error_m_deg(found.Ts_body_camera[1])[0] < 0.2
        assert not found.inliers[60:100:2].any()
    elif harm == "behind":
        assert found.n_inliers[1] == 0


def test_covariances_of_many_bodies_are_their_spread():
    """Monte Carlo over 100 runs of three bodies; rejection at 95 % costs a little more."""
    sizes, nees = (40, 100, 200), []
    rng = np.random.default_rng(23)
    for _ in range(100):
        observations, n = join([observe(rng, size) for size in sizes])
        found = estimate_poses(CAMERA, np.repeat(GUESS[None], 3, axis=0), observations, n)
        errors = [twist_error(T) for T in found.Ts_body_camera]
        nees.append(
            [e @ np.linalg.solve(C, e) for e, C in zip(errors, found.covariances, strict=True)]
        )
    mean = np.mean(nees, axis=0)
    assert (mean > 4.8).all() and (mean < 9.0).all(), mean


def test_a_gate_keeps_out_what_would_drag_the_cost_along():
    """45 % of a body's points share another motion; from a good guess the gate leaves them out."""
    rng, errors = np.random.default_rng(24), {np.inf: [], 4.0: []}
    guess = T_TRUE @ exp_se3(np.array([1e-4, 1e-4, 0, 0.002, 0.0, 0.01]))
    for _ in range(10):
        observations = observe(rng, 100)
        uvr = observations.uvr_px.copy()
        uvr[:45] += [6.0, 2.0, 6.0]
        observations = replace(observations, uvr_px=uvr)
        for gate_px, found in errors.items():
            T = estimate_camera_pose(CAMERA, guess, observations, gate_px=gate_px).T_world_camera
            found.append(error_m_deg(T)[0])
    assert 1e-3 < np.mean(errors[4.0]) < 0.06
    assert np.mean(errors[4.0]) < 0.5 * np.mean(errors[np.inf])
