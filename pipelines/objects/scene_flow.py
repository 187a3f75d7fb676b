"""Scene flow: how far the matter under each pixel moved in the world between two frames.

Owns the vector of the paper's section Object Motion Tracking. `motion_state` decides by it.
"""

from __future__ import annotations

import numpy as np

from pipelines.frontend.sampling import sample_bilinear, sample_disparity
from pipelines.frontend.view import PreparedFrame
from pipelines.geometry import backproject, transform_points
from pipelines.types import Array, StereoCamera

_SIGMA_DISPARITY_PX = 0.3  # of one pixel: how much neighbours on one surface may differ


def scene_flow(
    camera: StereoCamera,
    before: PreparedFrame,
    now: PreparedFrame,
    Ts_world_camera: tuple[Array, Array],
    uv_px: Array,
) -> Array:
    """f = X_k p_k - X_{k-1} p_{k-1}, (N, 3) in metres in the world, of pixels (N, 2) of `before`.

    Ts_world_camera: X_{k-1} and X_k, (4, 4) each. p_{k-1} is the point that a pixel sees, p_k the
    point at the place to which the dense flow of `now` leads it. NaN where one of them is unknown;
    everywhere if `now` has no flow. Zero, but for noise, on all that stands still.
    """
    if now.flow_prev_to_curr_px is None:
        return np.full((len(uv_px), 3), np.nan)
    to_px = uv_px + sample_bilinear(now.flow_prev_to_curr_px, uv_px)
    points = [
        transform_points(T, _points_m(camera, frame, uv))
        for T, frame, uv in zip(Ts_world_camera, (before, now), (uv_px, to_px), strict=True)
    ]
    return points[1] - points[0]


def _points_m(camera: StereoCamera, frame: PreparedFrame, uv_px: Array) -> Array:
    """Points (N, 3) in the camera that sub-pixel places (N, 2) see; NaN outside and at edges."""
    H, W = frame.disparity_px.shape
    u, v = uv_px.T
    inside = (u >= 0) & (v >= 0) & (u <= W - 1) & (v <= H - 1)  # False for NaN
    points = np.full((len(uv_px), 3), np.nan)
    disparity = sample_disparity(frame.disparity_px, uv_px[inside], _SIGMA_DISPARITY_PX)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth_m = np.where(disparity > 0, camera.bf / disparity, np.nan)
    points[inside] = backproject(camera, uv_px[inside], depth_m)
    return points
