"""Motions of boxes of points against their truth: precision, covariance, outliers, speed."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.geometry import exp_se3, invert_T, make_T, rotation_vector, transform_points
from pipelines.objects.motion import (
    GATE_6DOF,
    displacement,
    estimate_motions,
    fuse_motions,
    motion_in_world,
    move_points,
    scale_about,
    world_covariance,
)
from pipelines.objects.points import ObjectPoints

NEAR_MISS = exp_se3(np.array([0.0, 0.01, 0.0, 0.05, 0.0, 0.1]))
T_PREV = exp_se3(np.array([0.02, -0.3, 0.01, 5.0, 0.2, 30.0]))
T_CURR = T_PREV @ exp_se3(np.array([0.001, 0.02, 0.0, 0.01, 0.0, 1.1]))


def join(*seen):
    """Points and observations of several objects, all in a row."""
    points = ObjectPoints.concatenate(*(p for p, _ in seen))
    names = seen[0][1].__slots__
    rows = {n: np.concatenate([getattr(o, n) for _, o in seen]) for n in names}
    return points, replace(seen[0][1], **rows)


def solve(kitti, seen, *guesses):
    points, observations = seen
    J = len(points.groups()[0])
    hypotheses = tuple(np.broadcast_to(g, (J, 4, 4)) for g in (*guesses, np.eye(4)))
    return estimate_motions(kitti, points, observations, hypotheses, seed=0)


def twist_error(twist_between, G_true, motions, j=0):
    return twist_between(invert_T(G_true), invert_T(motions.Gs_curr_prev[j]))


def test_exact_points_give_the_exact_motions_of_two_objects_at_once(kitti, body):
    rng = np.random.default_rng(0)
    still = body(center_m=(-4.0, 0.9, 18.0), G=exp_se3(np.array([0, 0.01, 0, 0, 0, -1.0])))
    bodies = [body(), still]
    seen = join(*(b.see(rng, 60, object_id=i, noise=0.0) for i, b in enumerate(bodies, 3)))
    motions = solve(kitti, seen, bodies[0].G @ NEAR_MISS)
    np.testing.assert_array_equal(motions.object_id, [3, 4])
    np.testing.assert_array_equal(motions.n_inliers, [60, 60])
    assert motions.inliers.all()
    for j, one in enumerate(bodies):
        np.testing.assert_allclose(motions.Gs_curr_prev[j], one.G, atol=1e-7)


@pytest.mark.parametrize(
    ("n", "patch_px", "outliers", "nees", "ratio"),
    [
        (150, 20.0, 0.0, (4.0, 14.0), (0.7, 2.0)),  # what the covariance is made for
        (150, 0.0, 0.0, (1.2, 6.0), (0.3, 1.1)),  # independent errors: it is careful
        (150, 0.0, 0.3, (1.2, 7.0), (0.3, 1.2)),
        (30, 0.0, 0.0, (2.5, 9.0), (0.5, 1.5)),
    ],
)
def test_errors_are_as_large_as_claimed(
    kitti, body, twist_between, n, patch_px, outliers, nees, ratio
):
    """100 runs: NEES of 6 degrees of freedom, and each component's spread beside its claim."""
    errors, claims, distances = [], [], []
    for seed in range(100):
        rng, truth = np.random.default_rng(seed), body()
        seen = truth.see(rng, n, patch_px=patch_px, outliers=outliers)
        motions = solve(kitti, seen, truth.G @ NEAR_MISS)
        error, covariance = twist_error(twist_between, truth.G, motions), motions.covariances[0]
        distances.append(error @ np.linalg.solve(covariance, error))
        errors.append(error)
        claims.append(np.sqrt(np.diag(covariance)))
    assert nees[0] < np.mean(distances) < nees[1]
    spread = np.sqrt(np.mean(np.square(errors), axis=0)) / np.mean(claims, axis=0)
    assert (spread > ratio[0]).all() and (spread < ratio[1]).all(), spread
    lengths = np.linalg.norm(np.array(errors)[:, 3:], axis=1)
    assert 1e-3 < np.median(lengths) < 0.02


def test_pnp_takes_over_where_both_hypotheses_are_wrong(kitti, body, twist_between, monkeypatch):
    """What comes on by 6 m and aside by 4 m in a frame, which nothing foretold; 20 % outliers."""
    fast = body(G=exp_se3(np.array([0.0, 0.0, 0.0, -4.0, 0.0, -6.0])))

    def errors_m():
        for seed in range(12):
            seen = fast.see(np.random.default_rng(seed), 60, outliers=0.2)
            motions = solve(kitti, seen, NEAR_MISS)
            yield np.linalg.norm(twist_error(twist_between, fast.G, motions)[3:])

    with_pnp = list(errors_m())
    assert np.median(with_pnp) > 1e-4 and max(with_pnp) < 0.05
    monkeypatch.setattr("pipelines.objects.motion._WEAK_SHARE", 0.0)  # it never competes
    assert np.median(list(errors_m())) > 1.0


