"""What is known of the sensor beyond its calibration: noise, disparity error, and how far it sees.

Owns the state that is learned from residuals while running; tracking and mapping share one.
"""

from __future__ import annotations

import numpy as np

from pipelines.config import DepthConfig
from pipelines.frontend.disparity_offset import DisparityOffset
from pipelines.frontend.noise import NoiseModel
from pipelines.frontend.sampling import sample_disparity
from pipelines.frontend.view import View
from pipelines.types import Array, StereoCamera

_DEPTH_SENSOR_SIGMA = 0.002  # 1 / m, sigma_z = this * z^2 of structured light, to begin with
_MIN_DISPARITY_PX = 1.5  # below this a disparity says nothing of a point's depth
_MIN_DISPARITY_SIGMAS = 3.0  # nor when it is within this many standard deviations of zero


class Sensor:
    """One stereo or RGB-D camera, as well as it is known by now.

    noise, offset: what is learned; `LocalMapping` and `Tracker` teach it.
    """

    def __init__(self, camera: StereoCamera, config: DepthConfig) -> None:
        self.camera, self.config = camera, config
        self.noise = NoiseModel()
        self.offset = DisparityOffset()
        if camera.is_rgbd:
            self.noise.sigma_disparity_px = _DEPTH_SENSOR_SIGMA * camera.bf

    @property
    def calibrates_disparity(self) -> bool:
        """Whether the offset of the disparities is learned: a depth sensor has no disparities."""
        return self.config.calibrate_disparity and not self.camera.is_rgbd

    @property
    def min_close_disparity_px(self) -> float:
        """Disparity from which on a point counts as close.

        The paper's rule is z < 40 baselines. Deviation: depths whose relative error is measured to
        be below `relative_error` are close as well, and for a depth sensor that alone counts, as
        its baseline is a convention.
        """
        by_baseline = self.camera.fx / self.config.close_baselines
        by_precision = self.noise.sigma_disparity_px / self.config.relative_error
        limit = by_precision if self.camera.is_rgbd else min(by_baseline, by_precision)
        if self.config.max_depth_m > 0:
            limit = max(limit, self.camera.bf / self.config.max_depth_m)
        return limit

    @property
    def min_disparity_px(self) -> float:
        """Disparity below which it does not even give a far point its first guess of depth."""
        sigma = self.noise.sigma_disparity_px
        return min(
            max(_MIN_DISPARITY_PX, _MIN_DISPARITY_SIGMAS * sigma), self.min_close_disparity_px
        )

    def read_close_disparity(self, view: View, uv_px: Array) -> Array:
        """Disparities (N,) of pixels (N, 2) in px; NaN where far or unknown."""
        disparity = sample_disparity(view.disparity_px, uv_px, self.noise.sigma_disparity_px)
        return np.where(disparity >= self.min_close_disparity_px, disparity, np.nan)
