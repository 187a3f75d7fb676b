"""Scene flow of planes with exact depth and flow: none where they stand, their own if they move."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.frontend.view import PreparedFrame
from pipelines.geometry import backproject, exp_se3, invert_T, project_stereo, transform_points
from pipelines.objects.scene_flow import scene_flow
from pipelines.types import Features, Frame, StereoCamera

CAMERA = StereoCamera(160, 120, 150.0, 150.0, 79.5, 59.5, 60.0)
V, U = np.mgrid[:120, :160]
GRID = np.column_stack([U.ravel(), V.ravel()]).astype(float)
X_BEFORE = exp_se3(np.array([0.02, -0.01, 0.0, 0.3, 0.1, 1.0]))
X_NOW = X_BEFORE @ exp_se3(np.array([0.004, 0.006, -0.002, 0.02, 0.01, 0.4]))


def depth_of_plane(T_world_camera, normal, offset_m):
    """(H, W) depth of the plane normal . p = offset in the world, seen from a camera."""
    rays = backproject(CAMERA, GRID, np.ones(len(GRID)))
    along = rays @ (T_world_camera[:3, :3].T @ normal)
    return ((offset_m - normal @ T_world_camera[:3, 3]) / along).reshape(120, 160)


def prepared(depth_m, flow=None) -> PreparedFrame:
    image = np.zeros((120, 160), np.uint8)
    disparity = (CAMERA.bf / depth_m).astype(np.float32)
    return PreparedFrame(
        Frame(0, 0.0, image), image, disparity, Features.empty(), flow_prev_to_curr_px=flow
    )


def scene(step_m):
    """A slanted plane that moves by `step_m` (3,) in the world, before and after, with its flow."""
    normal = np.array([0.1, -0.2, 1.0])
    before = depth_of_plane(X_BEFORE, normal, 9.0)
    now = depth_of_plane(X_NOW, normal, 9.0 + normal @ step_m)
    P = transform_points(X_BEFORE, backproject(CAMERA, GRID, before.ravel())) + step_m
    to = project_stereo(CAMERA, transform_points(invert_T(X_NOW), P))[:, :2]
    flow = (to - GRID).reshape(120, 160, 2).astype(np.float32)
    return prepared(before), prepared(now, flow)


UV = GRID[(GRID[:, 0] % 9 == 4) & (GRID[:, 1] % 9 == 4)]


@pytest.mark.parametrize("step_m", [[0.0, 0.0, 0.0], [0.3, 0.0, 0.0], [-0.1, 0.2, 0.5]])
def test_it_is_the_motion_in_the_world_whatever_the_camera_does(step_m):
    before, now = scene(np.array(step_m))
    f = scene_flow(CAMERA, before, now, (X_BEFORE, X_NOW), UV)
    known = np.isfinite(f).all(axis=1)
    assert known.mean() > 0.7
    np.testing.assert_allclose(f[known], np.tile(step_m, (known.sum(), 1)), atol=2e-3)


def test_it_is_unknown_without_flow_or_depth_and_outside():
    before, now = scene(np.zeros(3))
    assert np.isnan(scene_flow(CAMERA, before, prepared(np.full((120, 160), 9.0)),
                               (X_BEFORE, X_NOW), UV)).all()  # fmt: skip
    now.disparity_px[:60] = np.nan
    f = scene_flow(CAMERA, before, now, (X_BEFORE, X_NOW), UV)
    upper, lower = np.isfinite(f[UV[:, 1] < 50]), np.isfinite(f[UV[:, 1] > 70])
    assert not upper.any() and lower.any()
    assert np.isnan(
        scene_flow(CAMERA, before, now, (X_BEFORE, X_NOW), np.array([[-5.0, 3.0]]))
    ).all()
