"""Pictures of a world with exact depth and labels, by Open3D ray casting and numpy shading.

Owns the camera's side of a simulated world. Rays go through pixel centres; where geometry changes
and the colour with it, four more rays smooth the edge (of the picture only, never of the depth).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.simulated.atlas import Atlas
from pipelines.datasets.simulated.meshes import Mesh
from pipelines.datasets.simulated.raytables import Floats, TriangleTable, ViewTable
from pipelines.datasets.simulated.shadows import ShadowMap, patch_under
from pipelines.datasets.simulated.world import Actor, World
from pipelines.geometry import invert_T, make_T
from pipelines.types import Array, Image

_TAPS = 4  # look-ups along the long side of a pixel's footprint
_EDGE_CONTRAST = 20  # grey levels between neighbours of different geometry that earn more rays
_HAZE = np.float32((204, 214, 222))
_SUB_PIXELS = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))


@dataclass(frozen=True, slots=True)
class View:
    """One rendered moment. image: (H, W, 3) RGB. depth_m: (H, W) NaN in the sky. labels: (H, W)."""

    image: Image
    depth_m: NDArray[np.float32]
    labels: NDArray[np.int32]


@dataclass(slots=True)
class _Samples:
    """Rays of one pass. u, v: (S,) pixels. slots: (H, W) index of the first sample of a pixel or
    -1; copy k of a pixel lies `k * per_copy` further on. The rest is what was hit: t, owner (0 the
    still world, then 1 + index of the actor), triangle."""

    u: Floats
    v: Floats
    slots: NDArray[np.int32]
    copies: int
    t: Floats
    owner: NDArray[np.int32]
    triangle: NDArray[np.int32]

    def in_window(self, window: tuple[slice, slice]) -> NDArray[np.int64]:
        chosen = self.slots[window].ravel()
        chosen = chosen[chosen >= 0].astype(np.int64)
        per_copy = len(self.u) // self.copies
        return (chosen + per_copy * np.arange(self.copies)[:, None]).ravel()


@dataclass(frozen=True, slots=True)
class _Body:
    """A mesh ready for rays: Open3D's scene, the shading table, and the corners of its box."""

    scene: Any
    table: TriangleTable
    low: Array
    high: Array


@dataclass(slots=True)
class _Placed:
    """A body in front of one camera, whose rays are written in the body's frame.

    owner: see `_Samples`. facing, up: (M,) light on the triangles of a body that is shaded flat.
    """

    body: _Body
    owner: int
    origin: Array
    rays: Array
    R_scene_body: Array
    window: tuple[slice, slice]
    _view: ViewTable | None = None

    @property
    def view(self) -> ViewTable:
        if self._view is None:  # most bodies in the window turn out hidden
            self._view = ViewTable.of(self.body.table, self.origin, self.rays)
        return self._view


