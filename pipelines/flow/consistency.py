"""Flow against the flow back: a pixel that both lead home is trusted.

Owns the error and the wrapper that gives any method the check. Computes no flow.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.shapes import check_shape
from pipelines.types import Image

if TYPE_CHECKING:
    from pipelines.flow import Flow


def forward_backward_error(
    flow: NDArray[np.float32], back: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Distance (H, W) float32 in pixels between a pixel and where flow and flow back lead it.

    flow, back: (H, W, 2) in pixels, from the first image to the second and from the second to the
    first. `back` is read between its pixels. inf where the flow leaves the image, so that no
    limit lets it pass; NaN where the flow or the flow back is unknown.
    """
    check_shape("forward_backward_error", "back", back, flow.shape)
    height, width = flow.shape[:2]
    v, u = np.mgrid[:height, :width].astype(np.float32)
    there_u, there_v = u + flow[..., 0], v + flow[..., 1]
    unknown = ~np.isfinite(flow).all(axis=2)
    inside = (there_u >= 0) & (there_u <= width - 1) & (there_v >= 0) & (there_v <= height - 1)
    returned = cv2.remap(
        np.ascontiguousarray(back, np.float32),
        np.where(inside, there_u, 0),
        np.where(inside, there_v, 0),
        cv2.INTER_LINEAR,
    )
    error = np.linalg.norm(flow + returned, axis=2)
    error[~inside] = np.inf
    error[unknown] = np.nan
    return np.asarray(error, np.float32)


class CheckedFlow:
    """Flow of `method`, NaN where going there and back misses the start.

    back: the method that computes the way back, mostly `method` itself, which doubles its cost.
    max_miss_px: a pixel that comes back farther than this from its start is emptied, and so is one
    that leaves the image.
    """

    def __init__(self, method: Flow, back: Flow, max_miss_px: float = 1.0) -> None:
        self._method, self._back, self._max_miss_px = method, back, max_miss_px

    def compute(
        self, previous: Image, image: Image, given: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32] | None:
        """As `pipelines.flow.Flow.compute`; None where `method` has no flow."""
        flow = self._method.compute(previous, image, given)
        back = None if flow is None else self._back.compute(image, previous)
        if flow is None or back is None:
            return flow
        missed = ~(forward_backward_error(flow, back) <= self._max_miss_px)
        return np.where(missed[..., None], np.float32(np.nan), flow)
