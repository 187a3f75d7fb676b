"""What can be measured of the instances of a label image: place, size, colour; and carrying them.

Owns the reading of masks. Knows no tracks.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects

from pipelines.geometry import backproject
from pipelines.object_types import Detections
from pipelines.objects.points import Window
from pipelines.types import Array, Image, StereoCamera

_SAMPLES = 400  # pixels of an instance that its depth and colour are read from
_BINS = 4  # of the colour histogram, per channel
_CARRY_INLIER_PX = 3.0  # of points that move as the mask is moved
_MIN_CARRY_SHARE = 0.5  # of the points must


@dataclass(frozen=True, slots=True)
class Instances:
    """M instances of one image.

    labels: (H, W) int32, 0 = background, n = row n - 1. windows: where each lies, None where it has
    no pixel. boxes_px: (M, 4) first and last columns and rows, NaN without pixels.
    centers_m: (M, 3) in the camera, at the median depth; NaN where no depth is known.
    colors: (M, 64) histograms that sum to 1, of n_colored: (M,) pixels. class_names: (M,).
    scores: (M,).
    """

    labels: NDArray[np.int32]
    windows: list[Window | None]
    boxes_px: Array
    centers_m: Array
    colors: Array
    n_colored: NDArray[np.int64]
    class_names: NDArray[np.str_]
    scores: Array

    def __len__(self) -> int:
        return len(self.windows)


def describe_instances(
    camera: StereoCamera,
    image: Image,
    disparity_px: NDArray[np.float32],
    detections: Detections,
) -> Instances:
    """Read off place, size and colour of each detection. image: (H, W[, 3]). disparity: (H, W)."""
    M = len(detections)
    highest = int(detections.label_ids.max(initial=0))
    table = np.zeros(highest + 1, np.int32)
    table[detections.label_ids] = np.arange(1, M + 1)
    labels = relabelled(detections.labels, table) if M else detections.labels
    windows = find_objects(labels, max_label=M) if M else []
    boxes = np.full((M, 4), np.nan)
    centers = np.full((M, 3), np.nan)
    colors, n_colored = np.zeros((M, _BINS**3)), np.zeros(M, np.int64)
    for m, window in enumerate(windows):
        if window is None:
            continue
        rows, columns = window
        boxes[m] = columns.start, rows.start, columns.stop - 1, rows.stop - 1
        v, u = some_pixels(labels, m + 1, window)
        colors[m], n_colored[m] = _color_histogram(image[v, u]), len(v)
        centers[m] = middle_of_pixels(camera, disparity_px, v, u)
    return Instances(
        labels,
        windows,
        boxes,
        centers,
        colors,
        n_colored,
        detections.class_names,
        detections.scores,
    )


def middle_of_pixels(
    camera: StereoCamera,
    disparity_px: NDArray[np.float32],
    v: NDArray[np.int64],
    u: NDArray[np.int64],
    min_disparity_px: float = 0.0,
) -> Array:
    """(3,) in the camera: the middle of pixels (rows v, columns u), at their median depth.

    NaN where no pixel has a disparity of more than `min_disparity_px`.
    """
    disparity = disparity_px[v, u]
    known = disparity > min_disparity_px
    if not known.any():
        return np.full(3, np.nan)
    z = camera.bf / np.array([middle_of(disparity[known])], float)
    return backproject(camera, np.array([[middle_of(u), middle_of(v)]], float), z)[0]


def relabelled(labels: NDArray[np.int32], table: NDArray[np.int32]) -> NDArray[np.int32]:
    """Labels (H, W), each replaced by its entry of a table that has one for all of them."""
    if len(table) > 256:
        return np.take(table, labels)
    whole = np.zeros(256, np.int32)
    whole[: len(table)] = table
    return np.asarray(cv2.LUT(labels.astype(np.uint8), whole), np.int32)  # a fifth of the time


def middle_of(values: NDArray[Any]) -> Any:
    """The median of N > 0 values, the upper of the two middle ones: a fifth of numpy's time."""
    half = len(values) // 2
    return np.partition(values, half)[half]


def some_pixels(
    labels: NDArray[np.int32], label: int, window: Window
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows and columns (N,) of about `_SAMPLES` pixels of a label, evenly spread; one at least."""
    rows, columns = window
    height, width = rows.stop - rows.start, columns.stop - columns.start
    for step in (max(1, int(np.sqrt(height * width / _SAMPLES))), 1):
        v, u = np.nonzero(labels[window][::step, ::step] == label)
        if len(v):
            break
    return v * step + rows.start, u * step + columns.start


def _color_histogram(pixels: NDArray[np.uint8]) -> Array:
    """(64,) of RGB (N, 3) or grey (N,) pixels, normalised by their mean brightness."""
    values = pixels.astype(np.float32).reshape(len(pixels), -1)
    values = values * (110.0 / max(float(values.mean()), 1.0))  # exposure changes
    binned = np.clip(values * (_BINS / 256.0), 0, _BINS - 1).astype(np.int64)
    if binned.shape[1] == 1:
        binned = np.repeat(binned, 3, axis=1)
    index = (binned[:, 0] * _BINS + binned[:, 1]) * _BINS + binned[:, 2]
    return np.bincount(index, minlength=_BINS**3) / len(pixels)


def carry_mask(
    mask: NDArray[np.bool_],
    window: Window,
    uv_prev_px: Array,
    uv_px: Array,
    shape: tuple[int, ...],
) -> tuple[NDArray[np.bool_], Window] | None:
    """A mask of the previous frame, moved as the object's points moved.

    mask: (h, w) inside `window` of the previous image. uv_prev_px, uv_px: (N, 2) its points then
    and now. shape: (H, W) of the image. Returns the mask and its window in the present image, or
    None where the points do not move together or nothing stays in view.
    Paper, section Dense Optical Flow: where segmentation fails, the flow of an object's points
    brings its mask back. Deviation: the pixels follow the points' common shift, turn and scale, as
    dense flow tears at the borders of a mask.
    """
    A, agree = cv2.estimateAffinePartial2D(
        uv_prev_px, uv_px, method=cv2.RANSAC, ransacReprojThreshold=_CARRY_INLIER_PX
    )
    if A is None or agree.mean() < _MIN_CARRY_SHARE:
        return None
    rows, columns = window
    corners = np.array(
        [(u, v) for u in (columns.start, columns.stop - 1) for v in (rows.start, rows.stop - 1)]
    )
    moved = corners @ A[:, :2].T + A[:, 2]
    low = np.maximum(np.floor(moved.min(0)), 0).astype(int)
    high = np.minimum(np.ceil(moved.max(0)) + 1, (shape[1], shape[0])).astype(int)
    if (high <= low).any():
        return None
    A = A.copy()
    A[:, 2] += A[:, :2] @ (columns.start, rows.start) - low
    size = (int(high[0] - low[0]), int(high[1] - low[1]))
    carried = cv2.warpAffine(mask.astype(np.uint8), A, size, flags=cv2.INTER_NEAREST) > 0
    if not carried.any():
        return None
    return carried, (slice(int(low[1]), int(high[1])), slice(int(low[0]), int(high[0])))
