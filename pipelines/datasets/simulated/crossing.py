"""The crossing: a junction where things hide each other, leave the picture and come back.

Owns the choreography; the street itself is that of `street.py`. The camera car stands, then rolls
slowly towards the junction. What a tracker of identities has to survive, in frames at 10 fps, is
in `EVENTS`: it is truth, for tests, and no part of any frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from pipelines.datasets.simulated.facades import FACADES
from pipelines.datasets.simulated.meshes import pose
from pipelines.datasets.simulated.road import Road
from pipelines.datasets.simulated.street import (
    CROSSING_S,
    DAYLIGHT,
    EYE_M,
    KERB_M,
    ONCOMING,
    StreetScript,
    street_static,
)
from pipelines.datasets.simulated.textures import SURFACES
from pipelines.datasets.simulated.vehicles import VEHICLE_ART
from pipelines.datasets.simulated.world import World
from pipelines.types import Array, StereoCamera

FPS = 10.0
_AHEAD_M = 175.0
_EGO_S = 31.0
_NEAR_LANE, _FAR_LANE = CROSSING_S - 1.75, CROSSING_S + 1.75  # of the side street, along s
Speeds = tuple[tuple[float, float], ...]
_BACKING: Speeds = (
    (0.0, 6.5), (2.4, 6.5), (5.2, 0.0), (6.6, -3.2), (8.4, -3.2), (9.8, 0.0)
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Event:
    """Something that happens to one object. kind: `hidden`, `away` (out of the picture), `stop`.

    object_id: whose. by: object_id of what hides it, None otherwise. frames: first and last frame
    in which not a pixel of it is seen, or in which it stands still.
    """

    kind: str
    object_id: int
    by: int | None
    frames: tuple[int, int]


# The moving ones have the first labels, in this order; parked cars follow.
VAN, RETURNING_CAR, LEADING_CAR, WAITING_CAR, CROSSING_WALKER, PAVEMENT_WALKER = range(1, 7)
EVENTS: tuple[Event, ...] = (
    Event("stop", WAITING_CAR, None, (22, 42)),  # at the stop line, facing the camera
    Event("hidden", WAITING_CAR, VAN, (28, 35)),  # while it stands
    Event("hidden", CROSSING_WALKER, VAN, (28, 35)),  # walking the other way
    Event("hidden", LEADING_CAR, VAN, (39, 47)),  # driving away
    Event("away", RETURNING_CAR, None, (44, 66)),  # leaves on the left, backs up into view
    Event("hidden", PAVEMENT_WALKER, VAN, (48, 55)),
    Event("away", VAN, None, (72, 99)),  # leaves on the right for good
    Event("away", WAITING_CAR, None, (93, 99)),  # passes the camera for good
)


def make_crossing(frames: int, seed: int, camera: StereoCamera, fps: float = FPS) -> World:
    """The junction; the script is made for 100 frames, and goes on evenly after that."""
    rng = np.random.default_rng(seed)
    times = np.arange(frames + 1) / fps
    road = Road(_EGO_S + _AHEAD_M)
    script = StreetScript(road, times, rng)
    _traffic(script)
    _walkers(script)
    script.park(range(2))
    return World(
        camera,
        fps,
        street_static(road, rng),
        tuple(script.actors),
        _camera_path(road, times),
        DAYLIGHT,
        SURFACES | FACADES | VEHICLE_ART,
        sky="sky",
    )


def driven(times: Array, speeds: Speeds) -> Array:
    """Metres (N,) driven by `times` (s) from t = 0, at speeds (m/s) that pass through knots.

    speeds: (time, speed) pairs in order. Between knots the speed follows a smooth step, so that
    the acceleration has no jumps either.
    """
    t = np.arange(0.0, max(float(times[-1]), 1.0) + 0.002, 0.001)
    knots = np.array(speeds)
    at = np.clip(np.searchsorted(knots[:, 0], t, side="right") - 1, 0, max(len(knots) - 2, 0))
    begin, end = knots[at], knots[np.minimum(at + 1, len(knots) - 1)]
    share = np.clip((t - begin[:, 0]) / np.maximum(end[:, 0] - begin[:, 0], 1e-9), 0, 1)
    v = begin[:, 1] + (end[:, 1] - begin[:, 1]) * share**2 * (3 - 2 * share)
    s = np.append(0.0, np.cumsum((v[1:] + v[:-1]) / 2 * 0.001))
    return np.interp(times, t, s)


def _camera_path(road: Road, times: Array) -> Array:
    """Poses (N + 1, 4, 4): stands for 4 s, then rolls at 1.4 m/s; it sways only while it rolls."""
    s = _EGO_S + driven(times, ((0.0, 0.0), (4.0, 0.0), (6.5, 1.4)))
    rolling = np.clip(np.gradient(s, times) / 1.4, 0, 1)
    x, z, psi = road.at(s, 0.0)
    lift = 0.008 * rolling * np.sin(6.1 * times)
    pitch = 0.003 * rolling * np.sin(5.3 * times)
    Ts = np.stack([pose(a, -EYE_M + b, c, d) for a, b, c, d in zip(x, lift, z, psi, strict=True)])
    for T, p in zip(Ts, pitch, strict=True):
        tilt = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
        T[:3, :3] = T[:3, :3] @ tilt
    return Ts


def _across(script: StreetScript, s: float, lateral: Array, direction: int) -> Array:
    """Poses (N + 1, 4, 4) of something that heads across the road at `s`; 1 is to the right."""
    x, z, psi = script.road.at(np.full_like(lateral, s), lateral)
    rows = zip(x, z, psi + direction * np.pi / 2, strict=True)
    return np.stack([pose(a, 0, b, c) for a, b, c in rows])


def _traffic(script: StreetScript) -> None:
    """A van from the left; a car that leaves to the left and backs up; two on the main road."""
    t = script.times
    constant = partial(np.full_like, dtype=float)
    van = -15.0 + driven(t, ((0.0, 3.6), (4.5, 3.6), (6.0, 5.0)))
    script.car(_across(script, _NEAR_LANE, van, 1), True, "van")
    backing = 2.0 - driven(t, _BACKING)
    script.car(_across(script, _FAR_LANE, backing, -1), True, "hatchback")
    leading = _EGO_S + 33.0 + driven(t, ((0.0, 4.0), (6.0, 7.0)))
    script.car(script.follow(leading, lambda s: 0.0 * s), True, "estate")
    waiting = _EGO_S + 37.78 - driven(t, ((0.0, 5.8), (2.2, 0.0), (4.2, 0.0), (7.2, 6.0)))
    script.car(script.follow(waiting, lambda s: constant(s, ONCOMING), -1), True, "saloon")


def _walkers(script: StreetScript) -> None:
    """One person crosses the main road beyond the junction, two walk along the pavement."""
    t = script.times
    lateral = -1.5 - 1.35 * t
    across = _across(script, CROSSING_S + 5.9, lateral, -1)
    step = np.clip((-10.3 - lateral) / 0.4, 0, 1)  # up the kerb
    across[:, 1, 3] = -KERB_M * step**2 * (3 - 2 * step)
    script.walker(across)
    for s, direction in ((60.0, 1), (34.0, 1)):
        along = s + direction * 1.2 * t
        path = script.follow(along, partial(np.full_like, fill_value=6.3), direction, -KERB_M)
        script.walker(path)
