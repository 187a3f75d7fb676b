"""Curves in the plane that simulated roads follow, the street's own one, and ribbons along them.

Owns the plan of a road: s runs in metres along it, `lateral` to the right of the camera's lane.
"""

from __future__ import annotations

import numpy as np

from pipelines.datasets.simulated.meshes import Mesh, pose, surface
from pipelines.types import Array

STEP_M = 0.1
BLOCK_M = 84.0  # the bends and the street's script repeat after this length


class Curve:
    """The camera's lane as a curve in the plane, sampled every `STEP_M`.

    It passes through the origin at s = 0; its `curvature` (S,) in rad / m starts at `start_s`.
    """

    def __init__(self, start_s: float, end_s: float, s: Array, curvature: Array) -> None:
        self.start_s, self.end_s = start_s, end_s
        self._s = s
        zero = np.searchsorted(self._s, 0.0)
        self._psi, self._x, self._z = (np.zeros_like(self._s) for _ in range(3))
        self._psi[1:] = np.cumsum((curvature[1:] + curvature[:-1]) / 2 * STEP_M)
        self._x[1:] = np.cumsum(np.sin(self._psi[1:]) * STEP_M)
        self._z[1:] = np.cumsum(np.cos(self._psi[1:]) * STEP_M)
        self._x -= self._x[zero]
        self._z -= self._z[zero]

    def at(self, s: Array, lateral: Array | float) -> tuple[Array, Array, Array]:
        """x, z and heading (rad, clockwise from z) at `s` and `lateral` metres to the right."""
        psi = np.interp(s, self._s, self._psi)
        x = np.interp(s, self._s, self._x) + lateral * np.cos(psi)
        z = np.interp(s, self._s, self._z) - lateral * np.sin(psi)
        return x, z, psi

    def pose(self, s: float, lateral: float, y: float = 0.0, turn_rad: float = 0.0) -> Array:
        x, z, psi = self.at(np.array(s), lateral)
        return pose(float(x), y, float(z), float(psi) + turn_rad)

    def strip(
        self, s: tuple[float, float], lateral: tuple[float, float], heights: tuple[float, float],
        texture: str, columns: int = 2,
    ) -> Mesh:  # fmt: skip
        """Ribbon along the road between two laterals, at heights above the ground."""
        along = np.arange(s[0], s[1] + 0.01, min(1.5, s[1] - s[0]))
        if along[-1] < s[1] - 0.01:
            along = np.append(along, s[1])
        across = np.linspace(*lateral, columns)
        height = np.linspace(*heights, columns)
        x, z, _ = self.at(along[:, None], across[None])
        points = np.stack([x, np.broadcast_to(-height, x.shape), z], -1)
        rise = np.append(0, np.hypot(np.diff(across), np.diff(height)).cumsum())
        uv = np.stack(np.broadcast_arrays(across[0] + rise[None], along[:, None]), -1)
        return surface(points, texture, uv=uv)


class Road(Curve):
    """The street's curve: one gentle bend a block, by turns to the right and to the left."""

    def __init__(self, length_m: float) -> None:
        start_s = -45.0
        s = np.arange(start_s, length_m + 0.2, STEP_M)
        block, local = np.divmod(s, BLOCK_M)
        inside = (local > 3) & (local < 37) & (s > 0)
        bend = np.where(inside, np.sin((local - 3) / 34 * np.pi) ** 2, 0)
        super().__init__(start_s, length_m, s, 0.021 * bend * np.where(block % 2 == 0, 1, -1))
