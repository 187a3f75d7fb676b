"""The street: a bending road between terraced houses, driven through with traffic and walkers.

Owns its layout and choreography. Along the road, s runs in metres and `lateral` to the right of the
camera's lane. What happens is one script of 84 m that repeats: an overtaking car, oncoming ones
(one turning off, one stopping at the light), one pulling out, people walking, one crossing.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.simulated.buildings import (
    bench,
    house,
    lamp_post,
    litter_bin,
    planter,
    road_sign,
    traffic_light,
    tree,
)
from pipelines.datasets.simulated.facades import FACADES
from pipelines.datasets.simulated.meshes import WHITE, Mesh, box, merge, pose, surface
from pipelines.datasets.simulated.people import WARDROBE, walker_mesh
from pipelines.datasets.simulated.road import BLOCK_M, Curve, Road
from pipelines.datasets.simulated.textures import SURFACES
from pipelines.datasets.simulated.vehicles import SHAPES, VEHICLE_ART, car_mesh
from pipelines.datasets.simulated.world import Actor, Light, World
from pipelines.types import Array, StereoCamera

FPS = 10.0
CROSSING_S, ZEBRA_S = 52.0, 43.5
LEFT_LANE, ONCOMING = -3.2, -6.6
_KERBS = (-10.6, 4.2)
_FRONTS = (-13.9, 7.4)  # where the houses begin
_PARKED = (-9.45, 3.05)
KERB_M = 0.07
EYE_M = 1.65
AHEAD_M = 175.0
CAR_PAINTS = (
    (176, 34, 40), (38, 74, 138), (222, 222, 220), (52, 54, 58), (150, 156, 162),
    (56, 98, 78), (206, 160, 62), (120, 152, 178), (112, 44, 52), (232, 226, 206),
)  # fmt: skip
DAYLIGHT = Light((-0.62, -1.0, -0.55), (0.78, 0.73, 0.63), (0.75, 0.78, 0.84), (0.5, 0.48, 0.45))

Along = Callable[[Array], Array]


def make_street(
    frames: int, seed: int, camera: StereoCamera, fps: float = FPS, still: bool = False
) -> World:
    """The street with a camera car driving 6.4 to 9.6 m/s; `still` leaves out all that moves."""
    rng = np.random.default_rng(seed)
    times = np.arange(frames + 1) / fps
    ego = _ego_s(times)
    road = Road(float(ego[-1]) + AHEAD_M)
    blocks = range(int(ego[-1] // BLOCK_M) + 2)
    script = StreetScript(road, times, rng)
    script.park(blocks)
    if not still:
        script.lead()
        for block in blocks:
            script.block(block)
        script.people()
    return World(
        camera,
        fps,
        street_static(road, rng),
        tuple(script.actors),
        camera_poses(road, ego, 0.1 * np.sin(0.5 * times), times),
        DAYLIGHT,
        SURFACES | FACADES | VEHICLE_ART,
        sky="sky",
    )


def _ego_s(t: Array) -> Array:
    """Metres driven after t seconds: 8 m/s with a slow swing of 1.6 m/s."""
    return 8.0 * t + 1.6 / 0.45 * (1 - np.cos(0.45 * t))


def _ego_time(s: float) -> float:
    t = np.linspace(-20, 2000, 40401)
    return float(np.interp(s, _ego_s(t), t))


def camera_poses(road: Curve, s: Array, lateral: Array, t: Array) -> Array:
    """Poses (N + 1, 4, 4) of the left camera, with the slight pitch and bounce of a real car.

    s, lateral: (N + 1,) where on the road it is after `t` seconds.
    """
    x, z, psi = road.at(s, lateral)
    pitch = 0.004 * np.sin(5.3 * t) + 0.0025 * np.sin(11.0 * t + 1)
    roll = 0.004 * np.sin(3.1 * t + 0.5)
    lift = 0.015 * np.sin(6.1 * t) + 0.006 * np.sin(13.0 * t)
    Ts = np.stack([pose(a, -EYE_M + b, c, d) for a, b, c, d in zip(x, lift, z, psi, strict=True)])
    for T, p, r in zip(Ts, pitch, roll, strict=True):
        tilt = np.array([[1, 0, 0], [0, np.cos(p), -np.sin(p)], [0, np.sin(p), np.cos(p)]])
        lean = np.array([[np.cos(r), -np.sin(r), 0], [np.sin(r), np.cos(r), 0], [0, 0, 1]])
        T[:3, :3] = T[:3, :3] @ tilt @ lean
    return Ts


class StreetScript:
    """Collects the actors of the street, with their poses at all times."""

    def __init__(self, road: Curve, times: Array, rng: np.random.Generator) -> None:
        self.road, self.times, self.rng = road, times, rng
        self.actors: list[Actor] = []
        self._shapes = {kind: car_mesh(kind) for kind in SHAPES}
        self._walkers = [walker_mesh(clothes) for clothes in WARDROBE]

    def car(
        self, Ts: Array, moving: bool, kind: str = "", present: NDArray[np.bool_] | None = None
    ) -> None:
        """Add a car on the road at `Ts`, of a random kind unless told; its height is set here.

        present: (N + 1,) frames in which it is there at all, None for always.
        """
        kind = kind or str(self.rng.choice(list(SHAPES), p=(0.32, 0.32, 0.24, 0.12)))
        mesh = self._shapes[kind].painted_as(CAR_PAINTS[self.rng.integers(0, len(CAR_PAINTS))])
        Ts = Ts.copy()
        Ts[:, 1, 3] = -SHAPES[kind].size_m[1] / 2
        self.actors.append(Actor(len(self.actors) + 1, "car", mesh, Ts, moving, present))

    def walker(self, Ts: Array, present: NDArray[np.bool_] | None = None) -> None:
        """Add a person whose soles are at `Ts`; `present` as of `car`."""
        mesh = self._walkers[self.rng.integers(0, len(self._walkers))]
        _, high = mesh.bounds()
        Ts = Ts.copy()
        Ts[:, 1, 3] -= high[1]
        self.actors.append(Actor(len(self.actors) + 1, "person", mesh, Ts, True, present))

    def follow(self, s: Array, lateral: Along, direction: int = 1, y: float = 0.0) -> Array:
        """Poses of something that drives or walks along `lateral(s)`, facing its way."""
        x, z, psi = self.road.at(s, lateral(s))
        slope = np.arctan((lateral(s + 0.05) - lateral(s - 0.05)) / 0.1)
        heading = psi + slope + (np.pi if direction < 0 else 0)
        rows = zip(x, z, heading, strict=True)
        return np.stack([pose(a, y, b, c) for a, b, c in rows])

    def park(self, blocks: range) -> None:
        """Cars along both kerbs; not at crossings and where a script needs the place."""
        for side, lateral in enumerate(_PARKED):
            for s in np.arange(-8.0, self.road.end_s - 25, 6.1):
                local = s % BLOCK_M
                junction = abs(local - (CROSSING_S + ZEBRA_S) / 2) < 14
                taken = side == 0 and abs(local - 24) < 7
                if junction or taken or self.rng.random() < 0.28:
                    continue
                if len(self.actors) > 400:
                    return
                place = s + self.rng.uniform(-0.5, 0.5)
                off = lateral + self.rng.uniform(-0.12, 0.12)
                turn = self.rng.uniform(-0.03, 0.03) + (np.pi if side == 0 else 0)
                T = self.road.pose(place, off, 0.0, turn)
                self.car(np.repeat(T[None], len(self.times), 0), moving=False)

    def lead(self) -> None:
        s = _ego_s(self.times) + 15.5 + 2.5 * np.sin(0.32 * self.times)
        self.car(self.follow(s, lambda s: 0.1 * np.sin(s / 19)), True, "hatchback")

    def block(self, block: int) -> None:
        s0 = block * BLOCK_M
        tau = self.times - _ego_time(s0)
        constant = partial(np.full_like, dtype=float)
        overtaking = _ego_s(self.times) - 3.0 + 5.0 * tau
        self.car(self.follow(overtaking, lambda s: constant(s, LEFT_LANE)), True, "saloon")
        oncoming = s0 + 56 - 8.5 * tau
        self.car(self.follow(oncoming, lambda s: constant(s, ONCOMING), -1), True, "estate")
        self.car(self._turning(s0, tau), True, "saloon")
        stopping = s0 + _stopping_s(tau)
        self.car(self.follow(stopping, lambda s: constant(s, ONCOMING), -1), True, "van")
        out = np.maximum(tau - 0.2, 0)
        driven = np.where(out < 2.8, 1.1 * out**2, 8.624 + 6.16 * (out - 2.8))

        def from_kerb(s: Array) -> Array:
            share = np.clip((s0 + 24 - s) / 9.0, 0, 1)
            return _PARKED[0] + (ONCOMING - _PARKED[0]) * share**2 * (3 - 2 * share)

        self.car(self.follow(s0 + 24 - driven, from_kerb, -1), True, "hatchback")
        self._crossing_walker(s0, tau)

    def _turning(self, s0: float, tau: Array) -> Array:
        """Oncoming car that turns into the side street on the left of the camera."""
        radius, lane = 5.0, 1.75
        straight = 73.75 - (CROSSING_S + lane + radius)
        d = np.where(tau < 2.0, 7.0 * tau, 14 + 4.4 * (tau - 2.0))
        angle = np.clip((d - straight) / radius, 0, np.pi / 2)
        before = np.minimum(d, straight)
        after = np.maximum(d - straight - radius * np.pi / 2, 0)
        s = s0 + 73.75 - before - radius * np.sin(angle)
        lateral = ONCOMING - radius * (1 - np.cos(angle)) - after
        x, z, psi = self.road.at(s, lateral)
        return np.stack(
            [pose(a, 0, b, c) for a, b, c in zip(x, z, psi + np.pi + angle, strict=True)]
        )

    def _crossing_walker(self, s0: float, tau: Array) -> None:
        lateral = np.clip(-1.0 - 1.5 * tau, -12.3, 4.9)
        x, z, psi = self.road.at(np.full_like(tau, s0 + ZEBRA_S), lateral)
        rows = zip(x, z, psi - np.pi / 2, strict=True)
        self.walker(np.stack([pose(a, 0, b, c) for a, b, c in rows]))

    def people(self) -> None:
        """Walkers on both pavements, about one every 9 m, some with and some against the camera."""
        for s in np.arange(4.0, self.road.end_s - 40, 8.7):
            side = self.rng.integers(0, 2)
            lateral = self.rng.uniform(5.75, 6.7) if side else self.rng.uniform(-13.2, -12.2)
            direction = 1 if self.rng.random() < 0.5 else -1
            speed = self.rng.uniform(1.0, 1.6)
            along = s + self.rng.uniform(-2, 2) + direction * speed * self.times
            self.walker(
                self.follow(along, partial(np.full_like, fill_value=lateral), direction, -KERB_M)
            )


def _stopping_s(tau: Array) -> Array:
    """Where the oncoming van is: it brakes for the light, waits, and drives on."""
    speed, brake = 8.0, 2.5
    slow, wait, go = 2.0, 2.0 + speed / brake, 6.6
    t = np.clip(tau - slow, 0, speed / brake)
    braked = speed * np.minimum(tau, slow) + speed * t - brake * t**2 / 2
    u = np.maximum(tau - go, 0)
    gained = np.where(u < 4.0, u**2, 16 + 8 * (u - 4.0))
    return 90 - braked - gained * (tau > wait)


def street_static(road: Road, rng: np.random.Generator) -> Mesh:
    """All that stands still along a road: ground, markings, houses and furniture."""
    ends = (road.start_s, road.end_s)
    junctions = [
        k * BLOCK_M + CROSSING_S for k in range(-1, int(road.end_s // BLOCK_M) + 1)
        if road.start_s < k * BLOCK_M + CROSSING_S < road.end_s - 30
    ]  # fmt: skip
    parts = [road.strip(ends, _KERBS, (0.0, 0.0), "asphalt", 4)]
    open_ends = [road.start_s, *(x for j in junctions for x in (j - 5.0, j + 5.0)), road.end_s]
    for s in zip(open_ends[::2], open_ends[1::2], strict=True):
        for side, (kerb, front) in enumerate(zip(_KERBS, _FRONTS, strict=True)):
            outward = -1 if side == 0 else 1
            edge = kerb + 0.18 * outward
            parts.append(road.strip(s, (kerb, kerb), (0.0, KERB_M), "concrete"))
            parts.append(road.strip(s, (kerb, edge), (KERB_M, KERB_M), "concrete"))
            behind = front + 0.9 * outward  # house fronts are chords of the bends: leave no gap
            parts.append(road.strip(s, (edge, behind), (KERB_M, KERB_M), "paving"))
    x, z, _ = road.at(np.arange(*ends), 0.0)
    low, high = np.array([x.min() - 60, z.min()]), np.array([x.max() + 60, z.max()])
    centre, extent = (low + high) / 2, high - low
    yard = box((extent[0], 0.02, extent[1]), "grass", WHITE, (centre[0], 0.06, centre[1]))
    parts.append(yard)  # under everything: whatever is seen between houses stands on something
    parts += _markings(road, junctions)
    for junction in junctions:
        parts += _side_street(road, junction, rng)
    for front, outward in zip(_FRONTS, (-1, 1), strict=True):
        parts += _terrace(road, front, outward, junctions, rng)
    parts += _street_furniture(road, junctions, rng)
    return merge(parts)


def _markings(road: Road, junctions: list[float]) -> list[Mesh]:
    parts = []
    lift = (0.004, 0.004)

    def clear(s: float) -> bool:
        return all(abs(s - j + 2.5) > 11 for j in junctions)

    for s in np.arange(road.start_s + 2, road.end_s - 5, 6.0):
        if clear(s):
            parts.append(road.strip((s, s + 3.0), (-1.66, -1.54), lift, "paint"))
            parts.append(road.strip((s, s + 5.99), (-4.96, -4.84), lift, "paint"))
            for edge in (1.85, -8.25):
                parts.append(road.strip((s, s + 1.0), (edge, edge + 0.1), lift, "paint"))
    for j in junctions:
        zebra = j - CROSSING_S + ZEBRA_S
        for lateral in np.arange(_KERBS[0] + 0.5, _KERBS[1] - 0.4, 1.0):
            bar = (zebra - 1.5, zebra + 1.5)
            parts.append(road.strip(bar, (lateral, lateral + 0.5), lift, "paint"))
        parts.append(road.strip((zebra - 2.9, zebra - 2.5), (-4.8, 1.6), lift, "paint"))
        parts.append(road.strip((j + 6.6, j + 7.0), (-8.2, -5.0), lift, "paint"))
    return parts


def _side_street(road: Road, junction: float, rng: np.random.Generator) -> list[Mesh]:
    """Cross street with houses along it and across its ends."""
    s = (junction - 5.0, junction + 5.0)
    parts = []
    for inner, outer, outward in ((_KERBS[0], -52.0, -1), (_KERBS[1], 46.0, 1)):
        parts.append(road.strip(s, (inner, outer), (0.0, 0.0), "asphalt", 8))
        for edge, away in ((s[0], -1), (s[1], 1)):
            rim = sorted((edge, edge + 2.0 * away))
            span = (inner, outer)
            parts.append(road.strip((rim[0], rim[1]), span, (KERB_M,) * 2, "paving", 8))
            x, z, _ = road.at(np.array([edge, edge]), np.array(span))
            kerb = [[(a, -KERB_M, b), (a, 0, b)] for a, b in zip(x, z, strict=True)]
            parts.append(surface(kerb, "concrete"))
        begin = (_FRONTS[0] - 8.9) if outward < 0 else (_FRONTS[1] + 8.9)
        for k in range(2):
            near = begin + outward * 11.5 * k
            # left to right as seen from the street: the frame's z points away from it
            far_side = near if outward > 0 else near - 11.5
            near_side = near + 11.5 if outward > 0 else near
            parts.append(house(11.4, 9, rng, True).placed(road.pose(s[1] + 2, far_side)))
            turned = road.pose(s[0] - 2, near_side, 0.0, np.pi)
            parts.append(house(11.4, 9, rng, True).placed(turned))
        end = road.pose(junction + 7 * outward, outer, 0.0, outward * np.pi / 2)
        parts.append(house(14, 9, rng, True).placed(end))
    return parts


def _terrace(
    road: Road, front: float, outward: int, junctions: list[float], rng: np.random.Generator
) -> list[Mesh]:
    """Houses side by side; their corners stand on the line `front`, so the row has no gaps."""
    parts = []
    stops = [road.start_s, *(x for j in junctions for x in (j - 7.0, j + 7.0)), road.end_s - 4]
    for first, last in zip(stops[::2], stops[1::2], strict=True):
        widths = rng.uniform(8.5, 13.5, max(1, round((last - first) / 11)))
        edges = first + np.append(0, widths.cumsum()) * (last - first) / widths.sum()
        x, z, _ = road.at(edges, front)
        for i in range(len(widths)):
            # Left to right as seen from the road: the frame's z points away from it.
            a, b = (i, i + 1) if outward < 0 else (i + 1, i)
            direction = np.array([x[b] - x[a], z[b] - z[a]])
            yaw = np.arctan2(-direction[1], direction[0])
            block = house(float(np.hypot(*direction)), 9.0, rng)
            parts.append(block.placed(pose(x[a], -KERB_M + 0.03, z[a], yaw)))
    end = road.pose(road.end_s - 6, _FRONTS[0] - 2)
    parts.append(house(26, 9, rng, True).placed(end))
    return parts


def _street_furniture(road: Road, junctions: list[float], rng: np.random.Generator) -> list[Mesh]:
    parts = []
    trees = [tree(rng, rng.uniform(5.8, 7.4)) for _ in range(4)]
    y = -KERB_M
    for side, (kerb, inward) in enumerate(zip(_KERBS, (1, -1), strict=True)):
        line = kerb - 0.75 * inward
        for k, s in enumerate(np.arange(road.start_s + 5 + 4 * side, road.end_s - 10, 11.5)):
            if any(abs(s - j + 3) < 13 for j in junctions):
                continue
            turn = rng.uniform(0, 6.3)
            facing = np.pi / 2 * inward * -1  # z away from the road
            if k % 3 != 2:
                parts.append(trees[rng.integers(0, 4)].placed(road.pose(s, line, y, turn)))
                parts.append(
                    road.strip((s - 0.6, s + 0.6), (line - 0.5, line + 0.5), (0.075,) * 2, "grass")
                )
            else:
                parts.append(lamp_post().placed(road.pose(s, line, y, facing)))
            extra = rng.integers(0, 5)
            place = road.pose(s + 4.2, line - 0.1 * inward, y, facing)
            if extra == 0:
                parts.append(bench().placed(place))
            elif extra == 1:
                parts.append(litter_bin().placed(place))
            elif extra == 2:
                parts.append(planter(rng).placed(road.pose(s + 4.2, line, y, facing)))
            elif extra == 3:
                sign = ("limit", "parking")[rng.integers(0, 2)]
                parts.append(
                    road_sign(sign).placed(road.pose(s + 3.5, line, y, 0 if side else np.pi))
                )
    for j in junctions:
        zebra = j - CROSSING_S + ZEBRA_S
        parts.append(traffic_light().placed(road.pose(zebra - 2.7, _KERBS[1] + 0.5, y)))
        parts.append(road_sign("crossing").placed(road.pose(zebra - 1.7, _KERBS[1] + 0.6, y)))
        parts.append(traffic_light().placed(road.pose(j + 6.8, _KERBS[0] - 0.5, y, np.pi)))
    return parts
