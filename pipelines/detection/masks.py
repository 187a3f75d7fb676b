"""Masks between the coarse grid and the full image: borders follow depth, not cells.

Owns the way from pixels to cells and back. What belongs to an instance is decided elsewhere.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.detection.cells import Bools, CellGrid, Floats

_REACH_CELLS = 2  # a border lies at most this far from its cells
_WINDOW = 5  # cells, of the depth that a pixel by the border is compared with

Labels = NDArray[np.int32]


def labels_of_cells(grid: CellGrid, labels: Labels) -> Labels:
    """Labels (h, w) at the middle of each cell, of labels (H, W)."""
    h, w = grid.shape
    first = grid.cell_px // 2
    return labels[first :: grid.cell_px, first :: grid.cell_px][:h, :w]


def box_of(cells: Bools, margin: int = 0) -> tuple[slice, slice]:
    """Rows and columns of the set cells, wider by `margin` cells inside the grid."""
    rows, columns = np.flatnonzero(cells.any(axis=1)), np.flatnonzero(cells.any(axis=0))
    h, w = cells.shape
    return (
        slice(max(0, int(rows[0]) - margin), min(h, int(rows[-1]) + 1 + margin)),
        slice(max(0, int(columns[0]) - margin), min(w, int(columns[-1]) + 1 + margin)),
    )


def pixels_of_cells(grid: CellGrid, cells: Bools, window: tuple[slice, slice]) -> Bools:
    """Pixels of set cells in a window of the image; the remainder goes with the last cells."""
    indices = (
        np.minimum(np.arange(span.start, span.stop) // grid.cell_px, n - 1)
        for span, n in zip(window, grid.shape, strict=True)
    )
    return cells[np.ix_(*indices)]


def paint(
    grid: CellGrid, cells: Bools, cell_disparity_px: Floats, disparity_px: Floats, gap_share: float
) -> tuple[tuple[slice, slice], Bools]:
    """The pixels of a set of cells: a window of the image, and which of its pixels (bool).

    cells, cell_disparity_px: (h, w). disparity_px: (H, W), NaN unknown. Near the border a pixel
    goes to the side, inside or out, whose depth it has; where neither is nearer, or nothing is
    known, to the nearer cells. Depths differ where their disparities do by `gap_share`.
    """
    rows, columns = box = box_of(cells, _REACH_CELLS + 1)
    inner = cells[box].astype(np.float32)
    size = grid.cell_px
    H, W = disparity_px.shape
    # The last cells reach to the image's edge, over the remainder that has no cell
    bottom = H if rows.stop == grid.shape[0] else rows.stop * size
    right = W if columns.stop == grid.shape[1] else columns.stop * size
    window = (slice(rows.start * size, bottom), slice(columns.start * size, right))
    n_rows, n_columns = bottom - rows.start * size, right - columns.start * size
    full = (inner.shape[1] * size, inner.shape[0] * size)

    def enlarge(values: Floats) -> Floats:
        large = cv2.resize(values, full, interpolation=cv2.INTER_LINEAR)
        more = (n_rows - full[1], n_columns - full[0])
        return np.asarray(
            cv2.copyMakeBorder(large, 0, more[0], 0, more[1], cv2.BORDER_REPLICATE), np.float32
        )

    d = cell_disparity_px[box]
    known = np.isfinite(d).astype(np.float32)
    d = np.nan_to_num(d)
    inside = _local_mean(d, inner * known)
    outside = _local_mean(d, (1 - inner) * known)
    here = disparity_px[window]
    with np.errstate(invalid="ignore"):
        to_outside = np.abs(here - enlarge(outside))
        to_inside = np.abs(here - enlarge(inside))
        preference = (to_outside - to_inside) / (np.float32(gap_share) * here)
    preference = np.clip(np.nan_to_num(preference), -1, 1) * np.float32(0.5)
    reach = cv2.dilate(inner, np.ones((3, 3), np.uint8))
    belongs = (enlarge(inner) - np.float32(0.5) + preference > 0) & (enlarge(reach) > 0.5)
    return window, belongs


def _local_mean(values: Floats, weight: Floats) -> Floats:
    """Weighted mean over a window about each cell; NaN where it holds nothing."""
    window = (_WINDOW, _WINDOW)
    total = cv2.boxFilter(weight, cv2.CV_32F, window, borderType=cv2.BORDER_CONSTANT)
    summed = cv2.boxFilter(values * weight, cv2.CV_32F, window, borderType=cv2.BORDER_CONSTANT)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(total > 1e-3, summed / total, np.float32(np.nan))
