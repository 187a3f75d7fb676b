"""Motion hypotheses: constant velocity in time, PnP among outliers, and the count that decides."""

import numpy as np
import pytest

from pipelines.frontend.hypotheses import (
    ConstantVelocity,
    choose_hypothesis,
    estimate_pnp,
    reprojection_inliers,
)
from pipelines.geometry import (
    backproject,
    exp_se3,
    invert_T,
    rotation_angle_deg,
    transform_points,
)
from pipelines.types import MotionHypothesis, StereoCamera

CAMERA = StereoCamera(640, 480, 520.0, 520.0, 320.0, 240.0, 40.0)
T_TRUE = exp_se3(np.array([0.2, -0.4, 0.1, 1.0, 0.5, -2.0]))


def scene(n=200, n_wrong=0, sigma_px=0.3, seed=0):
    """World points and pixels seen from T_TRUE; the first `n_wrong` pixels are anywhere."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform([0, 0], [640, 480], (n, 2))
    points = transform_points(T_TRUE, backproject(CAMERA, uv, rng.uniform(1, 15, n)))
    uv = uv + rng.normal(0, sigma_px, (n, 2))
    uv[:n_wrong] = rng.uniform([0, 0], [640, 480], (n_wrong, 2))
    return points, uv


def error_m_deg(T):
    E = invert_T(T_TRUE) @ T
    return np.linalg.norm(E[:3, 3]), float(rotation_angle_deg(E))


def screw(seconds):
    """A camera that turns and drives at constant speed along its own axis."""
    return T_TRUE @ exp_se3(np.array([0.0, 0.2, 0.0, 0.0, 1.5, 0.0]) * seconds)


def test_velocity_is_kept_over_uneven_time():
    times = [0.0, 0.1, 0.17, 0.4]
    motion = ConstantVelocity(screw(0.0), 0.0)
    for t in times[1:]:
        motion.update(screw(t), t)
    for t in (0.4, 0.45, 0.5, 0.7, 1.3):
        np.testing.assert_allclose(motion.predict(t), screw(t), atol=1e-9)


def test_a_dropped_frame_doubles_the_step():
    forward = exp_se3(np.array([0.0, 0.01, 0.0, 0.0, 0.0, 0.8]))
    motion = ConstantVelocity(np.eye(4), 0.0)
    motion.update(forward, 0.1)
    one, two = motion.predict(0.2), motion.predict(0.3)
    np.testing.assert_allclose(one, forward @ forward, atol=1e-9)
    assert np.linalg.norm(two[:3, 3] - forward[:3, 3]) == pytest.approx(1.6, abs=0.01)
    assert rotation_angle_deg(two) == pytest.approx(np.degrees(0.03), rel=1e-6)


def test_without_velocity_the_camera_stays():
    motion = ConstantVelocity(T_TRUE, 5.0)
    np.testing.assert_array_equal(motion.predict(9.0), T_TRUE)


def test_velocity_is_dropped_after_a_jump():
    motion = ConstantVelocity(screw(0.0), 0.0)
    motion.update(screw(0.1), 0.1)
    motion.update(np.eye(4), 0.2, continuous=False)
    np.testing.assert_array_equal(motion.predict(0.3), np.eye(4))
    motion.update(screw(0.0), 0.3)
    assert not np.allclose(motion.predict(0.4), screw(0.0))


def test_equal_time_stamps_predict_something_finite():
    motion = ConstantVelocity(screw(0.0), 1.0)
    motion.update(screw(0.1), 1.0)
    np.testing.assert_array_equal(motion.predict(1.1), screw(0.1))


def test_predictions_stay_rigid():
    motion = ConstantVelocity(np.eye(4), 0.0)
    motion.update(screw(0.3), 0.05)
    R = motion.predict(0.5)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)


@pytest.mark.parametrize("n_wrong", [0, 80, 120])
def test_pnp_finds_the_pose_among_outliers(n_wrong):
    points, uv = scene(n_wrong=n_wrong)
    T = estimate_pnp(CAMERA, points, uv, 2.0, seed=0)
    metres, degrees = error_m_deg(T)
    assert 1e-5 < metres < 0.1
    assert 1e-4 < degrees < 0.6
    inliers = reprojection_inliers(CAMERA, T, points, uv, 3.0)
    assert inliers[n_wrong:].mean() > 0.9
    assert inliers[:n_wrong].sum() < 5


def test_pnp_repeats_itself_for_a_seed():
    points, uv = scene(n_wrong=100)
    a, b = (estimate_pnp(CAMERA, points, uv, 2.0, seed=3) for _ in range(2))
    np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("n", [0, 3, 5])
def test_pnp_needs_some_points(n):
    points, uv = scene(n=max(n, 1))
    assert estimate_pnp(CAMERA, points[:n], uv[:n], 2.0, seed=0) is None


def test_pnp_of_noise_is_none_or_has_few_inliers():
    points, uv = scene(n=60, n_wrong=60)
    T = estimate_pnp(CAMERA, points, uv, 2.0, seed=0)
    assert T is None or reprojection_inliers(CAMERA, T, points, uv, 2.0).sum() < 10


def test_inliers_are_near_and_in_front():
    points, uv = scene(n=50, sigma_px=0.0)
    uv[:10] += [3.0, 0.0]
    points[40:] = transform_points(
        T_TRUE, transform_points(invert_T(T_TRUE), points[40:]) * -1.0
    )  # the same pixels, from behind
    inliers = reprojection_inliers(CAMERA, T_TRUE, points, uv, 2.9)
    assert inliers.tolist() == [False] * 10 + [True] * 30 + [False] * 10
    assert reprojection_inliers(CAMERA, T_TRUE, points, uv, 3.1)[:40].all()


def test_the_hypothesis_with_most_inliers_wins():
    points, uv = scene(n_wrong=50)
    near, far = (T_TRUE @ exp_se3(np.array([0, 0, 0, d, 0, 0])) for d in (0.004, 0.3))
    names = list(MotionHypothesis)[1:4]
    for winner in range(3):
        poses = [far, far, far]
        poses[winner] = near
        name, T, count = choose_hypothesis(
            CAMERA, dict(zip(names, poses, strict=True)), points, uv, 3.0
        )
        assert name is names[winner]
        np.testing.assert_array_equal(T, near)
        assert count == reprojection_inliers(CAMERA, near, points, uv, 3.0).sum()
        assert 130 < count <= 155


def test_a_tie_goes_to_the_earliest_and_missing_poses_do_not_stand():
    points, uv = scene()
    candidates = {
        MotionHypothesis.RGBD_ODOMETRY: None,
        MotionHypothesis.CONSTANT_VELOCITY: T_TRUE,
        MotionHypothesis.PNP_RANSAC: T_TRUE.copy(),
    }
    assert choose_hypothesis(CAMERA, candidates, points, uv, 2.0)[0] == "constant_velocity"
    name, _, count = choose_hypothesis(CAMERA, candidates, points[:0], uv[:0], 2.0)
    assert (name, count) == ("constant_velocity", 0)
