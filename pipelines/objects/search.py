"""Points of one object in two images, by descriptors alone: for what moves too far for flow.

Owns the ORB matching between two masks of an object. Knows no motion.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.frontend.matching import match_all
from pipelines.objects.points import Window
from pipelines.types import Array, Image

_BORDER_PX = 24  # of image around a mask, so that corners at its edge can be described
_N_FEATURES = 300
_FAST_THRESHOLD = 12
_MAX_HAMMING = 64  # bits of 256
_RATIO = 0.85  # of the best to the second best distance (Lowe)


def match_masks(
    gray_prev: Image,
    mask_prev: NDArray[np.bool_],
    window_prev: Window,
    gray: Image,
    mask: NDArray[np.bool_],
    window: Window,
) -> tuple[Array, Array]:
    """Pixels (N, 2) of an object in the previous image, and the same (N, 2) in the present one.

    gray_prev, gray: (H, W) whole images. Each mask (h, w) lies inside its window.
    """
    uv_prev, descriptors_prev = _describe(gray_prev, mask_prev, window_prev)
    uv, descriptors = _describe(gray, mask, window)
    i, j = match_all(descriptors_prev, descriptors, _MAX_HAMMING, _RATIO)
    return uv_prev[i], uv[j]


def _describe(
    gray: Image, mask: NDArray[np.bool_], window: Window
) -> tuple[Array, NDArray[np.uint8]]:
    """ORB corners (N, 2) of the whole image's pixels in the mask, and their descriptors (N, 32)."""
    rows, columns = window
    top, left = max(rows.start - _BORDER_PX, 0), max(columns.start - _BORDER_PX, 0)
    bottom, right = rows.stop + _BORDER_PX, columns.stop + _BORDER_PX
    part = np.ascontiguousarray(gray[top:bottom, left:right])
    inner = np.zeros(part.shape, np.uint8)
    inner[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = mask
    orb = cv2.ORB_create(
        nfeatures=_N_FEATURES,
        nlevels=4,
        edgeThreshold=8,
        fastThreshold=_FAST_THRESHOLD,
    )
    corners, descriptors = orb.detectAndCompute(part, inner)
    if descriptors is None or not corners:
        return np.empty((0, 2)), np.empty((0, 32), np.uint8)
    return cv2.KeyPoint_convert(corners) + np.array([left, top], float), descriptors
