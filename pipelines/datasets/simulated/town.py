"""Two drives through a town: `loop`, twice round one block, and `long`, ever onward.

Owns how the camera goes and what stands along its way. The traffic it meets is in
`town_traffic.py`, plan and speed in `route.py`. Houses stand where `kitti_surroundings.py` finds
room for them; each stretch of the way has its own drawings on its fronts and its own posters.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.spatial import cKDTree

from pipelines.datasets.simulated.kitti_ground import Ground
from pipelines.datasets.simulated.kitti_surroundings import Surroundings
from pipelines.datasets.simulated.meshes import Mesh, merge, pose
from pipelines.datasets.simulated.quarters import in_quarter, poster_pillar, quarter_textures
from pipelines.datasets.simulated.route import (
    Corner,
    Route,
    block_route,
    corner_reach_m,
    onward_route,
)
from pipelines.datasets.simulated.street import DAYLIGHT, camera_poses
from pipelines.datasets.simulated.town_traffic import (
    LEFT_WALK,
    ONCOMING,
    PARKED,
    RIGHT_WALK,
    SIDE_STREET_M,
    Traffic,
)
from pipelines.datasets.simulated.vehicles import VEHICLE_ART
from pipelines.datasets.simulated.world import World
from pipelines.types import Array, StereoCamera

FPS = 10.0
_MIDDLE, _HALF_ROAD_M = -1.75, 5.85  # lateral of the middle of the asphalt, and half its width
_FRONT_M = 10.95  # from the middle of the asphalt to the fronts of houses
_INTO_CORNER_M = 8.0  # that rows of houses may reach beyond the straight
_MARGIN_M = 24.0  # of ground around all asphalt
_FASTEST_MPS = 9.0
_LOOP_SIGHT_M, _LONG_SIGHT_M = 62.0, 150.0  # along the way, beyond which nobody is there
_LOOP_PARKED, _LONG_PARKED = 0.65, 0.3  # share of the places at the kerb
_LOOP_QUARTERS, _LONG_QUARTERS = 4, 5
_LONG_QUARTER_M = 30.0
_PILLARS = 24  # different ones
_PILLAR_LATERALS = (5.2, -8.7)


def make_loop(frames: int, seed: int, camera: StereoCamera) -> World:
    """Round a block to the right; a round takes about 245 frames.

    From the second round on the car keeps farther to the left, by 0.2 to 0.5 m, and drives a
    little more slowly; other traffic is met than in the first.
    """
    times = np.arange(frames + 1) / FPS
    route, round_m = block_route(_FASTEST_MPS * float(times[-1]) + 2 * _LOOP_SIGHT_M)
    s = route.s_at(_slower_after(times, float(route.time_at(round_m))))
    lateral = 0.15 - 0.35 * _smooth_step((s - round_m + 25) / 25) + 0.06 * np.sin(s / 11)
    traffic = Traffic(route, times, s, np.random.default_rng([seed, 0]), _LOOP_SIGHT_M)
    traffic.park((0.0, round_m), _LOOP_PARKED)
    traffic.meet()
    rng = np.random.default_rng([seed, 1])  # the town is the same for any number of frames
    town = _town(route, (0.0, round_m), (_LOOP_QUARTERS, round_m / _LOOP_QUARTERS), rng)
    poses = camera_poses(route, s, lateral, times)
    return _world(camera, town, traffic, poses, _LOOP_QUARTERS)


def make_long(frames: int, seed: int, camera: StereoCamera) -> World:
    """Through streets of which none is seen twice: about 0.78 m a frame."""
    rng = np.random.default_rng(seed)
    times = np.arange(frames + 1) / FPS
    route = onward_route(_FASTEST_MPS * float(times[-1]) + _LONG_SIGHT_M, rng)
    s = route.s_at(times)
    stretch = (route.start_s, min(float(s[-1]) + _LONG_SIGHT_M, route.end_s))
    traffic = Traffic(route, times, s, rng, _LONG_SIGHT_M)
    traffic.park(stretch, _LONG_PARKED)
    traffic.meet()
    town = _town(route, stretch, (_LONG_QUARTERS, _LONG_QUARTER_M), rng)
    poses = camera_poses(route, s, 0.1 * np.sin(0.5 * times), times)
    return _world(camera, town, traffic, poses, _LONG_QUARTERS)


def _world(
    camera: StereoCamera, town: Mesh, traffic: Traffic, poses: Array, quarters: int
) -> World:
    return World(
        camera, FPS, town, traffic.actors, poses, DAYLIGHT,
        quarter_textures(quarters, _PILLARS) | VEHICLE_ART, sky="sky",
    )  # fmt: skip


def _smooth_step(share: Array) -> Array:
    u = np.clip(share, 0, 1)
    return u**2 * (3 - 2 * u)


def _slower_after(t: Array, since_s: float) -> Array:
    """The time (N,) by the clock of who becomes 6 % slower within 3 s after `since_s`."""
    u = np.maximum((t - since_s) / 3.0, 0)
    lost = np.where(u < 1, u**3 - u**4 / 2, u - 0.5)  # the integral of a smooth step
    return t - 0.06 * 3.0 * lost


def _town(
    route: Route, stretch: tuple[float, float], quarters: tuple[int, float],
    rng: np.random.Generator,
) -> Mesh:  # fmt: skip
    """All that stands still along a stretch of the route.

    quarters: how many there are, and the metres of the way that each takes, by turns.
    """
    s = np.arange(stretch[0], stretch[1], 0.5)
    path = _plan(route, s, 0.0)
    asphalt = np.concatenate([_plan(route, s, _MIDDLE), *_middle_lines(route, stretch)])
    pillars = _pillar_places(route, stretch)
    laterals = (0.0, ONCOMING, *PARKED, LEFT_WALK, RIGHT_WALK)
    occupied = [_plan(route, s, lateral) for lateral in laterals]
    low, high = asphalt.min(0) - _MARGIN_M, asphalt.max(0) + _MARGIN_M
    ground = Ground.around([(asphalt, _HALF_ROAD_M)], low, high)
    around = Surroundings(ground, path, np.concatenate([*occupied, pillars]), rng)
    for start, heading, length_m in _streets(route, stretch):
        begin = start - _INTO_CORNER_M * np.array([np.sin(heading), np.cos(heading)])
        around.line(begin, heading, length_m + 2 * _INTO_CORNER_M, _FRONT_M)
    parts = around.build(rows=0)
    places = np.array([part.vertices[:, [0, 2]].mean(0) for part in parts])
    _, nearest = cKDTree(path).query(places)
    number, length = quarters
    which = ((s[nearest] - stretch[0]) // length).astype(int) % number
    parts = [in_quarter(part, int(k)) for part, k in zip(parts, which, strict=True)]
    for k, (x, z) in enumerate(pillars):
        parts.append(poster_pillar(k % _PILLARS).placed(pose(x, 0, z, 2.4 * k)))
    return merge([ground.mesh(), *parts])


def _plan(route: Route, s: Array, lateral: float) -> Array:
    """Points (N, 2) of the plane, x and z, at places along the route."""
    return np.stack(route.at(s, lateral)[:2], 1)


def _streets(route: Route, stretch: tuple[float, float]) -> list[tuple[Array, float, float]]:
    """Straight streets: where the middle begins (2,), heading (rad), and length in metres.

    Those that are driven through come first, then the side streets that go on at corners.
    """
    driven, onward = [], []
    reach = corner_reach_m() + SIDE_STREET_M
    corners = [c for c in route.corners if stretch[0] <= c.s_m < stretch[1]]
    for s, length_m in ((c.end_m, _to_next(route, c)) for c in corners):
        x, z, psi = (float(q) for q in route.at(np.array(s), _MIDDLE))
        driven.append((np.array([x, z]), psi, length_m))
        onward.append((np.array([x, z]), psi + np.pi, reach))
    for corner in corners:
        x, z, psi = (float(q) for q in route.at(np.array(corner.s_m), _MIDDLE))
        onward.append((np.array([x, z]), psi, reach))
    return driven + onward


def _to_next(route: Route, corner: Corner) -> float:
    """Metres of straight street that follow a corner."""
    later = (other.s_m for other in route.corners if other.s_m > corner.s_m)
    return next(later, route.end_s) - corner.end_m


def _middle_lines(route: Route, stretch: tuple[float, float]) -> list[Array]:
    """Points (N, 2) in the middle of all straight streets, half a metre apart."""
    return [
        start + np.arange(0, length_m, 0.5)[:, None] * (np.sin(heading), np.cos(heading))
        for start, heading, length_m in _streets(route, stretch)
    ]


def _pillar_places(route: Route, stretch: tuple[float, float]) -> Array:
    """Places (N, 2) of poster pillars: near both ends of each straight, and in its middle."""
    right, left = _PILLAR_LATERALS
    places: list[Array] = [np.empty((0, 2))]
    for k, (before, after) in enumerate(pairwise(route.corners)):
        a, b = before.end_m, after.s_m
        for s, lateral in ((a + 3, left), ((a + b) / 2, (left, right)[k % 2]), (b - 2, right)):
            if stretch[0] <= s < stretch[1]:
                places.append(_plan(route, np.array([s]), lateral))
    return np.concatenate(places)