class Renderer:
    """Renders frames of one world; building it draws the textures and the shadow map."""

    def __init__(self, world: World, seed: int = 0) -> None:
        self.world = world
        meshes = [world.static, *(a.mesh for a in world.actors)]
        names = sorted({str(n) for m in meshes for n in np.unique(m.texture)})
        if world.sky:
            names.append(world.sky)
        # One generator per texture, so that a texture looks the same in every scene.
        self._names = names
        self._atlas = Atlas(
            [world.textures[n](np.random.default_rng([seed, *n.encode()])) for n in names]
        )
        self._shadow = ShadowMap(world.static, world.light)
        self._static = self._body(world.static, {})
        shared: dict[int, Any] = {}
        self._actors = [self._body(a.mesh, shared) for a in world.actors]
        towards = np.asarray(world.light.towards)
        self._towards = (towards / np.linalg.norm(towards)).astype(np.float32)

    def _body(self, mesh: Mesh, shared: dict[int, Any]) -> _Body:
        import open3d as o3d

        scene = shared.get(id(mesh.vertices))  # repainted copies share their shape
        if scene is None:
            scene = o3d.t.geometry.RaycastingScene()
            scene.add_triangles(
                o3d.core.Tensor(mesh.vertices.astype(np.float32)),
                o3d.core.Tensor(mesh.triangles.astype(np.uint32)),
            )
            shared[id(mesh.vertices)] = scene
        table = TriangleTable.of(mesh, self._names, self._atlas.tile_m)
        return _Body(scene, table, *mesh.bounds())

    def render(self, index: int, right: bool = False) -> View:
        """Frame `index` from the left camera, or from the right one of the stereo pair."""
        T_scene_camera = self.world.Ts_scene_camera[index]
        if right:
            T_scene_camera = T_scene_camera @ make_T(
                np.eye(3), np.array([self.world.camera.baseline_m, 0, 0])
            )
        return self.render_from(T_scene_camera, index)

    def render_from(self, T_scene_camera: Array, index: int) -> View:
        """The world as it is at frame `index`, from any camera pose (4, 4) in the scene."""
        camera = self.world.camera
        H, W = camera.height, camera.width
        placed = self._in_front(T_scene_camera, index)
        v, u = (a.ravel().astype(np.float32) for a in np.mgrid[:H, :W])
        slots = np.arange(H * W, dtype=np.int32).reshape(H, W)
        samples = self._cast(u, v, slots, 1, placed)
        colour = self._shade(samples, placed, index)
        image = np.clip(colour + 0.5, 0, 255).astype(np.uint8).reshape(H, W, 3)
        image = self._smooth_edges(image, samples, placed, index)
        ids = np.array([0, *(a.object_id for a in self.world.actors)], np.int32)
        depth = samples.t.reshape(H, W)
        depth[~np.isfinite(depth)] = np.nan
        return View(image, depth, ids[samples.owner].reshape(H, W))

    def _in_front(self, T_scene_camera: Array, index: int) -> list[_Placed]:
        """The still world and all actors whose box may show in the picture."""
        H, W = self.world.camera.height, self.world.camera.width
        whole = (slice(0, H), slice(0, W))
        placed = [self._place(self._static, 0, T_scene_camera, np.eye(4), whole)]
        for i, (actor, body) in enumerate(zip(self.world.actors, self._actors, strict=True)):
            T = actor.Ts_scene_object[index]
            window = self._window(_box_corners(body.low, body.high), T_scene_camera, T)
            if window is not None:
                placed.append(self._place(body, i + 1, T_scene_camera, T, window))
        return placed

    def _place(
        self, body: _Body, owner: int, T_scene_camera: Array, T: Array, window: Any
    ) -> _Placed:
        camera = self.world.camera
        T_body_camera = invert_T(T) @ T_scene_camera
        K_inverse = np.linalg.inv(camera.K)
        # Rows d0, du, dv: the ray of pixel (u, v) is d0 + u du + v dv, of unit depth.
        rays = (T_body_camera[:3, :3] @ K_inverse)[:, [2, 0, 1]].T
        return _Placed(body, owner, T_body_camera[:3, 3], rays, T[:3, :3], window)

    def _window(
        self, corners: Array, T_scene_camera: Array, T: Array
    ) -> tuple[slice, slice] | None:
        """Pixels (rows, columns) that a box may cover, or None where it is out of sight."""
        camera = self.world.camera
        T_camera_body = invert_T(T_scene_camera) @ T
        p = corners @ T_camera_body[:3, :3].T + T_camera_body[:3, 3]
        if p[:, 2].min() > self.world.reach_m:
            return None
        p = _in_front_of(p, 0.05)
        if not len(p):
            return None
        u = camera.fx * p[:, 0] / p[:, 2] + camera.cx
        v = camera.fy * p[:, 1] / p[:, 2] + camera.cy
        left, top = max(int(u.min()) - 1, 0), max(int(v.min()) - 1, 0)
        right, bottom = min(int(u.max()) + 3, camera.width), min(int(v.max()) + 3, camera.height)
        if left >= right or top >= bottom:
            return None
        return slice(top, bottom), slice(left, right)

    def _cast(
        self, u: Floats, v: Floats, slots: NDArray[np.int32], copies: int, placed: list[_Placed]
    ) -> _Samples:
        t, triangle = _cast_body(placed[0], u, v)
        samples = _Samples(u, v, slots, copies, t, np.zeros(len(u), np.int32), triangle)
        for item in placed[1:]:
            where = samples.in_window(item.window)
            if not len(where):
                continue
            t, triangle = _cast_body(item, u[where], v[where])
            closer = t < samples.t[where]
            hit = where[closer]
            samples.t[hit], samples.triangle[hit] = t[closer], triangle[closer]
            samples.owner[hit] = item.owner
        return samples

    def _smooth_edges(
        self, image: Image, samples: _Samples, placed: list[_Placed], index: int
    ) -> Image:
        H, W = image.shape[:2]
        part = samples.triangle.reshape(H, W) + samples.owner.reshape(H, W) * 1_000_003
        edge = np.zeros((H, W), bool)
        for a, b in (((slice(None), slice(1, None)), (slice(None), slice(None, -1))),
                     ((slice(1, None),), (slice(None, -1),))):  # fmt: skip
            step = cv2.absdiff(image[a], image[b])
            contrast = np.maximum(np.maximum(step[..., 0], step[..., 1]), step[..., 2])
            other = (part[a] != part[b]) & (contrast > _EDGE_CONTRAST)
            edge[a] |= other
            edge[b] |= other
        rows, columns = np.nonzero(edge)
        n = len(rows)
        self.n_edges = n
        if not n:
            return image
        slots = np.full((H, W), -1, np.int32)
        slots[rows, columns] = np.arange(n)
        u = np.concatenate([columns + du for du, _ in _SUB_PIXELS]).astype(np.float32)
        v = np.concatenate([rows + dv for _, dv in _SUB_PIXELS]).astype(np.float32)
        finer = self._cast(u, v, slots, len(_SUB_PIXELS), placed)
        colour = self._shade(finer, placed, index).reshape(len(_SUB_PIXELS), n, 3).mean(0)
        image[rows, columns] = np.clip(colour + 0.5, 0, 255).astype(np.uint8)
        return image

    def _shade(self, samples: _Samples, placed: list[_Placed], index: int) -> Floats:
        """Colours (S, 3) 0-255 of samples."""
        colour = np.empty((len(samples.u), 3), np.float32)
        hit = samples.triangle >= 0
        still = np.flatnonzero((samples.owner == 0) & hit)
        item = placed[0]
        points = _along(item, samples.u[still], samples.v[still], samples.t[still])
        lamp = self._shadow.lit(points)
        around = np.ones_like(lamp)
        self._darken_under_actors(samples, still, points, (lamp, around), placed, index)
        colour[still] = self._lit_colour(item, samples, still, lamp, around)
        for item in placed[1:]:
            window = samples.in_window(item.window)
            mine = window[samples.owner[window] == item.owner]
            if len(mine):
                at = _along(placed[0], samples.u[mine], samples.v[mine], samples.t[mine])
                shade = self._shadow.lit(at)
                full = np.ones(len(mine), np.float32)
                colour[mine] = self._lit_colour(item, samples, mine, shade, full)
        if not hit.all():
            colour[~hit] = self._sky(placed[0], samples.u[~hit], samples.v[~hit])
        return colour

    def _darken_under_actors(
        self,
        samples: _Samples,
        still: NDArray[np.int64],
        points: Floats,
        lights: tuple[Floats, Floats],
        placed: list[_Placed],
        index: int,
    ) -> None:
        """Multiply the light at `points` of `still` samples by the actors' shadow patches."""
        T_scene_camera = self.world.Ts_scene_camera[index]
        position = np.full(len(samples.u), -1, np.int64)
        position[still] = np.arange(len(still))
        for actor, body in zip(self.world.actors, self._actors, strict=True):
            window, size = self._patch_window(actor, body, T_scene_camera, index)
            if window is None:
                continue
            where = position[samples.in_window(window)]
            where = where[where >= 0]
            if len(where):
                T = actor.Ts_scene_object[index]
                x, y, z = (axis[where] for axis in points)
                reach = np.float32(np.hypot(size[0], size[2]) / 2 + 0.6 + size[1])
                close = (np.abs(x - np.float32(T[0, 3])) < reach) & (y > T[1, 3])
                close &= np.abs(z - np.float32(T[2, 3])) < reach
                where = where[close]
                if not len(where):
                    continue
                lamp, around = patch_under(points[:, where], _upright(T), size, self.world.light)
                lights[0][where] *= lamp
                lights[1][where] *= around

    def _patch_window(
        self, actor: Actor, body: _Body, T_scene_camera: Array, index: int
    ) -> tuple[tuple[slice, slice] | None, Array]:
        T = actor.Ts_scene_object[index]
        low, high = body.low, body.high
        corners = _box_corners(low, high) @ T[:3, :3].T + T[:3, 3]
        size = high - low
        if abs(T[1, 1]) < 0.999:  # tumbling: the box around the turned thing
            size = np.ptp(corners, axis=0)
        reach = 0.6 + 0.9 * size[1]
        centre_xz, bottom = T[[0, 2], 3], corners[:, 1].max()
        radius = np.hypot(size[0], size[2]) / 2 + reach
        drop = self.world.light.patch_drop_m
        low_corner = np.array([centre_xz[0] - radius, bottom - 0.1, centre_xz[1] - radius])
        high_corner = np.array([centre_xz[0] + radius, bottom + drop, centre_xz[1] + radius])
        ground = _box_corners(low_corner, high_corner)
        z = (ground - T_scene_camera[:3, 3]) @ T_scene_camera[:3, 2]
        if z.min() > 60.0:  # too far to see
            return None, size
        return self._window(ground, T_scene_camera, np.eye(4)), size

    def _lit_colour(
        self,
        item: _Placed,
        samples: _Samples,
        where: NDArray[np.int64],
        lamp: Floats,
        around: Floats,
    ) -> Floats:
        """Texture times light (N, 3) for samples `where` on one body."""
        triangle, t = samples.triangle[where], samples.t[where]
        u, v = samples.u[where], samples.v[where]
        tiles, right, down = item.view.texture_at(triangle, t, u, v)
        table = item.body.table
        rgba = self._texture(table.texture[triangle], tiles, right, down)
        tinted = rgba[:, 3:] * np.float32(1 / 255)
        colour = rgba[:, :3] * (1 - tinted * (1 - table.tint[triangle]))
        facing, up = self._facing(item, triangle, (u, v, t))
        facing, up = facing * lamp, up * around
        light = self.world.light
        for channel in range(3):
            shine = facing * np.float32(light.lamp[channel]) + up * np.float32(light.above[channel])
            shine += (around - up) * np.float32(light.below[channel])
            colour[:, channel] *= shine
        if light.haze_m is not None:
            clear = np.exp(t * np.float32(-1 / light.haze_m))[:, None]
            colour -= _HAZE
            colour *= clear
            colour += _HAZE
        return colour

    def _facing(
        self, item: _Placed, triangle: NDArray[np.int32], at: tuple[Floats, Floats, Floats]
    ) -> tuple[Floats, Floats]:
        """Cosine towards the lamp (N,), and 0 to 1 (N,) from downward to upward, of surfaces."""
        table, R = item.body.table, item.R_scene_body.astype(np.float32)
        towards, up = R.T @ self._towards, -R[1]
        if item.owner == 0:  # the still world is shaded flat: one value a triangle
            normals = table.corner_normals[:, 0] * item.view.side[:, None]
            facing, upward = (normals @ towards)[triangle], (normals @ up)[triangle]
        else:
            normals = table.smooth_normals(triangle, _along(item, *at))
            side = item.view.side[triangle]
            facing, upward = (normals @ towards) * side, (normals @ up) * side
        return np.maximum(facing, 0), 0.5 + 0.5 * upward

    def _texture(
        self, texture: NDArray[np.int32], tiles: Floats, right: Floats, down: Floats
    ) -> Floats:
        """Anti-aliased look-up (N, 4): several along the footprint's long side where it is long."""
        size = self._atlas.size_px[texture].T
        along_u = np.hypot(right[0] * size[0], right[1] * size[1])
        along_v = np.hypot(down[0] * size[0], down[1] * size[1])
        long, short = np.maximum(along_u, along_v), np.minimum(along_u, along_v)
        step = np.maximum(short, long / _TAPS)
        stretched = long > 1.6 * np.maximum(short, 0.6)
        out = np.empty((len(texture), 4), np.float32)
        one = np.flatnonzero(~stretched)
        if len(one):
            out[one] = self._atlas.look_up(texture[one], *tiles[:, one], long[one])
        many = np.flatnonzero(stretched)
        if len(many):
            axis = np.where(along_u[many] >= along_v[many], right[:, many], down[:, many])
            total = np.zeros((len(many), 4), np.uint16)
            for k in range(_TAPS):
                shift = np.float32((k + 0.5) / _TAPS - 0.5)
                place = tiles[:, many] + shift * axis
                total += self._atlas.look_up(texture[many], place[0], place[1], step[many])
            out[many] = total * np.float32(1 / _TAPS)
        return out

    def _sky(self, item: _Placed, u: Floats, v: Floats) -> Floats:
        """The sky's texture, wrapped around the horizon; no sky is a dark room beyond."""
        if not self.world.sky:
            return np.zeros((len(u), 3), np.float32)
        d = item.rays.astype(np.float32)
        ray = d[0] + u[:, None] * d[1] + v[:, None] * d[2]
        turn = np.arctan2(ray[:, 0], ray[:, 2]) / np.float32(2 * np.pi)
        height = np.arctan2(-ray[:, 1], np.hypot(ray[:, 0], ray[:, 2])) / np.float32(np.pi / 2)
        down = np.clip(1 - height, 0.002, 0.995)
        index = np.full(len(u), self._names.index(self.world.sky), np.int32)
        return self._atlas.look_up(index, turn, down, np.ones(len(u), np.float32))[:, :3].astype(
            np.float32
        )


