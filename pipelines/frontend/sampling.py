"""Sub-pixel reading of dense maps: flow and disparity between the pixels, never across an edge.

Truncated look-ups are the accuracy floor of earlier systems, so every read goes through here.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.types import Array

_HALF = 2  # px, half the window of the local disparity plane: 5 x 5 pixels
_EDGE_SHARE = 0.04  # a neighbour whose disparity differs by more than this share is across an edge
_EDGE_SIGMAS = 4.0  # plus this many standard deviations of a single pixel's disparity
_MIN_SUPPORT = 0.6  # share of the window that must lie on the plane


def sample_bilinear(image: NDArray[np.float32], uv_px: Array) -> Array:
    """Values (N,) or (N, C) of a map (H, W[, C]) at pixels (N, 2); NaN outside or next to NaN."""
    H, W = image.shape[:2]
    u, v = uv_px[:, 0], uv_px[:, 1]
    outside = ~((u >= 0) & (v >= 0) & (u <= W - 1) & (v <= H - 1))
    u = np.where(outside, 0.0, u)
    v = np.where(outside, 0.0, v)
    x = np.minimum(u.astype(np.int64), W - 2)
    y = np.minimum(v.astype(np.int64), H - 2)
    a, b = u - x, v - y
    if image.ndim == 3:
        a, b = a[:, None], b[:, None]
    top = image[y, x] * (1.0 - a) + image[y, x + 1] * a
    bottom = image[y + 1, x] * (1.0 - a) + image[y + 1, x + 1] * a
    value = top * (1.0 - b) + bottom * b
    value[outside] = np.nan
    return value


def sample_disparity(disparity_px: NDArray[np.float32], uv_px: Array, sigma_px: float) -> Array:
    """Disparities (N,) in px at sub-pixel places (N, 2), from a plane through the 5 x 5 pixels.

    Disparity is linear in the pixel on any plane of the scene, so the fit is exact there and
    averages noise. Pixels that differ from the median of the inner 3 x 3 by more than a share of it
    (what a slanted road does) plus the noise `sigma_px` allows lie across a depth edge and are left
    out; where too few remain the answer is NaN.
    """
    if len(uv_px) == 0:
        return np.empty(0)
    H, W = disparity_px.shape
    span = np.arange(-_HALF, _HALF + 1)
    dx, dy = (grid.ravel() for grid in np.meshgrid(span, span))
    x0 = np.clip(np.rint(uv_px[:, 0]).astype(np.int64), _HALF, W - 1 - _HALF)
    y0 = np.clip(np.rint(uv_px[:, 1]).astype(np.int64), _HALF, H - 1 - _HALF)
    window = disparity_px[y0[:, None] + dy, x0[:, None] + dx].astype(np.float64)
    inner = (np.abs(dx) <= 1) & (np.abs(dy) <= 1)
    centre = np.sort(window[:, inner], axis=1)  # NaN sorts last
    n_valid = np.isfinite(centre).sum(1)
    median = centre[np.arange(len(centre)), np.maximum(n_valid - 1, 0) // 2]
    edge = _EDGE_SHARE * median + _EDGE_SIGMAS * sigma_px
    on_plane = np.abs(window - median[:, None]) < edge[:, None]
    weight = on_plane.astype(np.float64)
    value = np.where(on_plane, window - median[:, None], 0.0)
    ox = (x0 - uv_px[:, 0])[:, None] + dx
    oy = (y0 - uv_px[:, 1])[:, None] + dy
    basis = np.stack([np.ones_like(ox), ox, oy], -1)  # d = c0 + c1 du + c2 dv
    weighted = basis * weight[..., None]
    normal = weighted.transpose(0, 2, 1) @ basis + np.diag([1e-9, 1e-3, 1e-3])
    rhs = (weighted.transpose(0, 2, 1) @ value[..., None])[..., 0]
    offset = np.linalg.solve(normal, rhs[..., None])[:, 0, 0]
    supported = weight.sum(1) >= _MIN_SUPPORT * len(dx)
    return np.where(supported, median + offset, np.nan)
