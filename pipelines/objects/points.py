"""Points on objects: where they are tracked, and where new ones are taken.

Owns the noun `ObjectPoints` and the choice of pixels inside masks. Knows no motion.

Deviation: VDO-SLAM takes every n-th pixel of a mask. Here the best corner of each cell is taken, as
it can be aligned to a fraction of a pixel, and points live on for as long as they are seen, so that
their depths are averaged.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.frontend.sampling import sample_disparity
from pipelines.mapping.point_filter import make_points
from pipelines.types import Array, Image, StereoCamera

Window = tuple[slice, slice]  # rows and columns of an image
_CORNER_WINDOW_PX = 5  # of the structure tensor that ranks pixels
_MIN_CELL_PX, _MAX_CELL_PX = 2, 12
_AREA_PER_POINT_PX, _FEWEST_POINTS = 36, 24
_SIGMA_NEW_UV_PX = 0.05  # px, small: a point is by definition where it was first seen
# Masks are worn at their edges: a rim is left out, thinner on smaller objects
_RIM_PX = ((4000, 3), (1000, 2), (250, 1))  # least pixels of an object, rim


@dataclass(frozen=True, slots=True)
class ObjectPoints:
    """Points on objects (parallel arrays of length N), those of one object in a row.

    object_id: (N,) int64, ascending. position_m: (N, 3) in the camera of the last frame, with
    covariance_m2: (N, 3, 3). uv_px: (N, 2) where that frame saw them. track_id: (N,) int64, the
    point's lasting number, never used twice.
    """

    object_id: NDArray[np.int64]
    position_m: Array
    covariance_m2: Array
    uv_px: Array
    track_id: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.object_id)

    def __getitem__(self, which: NDArray) -> ObjectPoints:
        """The points chosen by a boolean mask or an index array."""
        return ObjectPoints(*(getattr(self, f.name)[which] for f in fields(self)))

    def groups(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Ids (J,) of the objects that have points, and how many each has (J,)."""
        return np.unique(self.object_id, return_counts=True)

    @classmethod
    def empty(cls) -> ObjectPoints:
        """No points at all."""
        ids, two = np.empty(0, np.int64), np.empty((0, 2))
        return cls(ids, np.empty((0, 3)), np.empty((0, 3, 3)), two, ids)

    @classmethod
    def concatenate(cls, *parts: ObjectPoints) -> ObjectPoints:
        """All parts, sorted by object."""
        parts = parts or (cls.empty(),)
        joined = cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))
        return joined[np.argsort(joined.object_id, kind="stable")]


def create_points(
    camera: StereoCamera,
    disparity_px: NDArray[np.float32],
    object_id: NDArray[np.int64],
    uv_px: Array,
    sigma_disparity_px: float,
    min_disparity_px: float,
    first_track_id: int = 0,
) -> ObjectPoints:
    """Points at pixels (N, 2) of objects (N,), by their disparities; those without one are left.

    disparity_px: (H, W) of the same frame, with its noise. min_disparity_px: less says no depth.
    They are numbered from `first_track_id` on.
    """
    disparity = sample_disparity(disparity_px, uv_px, sigma_disparity_px)
    good = disparity >= min_disparity_px
    uv, disparity, owner = uv_px[good], disparity[good], object_id[good]
    sigma = np.full(len(uv), sigma_disparity_px)
    points, covariances = make_points(camera, np.eye(4), uv, disparity, _SIGMA_NEW_UV_PX, sigma)
    track_id = first_track_id + np.arange(len(uv))
    return ObjectPoints(owner, points, covariances, uv, track_id)


def points_wanted(area_px: int, max_points: int) -> int:
    """How many points an object of an area should have: closer ones would see the same patch."""
    return min(max_points, max(_FEWEST_POINTS, area_px // _AREA_PER_POINT_PX))


def choose_pixels(
    gray: Image, mask: NDArray[np.bool_], window: Window, n_all: int, occupied_px: Array
) -> Array:
    """Pixels (N, 2) of an object for new points, at most one a cell: the best corner of each.

    gray: (H, W) the whole image. mask: (h, w) the object inside `window`. n_all: points that the
    whole object should have. occupied_px: (K, 2) those it has, whose cells are taken already.
    """
    inner = _without_rim(mask)
    n_pixels, n = int(np.count_nonzero(inner)), n_all - len(occupied_px)
    if n_pixels == 0 or n <= 0:
        return np.empty((0, 2))
    cell_px = int(np.clip(np.sqrt(n_pixels / n_all), _MIN_CELL_PX, _MAX_CELL_PX))
    quality = cv2.cornerMinEigenVal(np.ascontiguousarray(gray[window]), _CORNER_WINDOW_PX)
    quality = np.where(inner, quality + np.float32(1e-12), np.float32(0.0))
    h, w = quality.shape
    rows, columns = -(-h // cell_px), -(-w // cell_px)
    padded = np.zeros((rows * cell_px, columns * cell_px), np.float32)
    padded[:h, :w] = quality
    tiles = padded.reshape(rows, cell_px, columns, cell_px).transpose(0, 2, 1, 3)
    cells = tiles.reshape(rows * columns, cell_px * cell_px)
    best = cells.argmax(1)
    score = cells[np.arange(len(cells)), best]
    v0, u0 = window[0].start, window[1].start
    if len(occupied_px):
        at = np.rint(occupied_px).astype(np.int64) - (u0, v0)
        inside = (at[:, 0] >= 0) & (at[:, 1] >= 0) & (at[:, 0] < w) & (at[:, 1] < h)
        at = at[inside] // cell_px
        score[at[:, 1] * columns + at[:, 0]] = 0.0
    chosen = np.flatnonzero(score > 0)
    if len(chosen) > n:
        chosen = np.sort(chosen[np.argpartition(-score[chosen], n - 1)[:n]])
    row, column = np.divmod(chosen, columns)
    dv, du = np.divmod(best[chosen], cell_px)
    uv = np.stack([column * cell_px + du + u0, row * cell_px + dv + v0], -1)
    return uv.astype(np.float64)


def _without_rim(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask (h, w) less its rim, but for where it ends with its window.

    Its farthest parts, and where the image cuts it, stay: they say most of how the object turns.
    """
    n_pixels = np.count_nonzero(mask)
    rim_px = next((rim for least, rim in _RIM_PX if n_pixels >= least), 0)
    if rim_px == 0:
        return mask
    kernel = np.ones((2 * rim_px + 1,) * 2, np.uint8)
    return cv2.erode(mask.astype(np.uint8), kernel, borderValue=1) > 0


def tight_window(mask: NDArray[np.bool_]) -> Window:
    """Where the pixels of a mask (h, w) lie in it. It must have some."""
    rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
    return slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
