"""The ground below the camera: a plane in disparity, found anew in each frame.

Owns its fit and heights above it. A road, a floor; where there is none, nothing counts as ground.
"""

from __future__ import annotations

import numpy as np

from pipelines.detection.cells import CellGrid, Floats
from pipelines.types import Array

_SAMPLES = 400  # cells that a plane is scored on
_MAX_CELLS = 3000  # that the plane is refined on
_TRIALS = 120
_TOLERANCE_SHARE = 0.03  # of the disparity, that the ground may be uneven by
_MAX_TILT_DEG = 25.0  # of the ground against the camera
_MIN_HEIGHT_M, _MAX_HEIGHT_M = 0.3, 4.0  # of the camera above it
_MIN_SHARE = 0.12  # of the cells in the lower half of the image that must lie on it
_BELOW_WEIGHT = 2.0  # a cell beneath a plane speaks against it more than one on it speaks for it


def fit_ground(
    grid: CellGrid, disparity_px: Floats, last: Array | None, sigma_px: float
) -> Array | None:
    """Inverse-depth plane (3,): 1 / z = plane . (x, y, 1) for rays (x, y, 1); None if not seen.

    disparity_px: (h, w) of the cells. last: the plane of the frame before, tried first.
    sigma_px: noise of a cell. RANSAC on the lower half of the image, where planes must be about
    level, and refined on what agrees.
    """
    h, w = grid.shape
    lower = np.arange((h // 2) * w, h * w)
    d = disparity_px.ravel()[lower]
    seen = np.isfinite(d) & (d > 0)
    lower, d = lower[seen], d[seen].astype(np.float64)
    if len(d) < 50:
        return None
    thinned = slice(None, None, max(1, len(d) // _MAX_CELLS))
    lower, d = lower[thinned], d[thinned]
    inverse = d / grid.camera.bf
    rays = grid.rays[:, lower].astype(np.float64).T
    sigma = sigma_px / grid.camera.bf
    rng = np.random.default_rng(0)  # the same answer for the same frame
    chosen = rng.choice(len(d), min(_SAMPLES, len(d)), replace=False)
    trials = _level_planes(rays, inverse, rng)
    if last is not None:
        trials = np.concatenate([last[None], trials])
    if len(trials) == 0:
        return None
    tolerance = _TOLERANCE_SHARE * inverse + 3 * sigma
    off = inverse[chosen] - trials @ rays[chosen].T
    on = np.abs(off) < tolerance[chosen]
    below = off < -tolerance[chosen]
    score = on.sum(axis=1) - _BELOW_WEIGHT * below.sum(axis=1)
    best = int(np.argmax(score))
    if on[best].sum() < _MIN_SHARE * len(chosen):
        return None
    plane = trials[best]
    for _ in range(2):
        agree = np.abs(inverse - rays @ plane) < tolerance
        if agree.sum() < 20:
            return None
        weighted = rays[agree] / tolerance[agree, None] ** 2
        plane = np.linalg.solve(weighted.T @ rays[agree], weighted.T @ inverse[agree])
    return plane if _is_level(plane[None])[0] else None


def heights_above(grid: CellGrid, disparity_px: Floats, plane: Array) -> Floats:
    """Heights (h, w) in m above the ground `plane` of cells with disparities (h, w)."""
    ground = (plane.astype(np.float32) @ grid.rays).reshape(grid.shape) * np.float32(grid.camera.bf)
    height = np.float32(1 / np.linalg.norm(plane))
    with np.errstate(invalid="ignore", divide="ignore"):
        return height * (1 - ground / disparity_px)


def _level_planes(rays: Array, inverse: Array, rng: np.random.Generator) -> Array:
    """Planes (n, 3) through three cells each, those that may be ground."""
    three = rng.integers(0, len(inverse), (_TRIALS, 3))
    A, b = rays[three], inverse[three]
    solvable = np.abs(np.linalg.det(A)) > 1e-6
    planes = np.linalg.solve(A[solvable], b[solvable][..., None])[..., 0]
    return planes[_is_level(planes)]


def _is_level(planes: Array) -> Array:
    """Which planes (n, 3) lie about level below the camera, (n,) bool."""
    size = np.maximum(np.linalg.norm(planes, axis=1), 1e-9)
    level = planes[:, 1] / size > np.cos(np.deg2rad(_MAX_TILT_DEG))
    return level & (size > 1 / _MAX_HEIGHT_M) & (size < 1 / _MIN_HEIGHT_M)
