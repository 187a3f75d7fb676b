"""Who is met in the streets of a town: parked cars, oncoming ones, cars ahead, people walking.

Owns the choreography along a `Route`. Nobody is driven into: who would touch another stays away.
Everybody is there only while the camera is within sight along the way; houses hide the rest.
"""

from __future__ import annotations

from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.simulated.kitti_motion import outline, overlapping
from pipelines.datasets.simulated.meshes import pose
from pipelines.datasets.simulated.route import Route
from pipelines.datasets.simulated.street import StreetScript
from pipelines.datasets.simulated.world import Actor
from pipelines.types import Array

ONCOMING, PARKED = -3.5, (-6.5, 3.0)  # laterals
LEFT_WALK, RIGHT_WALK = -10.4, 6.9
SIDE_STREET_M = 45.0  # what goes straight on at each corner, of which cars use a little less
_HEADWAY_S = 2.3
_MEETING_S = (4.0, 7.5)  # between cars met
_WALKER_S = (2.5, 5.5)
_PLACE_M = 6.2
_APART_M = 0.3
_GUEST_EVERY, _GUEST_FOR = 4, 2  # corners


class Traffic:
    """Collects the actors of a drive. s: (N + 1,) where the camera is at `times`."""

    def __init__(
        self, route: Route, times: Array, s: Array, rng: np.random.Generator, sight_m: float
    ) -> None:
        self._route, self._s, self._rng, self._sight_m = route, s, rng, sight_m
        self._script = StreetScript(route, times, rng)
        self._plans: list[Array] = []

    @property
    def actors(self) -> tuple[Actor, ...]:
        return tuple(self._script.actors)

    def park(self, stretch: tuple[float, float], share: float) -> None:
        """Cars along both kerbs where it is straight; `share` of the places are taken."""
        for before, after in pairwise(self._route.corners):
            for s in np.arange(before.end_m + 4, after.s_m - 4, _PLACE_M):
                for side, lateral in enumerate(PARKED):
                    if not stretch[0] <= s < stretch[1] or self._rng.random() > share:
                        continue
                    turn = self._rng.uniform(-0.03, 0.03) + (np.pi if side == 0 else 0)
                    place = s + self._rng.uniform(-0.4, 0.4)
                    T = self._route.pose(place, lateral + self._rng.uniform(-0.12, 0.12), 0.0, turn)
                    self._script.car(np.repeat(T[None], len(self._s), 0), moving=False)

    def meet(self) -> None:
        """Cars ahead, oncoming cars and walkers from the start of the drive to its end."""
        corners = self._route.corners
        first = next(k for k, corner in enumerate(corners) if corner.s_m > 0)
        self._lead(corners[first - 1].end_m if first else self._route.start_s, corners[first].s_m)
        for k in range(first + _GUEST_EVERY + 1, len(corners) - _GUEST_FOR, _GUEST_EVERY):
            self._lead(corners[k].end_m, corners[k + _GUEST_FOR].s_m)
        end = float(self._script.times[-1])
        t = 2.0
        while t < end + 3:
            self._oncoming(t, float(self._rng.uniform(0.8, 1.0)))
            t += float(self._rng.uniform(*_MEETING_S))
        t = 1.0
        while t < end + 3:
            self._walker(t)
            t += float(self._rng.uniform(*_WALKER_S))

    def _lead(self, joins_m: float, leaves_m: float) -> None:
        """A car ahead that comes straight out of a side street and leaves into another."""
        route, times = self._route, self._script.times
        ahead = _HEADWAY_S + 0.3 * np.sin(0.4 * times)
        s = route.s_at(route.time_at(self._s) + ahead)
        x, z, psi = route.straight_through(s, 0.0, joins_m, leaves_m)
        Ts = np.stack([pose(a, 0, b, c) for a, b, c in zip(x, z, psi, strict=True)])
        reach = SIDE_STREET_M - 4
        self._add_car(Ts, (s > joins_m - reach) & (s < leaves_m + reach))

    def _oncoming(self, t_s: float, pace: float) -> None:
        """A car that keeps the same speed limits times `pace`, and is met at `t_s`."""
        route, times = self._route, self._script.times
        met = float(np.interp(t_s, times, self._s)) + 9.0 * max(t_s - float(times[-1]), 0)
        s = route.s_at(route.time_at(met) - pace * (times - t_s))
        Ts = self._script.follow(s, partial(np.full_like, fill_value=ONCOMING), -1)
        on_asphalt = s > route.start_s + 5.0
        self._add_car(Ts, on_asphalt & (np.abs(s - self._s) < self._sight_m))

    def _add_car(self, Ts: Array, present: NDArray[np.bool_]) -> None:
        """Add a car unless it is never there or would touch one that is there already."""
        plan = outline(Ts[:, 0, 3], Ts[:, 2, 3], np.arctan2(Ts[:, 0, 2], Ts[:, 2, 2]), 1.95, 4.85)
        plan = np.where(present[:, None, None], plan, np.nan)
        touches = any(overlapping(plan, other, _APART_M).any() for other in self._plans)
        if present.any() and not touches:
            self._plans.append(plan)
            self._script.car(Ts, True, present=_or_always(present))

    def _walker(self, t_s: float) -> None:
        """A person on a straight pavement, met at `t_s`, who stops before the corner."""
        route, times, rng = self._route, self._script.times, self._rng
        lateral = RIGHT_WALK if rng.random() < 0.5 else LEFT_WALK
        direction, speed = int(rng.choice((-1, 1))), float(rng.uniform(1.0, 1.5))
        met = float(np.interp(t_s, times, self._s))
        straight = next(
            ((a.end_m + 1, b.s_m - 1) for a, b in pairwise(route.corners)
             if a.end_m + 4 < met < b.s_m - 4),
            None,
        )  # fmt: skip
        if straight is None:
            return
        s = np.clip(met + direction * speed * (times - t_s), *straight)
        present = np.abs(s - self._s) < self._sight_m
        Ts = self._script.follow(s, partial(np.full_like, fill_value=lateral), direction)
        if present.any():
            self._script.walker(Ts, _or_always(present))


def _or_always(present: NDArray[np.bool_]) -> NDArray[np.bool_] | None:
    return None if present.all() else present
