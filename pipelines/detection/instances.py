"""What both networks' answers become: one label image with the best instances on top.

Owns the last steps, which must not cost more than the network: each mask is worked on within its
box alone, and brought to the image's resolution only there.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.object_types import Detections
from pipelines.types import Array

# Two names for one thing, a car and a truck say, share nearly all of their boxes; a rider and the
# bicycle, or a person before a bus, do not.
_SAME_THING_IOU = 0.85

# First column and row of a mask in the image, and its pixels (h, w) bool
PlacedMask = tuple[int, int, NDArray[np.bool_]]


def suppress_duplicates(
    boxes_px: NDArray[np.float32],
    scores: NDArray[np.float32],
    classes: NDArray[np.int64],
    iou: float,
) -> NDArray[np.int64]:
    """Indices of the boxes (N, 4) x1 y1 x2 y2 that stay, best score first.

    A box goes where a better one of its class overlaps it by more than `iou`, or a better one of
    any class nearly covers the same.
    """
    if len(scores) == 0:
        return np.empty(0, np.int64)
    corner_and_size = np.hstack([boxes_px[:, :2], boxes_px[:, 2:] - boxes_px[:, :2]])
    kept = _indices(
        cv2.dnn.NMSBoxesBatched(
            corner_and_size.tolist(), scores.tolist(), classes.tolist(), 0.0, iou
        )
    )
    unlike = cv2.dnn.NMSBoxes(
        corner_and_size[kept].tolist(), scores[kept].tolist(), 0.0, _SAME_THING_IOU
    )
    kept = kept[_indices(unlike)]
    return kept[np.argsort(-scores[kept], kind="stable")]


def _indices(chosen: Sequence[int]) -> NDArray[np.int64]:
    return np.array(chosen, np.int64).reshape(-1)


def place_mask(
    grid: NDArray[np.float32],
    cell_xy: tuple[float, float],
    origin_xy: tuple[float, float],
    box_px: Array,
    image_shape: tuple[int, ...],
    threshold: float,
    *,
    beyond: float | None = None,
) -> PlacedMask:
    """The pixels of a box where a coarse grid (h, w), read between its cells, is over `threshold`.

    cell_xy, origin_xy: size of a cell and corner of the grid, in px of the image's pixel edges.
    box_px: (4,) x1 y1 x2 y2 in the same. beyond: value outside the grid; None = that of its border.
    """
    height, width = image_shape[:2]
    ends = np.ceil(np.asarray(box_px, np.float64) - 0.5)  # pixels whose centre is in the box
    x1, y1, x2, y2 = np.clip(ends, 0, [width, height, width, height]).astype(int)
    if x2 <= x1 or y2 <= y1 or grid.size == 0:
        return int(x1), int(y1), np.zeros((0, 0), bool)
    to_grid = np.array(
        [
            [1 / cell_xy[0], 0, (x1 + 0.5 - origin_xy[0]) / cell_xy[0] - 0.5],
            [0, 1 / cell_xy[1], (y1 + 0.5 - origin_xy[1]) / cell_xy[1] - 0.5],
        ]
    )
    fine = cv2.warpAffine(
        np.ascontiguousarray(grid, np.float32),
        to_grid,
        (int(x2 - x1), int(y2 - y1)),
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REPLICATE if beyond is None else cv2.BORDER_CONSTANT,
        borderValue=beyond or 0.0,
    )
    return int(x1), int(y1), np.asarray(fine > threshold)


def compose(
    image_shape: tuple[int, ...],
    class_names: NDArray[np.str_],
    scores: NDArray[np.float32],
    masks: Iterator[PlacedMask],
) -> Detections:
    """Instances in order of falling score, as one image of labels 1, 2, ...

    A pixel belongs to the best instance whose mask holds it; instances left without one are gone.
    """
    labels = np.zeros(image_shape[:2], np.int32)
    for label, (x, y, mask) in enumerate(masks, start=1):
        window = labels[y : y + mask.shape[0], x : x + mask.shape[1]]
        window[mask & (window == 0)] = label
    left = np.flatnonzero(np.bincount(labels.ravel(), minlength=1)[1:])
    return Detections(
        labels,
        (left + 1).astype(np.int32),
        class_names[left],
        np.clip(scores[left].astype(np.float64), 0.0, 1.0),
    )
