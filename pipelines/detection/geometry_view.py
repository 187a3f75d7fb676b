"""What multi-view geometry gets of one frame.

Owns shapes and units of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.shapes import check_shape
from pipelines.types import Array, Image


@dataclass(frozen=True, slots=True)
class GeometryView:
    """One frame with its pose, as geometry sees it.

    frame_index: by it is known whether the flow begins at the view segmented last. gray: (H, W)
    uint8. disparity_px: (H, W) float32, as measured, NaN unknown.
    T_world_camera: (4, 4). pose_covariance: (6, 6) of the right perturbation [omega rad, v m]; NaN
    counts as none. flow_prev_to_curr_px: (H, W, 2) float32 on the pixels of the frame before, NaN
    unknown, or None. sigma_disparity_px, sigma_flow_px: standard deviations as learned by the
    front-end, of disparities that are averaged over a few pixels and of flow. disparity_offset_px:
    true minus measured, as learned by now; it is applied to older views too, as it is learned late.
    """

    frame_index: int
    timestamp_s: float
    gray: Image
    disparity_px: NDArray[np.float32]
    T_world_camera: Array
    pose_covariance: Array
    flow_prev_to_curr_px: NDArray[np.float32] | None
    sigma_disparity_px: float
    sigma_flow_px: float
    disparity_offset_px: float = 0.0

    def __post_init__(self) -> None:
        check_shape("GeometryView", "disparity_px", self.disparity_px, (None, None))
        check_shape("GeometryView", "gray", self.gray, self.disparity_px.shape)
        check_shape("GeometryView", "T_world_camera", self.T_world_camera, (4, 4))
        check_shape("GeometryView", "pose_covariance", self.pose_covariance, (6, 6))
        if self.flow_prev_to_curr_px is not None:
            shape = (*self.disparity_px.shape, 2)
            check_shape("GeometryView", "flow_prev_to_curr_px", self.flow_prev_to_curr_px, shape)