def test_the_hypothesis_with_more_inliers_wins(kitti, body, twist_between):
    truth = body()
    seen = truth.see(np.random.default_rng(2), 60)
    far_off = exp_se3(np.array([0.0, 0.5, 0.0, 3.0, 0.0, 8.0]))
    for guesses in ((truth.G, far_off), (far_off, truth.G)):
        motions = solve(kitti, seen, *guesses)
        assert np.linalg.norm(twist_error(twist_between, truth.G, motions)[3:]) < 0.05


def test_points_without_a_disparity_now_still_count(kitti, body, twist_between):
    truth = body()
    points, observations = truth.see(np.random.default_rng(3), 80)
    uvr = observations.uvr_px.copy()
    uvr[::2, 2] = np.nan
    motions = solve(kitti, (points, replace(observations, uvr_px=uvr)), truth.G)
    assert np.linalg.norm(twist_error(twist_between, truth.G, motions)[3:]) < 0.05
    assert motions.n_inliers[0] > 70


def test_few_points_and_none_are_no_motion(kitti, body):
    points, observations = body().see(np.random.default_rng(4), 5)
    motions = solve(kitti, (points, observations), body().G)
    assert np.isnan(motions.covariances).all() and np.isfinite(motions.Gs_curr_prev).all()
    nothing = np.zeros(0, np.int64)
    motions = solve(kitti, (points[nothing], observations[nothing]))
    assert len(motions.object_id) == len(motions.inliers) == 0
    assert motions.Gs_curr_prev.shape == (0, 4, 4)


def test_a_lost_object_leaves_the_other_alone(kitti, body):
    truth = body()
    good = truth.see(np.random.default_rng(5), 60, object_id=1)
    points, observations = body().see(np.random.default_rng(6), 40, object_id=2)
    shuffled = np.random.default_rng(7).permutation(observations.uvr_px)
    both = solve(kitti, join(good, (points, replace(observations, uvr_px=shuffled))), truth.G)
    alone = solve(kitti, good, truth.G)
    np.testing.assert_allclose(both.Gs_curr_prev[0], alone.Gs_curr_prev[0], atol=1e-9)
    assert both.n_inliers[1] < 12


# ---------------------------------------------------------------- in the world


def test_motion_in_the_world_of_what_stands_still_is_none():
    G = invert_T(T_CURR) @ T_PREV
    np.testing.assert_allclose(motion_in_world(G, T_CURR, T_PREV), np.eye(4), atol=1e-12)


def test_motion_in_the_world_moves_world_points():
    H = exp_se3(np.array([0.01, 0.1, 0.0, 0.3, 0.0, 1.2]))
    G = invert_T(T_CURR) @ H @ T_PREV
    np.testing.assert_allclose(motion_in_world(G, T_CURR, T_PREV), H, atol=1e-12)
    points = np.random.default_rng(8).normal(size=(5, 3)) + np.array([0, 0, 10.0])
    moved = move_points(np.stack([G, np.eye(4)]), np.r_[points, points], np.array([5, 5]))
    np.testing.assert_allclose(
        transform_points(T_CURR, moved[:5]), transform_points(H @ T_PREV, points), atol=1e-9
    )
    np.testing.assert_array_equal(moved[5:], points)


def test_world_covariance_is_that_of_the_disturbed_motions():
    """Monte Carlo: G disturbed as it is defined, H's turn and the centre's place read off."""
    rng = np.random.default_rng(9)
    A = rng.normal(size=(6, 6)) * [[1e-4]] * 3 + np.diag([1e-3, 2e-3, 5e-4, 0.02, 0.01, 0.03])
    covariance = A @ A.T
    H = exp_se3(np.array([0.0, 0.05, 0.0, 0.5, 0.0, 1.0]))
    center_prev = transform_points(T_PREV, np.array([[3.0, 1.0, 15.0]]))[0]
    center = center_prev + displacement(H, center_prev)
    inverse_G = invert_T(invert_T(T_CURR) @ H @ T_PREV)
    xi = rng.normal(size=(20000, 6)) @ np.linalg.cholesky(covariance).T
    Gs = invert_T(inverse_G @ exp_se3(xi))
    Hs = T_CURR @ Gs @ invert_T(T_PREV)
    turns = rotation_vector(Hs @ invert_T(H))
    ways = Hs[:, :3, :3] @ center_prev + Hs[:, :3, 3] - center
    sampled = np.cov(np.c_[turns, ways].T)
    claimed = world_covariance(covariance, T_CURR, center)
    scale = np.sqrt(np.outer(np.diag(claimed), np.diag(claimed)))
    np.testing.assert_allclose(sampled / scale, claimed / scale, atol=0.04)
    # What turns the object also shifts its far centre: the signs of both must agree
    assert np.abs((claimed / scale)[:3, 3:]).max() > 0.3


