"""The colour of what rays hit: textures, light, shadows, haze and sky.

Owns the look of a simulated world. Everything is arrays of pixels, one plane a channel.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.simulated.atlas import Atlas
from pipelines.datasets.simulated.rays import Body, PlacedBody, Samples, box_corners, box_window
from pipelines.datasets.simulated.raytables import Floats
from pipelines.datasets.simulated.shadows import ShadowMap, patch_under
from pipelines.datasets.simulated.world import Actor, World
from pipelines.geometry import make_T
from pipelines.types import Array

_CHUNK = 1 << 16  # samples that one thread shades at a time
_MANY_TRIANGLES = 200_000  # of the still world, above which only those seen are looked at
_TAPS = 4  # look-ups of the atlas along the long side of a pixel's footprint
_HAZE_RGB = (204.0, 214.0, 222.0)
_PATCH_REACH_M = 60.0  # shadow patches farther away than this are too small to see


class Shading:
    """Turns hits in one world into colours."""

    def __init__(self, world: World, atlas: Atlas, sky_index: int, bodies: list[Body]) -> None:
        """bodies: of the actors, in their order. sky_index: the sky's texture, -1 for none."""
        self._world, self._atlas, self._sky_index, self._bodies = world, atlas, sky_index, bodies
        self._shadow = ShadowMap(world.static, world.light)
        towards = np.asarray(world.light.towards)
        self._threads = ThreadPoolExecutor(min(os.cpu_count() or 1, 4), "shading")
        self._towards = (towards / np.linalg.norm(towards)).astype(np.float32)

    def colours(
        self, samples: Samples, placed: list[PlacedBody], T_scene_camera: Array, index: int
    ) -> Floats:
        """RGB planes (3, S), 0-255, of the samples of frame `index`."""
        colour = np.empty((3, len(samples.u)), np.float32)
        world = placed[0]
        still = np.flatnonzero((samples.owner == 0) & (samples.triangle >= 0))
        if len(world.body.table) > _MANY_TRIANGLES:
            triangle = samples.triangle.copy()
            world, triangle[still] = world.narrowed(triangle[still])
            samples = replace(samples, triangle=triangle)
        points = world.points(samples.u[still], samples.v[still], samples.t[still])
        lamp = self._shadow.lit(points)
        around = np.ones_like(lamp)
        self._darken(samples, still, points, (lamp, around), T_scene_camera, index)
        flat = self._flat_facing(world)

        def shade_still(start: int) -> None:
            part = slice(start, start + _CHUNK)
            lights = lamp[part], around[part]
            colour[:, still[part]] = self._lit(world, samples, still[part], lights, flat)

        def shade_actor(item: PlacedBody) -> None:
            mine = samples.of(item.owner, item.window)
            if len(mine):
                at = world.points(samples.u[mine], samples.v[mine], samples.t[mine])
                share = self._shadow.lit(at)
                colour[:, mine] = self._lit(item, samples, mine, (share, np.ones_like(share)))

        # Every sample belongs to one of these, so the threads write apart from each other.
        jobs = [self._threads.submit(shade_still, i) for i in range(0, len(still), _CHUNK)]
        jobs += [self._threads.submit(shade_actor, item) for item in placed[1:]]
        for job in jobs:
            job.result()
        missed = np.flatnonzero(samples.triangle < 0)
        if len(missed):
            colour[:, missed] = self._sky(world, samples.u[missed], samples.v[missed])
        return colour

    def _lit(
        self,
        item: PlacedBody,
        samples: Samples,
        where: NDArray[np.int64],
        lights: tuple[Floats, Floats],
        flat: tuple[Floats, Floats] | None = None,
    ) -> Floats:
        """Texture times light (3, N) for samples `where` on one body.

        lights: (N,) shares of the lamp and of the surrounding light that arrive. flat: (M,) what
        `_facing` gives, by triangle, for a body that is shaded flat.
        """
        triangle, t = samples.triangle[where], samples.t[where]
        u, v = samples.u[where], samples.v[where]
        table, light = item.body.table, self._world.light
        tiles, right, down = item.view.texture_at(triangle, t, u, v)
        rgba = self._texture(table.texture[triangle], tiles, right, down)
        if flat is None:
            facing, upward = self._facing(item, triangle, (u, v, t))
        else:
            facing, upward = flat[0][triangle], flat[1][triangle]
        facing, upward = facing * lights[0], upward * lights[1]
        downward = lights[1] - upward
        tinted = rgba[3] * np.float32(1 / 255)
        clear = None if light.haze_m is None else np.exp(t * np.float32(-1 / light.haze_m))
        for channel in range(3):
            plane = rgba[channel]
            plane *= 1 - tinted * (1 - table.tint[channel][triangle])
            plane *= (
                facing * np.float32(light.lamp[channel])
                + upward * np.float32(light.above[channel])
                + downward * np.float32(light.below[channel])
            )
            if clear is not None:
                haze = np.float32(_HAZE_RGB[channel])
                plane -= haze
                plane *= clear
                plane += haze
        return rgba[:3]

    def _facing(
        self, item: PlacedBody, triangle: NDArray[np.int32], at: tuple[Floats, Floats, Floats]
    ) -> tuple[Floats, Floats]:
        """Cosine towards the lamp (N,), and 0 to 1 (N,) from downward to upward, of surfaces."""
        R = item.R_scene_body.astype(np.float32)
        normals = item.body.table.smooth_normals(triangle, item.points(*at))
        side = item.view.side[triangle]
        facing, upward = normals @ (R.T @ self._towards) * side, normals @ -R[1] * side
        return np.maximum(facing, 0), 0.5 + 0.5 * upward

    def _flat_facing(self, world: PlacedBody) -> tuple[Floats, Floats]:
        """The same as `_facing` for each triangle (M,) of the still world, which is shaded flat."""
        normals = world.body.table.corner_normals[:, 0] * world.view.side[:, None]
        return np.maximum(normals @ self._towards, 0), 0.5 - 0.5 * normals[:, 1]

    def _texture(
        self, texture: NDArray[np.int32], tiles: Floats, right: Floats, down: Floats
    ) -> Floats:
        """Anti-aliased planes (4, N): several look-ups along a footprint's side that is long."""
        size_u, size_v = (side[texture] for side in self._atlas.size_px)
        along_u = (right[0] * size_u) ** 2 + (right[1] * size_v) ** 2
        along_v = (down[0] * size_u) ** 2 + (down[1] * size_v) ** 2
        long, short = np.maximum(along_u, along_v), np.minimum(along_u, along_v)
        stretched = long > 2.5 * np.maximum(short, 0.36)
        out = np.empty((4, len(texture)), np.float32)
        for which in (~stretched, stretched):
            where = np.flatnonzero(which)
            if not len(where):
                continue
            place = tiles[0][where], tiles[1][where]
            if which is stretched:
                horizontal = (along_u >= along_v)[where]
                along = (
                    np.where(horizontal, right[0][where], down[0][where]),
                    np.where(horizontal, right[1][where], down[1][where]),
                )
                step2 = np.maximum(short, long / _TAPS**2)[where]
                out[:, where] = self._atlas.look_up(texture[where], place, step2, along)
            else:
                out[:, where] = self._atlas.look_up(texture[where], place, long[where])
        return out

    def _sky(self, item: PlacedBody, u: Floats, v: Floats) -> Floats:
        """The sky's texture (3, N), wrapped round the horizon; without one, darkness."""
        if self._sky_index < 0:
            return np.zeros((3, len(u)), np.float32)
        d = item.rays.astype(np.float32)
        x, y, z = (d[0, i] + u * d[1, i] + v * d[2, i] for i in range(3))
        turn = np.arctan2(x, z) / np.float32(2 * np.pi)
        height = np.arctan2(-y, np.hypot(x, z)) / np.float32(np.pi / 2)
        below_zenith = np.clip(1 - height, 0.002, 0.995)
        index = np.full(len(u), self._sky_index, np.int32)
        return self._atlas.look_up(index, (turn, below_zenith), np.ones(len(u), np.float32))[:3]

    def _darken(
        self,
        samples: Samples,
        still: NDArray[np.int64],
        points: Floats,
        lights: tuple[Floats, Floats],
        T_scene_camera: Array,
        index: int,
    ) -> None:
        """Multiply the light at `points` (3, N) of `still` samples by the actors' dark patches."""
        position = np.full(len(samples.u), -1, np.int64)
        position[still] = np.arange(len(still))
        for actor, body in zip(self._world.actors, self._bodies, strict=True):
            if not actor.is_present(index):
                continue
            T = actor.Ts_scene_object[index]
            window, size = self._patch_window(actor, body, T_scene_camera, index)
            if window is None:
                continue
            where = position[samples.inside(window)]
            where = where[where >= 0]
            x, y, z = (axis[where] for axis in points)
            reach = np.float32(np.hypot(size[0], size[2]) / 2 + 0.6 + size[1])
            close = (np.abs(x - np.float32(T[0, 3])) < reach) & (y > np.float32(T[1, 3]))
            where = where[close & (np.abs(z - np.float32(T[2, 3])) < reach)]
            if len(where):
                lamp, around = patch_under(points[:, where], _upright(T), size, self._world.light)
                lights[0][where] *= lamp
                lights[1][where] *= around

    def _patch_window(
        self, actor: Actor, body: Body, T_scene_camera: Array, index: int
    ) -> tuple[tuple[slice, slice] | None, Array]:
        """Pixels that the dark patch of an actor may cover, and the size of its upright box."""
        T = actor.Ts_scene_object[index]
        corners = box_corners(body.low, body.high) @ T[:3, :3].T + T[:3, 3]
        size = np.ptp(corners, axis=0) if _tumbles(T) else body.high - body.low
        radius, bottom = np.hypot(size[0], size[2]) / 2 + 0.6 + 0.9 * size[1], corners[:, 1].max()
        low = np.array([T[0, 3] - radius, bottom - 0.1, T[2, 3] - radius])
        high = low + np.array([2 * radius, 0.1 + self._world.light.patch_drop_m, 2 * radius])
        ground = box_corners(low, high)
        window = box_window(self._world.camera, ground, T_scene_camera, np.eye(4), _PATCH_REACH_M)
        return window, size


def _tumbles(T: Array) -> bool:
    return abs(float(T[1, 1])) < 0.999


def _upright(T: Array) -> Array:
    """`T` for a patch: as it is where it stands upright, without rotation where it tumbles."""
    return make_T(np.eye(3), T[:3, 3]) if _tumbles(T) else T
