"""Dense odometry on a small room of three walls whose depth is known in closed form."""

import numpy as np
import pytest

from pipelines.frontend.rgbd_odometry import estimate_rgbd_odometry
from pipelines.geometry import exp_se3, invert_T, rotation_angle_deg
from pipelines.types import StereoCamera

CAMERA = StereoCamera(160, 120, 130.0, 130.0, 79.5, 59.5, 10.0, is_rgbd=True)
T_PREV_CURR = exp_se3(np.array([0.01, -0.02, 0.015, 0.03, -0.02, 0.05]))
# Planes n . p = d in the previous camera: a back wall askew, a side wall, a floor, a step in front.
NORMALS = np.array([[0.2, 0.1, 1.0], [1.0, 0.0, 0.1], [0.0, 1.0, 0.05], [-0.9, 0.1, 0.4]])
OFFSETS = np.array([3.2, 1.2, 0.9, 2.0])


def look(T_world_camera):
    """Grey image and depth (H, W) of the walls: what is nearest along each ray."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    rays = np.stack(
        [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1
    )
    direction = rays @ T_world_camera[:3, :3].T
    with np.errstate(divide="ignore"):
        z = (OFFSETS - NORMALS @ T_world_camera[:3, 3]) / (direction @ NORMALS.T)
    depth = np.where(z > 0.1, z, np.inf).min(-1)
    x, y, w = (T_world_camera[:3, 3] + direction * depth[..., None]).transpose(2, 0, 1)
    gray = 128 + 50 * np.sin(9 * x) * np.sin(8 * y) + 40 * np.sin(7 * w + 2 * x)
    return np.clip(gray, 0, 255).astype(np.uint8), depth.astype(np.float32)


PREVIOUS, CURRENT = look(np.eye(4)), look(T_PREV_CURR)


def error_m_deg(T):
    E = invert_T(T_PREV_CURR) @ T
    return np.linalg.norm(E[:3, 3]), float(rotation_angle_deg(E))


def test_a_small_motion_is_found_from_a_rough_guess():
    T = estimate_rgbd_odometry(CAMERA, PREVIOUS, CURRENT, np.eye(4), 8.0)
    metres, degrees = error_m_deg(T)
    assert error_m_deg(np.eye(4))[0] > 0.05  # what the guess leaves to be found
    assert 1e-7 < metres < 0.004
    assert degrees < 0.1


def test_moving_pixels_are_left_out_when_unknown():
    """A board before the wall that goes its own way pulls, unless both frames leave it out."""

    def with_board(view, column, unknown):
        gray, depth = view[0].copy(), view[1].copy()
        where = np.s_[25:95, column : column + 60]
        depth[where] = np.nan if unknown else 1.1
        return gray, depth

    errors = []
    for unknown in (False, True):
        a, b = with_board(PREVIOUS, 40, unknown), with_board(CURRENT, 46, unknown)
        errors.append(error_m_deg(estimate_rgbd_odometry(CAMERA, a, b, np.eye(4), 8.0))[0])
    assert errors[1] < 0.004
    assert errors[1] < 0.5 * errors[0]


@pytest.mark.parametrize("which", [0, 1])
def test_without_depth_there_is_no_answer(which):
    views = [PREVIOUS, CURRENT]
    views[which] = (views[which][0], np.full_like(views[which][1], np.nan))
    assert estimate_rgbd_odometry(CAMERA, *views, np.eye(4), 8.0) is None


def test_hardly_any_depth_is_no_answer():
    gray, depth = CURRENT
    sparse = np.full_like(depth, np.nan)
    sparse[::8, ::8] = depth[::8, ::8]
    assert estimate_rgbd_odometry(CAMERA, PREVIOUS, (gray, sparse), np.eye(4), 8.0) is None


def test_inputs_are_not_changed():
    gray, depth = CURRENT[0].copy(), CURRENT[1].copy()
    depth[:20] = np.nan
    before, guess = depth.copy(), np.eye(4)
    T = estimate_rgbd_odometry(CAMERA, PREVIOUS, (gray, depth), guess, 8.0)
    assert T is not None
    np.testing.assert_array_equal(depth, before)
    np.testing.assert_array_equal(gray, CURRENT[0])
    np.testing.assert_array_equal(guess, np.eye(4))
