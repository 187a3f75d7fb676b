"""SE(3) against the matrix exponential, and Jacobians against finite differences."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from pipelines.geometry import (
    T_from_q_xyzw,
    backproject,
    exp_se3,
    inside_image,
    invert_T,
    make_T,
    orthonormalise,
    pose_jacobian,
    project_stereo,
    projection_jacobian,
    q_xyzw_from_T,
    rotation_angle_deg,
    rotation_vector,
    skew,
    transform_points,
)
from pipelines.types import StereoCamera

CAMERA = StereoCamera(640, 400, 480.0, 510.0, 315.0, 190.0, 240.0)


def random_motions(n, seed=0):
    rng = np.random.default_rng(seed)
    return np.stack([
        make_T(Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3))
        for _ in range(n)
    ])  # fmt: skip


def points_in_view(n, seed=1):
    rng = np.random.default_rng(seed)
    uv = rng.uniform([0, 0], [CAMERA.width, CAMERA.height], (n, 2))
    return backproject(CAMERA, uv, rng.uniform(2, 60, n))


def test_inverse_undoes_motions_of_any_stack():
    Ts = random_motions(12).reshape(3, 4, 4, 4)
    before = Ts.copy()
    np.testing.assert_allclose(invert_T(Ts) @ Ts, np.broadcast_to(np.eye(4), Ts.shape), atol=1e-12)
    np.testing.assert_array_equal(Ts, before)


def test_points_are_transformed_like_homogeneous_ones():
    T, points = random_motions(1)[0], points_in_view(7)
    expected = (T @ np.c_[points, np.ones(7)].T).T[:, :3]
    np.testing.assert_allclose(transform_points(T, points), expected, atol=1e-12)


def test_skew_is_the_cross_product():
    a, b = np.random.default_rng(2).normal(size=(2, 5, 3))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", skew(a), b), np.cross(a, b), atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-9, 1e-7, 1e-4, 0.3, 3.0])
def test_exponential_of_a_twist(angle):
    axis = np.array([0.36, -0.48, 0.8])
    xi = np.r_[axis * angle, 0.7, -1.1, 0.4]
    generator = np.zeros((4, 4))
    generator[:3, :3], generator[:3, 3] = skew(xi[:3]), xi[3:]
    T = exp_se3(xi)
    np.testing.assert_allclose(T, expm(generator), atol=1e-9)
    np.testing.assert_allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)
    assert rotation_angle_deg(T) == pytest.approx(np.degrees(angle), rel=1e-6, abs=1e-15)


def test_opposite_twists_undo_each_other():
    xi = np.array([0.1, -0.4, 0.2, 1.0, 2.0, -3.0])
    np.testing.assert_allclose(exp_se3(xi) @ exp_se3(-xi), np.eye(4), atol=1e-14)


def test_orthonormalise_repairs_a_rotation_and_keeps_the_place():
    T = random_motions(1)[0]
    worn = T.copy()
    worn[:3, :3] += np.random.default_rng(3).normal(0, 1e-3, (3, 3))
    repaired = orthonormalise(worn)
    np.testing.assert_allclose(repaired[:3, :3] @ repaired[:3, :3].T, np.eye(3), atol=1e-14)
    np.testing.assert_array_equal(repaired[:, 3], T[:, 3])
    assert 1e-5 < np.abs(repaired - T).max() < 3e-3


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 0.01, 90.0, 179.9, 180.0])
def test_angles_are_exact_from_tiny_to_half_a_turn(degrees):
    axis = np.array([2.0, -1.0, 2.0]) / 3
    R = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
    T = make_T(R, np.zeros(3))
    assert rotation_angle_deg(np.stack([T, T])) == pytest.approx([degrees] * 2, rel=1e-7, abs=1e-13)


def test_quaternions_go_and_come_back():
    Ts = random_motions(6).reshape(2, 3, 4, 4)
    q = q_xyzw_from_T(Ts)
    assert q.shape == (2, 3, 4)
    np.testing.assert_allclose(np.linalg.norm(q, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_allclose(T_from_q_xyzw(Ts[..., :3, 3], q), Ts, atol=1e-12)


def test_quaternion_order_is_x_y_z_w():
    quarter_about_z = np.array([0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)])
    T = T_from_q_xyzw(np.array([1.0, 2.0, 3.0]), quarter_about_z)
    np.testing.assert_allclose(T @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)


def test_stereo_projection_is_the_pinhole_pair():
    point = np.array([[1.0, -0.5, 8.0]])
    left, right = point[0], point[0] - [CAMERA.baseline_m, 0, 0]
    u_l, v, u_r = project_stereo(CAMERA, point)[0]
    for u, p in ((u_l, left), (u_r, right)):
        expected = CAMERA.K @ p
        assert (u, v) == pytest.approx(tuple(expected[:2] / expected[2]))
    assert u_l - u_r == pytest.approx(CAMERA.bf / 8.0)


def test_backprojection_undoes_projection():
    points = points_in_view(20)
    uvr = project_stereo(CAMERA, points)
    np.testing.assert_allclose(
        backproject(CAMERA, uvr[:, :2], CAMERA.bf / (uvr[:, 0] - uvr[:, 2])), points, rtol=1e-9
    )


def test_projection_jacobian_is_the_slope():
    points, h = points_in_view(30), 1e-5
    J = projection_jacobian(CAMERA, points)
    for axis, step in enumerate(h * np.eye(3)):
        up, down = project_stereo(CAMERA, points + step), project_stereo(CAMERA, points - step)
        np.testing.assert_allclose(J[:, :, axis], (up - down) / (2 * h), rtol=1e-5, atol=1e-5)


def test_projection_jacobian_stays_finite_behind_the_camera():
    J = projection_jacobian(CAMERA, np.array([[1.0, 2.0, -3.0], [0.0, 0.0, 0.0]]))
    assert np.isfinite(J).all()


def test_pose_jacobian_is_the_slope_of_a_right_perturbation():
    T, h = random_motions(1, seed=4)[0], 1e-6
    points = points_in_view(30, seed=5)
    world = transform_points(T, points)
    J = pose_jacobian(projection_jacobian(CAMERA, points), points)

    def project_from(xi):
        return project_stereo(CAMERA, transform_points(invert_T(T @ exp_se3(xi)), world))

    for axis, step in enumerate(h * np.eye(6)):
        slope = (project_from(step) - project_from(-step)) / (2 * h)
        np.testing.assert_allclose(J[:, :, axis], slope, rtol=1e-5, atol=1e-4)


def test_inside_image_counts_the_edges_in():
    corners = np.array([[0.0, 0.0], [639.0, 399.0], [-0.01, 5.0], [5.0, 399.01], [np.nan, 5.0]])
    assert inside_image(CAMERA, corners).tolist() == [True, True, False, False, False]
    assert not inside_image(CAMERA, corners, border_px=1.0).any()
    assert inside_image(CAMERA, np.array([[1.0, 398.0]]), border_px=1.0).all()


@pytest.mark.parametrize("shape", [(5,), (2, 3), (0,), (1,)])
def test_exponentials_of_a_batch_are_those_of_each(shape):
    xi = np.random.default_rng(30).normal(size=(*shape, 6))
    xi.reshape(-1, 6)[:1, :3] *= 1e-12  # one hardly turns, and the rest do
    Ts = exp_se3(xi)
    assert Ts.shape == (*shape, 4, 4)
    for index in np.ndindex(shape):
        np.testing.assert_allclose(Ts[index], exp_se3(xi[index]), atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-10, 1e-3, 1.0, 3.1])
def test_rotation_vectors_undo_the_exponential(angle):
    axes = np.random.default_rng(31).normal(size=(2, 3, 3))
    omega = angle * axes / np.linalg.norm(axes, axis=-1, keepdims=True)
    xi = np.concatenate([omega, np.ones_like(omega)], -1)
    np.testing.assert_allclose(rotation_vector(exp_se3(xi)), omega, atol=1e-9)
    assert rotation_vector(exp_se3(xi[0, 0])).shape == (3,)
    assert rotation_vector(np.empty((0, 4, 4))).shape == (0, 3)
