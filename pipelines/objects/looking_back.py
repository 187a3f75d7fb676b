"""Points of objects in the previous image that were not tracked there: of new ones, and of lost.

Owns the two ways back: along the flow for what is detected for the first time, by descriptors for
what moved too far for the flow. Keeps nothing.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.frontend.view import View
from pipelines.objects.frame import LastObjects, ObjectFrame
from pipelines.objects.points import choose_pixels, tight_window
from pipelines.objects.search import match_masks
from pipelines.objects.solver import MotionSolver
from pipelines.types import Array

_GRID_PX = 3  # on the previous image, which is searched for a new object's pixels
_SHY_NODES = 5  # nodes, side of the square by which a seed keeps off other objects
_MIN_SEARCH_PX = 400  # an object of fewer pixels has too few corners to be found by them


def seed_pixels(
    last: LastObjects, frame: ObjectFrame, flow_px: NDArray[np.float32], n_each: int
) -> tuple[NDArray[np.int64], Array]:
    """Pixels of the previous image that belong to the frame's new objects: ids (N,), pixels (N, 2).

    A new object was there before it was detected: the flow (H, W, 2) says which pixels lead into
    its mask, so that it has a motion in its very first frame. What stood before it or beside it
    then is left out.
    """
    to = flow_px[::_GRID_PX, ::_GRID_PX]
    v, u = np.mgrid[0 : to.shape[0], 0 : to.shape[1]].astype(np.float32) * _GRID_PX
    x, y = u + to[..., 0], v + to[..., 1]
    x[~(np.isfinite(x) & np.isfinite(y))] = -1e6  # out of the image, where there is no label
    label = cv2.remap(frame.labels.astype(np.float32), x, y, cv2.INTER_NEAREST)
    before = last.labels[::_GRID_PX, ::_GRID_PX].astype(np.float32)
    before = cv2.dilate(before, np.ones((_SHY_NODES, _SHY_NODES), np.uint8))
    label[(before > 0) & (before != label)] = 0
    pixels = [_pixels_on_grid(last.view, label == np.float32(i), n_each) for i in frame.new_ids]
    ids = np.repeat(np.array(frame.new_ids, np.int64), [len(p) for p in pixels])
    return ids, np.concatenate([np.empty((0, 2)), *pixels])


def _pixels_on_grid(view: View, on_grid: NDArray[np.bool_], n: int) -> Array:
    """Pixels (N, 2) of a view for points of an object that covers these nodes of the grid."""
    if not on_grid.any():
        return np.empty((0, 2))
    nodes = tight_window(on_grid)
    mask = np.repeat(np.repeat(on_grid[nodes], _GRID_PX, axis=0), _GRID_PX, axis=1)
    H, W = view.gray.shape
    y0, x0 = nodes[0].start * _GRID_PX, nodes[1].start * _GRID_PX
    mask = mask[: H - y0, : W - x0]
    window = (slice(y0, y0 + mask.shape[0]), slice(x0, x0 + mask.shape[1]))
    return choose_pixels(view.gray, mask, window, n, np.empty((0, 2)))


def guess_motions(
    solver: MotionSolver, last: LastObjects, view: View, frame: ObjectFrame, solved: set[int]
) -> dict[int, Array]:
    """Motions G (4, 4) by id, by descriptors, of detected objects that are not among the solved."""
    guesses: dict[int, Array] = {}
    for object_id in frame.windows:
        before = last.mask(object_id)
        if object_id in solved or before is None or object_id in frame.carried_ids:
            continue
        mask = frame.mask(object_id)
        if min(np.count_nonzero(before[0]), np.count_nonzero(mask)) < _MIN_SEARCH_PX:
            continue
        uv_prev, uv = match_masks(
            last.view.gray, *before, view.gray, mask, frame.windows[object_id]
        )
        G = solver.guess_by_matches(last.view.disparity_px, uv_prev, uv)
        if G is not None:
            guesses[object_id] = G
    return guesses
