"""Tells disparity images from metric depth images by the shape of planes in them.

Owns that one test. Walls, floors and roads are planes; over a plane the disparity is a linear
function of the pixel while the depth is not, at any scale and in any units.
"""

from __future__ import annotations

from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.files import SATURATED

STEP_PX = 16  # between the three samples of a line
SMOOTHING_PX = 7  # box that averages the sensor's noise away
SLOPES = (
    0.05,
    0.3,
)  # relative change over STEP_PX: enough to see the curve, too little for an edge
CAST_WITHIN = 0.25  # how near to its expected curvature a sample must be to vote
MIN_VOTES = 500


def disparity_share(images: Iterable[NDArray[np.uint16]]) -> float:
    """Share of votes (0 to 1) that `images` are disparities rather than depths; NaN if too few.

    With q = a + s at three equally spaced pixels and relative slope g, the second difference
    divided by q is 0 where q is a disparity and 2 g^2 where it is a depth (its inverse is linear).
    Noise-free planes give 1 and 0; our rooms and streets, worn or not, 0.8 and more against 0.25
    and less.
    """
    for_disparity = for_metric = 0
    for image in images:
        values = _smooth(image)
        for axis in (0, 1):
            q = np.moveaxis(values, axis, 0)
            low, mid, high = q[: -2 * STEP_PX : 3], q[STEP_PX:-STEP_PX:3], q[2 * STEP_PX :: 3]
            with np.errstate(invalid="ignore"):
                slope = np.abs(high - low) / (2 * mid)
                use = (slope > SLOPES[0]) & (slope < SLOPES[1])
            curvature = (low + high - 2 * mid)[use] / mid[use] / (2 * slope[use] ** 2)
            for_disparity += int(np.count_nonzero(np.abs(curvature) < CAST_WITHIN))
            for_metric += int(np.count_nonzero(np.abs(curvature - 1) < CAST_WITHIN))
    votes = for_disparity + for_metric
    return for_disparity / votes if votes >= MIN_VOTES else float("nan")


def _smooth(image: NDArray[np.uint16]) -> NDArray[np.float32]:
    """Box average (H, W), NaN where the box holds a pixel without a reading."""
    known = ((image != 0) & (image != SATURATED)).astype(np.float32)
    box = (SMOOTHING_PX, SMOOTHING_PX)
    mean = cv2.blur(image.astype(np.float32) * known, box)
    return np.where(cv2.blur(known, box) > 0.999, mean, np.float32(np.nan))
