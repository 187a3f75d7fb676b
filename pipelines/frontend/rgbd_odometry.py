"""Dense RGB-D odometry by Open3D: the third motion hypothesis, always seeded with a guess.

Excellent where it converges and wild where it does not, so it is used only where the hypotheses
that rest on points are weak, and must win by inliers like them.
"""

from __future__ import annotations

import os
import sys
from functools import cache
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.types import Array, Image, StereoCamera

_ITERATIONS = (20, 10, 5)  # per pyramid level, coarse to fine
_DEPTH_UNITS_PER_M = 1.0
_MIN_VALID_PIXELS = 2000  # fewer pixels with depth cannot fix a pose
_MAX_DEPTH_JUMP = 0.05  # depths that differ by more, as a share of the median, do not correspond


def estimate_rgbd_odometry(
    camera: StereoCamera,
    previous: tuple[Image, NDArray[np.float32]],
    current: tuple[Image, NDArray[np.float32]],
    T_prev_curr: Array,
    max_depth_m: float,
) -> Array | None:
    """T_prev_curr (4, 4) of two frames, p_prev = T_prev_curr @ p_curr, or None where it fails.

    previous, current: (H, W) uint8 grey and (H, W) float32 depth in m, NaN where unknown *or
    dynamic*: moving pixels must be unknown in both frames. T_prev_curr: the guess that seeds the
    iteration. max_depth_m: depths beyond are left out.
    """
    o3d = _import_open3d()
    odometry = o3d.t.pipelines.odometry
    if min(np.isfinite(depth).sum() for _, depth in (previous, current)) < _MIN_VALID_PIXELS:
        return None
    source, target = (_rgbd_image(o3d, *view, max_depth_m) for view in (current, previous))
    try:
        result = odometry.rgbd_odometry_multi_scale(
            source,
            target,
            o3d.core.Tensor(camera.K),
            o3d.core.Tensor(np.ascontiguousarray(T_prev_curr)),
            _DEPTH_UNITS_PER_M,
            max_depth_m,
            [odometry.OdometryConvergenceCriteria(n) for n in _ITERATIONS],
            odometry.Method.PointToPlane,
            odometry.OdometryLossParams(_MAX_DEPTH_JUMP * float(np.nanmedian(current[1]))),
        )
    except RuntimeError:  # a singular system: too little structure in common
        return None
    T = result.transformation.numpy()
    return T if np.isfinite(T).all() else None


@cache
def _import_open3d() -> Any:
    """Open3D with one thread, so that its parallel sums come out the same every time.

    Its thread pool is sized when it is loaded, by the cores that the loading thread may use. Where
    something else has loaded it before (rendering a simulated scene does), results may differ in
    the last digits from run to run.
    """
    if "open3d" in sys.modules or not hasattr(os, "sched_setaffinity"):
        return import_module("open3d")
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    try:
        return import_module("open3d")
    finally:
        os.sched_setaffinity(0, allowed)


def _rgbd_image(o3d: Any, gray: Image, depth_m: NDArray[np.float32], max_depth_m: float) -> Any:
    depth = np.nan_to_num(depth_m, nan=0.0, posinf=0.0)
    depth[depth > max_depth_m] = 0.0
    color = np.repeat(gray[..., None], 3, axis=2)
    return o3d.t.geometry.RGBDImage(
        o3d.t.geometry.Image(o3d.core.Tensor(color)),
        o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(depth, dtype=np.float32))),
    )
