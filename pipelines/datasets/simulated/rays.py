"""Rays and what they hit: meshes ready for casting, placed before a camera, and sampled pixels.

Owns Open3D's ray casting. Every mesh has its own scene, built once, in its own frame: it is the
rays that are moved, and only those through the window of pixels that its box covers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.simulated.raytables import Floats, TriangleTable, ViewTable
from pipelines.geometry import invert_T, transform_points
from pipelines.types import Array, StereoCamera

Window = tuple[slice, slice]  # rows and columns of pixels
_NEAR_M = 0.05


@dataclass(frozen=True, slots=True)
class Body:
    """A mesh ready for rays: Open3D's scene, the shading table, and the corners of its box."""

    scene: Any
    table: TriangleTable
    low: Array
    high: Array


@dataclass(slots=True)
class PlacedBody:
    """A body in front of one camera, whose rays are written in the body's frame.

    owner: 0 for the still world, else 1 + the actor's place in the list. origin: (3,) camera
    centre. rays: (3, 3) rows d0, du, dv; the ray of pixel (u, v) is d0 + u du + v dv, which has
    unit depth, so that the distance along it is the depth.
    """

    body: Body
    owner: int
    origin: Array
    rays: Array
    R_scene_body: Array
    window: Window
    _view: ViewTable | None = None

    @classmethod
    def of(
        cls, body: Body, owner: int, T_body_camera: Array, K: Array, R: Array, window: Window
    ) -> PlacedBody:
        rays = (T_body_camera[:3, :3] @ np.linalg.inv(K))[:, [2, 0, 1]].T
        return cls(body, owner, T_body_camera[:3, 3], rays, R, window)

    @property
    def view(self) -> ViewTable:
        if self._view is None:  # made late: many bodies turn out to be hidden
            self._view = ViewTable.of(self.body.table, self.origin, self.rays)
        return self._view

    def narrowed(self, triangle: NDArray[np.int32]) -> tuple[PlacedBody, NDArray[np.int32]]:
        """The body with the rows of `triangle` (N,) only, and these by their new numbers (N,).

        Only a few thousand triangles of a town are seen at once: the others need no view.
        """
        seen = np.zeros(len(self.body.table), bool)
        seen[triangle] = True
        number = np.cumsum(seen, dtype=np.int32) - 1
        body = replace(self.body, table=self.body.table.rows(np.flatnonzero(seen)))
        return replace(self, body=body, _view=None), number[triangle]

    def points(self, u: Floats, v: Floats, t: Floats) -> Floats:
        """Points (3, N) in the body's frame, at `t` along the rays of pixels."""
        d = self.rays.astype(np.float32)
        out = np.empty((3, len(t)), np.float32)
        for axis in range(3):
            ray = d[0, axis] + u * d[1, axis] + v * d[2, axis]
            out[axis] = np.float32(self.origin[axis]) + t * ray
        return out

    def cast(self, u: Floats, v: Floats) -> tuple[Floats, NDArray[np.int32]]:
        """Depth (N,), infinite for a miss, and triangle (N,), -1 for a miss."""
        import open3d as o3d

        d = self.rays.astype(np.float32)
        rays = np.empty((len(u), 6), np.float32)
        rays[:, :3] = self.origin
        for axis in range(3):
            rays[:, 3 + axis] = d[0, axis] + u * d[1, axis] + v * d[2, axis]
        found = self.body.scene.cast_rays(o3d.core.Tensor(rays))
        # Open3D's invalid id is the largest uint32: as int32 it is -1.
        return found["t_hit"].numpy(), found["primitive_ids"].numpy().view(np.int32)


@dataclass(slots=True)
class Samples:
    """Rays of one pass and what they hit (parallel arrays of length S).

    u, v: pixels. slots: (H, W) index of the first sample of a pixel, -1 where it has none; where
    a pixel has several `copies`, they lie S / copies apart. t, triangle: as of `PlacedBody.cast`.
    owner: of the body that was hit.
    """

    u: Floats
    v: Floats
    slots: NDArray[np.int32]
    copies: int
    t: Floats
    owner: NDArray[np.int32]
    triangle: NDArray[np.int32]

    @classmethod
    def cast(
        cls, u: Floats, v: Floats, slots: NDArray[np.int32], copies: int, placed: list[PlacedBody]
    ) -> Samples:
        """The nearest hit of each ray; the first of `placed` is the still world."""
        t, triangle = placed[0].cast(u, v)
        samples = cls(u, v, slots, copies, t, np.zeros(len(u), np.int32), triangle)
        for item in placed[1:]:
            where = samples.inside(item.window)
            if not len(where):
                continue
            t, triangle = item.cast(u[where], v[where])
            closer = t < samples.t[where]
            hit = where[closer]
            samples.t[hit], samples.triangle[hit] = t[closer], triangle[closer]
            samples.owner[hit] = item.owner
        return samples

    def inside(self, window: Window) -> NDArray[np.int64]:
        """Indices of the samples of the pixels in a window."""
        slots = self.slots[window].ravel()
        chosen = slots[slots >= 0].astype(np.int64)
        if self.copies == 1:
            return chosen
        copies = np.arange(self.copies, dtype=np.int64) * (len(self.u) // self.copies)
        return (chosen + copies[:, None]).ravel()

    def of(self, owner: int, window: Window) -> NDArray[np.int64]:
        """Indices of the samples in a window that hit one body."""
        where = self.inside(window)
        mine: NDArray[np.int64] = where[self.owner[where] == owner]
        return mine


def box_corners(low: Array, high: Array) -> Array:
    """The corners (8, 3) of a box; corners i and j share an edge where i ^ j is 1, 2 or 4."""
    return np.where((np.arange(8)[:, None] >> np.arange(3)) & 1, high, low)


def box_window(
    camera: StereoCamera, corners: Array, T_scene_camera: Array, T_scene_box: Array, reach_m: float
) -> Window | None:
    """Pixels that a box of `box_corners` may cover, or None where it is out of sight."""
    T = invert_T(T_scene_camera) @ T_scene_box
    in_camera = transform_points(T, corners)
    if in_camera[:, 2].min() > reach_m:
        return None
    p = _cut(in_camera)
    if not len(p):
        return None
    u = camera.fx * p[:, 0] / p[:, 2] + camera.cx
    v = camera.fy * p[:, 1] / p[:, 2] + camera.cy
    left, top = max(int(u.min()) - 1, 0), max(int(v.min()) - 1, 0)
    right, bottom = min(int(u.max()) + 3, camera.width), min(int(v.max()) + 3, camera.height)
    if left >= right or top >= bottom:
        return None
    return slice(top, bottom), slice(left, right)


def _cut(corners: Array) -> Array:
    """What lies in front of the camera: corners there, and where edges cross the near plane."""
    z = corners[:, 2]
    front = z >= _NEAR_M
    if front.all():
        return corners
    a, b = np.array([(i, i ^ bit) for i in range(8) for bit in (1, 2, 4) if i < i ^ bit]).T
    crossing = front[a] != front[b]
    a, b = a[crossing], b[crossing]
    share = ((_NEAR_M - z[a]) / (z[b] - z[a]))[:, None]
    return np.concatenate([corners[front], corners[a] + share * (corners[b] - corners[a])])
