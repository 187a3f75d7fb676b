"""The coarse grid that geometry works on: disparity, flow and static motion, a value a cell.

Owns the reduction of full maps to cells, and where static things were seen from another place. A
cell is a square of `cell_px` pixels; a remainder at the right and bottom edge has no cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.frontend.disparity_offset import corrected
from pipelines.types import Array, StereoCamera

_MIN_KNOWN = 0.4  # share of a cell's pixels that must have a disparity
_EDGE_SHARE = 0.05  # disparities in one cell that spread by more than this share of their mean
_EDGE_SIGMAS = 3.0  # and by more than this many standard deviations of noise lie across an edge

Floats = NDArray[np.float32]
Bools = NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class CellGrid:
    """The geometry of the grid over one camera's image.

    cell_px: px, side of a cell. shape: (h, w). u_px, v_px: (h, w) float32 pixels of the centres.
    rays: (3, h * w) float32, points of the centres at 1 m depth, in the camera.
    """

    camera: StereoCamera
    cell_px: int
    shape: tuple[int, int]
    u_px: Floats
    v_px: Floats
    rays: Floats

    @classmethod
    def of(cls, camera: StereoCamera, cell_px: int) -> CellGrid:
        """The grid of a camera."""
        h, w = camera.height // cell_px, camera.width // cell_px
        middle = (cell_px - 1) / 2
        v, u = np.mgrid[:h, :w].astype(np.float32) * np.float32(cell_px) + np.float32(middle)
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        rays = np.stack([x.ravel(), y.ravel(), np.ones(h * w)]).astype(np.float32)
        return cls(camera, cell_px, (h, w), u, v, rays)

    def to_cells(self, u_px: Floats, v_px: Floats) -> tuple[Floats, Floats]:
        """Fractional column and row on the grid of pixels."""
        middle, share = np.float32((self.cell_px - 1) / 2), np.float32(1 / self.cell_px)
        return (u_px - middle) * share, (v_px - middle) * share

    def mean(self, image: NDArray) -> Floats:
        """Mean of every cell, (h, w[, C]) float32, of a full map (H, W[, C]) without NaN."""
        h, w = self.shape
        cropped = np.ascontiguousarray(image[: h * self.cell_px, : w * self.cell_px])
        mean = cv2.resize(cropped, (w, h), interpolation=cv2.INTER_AREA)
        return np.asarray(mean, np.float32)


@dataclass(frozen=True, slots=True)
class DepthCells:
    """Depth of one view on the grid.

    disparity_px: (h, w) float32, mean of the cell, NaN where unknown. edge: (h, w) bool, whether a
    depth edge crosses the cell, so that its mean is of two things.
    """

    disparity_px: Floats
    edge: Bools

    def corrected(self, camera: StereoCamera, offset_px: float) -> DepthCells:
        """The same with disparities as a learned offset has them."""
        return DepthCells(corrected(camera, self.disparity_px, offset_px), self.edge)


def reduce_disparity(grid: CellGrid, disparity_px: Floats, sigma_px: float) -> DepthCells:
    """Cells of a disparity map (H, W) with NaN where unknown and noise `sigma_px` a cell."""
    known = np.isfinite(disparity_px)
    filled = np.where(known, disparity_px, np.float32(0))
    share = grid.mean(known.astype(np.float32))
    count = np.maximum(share, np.float32(1e-3))
    mean = grid.mean(filled) / count
    # Far from zero mean the difference of squares would drown in rounding: 32 bits do here
    variance = np.maximum(grid.mean(filled * filled) / count - mean * mean, 0)
    # A pixel is noisier than a cell: by sqrt(16) where its errors are independent
    limit = np.maximum(_EDGE_SHARE * mean, np.float32(_EDGE_SIGMAS * grid.cell_px * sigma_px))
    missing = share < _MIN_KNOWN
    edge = (np.sqrt(variance) > limit) & ~missing
    return DepthCells(np.where(missing, np.float32(np.nan), mean), edge)


@dataclass(frozen=True, slots=True)
class StaticPlaces:
    """Where the cells of one view would be seen from another if all they show stood still.

    u_px, v_px, disparity_px: (h, w) float32, NaN where it would be behind the camera.
    du_dd, dv_dd, dd_dd: (h, w) float32, how these change with the cell's own disparity.
    """

    u_px: Floats
    v_px: Floats
    disparity_px: Floats
    du_dd: Floats
    dv_dd: Floats
    dd_dd: Floats


def static_places(grid: CellGrid, disparity_px: Floats, T_other_this: Array) -> StaticPlaces:
    """Places in another view of this view's cells with disparities (h, w).

    T_other_this: (4, 4), takes points of this camera to the other. Works on disparities, which
    stay exact towards infinity: n = R ray + t d / bf, u' = fx n_x / n_z + cx, d' = d / n_z.
    """
    camera = grid.camera
    R, t = T_other_this[:3, :3].astype(np.float32), T_other_this[:3, 3] / camera.bf
    tx, ty, tz = t.astype(np.float32)
    turned = (R @ grid.rays).reshape(3, *grid.shape)
    nx, ny, nz = (turned[i] + ti * disparity_px for i, ti in enumerate((tx, ty, tz)))
    nz = np.where(nz > 1e-3, nz, np.float32(np.nan))
    inverse = np.float32(1) / nz
    x, y = nx * inverse, ny * inverse
    fx, fy = np.float32(camera.fx), np.float32(camera.fy)
    d = np.asarray(disparity_px * inverse, np.float32)
    return StaticPlaces(
        fx * x + np.float32(camera.cx),
        fy * y + np.float32(camera.cy),
        d,
        fx * (tx - x * tz) * inverse,
        fy * (ty - y * tz) * inverse,
        inverse - d * tz * inverse,
    )


def sample(image: NDArray, u: Floats, v: Floats, nearest: bool = False) -> Floats:
    """Values of a map at fractional columns and rows (h, w); NaN outside it and next to NaN."""
    how = cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR
    outside = (np.nan,) * 4
    far = np.float32(-1e4)  # OpenCV does not take NaN for a place
    u, v = (np.where(np.isfinite(x) & (np.abs(x) < 1e4), x, far) for x in (u, v))
    found = cv2.remap(image, u, v, how, borderMode=cv2.BORDER_CONSTANT, borderValue=outside)
    return np.asarray(found, np.float32)
