"""What stands along a way through a town or a replayed KITTI sequence: houses, trees, furniture.

Owns where they stand: along the ego path, and never where anything of the sequence ever is. A
closed row of houses round everything leaves no open horizon.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipelines.datasets.simulated.buildings import (
    bench,
    house,
    lamp_post,
    litter_bin,
    planter,
    road_sign,
    tree,
)
from pipelines.datasets.simulated.kitti_ground import Ground
from pipelines.datasets.simulated.kitti_motion import outline, overlapping
from pipelines.datasets.simulated.meshes import Mesh, pose, surface
from pipelines.types import Array

_HOUSE_DEPTH_M = 9.0
_CLEAR_M = 1.5  # from a house to the asphalt
_ROWS = ((9.0, 10.5, 12.0, 14.0, 17.0, 21.0), (27.0, 31.0, 36.0, 42.0))  # laterals to try
_AVENUE_M = 11.5


class Surroundings:
    """Collects the meshes of everything that stands still on the ground."""

    def __init__(
        self, ground: Ground, path: Array, occupied: Array, rng: np.random.Generator
    ) -> None:
        """path: (P, 2) of the ego car, every half metre. occupied: (Q, 2) where things ever are."""
        self.parts: list[Mesh] = []
        self._ground, self._path, self._rng = ground, path, rng
        self._occupied = cKDTree(occupied)
        step = np.gradient(path, axis=0)
        self._heading = np.arctan2(step[:, 0], step[:, 1])
        self._houses: list[Array] = []

    def build(self, rows: int = len(_ROWS)) -> list[Mesh]:
        """Houses first, of which `rows` along the path, then what fits before and between them."""
        self._border()
        for row in range(rows):
            for side in (-1, 1):
                self._terrace(side, row)
        for side in (-1, 1):
            self._avenue(side)
        self._meadow()
        self._centre_line()
        return self.parts

    def line(self, start: Array, heading: float, length_m: float, front_m: float) -> None:
        """Houses wall to wall on both sides of a straight street, wherever one stands free.

        start: (2,) where the middle of the street begins. front_m: from there to the fronts.
        """
        forward = np.array([np.sin(heading), np.cos(heading)])
        for side in (-1, 1):
            s = 0.0
            while s < length_m:
                width = float(self._rng.uniform(8.5, 13.5))
                place = start + (s + width / 2) * forward
                placed = self._place_house(place, heading, side * front_m, width, False)
                s += width if placed else 1.0

    def _border(self) -> None:
        """A closed row of houses just inside the edge of the ground, fronts inward."""
        x0, x1 = self._ground.x_m[[0, -1]]
        z0, z1 = self._ground.z_m[[0, -1]]
        inset = _HOUSE_DEPTH_M + 1
        rim = [(x0, z0, x1, z0), (x1, z0, x1, z1), (x1, z1, x0, z1), (x0, z1, x0, z0)]
        for ax, az, bx, bz in rim:
            direction = np.array([bx - ax, bz - az])
            length = float(np.hypot(*direction)) - 2 * inset
            along = direction / np.hypot(*direction)
            inward = np.array([-along[1], along[0]])
            n = max(1, round(length / 13))
            for k in range(n):
                # Seen from inside, left to right is against this way round.
                start = np.array([ax, az]) + along * (inset + (k + 1) * length / n)
                start = start + inward * inset
                yaw = float(np.arctan2(along[1], -along[0]))
                block = house(length / n, _HOUSE_DEPTH_M, self._rng, True)
                self.parts.append(block.placed(pose(start[0], 0, start[1], yaw)))

    def _terrace(self, side: int, row: int) -> None:
        """Houses along one side, each at the nearest lateral where it stands free."""
        arc = np.append(0, np.hypot(*np.diff(self._path, axis=0).T).cumsum())
        s = float(self._rng.uniform(0, 5))
        while s < arc[-1] - 5:
            width = float(self._rng.uniform(8.5, 13.5))
            k = int(np.searchsorted(arc, min(s + width / 2, arc[-1])))
            s += width
            for lateral in _ROWS[row]:
                wider = 3.3 if side < 0 else 0.0  # the oncoming lane is on the left
                place, heading = self._path[k], float(self._heading[k])
                if self._place_house(place, heading, side * (lateral + wider), width, row > 0):
                    break

    def _place_house(
        self, place: Array, heading: float, lateral: float, width: float, plain: bool
    ) -> bool:
        side = float(np.sign(lateral))
        right = np.array([np.cos(heading), -np.sin(heading)])
        forward = np.array([np.sin(heading), np.cos(heading)])
        front = place + lateral * right
        centre = front + side * right * _HOUSE_DEPTH_M / 2
        plan = outline(centre[0], centre[1], np.array(heading), _HOUSE_DEPTH_M, width)
        if not self._is_free(plan, heading):
            return False
        self._houses.append(plan)
        # Its frame has x along the front, left to right as seen from the road, z away from it.
        corner = front - side * -1 * forward * width / 2
        yaw = heading + side * np.pi / 2
        block = house(width, _HOUSE_DEPTH_M, self._rng, plain)
        self.parts.append(block.placed(pose(corner[0], 0, corner[1], yaw)))
        return True

    def _is_free(self, plan: Array, heading: float) -> bool:
        """Whether a house on `plan` is off the road, in the ground, and away from all else."""
        low, high = plan.min(0), plan.max(0)
        rim = _HOUSE_DEPTH_M + 4
        grid = self._ground
        inside = (low > (grid.x_m[0] + rim, grid.z_m[0] + rim)).all()
        if not inside or not (high < (grid.x_m[-1] - rim, grid.z_m[-1] - rim)).all():
            return False
        share = np.linspace(0, 1, 9)
        a, b = np.meshgrid(share, share)
        u, v = plan[1] - plan[0], plan[3] - plan[0]
        cover = plan[0] + a.reshape(-1, 1) * u + b.reshape(-1, 1) * v
        if grid.at(cover).min() < _CLEAR_M or self._occupied.query(cover)[0].min() < 2.2:
            return False
        return not (self._houses and overlapping(plan, np.array(self._houses), 0.02).any())

    def _free_spot(self, place: Array, apart_m: float, from_house_m: float) -> bool:
        if self._occupied.query(place)[0] < apart_m:
            return False
        reach = 2 * from_house_m
        spot = outline(place[0], place[1], np.array(0.0), reach, reach)
        return not (self._houses and overlapping(spot, np.array(self._houses)).any())

    def _avenue(self, side: int) -> None:
        """Trees, lamps, signs and the like at the kerb, where the kerb follows the path."""
        arc = np.append(0, np.hypot(*np.diff(self._path, axis=0).T).cumsum())
        trees = [tree(self._rng, float(self._rng.uniform(5.8, 7.4))) for _ in range(4)]
        laterals = np.arange(3.0, 14.0, 0.1)
        for n, s in enumerate(np.arange(3.0 + 4 * (side > 0), arc[-1], _AVENUE_M / 2)):
            k = int(np.searchsorted(arc, s))
            heading = float(self._heading[k])
            right = np.array([np.cos(heading), -np.sin(heading)])
            line = self._path[k] + side * laterals[:, None] * right
            at = np.flatnonzero(self._ground.at(line) > 0.85)
            if not len(at):
                continue
            place = line[at[0]]
            if n % 2 == 0:
                self._tall(place, heading, side, (n // 2) % 3 == 2, trees)
            elif self._free_spot(place, 1.2, 0.5):
                self._small(place, heading, side)

    def _tall(self, place: Array, heading: float, side: int, lamp: bool, trees: list[Mesh]) -> None:
        x, z = place
        if lamp and self._free_spot(place, 0.9, 0.3):
            self.parts.append(lamp_post().placed(pose(x, 0, z, heading + side * np.pi / 2)))
        elif not lamp and self._free_spot(place, 1.8, 1.2):
            turn = float(self._rng.uniform(0, 6.3))
            which = int(self._rng.integers(0, len(trees)))
            self.parts.append(trees[which].placed(pose(x, 0, z, turn)))

    def _small(self, place: Array, heading: float, side: int) -> None:
        facing = heading + side * np.pi / 2
        at = pose(place[0], 0, place[1], facing)
        kind = int(self._rng.integers(0, 6))
        if kind == 0:
            self.parts.append(bench().placed(at))
        elif kind == 1:
            self.parts.append(litter_bin().placed(at))
        elif kind == 2:
            self.parts.append(planter(self._rng).placed(at))
        elif kind == 3:
            sign = ("limit", "parking")[int(self._rng.integers(0, 2))]
            turn = heading if side > 0 else heading + np.pi
            self.parts.append(road_sign(sign).placed(pose(place[0], 0, place[1], turn)))

    def _meadow(self) -> None:
        """Trees scattered over the grass between and behind the houses."""
        trees = [tree(self._rng, float(self._rng.uniform(6.0, 8.5))) for _ in range(4)]
        low = np.array([self._ground.x_m[0], self._ground.z_m[0]]) + 14
        high = np.array([self._ground.x_m[-1], self._ground.z_m[-1]]) - 14
        n = int(np.clip(np.prod(high - low) / 350, 20, 80))
        spots = self._rng.uniform(low, high, (n, 2))
        turns, kinds = self._rng.uniform(0, 6.3, n), self._rng.integers(0, 4, n)
        outside = self._ground.at(spots)
        for spot, turn, kind, out in zip(spots, turns, kinds, outside, strict=True):
            if out > 4.5 and self._free_spot(spot, 2.2, 2.2):
                self.parts.append(trees[kind].placed(pose(spot[0], 0, spot[1], float(turn))))

    def _centre_line(self) -> None:
        """Dashes between the ego lane and the oncoming one, wherever the road is wide enough."""
        right = np.stack([np.cos(self._heading), -np.sin(self._heading)], 1)
        for start in range(4, len(self._path) - 8, 12):
            which = slice(start, start + 7)
            edges = [self._path[which] + lateral * right[which] for lateral in (-1.86, -1.74)]
            if self._ground.at(np.concatenate(edges)).max() > -0.5:
                continue
            points = np.stack(edges, 1)
            points = np.stack(
                [points[..., 0], np.full(points.shape[:2], -0.004), points[..., 1]], -1
            )
            self.parts.append(surface(points, "paint"))
