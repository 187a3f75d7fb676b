"""Ways through a town: straights and corners, round a block or ever onward, and how fast one goes.

Owns plan and speed of a drive. Along it, s runs in metres and `lateral` to the right of the lane;
what stands along it is in `town.py`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.simulated.road import STEP_M, Curve
from pipelines.types import Array

CORNER_M = 20.0  # length of a right-angled corner along the lane
_RAMP = 0.3  # share of a corner in which the steering turns in, and out again
_CRUISE_MPS, _CORNER_MPS = 9.0, 6.0
_ACCELERATION_MPS2 = 2.2
_BLOCK_M = (52.0, 40.0)  # sides of the block, from corner point to corner point
_STREET_M = (70.0, 140.0)  # between corners of the way onward
_BEFORE_M, _BEYOND_M = 60.0, 120.0


@dataclass(frozen=True, slots=True)
class Corner:
    """A right-angled turn. s_m: where it begins. turn: 1 to the right, -1 to the left."""

    s_m: float
    turn: int

    @property
    def end_m(self) -> float:
        return self.s_m + CORNER_M


class Route(Curve):
    """A curve of straights and corners, and the time at which a car gets where on it."""

    def __init__(self, start_s: float, end_s: float, corners: list[Corner]) -> None:
        s = np.arange(round(start_s / STEP_M), round(end_s / STEP_M) + 2) * STEP_M
        bend, turn = _corner(), np.zeros_like(s)
        for corner in corners:
            first = round((corner.s_m - start_s) / STEP_M)
            stop = min(first + len(bend), len(s))
            turn[first:stop] += corner.turn * bend[: stop - first]
        super().__init__(start_s, end_s, s, turn)
        self.corners = tuple(corners)
        speed = _speed_limit(s, np.abs(turn) > 0)
        pace = (1 / speed[1:] + 1 / speed[:-1]) / 2 * STEP_M
        self._t = np.append(0, np.cumsum(pace))
        self._t -= np.interp(0.0, s, self._t)

    def s_at(self, t: Array | float) -> Array:
        """Metres driven (N,) after `t` seconds (N,) by who starts at s = 0 and keeps the speed."""
        return np.asarray(np.interp(t, self._t, self._s))

    def time_at(self, s: Array | float) -> Array:
        """The other way round: seconds (N,) after which one is at `s` (N,)."""
        return np.asarray(np.interp(s, self._s, self._t))

    def straight_through(
        self, s: Array, lateral: float, joins_m: float, leaves_m: float
    ) -> tuple[Array, Array, Array]:
        """x, z, heading (N,) of who comes straight out of a side street at `joins_m` and leaves it.

        joins_m, leaves_m: end of one corner and beginning of another, beyond which the way goes
        straight on where the route bends.
        """
        x, z, psi = self.at(np.clip(s, joins_m, leaves_m), lateral)
        further = np.minimum(s - joins_m, 0) + np.maximum(s - leaves_m, 0)
        return x + further * np.sin(psi), z + further * np.cos(psi), psi


def block_route(length_m: float) -> tuple[Route, float]:
    """Round a block to the right, again and again, for `length_m`; and metres a round."""
    ahead = _straight(_BLOCK_M[0]) / 2  # s = 0 is the middle of a long side
    sides = [ahead, *(_straight(_BLOCK_M[k % 2]) for k in (1, 0, 1)), ahead]
    round_m = sum(sides) + 4 * CORNER_M
    corners = []
    for start in np.arange(-1, np.ceil(length_m / round_m) + 1) * round_m:
        s = start
        for side in sides[:-1]:
            s += side
            corners.append(Corner(round(float(s), 1), 1))
            s += CORNER_M
    end = corners[-1].end_m + ahead
    return Route(round(-round_m, 1), round(end, 1), corners), round(round_m, 1)


def onward_route(length_m: float, rng: np.random.Generator) -> Route:
    """A random walk of at least `length_m` through ever new streets; it never crosses itself.

    Streets lie on a grid and lead north, east or west. West never follows on east without a street
    to the north between them, so no corner is passed twice.
    """
    corners: list[Corner] = []
    s, heading = 25.0, 0  # quarter turns to the right of north
    while s < length_m + _BEYOND_M:
        turn = -heading if heading else int(rng.choice((-1, 1)))
        corners.append(Corner(round(s, 1), turn))
        heading += turn
        s += CORNER_M + _straight(_STREET_M[int(rng.random() < 0.35)])
    return Route(-_BEFORE_M, round(s, 1), corners)


def _corner() -> Array:
    """Curvature (C,) along a corner: it grows evenly, stays, and falls; together a right angle."""
    share = np.arange(0, CORNER_M + STEP_M / 2, STEP_M) / CORNER_M
    bend = np.clip(np.minimum(share, 1 - share) / _RAMP, 0, 1)
    return bend * (np.pi / 2) / (bend.sum() * STEP_M)


def corner_reach_m() -> float:
    """How far before the point where two streets would meet a corner begins."""
    psi = np.append(0, np.cumsum((_corner()[1:] + _corner()[:-1]) / 2 * STEP_M))
    return float((np.cos(psi) * STEP_M).sum())


def _straight(street_m: float) -> float:
    """Length of what is straight in a street between two corner points, a multiple of the step."""
    return round((street_m - 2 * corner_reach_m()) / STEP_M / 2) * 2 * STEP_M


def _speed_limit(s: Array, bends: NDArray[np.bool_]) -> Array:
    """Speed (S,) on the way: slow in corners, slowing down before and gathering speed after."""
    at = s[bends]
    if not len(at):
        return np.full(len(s), _CRUISE_MPS)
    place = np.searchsorted(at, s)
    before = np.abs(s - at[np.maximum(place - 1, 0)])
    after = np.abs(at[np.minimum(place, len(at) - 1)] - s)
    away = np.where(bends, 0.0, np.minimum(before, after))
    fast = np.sqrt(_CORNER_MPS**2 + 2 * _ACCELERATION_MPS2 * away)
    return np.minimum(fast, _CRUISE_MPS)