def test_displacement_is_equation_6():
    R = exp_se3(np.array([0.02, 0.2, -0.1, 0, 0, 0]))[:3, :3]
    center, way = np.array([10.0, -1.0, 40.0]), np.array([0.4, 0.0, 1.1])
    H = make_T(R, center + way - R @ center)
    np.testing.assert_allclose(displacement(H, center), way, atol=1e-12)
    spin = make_T(R, center - R @ center)  # turning on the spot is no speed
    assert np.linalg.norm(displacement(spin, center)) < 1e-12
    assert np.linalg.norm(spin[:3, 3]) > 1.0


def test_a_motion_is_made_of_its_shares():
    center = np.array([3.0, 0.5, 20.0])
    H = exp_se3(np.array([0.0, 0.2, 0.02, 0.3, -0.1, 1.0]))
    np.testing.assert_allclose(scale_about(H, center, 1.0), H, atol=1e-9)
    np.testing.assert_allclose(scale_about(H, center, 0.0), np.eye(4), atol=1e-12)
    half = scale_about(H, center, 0.5)
    np.testing.assert_allclose(displacement(half, center), 0.5 * displacement(H, center))
    np.testing.assert_allclose(half[:3, :3] @ half[:3, :3], H[:3, :3], atol=1e-12)
    np.testing.assert_allclose(
        rotation_vector(scale_about(H, center, -1.0)), -rotation_vector(H), atol=1e-9
    )


# --------------------------------------------------------------------- fusion


def disturbed(H, center, xi):
    """H with its turn and its way of the centre put wrong by xi (6,), as of `world_covariance`."""
    R = exp_se3(np.r_[xi[:3], np.zeros(3)])[:3, :3] @ H[:3, :3]
    return make_T(R, center + displacement(H, center) + xi[3:] - R @ center)


def test_fusion_is_the_weighted_mean_and_its_covariance_is_true():
    rng, center = np.random.default_rng(10), np.array([3.0, 1.0, 15.0])
    H = exp_se3(np.array([0.0, 0.05, 0.0, 0.3, 0.0, 1.0]))
    P = np.diag([0.01, 0.02, 0.01, 0.2, 0.1, 0.3]) ** 2
    R = np.diag([0.02, 0.01, 0.01, 0.1, 0.1, 0.6]) ** 2
    errors, distances = [], []
    for _ in range(600):
        a = disturbed(H, center, rng.normal(size=6) * np.sqrt(np.diag(P)))
        b = disturbed(H, center, rng.normal(size=6) * np.sqrt(np.diag(R)))
        fused = fuse_motions(a, P, b, R, center)
        distances.append(fused.distance2)
        if fused.distance2 <= GATE_6DOF:
            E = fused.H_world_curr_prev
            turn = rotation_vector(E @ invert_T(H))
            errors.append(np.r_[turn, displacement(E, center) - displacement(H, center)])
            claimed = fused.covariance
    assert 5.4 < np.mean(distances) < 6.6  # chi-square of 6 degrees of freedom
    assert 0.97 < len(errors) / 600 < 1.0  # the gate holds 99 %
    np.testing.assert_allclose(np.std(errors, axis=0), np.sqrt(np.diag(claimed)), rtol=0.12)
    np.testing.assert_allclose(np.diag(claimed), 1 / (1 / np.diag(P) + 1 / np.diag(R)))


def test_what_is_beyond_the_gate_is_answered_as_measured():
    center, small = np.zeros(3), np.eye(6) * 1e-4
    jump = make_T(np.eye(3), np.array([3.0, 0, 0]))
    fused = fuse_motions(np.eye(4), small, jump, 2 * small, center)
    assert fused.distance2 == pytest.approx(9.0 / 3e-4)
    np.testing.assert_array_equal(fused.H_world_curr_prev, jump)
    np.testing.assert_array_equal(fused.covariance, 2 * small)
