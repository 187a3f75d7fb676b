"""Sub-pixel reading of dense maps: flow between the pixels, disparity never across an edge.

Truncated look-ups are the accuracy floor of earlier systems, so every read goes through here.
Deviation: flow is read across edges too, unlike designed; fusion with patch alignment and the
rejection of outliers are what keeps such mixtures out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.types import Array

_HALF = 2  # px, half the window of the local disparity plane: 5 x 5 pixels
_EDGE_SHARE = 0.04  # a neighbour whose disparity differs by more than this share is across an edge
_EDGE_SIGMAS = 4.0  # plus this many standard deviations of a single pixel's disparity
_MIN_SUPPORT = 0.6  # share of the window that must lie on the plane
_DX, _DY = (
    grid.ravel() for grid in np.meshgrid(np.arange(-_HALF, _HALF + 1), np.arange(-_HALF, _HALF + 1))
)  # px, of the window's pixels from its centre
_INNER = np.flatnonzero((np.abs(_DX) <= 1) & (np.abs(_DY) <= 1))
_MOMENTS = np.stack([np.ones(len(_DX)), _DX, _DY, _DX**2, _DY**2, _DX * _DY], -1)


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
    return _fit_planes(disparity_px, uv_px, sigma_px, 1)[:, 0]


def disparity_slopes(disparity_px: NDArray[np.float32], uv_px: Array, sigma_px: float) -> Array:
    """Slopes (N, 2) of the disparity along u and v at places (N, 2), in px a px.

    As `sample_disparity`, from every second pixel of 9 x 9; none, 0, where too few remain.
    """
    if len(uv_px) == 0:
        return np.empty((0, 2))
    return np.nan_to_num(_fit_planes(disparity_px, uv_px, sigma_px, 2)[:, 1:])


def edge_share(disparity_px: NDArray[np.float32], uv_px: Array, sigma_px: float) -> Array:
    """Share (N,) of the known surroundings of places (N, 2) that lie across a depth edge.

    By every fourth pixel of 17 x 17, the window of an alignment: what lies across moves otherwise,
    and drags the aligned place along.
    """
    if len(uv_px) == 0:
        return np.empty(0)
    window = _read_windows(disparity_px, uv_px, sigma_px, 4)
    known = np.isfinite(window.off_median_px)
    across = np.count_nonzero(known & ~window.on_plane, axis=1)
    return across / np.maximum(np.count_nonzero(known, axis=1), 1)


@dataclass(frozen=True, slots=True)
class _Windows:
    """Disparities of 5 x 5 pixels around N places.

    center_px: (N, 2) int64, where they are. median_px: (N,) of the inner 3 x 3, off_median_px:
    (N, 25) what each is more. on_plane: (N, 25) which are known and not across a depth edge.
    """

    center_px: NDArray[np.int64]
    median_px: Array
    off_median_px: Array
    on_plane: NDArray[np.bool_]


def _read_windows(
    disparity_px: NDArray[np.float32], uv_px: Array, sigma_px: float, spread: int
) -> _Windows:
    """spread: px, from one to the next of the 5 x 5 pixels."""
    H, W = disparity_px.shape
    reach = _HALF * spread
    x0 = np.clip(np.rint(uv_px[:, 0]).astype(np.int64), reach, W - 1 - reach)
    y0 = np.clip(np.rint(uv_px[:, 1]).astype(np.int64), reach, H - 1 - reach)
    pixels = (y0 * W + x0)[:, None] + spread * (_DY * W + _DX)
    window = np.take(disparity_px.ravel(), pixels)
    centre = np.sort(np.take(window, _INNER, axis=1), axis=1)  # NaN sorts last
    n_valid = np.isfinite(centre).sum(1)
    median = centre[np.arange(len(centre)), np.maximum(n_valid - 1, 0) // 2].astype(np.float64)
    window = window.astype(np.float64)
    edge = spread * _EDGE_SHARE * median + _EDGE_SIGMAS * sigma_px
    window -= median[:, None]
    on_plane = np.abs(window) < edge[:, None]
    return _Windows(np.stack([x0, y0], -1), median, window, on_plane)


def _fit_planes(
    disparity_px: NDArray[np.float32], uv_px: Array, sigma_px: float, spread: int
) -> Array:
    """(N, 3) disparity and its slopes at places (N, 2), NaN where too few pixels lie on a plane."""
    window = _read_windows(disparity_px, uv_px, sigma_px, spread)
    on_plane = window.on_plane
    plane = _planes_at(
        np.where(on_plane, window.off_median_px, 0.0),
        on_plane.astype(np.float64),
        (uv_px[:, 0] - window.center_px[:, 0]) / spread,
        (uv_px[:, 1] - window.center_px[:, 1]) / spread,
    )
    plane[:, 0] += window.median_px
    plane[:, 1:] /= spread
    plane[on_plane.sum(1) < _MIN_SUPPORT * len(_DX)] = np.nan
    return plane


def _planes_at(value: Array, weight: Array, du: Array, dv: Array) -> Array:
    """Least-squares planes through windows (N, 25) with weights (N, 25): (N, 3).

    Value at (du, dv) off centre, and slopes. The normal equations of d = c0 + c1 du + c2 dv are
    solved by Cramer's rule, as there are many.
    """
    n, x, y, xx, yy, xy = (weight @ _MOMENTS).T
    d, dx, dy = (value @ _MOMENTS[:, :3]).T
    n, xx, yy = n + 1e-9, xx + 1e-3, yy + 1e-3  # a row of pixels alone is taken as level
    a, b, c = xx * yy - xy * xy, xy * y - x * yy, x * xy - xx * y
    e, f, g = n * yy - y * y, x * y - n * xy, n * xx - x * x
    determinant = n * a + x * b + y * c
    c0 = a * d + b * dx + c * dy
    c1 = b * d + e * dx + f * dy
    c2 = c * d + f * dx + g * dy
    return np.column_stack([c0 + c1 * du + c2 * dv, c1, c2]) / determinant[:, None]
