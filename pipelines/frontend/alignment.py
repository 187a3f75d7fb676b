"""Sub-pixel places of tracked points: Lucas-Kanade alignment, fused with given optical flow.

Owns the measurement of where last frame's points are now. Knows no poses.

Deviation: the paper takes features and flow as they are. Aligned patches have a third of the noise
of ORB corners, and stand in for a joint refinement of flow and pose.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.types import Array, Image

_WINDOW_PX = 17  # side of the aligned patch
_PYRAMID_LEVELS = 1  # one coarser level: the predictions are good to some pixels
_AGREE_SIGMAS = 3.0  # two measurements further apart are not of the same place
_PRECISE_SHARE = 0.2  # of alignment's noise, below which flow gains 2 % by it at most
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.005)


def align_patches(
    gray_from: Image,
    gray_to: Image,
    uv_from_px: Array,
    predicted_px: Array,
    max_shift_px: float,
    sure: NDArray[np.bool_] | None = None,
) -> tuple[Array, NDArray[np.bool_]]:
    """Places (N, 2) in `gray_to` of the patches around `uv_from_px` (N, 2) of `gray_from`.

    gray_from, gray_to: (H, W). Starts at `predicted_px` (N, 2), NaN where there is no prediction.
    sure: (N,) which predictions are good to a pixel or two, so that the coarse level, half of the
    work, is not needed; none by default.
    The second answer (N,) says which converged within `max_shift_px` of their prediction.
    """
    n = len(uv_from_px)
    known = np.asarray(np.isfinite(predicted_px).all(axis=1))
    start = np.where(known[:, None], predicted_px, uv_from_px)
    uv, found = start.copy(), np.zeros(n, bool)
    sure = np.zeros(n, bool) if sure is None else sure
    for which, levels in ((known & ~sure, _PYRAMID_LEVELS), (known & sure, 0)):
        if not which.any():
            continue
        placed, status, _ = cv2.calcOpticalFlowPyrLK(
            gray_from,
            gray_to,
            np.ascontiguousarray(uv_from_px[which, None], dtype=np.float32),
            np.ascontiguousarray(start[which, None], dtype=np.float32),
            winSize=(_WINDOW_PX, _WINDOW_PX),
            maxLevel=levels,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
            criteria=_STOP,
        )
        uv[which], found[which] = placed[:, 0], status[:, 0] > 0
    shift = np.linalg.norm(uv - start, axis=1)
    return uv, found & (shift <= max_shift_px)


def is_precise(flow_sigma_px: float, alignment_sigma_px: float) -> bool:
    """Whether flow is so much more precise than alignment that it needs none."""
    return flow_sigma_px < _PRECISE_SHARE * alignment_sigma_px


def fuse_measurements(
    uv_a_px: Array, ok_a: NDArray[np.bool_], sigma_a_px: float,
    uv_b_px: Array, ok_b: NDArray[np.bool_], sigma_b_px: float,
) -> tuple[Array, NDArray[np.bool_], Array]:  # fmt: skip
    """Inverse-variance mean of two measurements (N, 2) of the same places.

    ok_a, ok_b: (N,) where they are valid. sigma_a_px, sigma_b_px: their standard deviations per
    axis. Where only one is valid it stands alone. Where both are and they differ by more than three
    standard deviations, one of them is wrong and the more precise source is believed.
    Returns places (N, 2), validity (N,) and standard deviations (N,) in px.
    """
    weight_a, weight_b = sigma_a_px**-2, sigma_b_px**-2
    mean = (weight_a * uv_a_px + weight_b * uv_b_px) / (weight_a + weight_b)
    apart_px = np.linalg.norm(uv_a_px - uv_b_px, axis=1)
    agree = apart_px <= _AGREE_SIGMAS * np.hypot(sigma_a_px, sigma_b_px)
    a_alone = ok_a & (~ok_b | (~agree & (sigma_a_px <= sigma_b_px)))
    b_alone = ok_b & ~a_alone & (~ok_a | ~agree)
    uv = np.where(a_alone[:, None], uv_a_px, np.where(b_alone[:, None], uv_b_px, mean))
    sigma = np.full(len(uv), (weight_a + weight_b) ** -0.5)
    sigma[a_alone], sigma[b_alone] = sigma_a_px, sigma_b_px
    return uv, ok_a | ok_b, sigma
