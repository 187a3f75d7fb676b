"""The Kalman filter of one object: where its centre is in the world, and how it moves.

Owns the motion model: constant velocity that turns as the object was last seen to turn. Used for
gates, coasting and the smoothed speed; measures nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipelines.geometry import rotation_of
from pipelines.types import Array

_MAX_TURN_RADPS = 1.0  # faster turns are noise of small objects, and would curl their prediction
_GATE = 11.3  # chi-square, 3 degrees of freedom, 99 %
_TURN_MEMORY = 0.7  # share of the old turn rate that each measurement keeps
_SPEEDING_MEMORY = 0.8  # and of the old change of speed
_SPEEDING_LASTS_S = 1.0  # s, for which a change of speed goes on where nobody sees it
_SURE_SPEED_MPS = 1.0  # m/s, standard deviation of a speed whose change says something


class ObjectFilter:
    """State (6,): centre in m and velocity in m/s, in the world; step 9.

    center_m: (3,) first seen, with covariance (3, 3). acceleration_mps2: standard deviation of the
    unmodelled acceleration. A new object may move at any speed up to `_FIRST_SPEED_MPS`.
    """

    _FIRST_SPEED_MPS = 15.0
    _HIDDEN_SPEED_MPS = 5.0

    def __init__(self, center_m: Array, covariance_m2: Array, acceleration_mps2: float) -> None:
        self._kf = _make_filter()
        self._kf.x = np.r_[center_m, np.zeros(3)]
        self._kf.P = np.zeros((6, 6))
        self._kf.P[:3, :3] = covariance_m2
        self._kf.P[3:, 3:] = self._FIRST_SPEED_MPS**2 * np.eye(3)
        self._acceleration = acceleration_mps2
        self._speeding_mps2 = 0.0  # smoothed change of the speed, as it was last measured
        self.turn_radps = np.zeros(3)

    def __getstate__(self) -> dict[str, Any]:
        """All of it; of filterpy's filter what outlasts an update."""
        return {**vars(self), "_kf": (self._kf.x, self._kf.P)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        kf = _make_filter()
        kf.x, kf.P = state["_kf"]
        vars(self).update(state, _kf=kf)

    @property
    def center_m(self) -> Array:
        """(3,) in the world."""
        return self._kf.x[:3].copy()

    @property
    def velocity_mps(self) -> Array:
        """(3,) in the world."""
        return self._kf.x[3:].copy()

    @property
    def velocity_covariance(self) -> Array:
        """(3, 3), (m/s)^2."""
        return self._kf.P[3:, 3:].copy()

    @property
    def speed_std_mps(self) -> float:
        """Standard deviation of the speed: that of the velocity along its own direction."""
        return direction_std(self.velocity_mps, self.velocity_covariance)

    def predict(self, dt_s: float) -> None:
        """Move on by a time; the velocity turns at the rate last seen."""
        R = rotation_of(self.turn_radps * dt_s)
        half = rotation_of(self.turn_radps * (0.5 * dt_s))
        F = np.eye(6)
        F[:3, 3:] = dt_s * half  # the chord of the arc lies half-way between both directions
        F[3:, 3:] = R
        # White acceleration, constant over the step
        G = np.vstack([0.5 * dt_s**2 * np.eye(3), dt_s * np.eye(3)])
        self._kf.predict(F=F, Q=self._acceleration**2 * G @ G.T)

    def move_world(self, C: Array) -> None:
        """Follow a correction of the map: p_new = C (4, 4) @ p_old."""
        R = np.kron(np.eye(2), C[:3, :3])
        self._kf.x = R @ self._kf.x
        self._kf.x[:3] += C[:3, 3]
        self._kf.P = R @ self._kf.P @ R.T
        self.turn_radps = C[:3, :3] @ self.turn_radps

    def coast(self, dt_s: float, unmeasured_s: float) -> None:
        """Move on by a time as what moves does when its motion is not measured, since a while.

        What speeds up or brakes goes on so for a while, but never turns round. Accelerations that
        nobody sees add up, as of a car that brakes: a speed is off by a t, a variance by (a t)^2.
        """
        speed = float(np.linalg.norm(self._kf.x[3:]))
        if speed > 0.0:
            change = self._speeding_mps2 * np.exp(-unmeasured_s / _SPEEDING_LASTS_S) * dt_s
            self._kf.x[3:] *= max(0.0, 1.0 + change / speed)
        self.predict(dt_s)
        G = np.vstack([0.5 * dt_s * np.eye(3), np.eye(3)])
        self._kf.P += self._acceleration**2 * 2.0 * unmeasured_s * dt_s * G @ G.T

    def stay(self, dt_s: float) -> None:
        """Move on by a time as what has no sure velocity: all of it becomes doubt.

        But never more than `_HIDDEN_SPEED_MPS`: most of what is lost like this stands.
        """
        doubt = self.velocity_covariance + np.outer(self.velocity_mps, self.velocity_mps)
        if np.trace(doubt) > 3.0 * self._HIDDEN_SPEED_MPS**2:
            doubt = self._HIDDEN_SPEED_MPS**2 * np.eye(3)
            self._kf.P[:3, 3:] = self._kf.P[3:, :3] = 0.0
        self._kf.x[3:], self._kf.P[3:, 3:] = 0.0, doubt
        self.predict(dt_s)

    def move_to(self, center_m: Array, covariance_m2: Array) -> None:
        """Put the centre (3,) elsewhere, with a covariance (3, 3); the velocity stays."""
        self._kf.x[:3] = center_m
        self._kf.P[:3] = 0.0
        self._kf.P[:, :3] = 0.0
        self._kf.P[:3, :3] = covariance_m2

    def forget_velocity(self) -> None:
        """Begin anew with a velocity that nobody knows; the centre stays."""
        self._kf.x[3:] = 0.0
        self._kf.P[3:] = 0.0
        self._kf.P[:, 3:] = 0.0
        self._kf.P[3:, 3:] = self._FIRST_SPEED_MPS**2 * np.eye(3)

    def update_motion(
        self,
        center_m: Array,
        center_covariance_m2: Array,
        velocity_mps: Array,
        velocity_covariance: Array,
        *,
        turn_radps: Array,
        dt_s: float,
    ) -> None:
        """Take in a measured motion: centre (3,) now, mean velocity (3,) over the last `dt_s`.

        turn_radps: (3,) rotation vector per second, in the world. The mean velocity of a turning
        object points to where it went half a step ago. A centre or velocity outside
        its 99 % gate counts as less certain, just so much that it lies about on the gate: one wild
        motion does not carry the filter away, and several that agree do.
        """
        turn = _TURN_MEMORY * self.turn_radps + (1.0 - _TURN_MEMORY) * turn_radps
        self.turn_radps = turn * min(1.0, _MAX_TURN_RADPS / max(float(np.linalg.norm(turn)), 1e-9))
        H = np.eye(6)
        H[3:, 3:] = rotation_of(self.turn_radps * (-0.5 * dt_s))
        before, was_sure = self.velocity_mps, self.speed_std_mps < _SURE_SPEED_MPS
        z = np.r_[center_m, velocity_mps]
        residual, P = z - H @ self._kf.x, H @ self._kf.P @ H.T
        R = np.zeros((6, 6))
        for part, covariance in (
            (slice(0, 3), center_covariance_m2),
            (slice(3, 6), velocity_covariance),
        ):
            innovation = residual[part]
            distance2 = float(innovation @ np.linalg.solve(P[part, part] + covariance, innovation))
            R[part, part] = covariance * max(1.0, distance2 / _GATE)
        self._kf.update(z, R=R, H=H)
        if was_sure:
            change = float(np.linalg.norm(self.velocity_mps) - np.linalg.norm(before)) / dt_s
            change = float(np.clip(change, -self._acceleration, self._acceleration))
            self._speeding_mps2 += (1.0 - _SPEEDING_MEMORY) * (change - self._speeding_mps2)

    def update_center(self, center_m: Array, covariance_m2: Array) -> None:
        """Take in a centre (3,) alone, where no motion could be measured; wild ones count less."""
        H = np.hstack([np.eye(3), np.zeros((3, 3))])
        distance2 = float(self.distances2(center_m[None], covariance_m2)[0][0])
        self._kf.update(center_m, R=covariance_m2 * max(1.0, distance2 / _GATE), H=H)

    def distances2(
        self, centers_m: Array, covariance_m2: Array, offset_m: Array | None = None
    ) -> tuple[Array, float]:
        """Squared Mahalanobis distances (M,) of centres (M, 3) seen with a covariance (3, 3).

        offset_m: (3,) of what is seen from the filter's own centre, none where None. Answers also
        the logarithm of the determinant of their covariance, in m^6.
        """
        d = centers_m - self._kf.x[:3] - (0.0 if offset_m is None else offset_m)
        S = self._kf.P[:3, :3] + covariance_m2
        return (
            np.einsum("mi,mi->m", d, np.linalg.solve(S, d.T).T),
            float(np.linalg.slogdet(S)[1]),
        )


def _make_filter() -> Any:
    from filterpy.kalman import KalmanFilter  # takes two seconds

    return KalmanFilter(dim_x=6, dim_z=6)


def direction_std(vector: Array, covariance: Array) -> float:
    """Standard deviation of the length of a vector (3,): along it, or the largest where it is 0."""
    length = float(np.linalg.norm(vector))
    if length < 1e-9:
        return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    unit = vector / length
    return float(np.sqrt(max(float(unit @ covariance @ unit), 0.0)))
