"""One object over time: identity, class, pose, filter and state.

Owns what is remembered of an object between frames, and its prediction. Measures nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from pipelines.geometry import make_T, transform_points
from pipelines.object_types import UNNAMED_CLASS, ObjectState
from pipelines.objects.kalman import ObjectFilter
from pipelines.objects.motion import scale_about
from pipelines.types import Array

_COLOR_MEMORY = 0.8  # share of the old colours that each frame keeps
_EXTENT_PERCENTILES = (4.0, 96.0)  # of the points, so that a stray one does not blow up the box
_GROWTH = 0.3  # of the way to them by which the box grows in a frame, for the same reason


@dataclass(slots=True)
class ObjectTrack:
    """An object that is in sight, or was not long ago.

    filter, T_world_object: None until something of it has a depth. H_world_curr_prev: last measured
    motion, over `H_dt_s`, with covariance (6, 6); None where the last frame measured none. seen_s, detected_s: when its
    points or mask, and when a detection, were last in view. still_since_s: None unless stopped.
    box_px, area_px, color: of its last mask. low_m, high_m: (3,) box around its points, along the axes of T_world_object.
    """

    object_id: int
    state: ObjectState = ObjectState.UNKNOWN
    scores: dict[str, float] = field(default_factory=dict)
    filter: ObjectFilter | None = None
    T_world_object: Array | None = None
    H_world_curr_prev: Array | None = None
    H_dt_s: float = 0.0
    H_covariance: Array = field(default_factory=lambda: np.full((6, 6), np.nan))
    seen_s: float = 0.0
    detected_s: float = 0.0
    still_since_s: float | None = None
    box_px: Array = field(default_factory=lambda: np.full(4, np.nan))
    area_px: int = 0
    color: Array = field(default_factory=lambda: np.zeros(64))
    low_m: Array = field(default_factory=lambda: np.full(3, np.nan))
    high_m: Array = field(default_factory=lambda: np.full(3, np.nan))

    @property
    def class_name(self) -> str:
        """The class with the highest sum of scores so far; a name wins over none."""
        named = {name: score for name, score in self.scores.items() if name != UNNAMED_CLASS}
        return max(named or {UNNAMED_CLASS: 0.0}, key=lambda name: (named.get(name, 0.0), name))

    @property
    def extent_m(self) -> Array:
        """(3,) size of the box around its points, NaN before there are any."""
        return self.high_m - self.low_m

    @property
    def box_center_m(self) -> Array | None:
        """(3,) centre in the world of the box around its points, None before there are any."""
        if self.T_world_object is None or np.isnan(self.low_m).any():
            return None
        middle = 0.5 * (self.low_m + self.high_m)
        return self.T_world_object[:3, :3] @ middle + self.T_world_object[:3, 3]

    def take_detection(self, name: str, score: float, color: Array, timestamp_s: float) -> None:
        """Take in what a detection says of its class and colours (64,)."""
        self.scores[name] = self.scores.get(name, 0.0) + max(score, 1e-3)
        share = _COLOR_MEMORY if self.color.any() else 0.0
        self.color = share * self.color + (1.0 - share) * color
        self.detected_s = timestamp_s

    def predicted_motion(self, dt_s: float) -> Array:
        """H (4, 4) over the next `dt_s`: the last motion goes on, else what the filter says."""
        if self.filter is None:
            return np.eye(4)
        center = self.filter.center_m
        if self.H_world_curr_prev is not None and self.H_dt_s > 0.0:
            return scale_about(self.H_world_curr_prev, center, dt_s / self.H_dt_s)
        R = Rotation.from_rotvec(self.filter.turn_radps * dt_s).as_matrix()
        return make_T(R, center + self.filter.velocity_mps * dt_s - R @ center)

    def set_state(self, state: ObjectState, timestamp_s: float) -> None:
        """Change the state; a stopped object remembers since when it is."""
        if state is not ObjectState.STOPPED:
            self.still_since_s = None
        elif self.still_since_s is None:
            self.still_since_s = timestamp_s
        self.state = state

    def take_points(self, points_world_m: Array) -> None:
        """Widen the box by the points (N, 3) seen now."""
        assert self.T_world_object is not None
        R, t = self.T_world_object[:3, :3], self.T_world_object[:3, 3]
        local = transform_points(make_T(R.T, -R.T @ t), points_world_m)
        low, high = np.percentile(local, _EXTENT_PERCENTILES, axis=0)
        if np.isnan(self.low_m).any():
            self.low_m, self.high_m = low, high
        self.low_m = self.low_m + _GROWTH * np.minimum(low - self.low_m, 0.0)
        self.high_m = self.high_m + _GROWTH * np.maximum(high - self.high_m, 0.0)