def _cast_body(item: _Placed, u: Floats, v: Floats) -> tuple[Floats, NDArray[np.int32]]:
    import open3d as o3d

    d = item.rays.astype(np.float32)
    rays = np.empty((len(u), 6), np.float32)
    rays[:, :3] = item.origin
    for axis in range(3):
        rays[:, 3 + axis] = d[0, axis] + u * d[1, axis] + v * d[2, axis]
    found = item.body.scene.cast_rays(o3d.core.Tensor(rays))
    # A miss is an infinite distance, and triangle -1 (Open3D's invalid id, the largest uint32).
    return found["t_hit"].numpy(), found["primitive_ids"].numpy().view(np.int32)


def _along(item: _Placed, u: Floats, v: Floats, t: Floats) -> Floats:
    """Points (3, N) in the frame of `item`, at `t` along the rays of pixels."""
    d = item.rays.astype(np.float32)
    points = np.empty((3, len(t)), np.float32)
    for axis in range(3):
        ray = d[0, axis] + u * d[1, axis] + v * d[2, axis]
        points[axis] = np.float32(item.origin[axis]) + t * ray
    return points


def _in_front_of(corners: Array, near_m: float) -> Array:
    """Corners of a box (8, 3) cut off at z = `near_m`: those in front and where edges cross."""
    z = corners[:, 2]
    front = z >= near_m
    if front.all():
        return corners
    a, b = np.array([(i, i ^ bit) for i in range(8) for bit in (1, 2, 4) if i < i ^ bit]).T
    crossing = front[a] != front[b]
    a, b = a[crossing], b[crossing]
    share = ((near_m - z[a]) / (z[b] - z[a]))[:, None]
    return np.concatenate([corners[front], corners[a] + share * (corners[b] - corners[a])])


def _box_corners(low: Array, high: Array) -> Array:
    return np.where((np.arange(8)[:, None] >> np.arange(3)) & 1, high, low)


def _upright(T: Array) -> Array:
    """`T` for the shadow patch: kept where it stands upright, without rotation where it tumbles."""
    if abs(T[1, 1]) > 0.999:
        return T
    return make_T(np.eye(3), T[:3, 3])
