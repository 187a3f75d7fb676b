"""One object over time: identity, class, pose, filter and state.

Owns what is remembered of an object between frames, how it is predicted, and how a measured motion
changes it. Measures nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pipelines.config import ObjectsConfig
from pipelines.geometry import (
    invert_T,
    make_T,
    orthonormalise,
    rotation_of,
    rotation_vector,
    skew,
    transform_points,
)
from pipelines.object_types import UNNAMED_CLASS, ObjectState
from pipelines.objects.kalman import ObjectFilter
from pipelines.objects.motion import scale_about
from pipelines.types import Array

_COLOR_MEMORY = 0.8  # share of the old colours that each frame keeps
# Of the points at each end, one at least: left out so that strays do not blow up the box
_STRAY_SHARE, _FEW_POINTS = 0.04, 8
_GROWTH = 0.6  # of the way to them by which the box grows in a frame, for the same reason
_SEEN_SIGMA_M = 1.0  # the middle of a mask, at its median depth
_PART_SHARE = 0.35  # of its size, the same where a part of it may be hidden
_LARGEST_PART_M = 1.75  # of anything: four of it are half of a bus; far boxes are too long
_MIDDLE_SHARE, _LARGEST_OFF_M = 0.12, 0.6  # of its size, how far its seen middle is off its own
_SHRINKING = 0.98  # share of its size that it keeps from frame to frame at least
_LEAST_SPEED_MPS = 0.1  # m/s over ground, of a velocity that has a direction
_MAX_SLIP_S = 0.5  # s without a measured motion after which nobody knows where its box is
_CENTER_SIGMA_M = 0.3  # the filter's centre is held this loosely: its model is not the matter's
_FASTEST_RADPS, _FASTEST_MPS = 2.0, 20.0  # standard deviations of motions not yet known


def middle_doubt_mps(extent_m: Array, turn_radps: float) -> float:
    """Standard deviation of an object's speed by not knowing where its middle is, while it turns.

    Only sides of it are seen, so that the middle of what is seen lies off its own; where it turns,
    each place of it has another speed. This error is the same in frame after frame. extent_m: (3,).
    """
    size_m = float(np.nan_to_num(extent_m).max())
    return turn_radps * min(_MIDDLE_SHARE * size_m, _LARGEST_OFF_M)


@dataclass(slots=True)
class ObjectTrack:
    """An object that is in sight, or was not long ago.

    filter, T_world_object: None until something of it has a depth; the filter follows the origin
    of the pose. H_world_curr_prev: last measured motion, over `H_dt_s`, with covariance (6, 6);
    None where the last frame measured none, `unmeasured_s` ago. seen_s: when it was last in view.
    missed_s: for how long detections have gone without it; unconfirmed_s: the same, frames without
    any detections counted. still_since_s: None unless stopped. box_px, area_px, color: of its last
    mask. low_m, high_m: (3,) box around its points in the axes of its pose, NaN where that is not
    known; middle_m: (3,) the middle and extent_m: (3,) the size of that box, also after that.
    surely_moves: whether the filter had it moving when its motion was last measured.
    """

    object_id: int
    config: ObjectsConfig
    state: ObjectState = ObjectState.UNKNOWN
    scores: dict[str, float] = field(default_factory=dict)
    filter: ObjectFilter | None = None
    T_world_object: Array | None = None
    H_world_curr_prev: Array | None = None
    H_dt_s: float = 0.0
    H_covariance: Array = field(default_factory=lambda: np.full((6, 6), np.nan))
    seen_s: float = 0.0
    missed_s: float = 0.0
    unconfirmed_s: float = 0.0
    unmeasured_s: float = 0.0
    still_since_s: float | None = None
    box_px: Array = field(default_factory=lambda: np.full(4, np.nan))
    area_px: int = 0
    color: Array = field(default_factory=lambda: np.zeros(64))
    low_m: Array = field(default_factory=lambda: np.full(3, np.nan))
    high_m: Array = field(default_factory=lambda: np.full(3, np.nan))
    middle_m: Array = field(default_factory=lambda: np.zeros(3))
    extent_m: Array = field(default_factory=lambda: np.full(3, np.nan))
    surely_moves: bool = False

    # ---------------------------------------------------------------- answers

    @property
    def class_name(self) -> str:
        """The class with the highest sum of scores so far; a name wins over none."""
        named = {name: score for name, score in self.scores.items() if name != UNNAMED_CLASS}
        return max(named or {UNNAMED_CLASS: 0.0}, key=lambda name: (named.get(name, 0.0), name))

    @property
    def box_center_m(self) -> Array | None:
        """(3,) centre in the world of the box around its points, None before there are any."""
        if self.T_world_object is None or np.isnan(self.low_m).any():
            return None
        middle = 0.5 * (self.low_m + self.high_m)
        return self.T_world_object[:3, :3] @ middle + self.T_world_object[:3, 3]

    @property
    def middle_offset_m(self) -> Array:
        """(3,) in the world, of the middle of its matter from the filter's centre."""
        if self.T_world_object is None:
            return np.zeros(3)
        return self.T_world_object[:3, :3] @ self.middle_m

    @property
    def fresh_box_px(self) -> Array:
        """(4,) its last box, NaN where it was missed for so long that it will be elsewhere."""
        return self.box_px if self.missed_s <= self.config.max_carried_s else np.full(4, np.nan)

    @property
    def is_anchored(self) -> bool:
        """Whether its pose is tied to its matter: its motion was measured a moment ago."""
        return self.has_motion and self.unmeasured_s <= _MAX_SLIP_S

    @property
    def has_motion(self) -> bool:
        """Whether a motion of it was ever measured, be it none at all."""
        return self.H_dt_s > 0.0

    def velocity_at(self, point_m: Array) -> Array:
        """(3,) m/s of the object's matter at a point (3,) in the world, by the filter.

        NaN before a motion was measured: middles of masks alone say little of a speed.
        """
        if self.filter is None or not self.has_motion:
            return np.full(3, np.nan)
        velocity = self.filter.velocity_mps
        if np.isfinite(point_m).all():
            velocity = velocity + np.cross(self.filter.turn_radps, point_m - self.filter.center_m)
        return velocity

    @property
    def velocity_std_mps(self) -> float:
        """Standard deviation along the filter's velocity, NaN where that is not told."""
        if self.filter is None or not self.has_motion:
            return np.nan
        turn_radps = float(np.linalg.norm(self.filter.turn_radps))
        return float(np.hypot(self.filter.speed_std_mps, self.middle_doubt_mps(turn_radps)))

    def middle_doubt_mps(self, turn_radps: float) -> float:
        """See `middle_doubt_mps`."""
        return middle_doubt_mps(self.extent_m, turn_radps)

    def is_landmark(self, timestamp_s: float) -> bool:
        """Whether it has been still for so long that it serves the camera as the world does."""
        since = self.still_since_s
        return since is not None and timestamp_s - since >= self.config.still_after_s

    def move_world(self, C: Array) -> None:
        """Follow a correction of the map: p_new = C (4, 4) @ p_old."""
        if self.filter is not None:
            self.filter.move_world(C)
        if self.T_world_object is not None:
            self.T_world_object = C @ self.T_world_object
        if self.H_world_curr_prev is not None:
            self.H_world_curr_prev = C @ self.H_world_curr_prev @ invert_T(C)
            R = np.kron(np.eye(2), C[:3, :3])
            self.H_covariance = R @ self.H_covariance @ R.T

    def predicted_motion(self, dt_s: float) -> Array:
        """H (4, 4) over a time: the last motion goes on, else what the filter says.

        The filter has been moved on by `dt_s` already: the motion leads to where it is now.
        """
        if self.filter is None:
            return np.eye(4)
        turn = self.filter.turn_radps * dt_s
        way_m = rotation_of(-0.5 * turn) @ self.filter.velocity_mps * dt_s
        center = self.filter.center_m - way_m
        if self.H_world_curr_prev is not None:
            return scale_about(self.H_world_curr_prev, center, dt_s / self.H_dt_s)
        R = rotation_of(turn)
        return make_T(R, center + way_m - R @ center)

    def expected_motion(self, center_m: Array, dt_s: float) -> tuple[Array, Array]:
        """What motion (4, 4) to expect in a time, with covariance (6, 6), before it is measured.

        The last one, changed by what objects can do in the time; of a new object, none, give or
        take the fastest that there is. center_m: (3,) what the covariance is about.
        """
        if self.H_world_curr_prev is None:
            std = np.repeat([_FASTEST_RADPS, _FASTEST_MPS], 3) * dt_s
            return np.eye(4), np.diag(std**2)
        share = dt_s / self.H_dt_s
        std = np.repeat([self.config.turn_radps2, self.config.acceleration_mps2], 3)
        std *= dt_s * 0.5 * (dt_s + self.H_dt_s)
        expected = scale_about(self.H_world_curr_prev, center_m, share)
        return expected, self.H_covariance * share**2 + np.diag(std**2)

    # ---------------------------------------------------------------- changes

    def predict(self, dt_s: float) -> None:
        """Move the filter on to the next frame, before anything is known of that."""
        if self.filter is None:
            return
        if self.surely_moves and self.unmeasured_s > 0.0:
            self.filter.coast(dt_s, self.unmeasured_s)
        elif not self.surely_moves and self.unconfirmed_s > 0.0:
            self.filter.stay(dt_s)  # what never surely moved is looked for where it was
        else:
            self.filter.predict(dt_s)

    def take_detection(self, name: str, score: float, color: Array) -> None:
        """Take in what a detection says of its class and colours (64,)."""
        self.scores[name] = self.scores.get(name, 0.0) + max(score, 1e-3)
        share = _COLOR_MEMORY if self.color.any() else 0.0
        self.color = share * self.color + (1.0 - share) * color
        self.missed_s = self.unconfirmed_s = 0.0

    def take_motion(self, H: Array, covariance: Array, center_m: Array, dt_s: float) -> None:
        """Take a measured motion (4, 4) into filter and pose. covariance: about the centre (3,)."""
        if not self.is_anchored:
            # So far the middle of a mask was all that was known, be it of what stood before it
            R = np.eye(3) if self.T_world_object is None else self.T_world_object[:3, :3]
            self.T_world_object = invert_T(H) @ make_T(H[:3, :3] @ R, center_m)
            self.low_m, self.high_m = np.full(3, np.nan), np.full(3, np.nan)
            self.middle_m = np.zeros(3)
        assert self.T_world_object is not None
        before = self.T_world_object[:3, 3]
        self.T_world_object = orthonormalise(H @ self.T_world_object)
        origin = self.T_world_object[:3, 3].copy()
        A = np.eye(6)
        A[3:, :3] = -skew(origin - center_m)
        covariance_m2 = (A @ covariance @ A.T)[3:, 3:]
        loose = covariance_m2 + _CENTER_SIGMA_M**2 * np.eye(3)
        if self.filter is None:
            self.filter = ObjectFilter(origin, loose, self.config.acceleration_mps2)
        elif not self.is_anchored:
            self.filter.move_to(origin, loose)
            if not self.has_motion:
                self.filter.forget_velocity()  # it came of wandering middles of masks
        self.filter.update_motion(
            origin, loose, (origin - before) / dt_s, covariance_m2 / dt_s**2,
            turn_radps=rotation_vector(H) / dt_s, dt_s=dt_s,
        )  # fmt: skip
        self.H_world_curr_prev, self.H_dt_s, self.H_covariance = H, dt_s, covariance
        self.unmeasured_s = 0.0
        speed_mps = float(np.linalg.norm(self.filter.velocity_mps))
        doubt_mps = self.config.significance * self.filter.speed_std_mps
        self.surely_moves = speed_mps - doubt_mps > self.config.min_speed_mps

    @property
    def center_sigma_m(self) -> float:
        """How far the middle of what is seen of it may be off: any part of it may be hidden."""
        size_m = float(np.nan_to_num(self.extent_m).max())
        return min(max(_SEEN_SIGMA_M, _PART_SHARE * size_m), _LARGEST_PART_M)

    def take_center(self, center_m: Array) -> None:
        """Take in where the middle (3,) of what is seen of it lies, where there is no motion.

        Of an object whose motion was measured a moment ago the prediction knows better.
        """
        if self.is_anchored:
            return
        covariance = self.center_sigma_m**2 * np.eye(3)
        if self.filter is None or self.T_world_object is None:
            self.filter = ObjectFilter(center_m, covariance, self.config.acceleration_mps2)
            self.T_world_object = make_T(np.eye(3), center_m)
            return
        self.filter.update_center(center_m, covariance)
        self._follow_filter()
        self.middle_m = np.zeros(3)  # the filter follows what is seen from here on

    def coast(self, dt_s: float) -> None:
        """Go on without a measured motion; the filter has been moved on already."""
        if self.T_world_object is not None and self.filter is not None:
            self.T_world_object = self.predicted_motion(dt_s) @ self.T_world_object
            self._follow_filter()
        self.H_world_curr_prev = None
        self.unmeasured_s += dt_s
        if self.unmeasured_s > _MAX_SLIP_S:
            self.low_m, self.high_m = np.full(3, np.nan), np.full(3, np.nan)

    def _follow_filter(self) -> None:
        """Put the pose's origin where the filter has it; the box stays with the matter."""
        assert self.filter is not None and self.T_world_object is not None
        slip_m = self.filter.center_m - self.T_world_object[:3, 3]
        self.T_world_object[:3, 3] += slip_m
        shift = self.T_world_object[:3, :3].T @ slip_m
        self.low_m, self.high_m = self.low_m - shift, self.high_m - shift
        self.middle_m = self.middle_m - shift

    def set_state(self, state: ObjectState, timestamp_s: float) -> None:
        """Change the state; a stopped object remembers since when it is."""
        if state is not ObjectState.STOPPED:
            self.still_since_s = None
        elif self.still_since_s is None:
            self.still_since_s = timestamp_s
        self.state = state

    def orient(self) -> None:
        """Turn the pose's x axis along the velocity: a box along a car's sides is its own.

        Of a box across them the middle of what is seen lies off the middle of the car.
        """
        if self.filter is None or self.T_world_object is None:
            return
        forward = self.filter.velocity_mps * (1.0, 0.0, 1.0)  # level: the world's y points down
        length = float(np.linalg.norm(forward))
        if length < _LEAST_SPEED_MPS:
            return
        x, _, z = forward / length
        offset_m = self.middle_offset_m
        self.T_world_object = make_T(
            np.array([[x, 0.0, -z], [0.0, 1.0, 0.0], [z, 0.0, x]]), self.T_world_object[:3, 3]
        )
        self.middle_m = self.T_world_object[:3, :3].T @ offset_m
        self.low_m, self.high_m = np.full(3, np.nan), np.full(3, np.nan)

    def take_points(self, points_world_m: Array) -> None:
        """Widen the box by the points (N, 3) seen now.

        Of a pose that is not tied to the matter the box is that of these points alone.
        """
        assert self.T_world_object is not None
        local = transform_points(invert_T(self.T_world_object), points_world_m)
        ordered = np.sort(local, axis=0)
        left_out = int(np.ceil(_STRAY_SHARE * len(ordered))) if len(ordered) >= _FEW_POINTS else 0
        low, high = ordered[left_out], ordered[-1 - left_out]
        if np.isnan(self.low_m).any() or not self.is_anchored:
            self.low_m, self.high_m = low, high
        self.low_m = self.low_m + _GROWTH * np.minimum(low - self.low_m, 0.0)
        self.high_m = self.high_m + _GROWTH * np.maximum(high - self.high_m, 0.0)
        self.middle_m = 0.5 * (self.low_m + self.high_m)
        self.extent_m = np.fmax(self.high_m - self.low_m, _SHRINKING * self.extent_m)
