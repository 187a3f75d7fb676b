"""Dense inverse search optical flow by OpenCV.

Owns the presets. The check of flow against the flow back is in `consistency`.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.depth import to_gray
from pipelines.errors import ConfigError
from pipelines.flow.images import check_pair
from pipelines.types import Image

PRESETS = {
    "ultrafast": cv2.DISOPTICAL_FLOW_PRESET_ULTRAFAST,
    "fast": cv2.DISOPTICAL_FLOW_PRESET_FAST,
    "medium": cv2.DISOPTICAL_FLOW_PRESET_MEDIUM,
}


class DisFlow:
    """Dense inverse search (Kroeger et al., ECCV 2016), without memory of earlier frames.

    preset: "ultrafast", "fast" or "medium" (about 4, 8 and 34 ms at 1242 x 375 on two cores).
    """

    def __init__(self, preset: str = "medium") -> None:
        if preset not in PRESETS:
            raise ConfigError(f"Flow preset: expected {', '.join(PRESETS)}, found {preset!r}.")
        self._dis = cv2.DISOpticalFlow.create(PRESETS[preset])

    def compute(
        self, previous: Image, image: Image, given: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Flow (H, W, 2) float32 in pixels from `previous` to `image`, known at every pixel.

        previous, image: (H, W) grey or (H, W, 3) RGB, uint8; it works on the grey values. `given`
        is not used. Raises ValueError where the images do not fit together.
        """
        check_pair("DisFlow", previous, image)
        first, second = (np.ascontiguousarray(to_gray(each)) for each in (previous, image))
        flow = np.zeros((*first.shape, 2), np.float32)
        return np.ascontiguousarray(self._dis.calc(first, second, flow), np.float32)
