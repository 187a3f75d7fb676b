"""How precise each source of measurements is, learned from its own residuals.

Exact files, a flow network and patch alignment differ by orders of magnitude; weights that are
learned serve them all and need no tuning per data set.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipelines.types import Array

_MIN_SAMPLES = 30  # fewer residuals say nothing about a spread
_MAD_TO_SIGMA = 1.4826  # of a normal distribution


def robust_sigma(residuals: Array) -> float:
    """Standard deviation by the median absolute deviation; residuals of any shape, no NaN."""
    return _MAD_TO_SIGMA * float(np.median(np.abs(residuals)))


@dataclass(slots=True)
class NoiseModel:
    """Running standard deviations in px: of pixels by source, and of disparities.

    sigma_uv_px: name of the source -> standard deviation per axis. memory: share of the old value
    that each new frame keeps. floor_px, ceiling_px: limits of what is learned in one frame.
    Deviation: the paper learns no weights; it takes fixed ones.
    """

    sigma_uv_px: dict[str, float] = field(
        default_factory=lambda: {
            "flow": 0.3,
            "alignment": 0.3,
            "orb": 0.9,
            "looks": 0.9,  # of points of the map that are found again
            "object_flow": 0.3,
            "object_alignment": 0.3,
            "object_interior": 0.3,  # fused, off all depth edges, and beside them
            "object_edge": 0.3,
        }
    )
    sigma_disparity_px: float = 0.5
    memory: float = 0.8
    floor_px: float = 0.005
    ceiling_px: float = 2.0
    _seen: set[str] = field(default_factory=set)

    @property
    def is_learned(self) -> bool:
        """Whether any residuals were taken in yet."""
        return bool(self._seen)

    def _blend(self, source: str, old: float, residuals: Array) -> float:
        """The old value moved by one frame's residuals; the first ones replace the guess."""
        if residuals.size < _MIN_SAMPLES:
            return old
        new = float(np.clip(robust_sigma(residuals), self.floor_px, self.ceiling_px))
        keep = self.memory if source in self._seen else 0.0
        self._seen.add(source)
        return keep * old + (1.0 - keep) * new

    def learn_uv(self, source: str, residuals_px: Array) -> None:
        """Take in the pixel residuals (N, 2) of one frame's inliers."""
        self.sigma_uv_px[source] = self._blend(source, self.sigma_uv_px[source], residuals_px)

    def has_learned(self, source: str) -> bool:
        """Whether residuals of a source were taken in yet."""
        return source in self._seen

    def borrow(self, source: str, other: str) -> None:
        """Begin a source that taught nothing yet with the noise of another that did."""
        if source not in self._seen and other in self._seen:
            self.sigma_uv_px[source] = self.sigma_uv_px[other]

    def learn_disparity(self, residuals_px: Array) -> None:
        """Take in the disparity residuals (N,) of one frame's inliers."""
        self.sigma_disparity_px = self._blend("disparity", self.sigma_disparity_px, residuals_px)
