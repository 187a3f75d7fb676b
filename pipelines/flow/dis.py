"""Dense inverse search optical flow by OpenCV.

Owns presets and the check of flow against the flow back.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.errors import ConfigError
from pipelines.types import Image

PRESETS = {
    "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}


class DisFlow:
    """Dense inverse search (Kroeger et al., ECCV 2016), without memory of earlier frames.

    preset: "ultrafast", "fast" or "medium" (about 4, 8 and 34 ms at 1242 x 375 on two cores).
    check: also compute the flow back, at twice the cost, and set NaN where going there and back
    misses the start by more than `max_miss_px`, or leaves the image.
    """

    def __init__(
        self, preset: str = "medium", check: bool = False, max_miss_px: float = 1.0
    ) -> None:
        if preset not in PRESETS:
            raise ConfigError(f"Flow preset: expected {', '.join(PRESETS)}, found {preset!r}.")
        self._dis = cv2.DISOpticalFlow.create(PRESETS[preset])
        self._check, self._max_miss_px = check, max_miss_px

    def compute(
        self, previous_gray: Image, gray: Image, given: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Flow (H, W, 2) float32 in pixels from `previous_gray` to `gray`, both (H, W) uint8.

        It lies on the grid of the previous image; NaN where the check fails. `given` is not
        used. Raises ValueError where the images do not fit together.
        """
        if previous_gray.shape != gray.shape or gray.ndim != 2:
            raise ValueError(
                "DisFlow: expected two grey images of one size, "
                f"found {previous_gray.shape} and {gray.shape}"
            )
        flow = self._run(previous_gray, gray)
        if self._check:
            back = self._run(gray, previous_gray)
            flow[_misses(flow, back) > self._max_miss_px] = np.nan
        return flow

    def _run(self, first: Image, second: Image) -> NDArray[np.float32]:
        first, second = np.ascontiguousarray(first), np.ascontiguousarray(second)
        flow = np.zeros((*first.shape, 2), np.float32)
        return np.ascontiguousarray(self._dis.calc(first, second, flow), np.float32)


def _misses(flow: NDArray[np.float32], back: NDArray[np.float32]) -> NDArray[np.float32]:
    """Distance (H, W) in pixels between each pixel and where flow and flow back lead it."""
    height, width = flow.shape[:2]
    v, u = np.mgrid[:height, :width].astype(np.float32)
    outside = float(height + width)  # the flow back from outside the image: surely a miss
    returned = cv2.remap(
        back,
        u + flow[..., 0],
        v + flow[..., 1],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(outside, outside),
    )
    return np.linalg.norm(flow + returned, axis=2)
