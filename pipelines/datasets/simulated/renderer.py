"""Pictures of a world with exact depth and labels.

Owns the passes of a frame. Rays go through pixel centres; where geometry changes and the colour
with it, four more rays smooth the edge (of the picture only, never of depth and labels).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.simulated.atlas import Atlas
from pipelines.datasets.simulated.meshes import Mesh
from pipelines.datasets.simulated.rays import Body, PlacedBody, Samples, box_corners, box_window
from pipelines.datasets.simulated.raytables import TriangleTable
from pipelines.datasets.simulated.shading import Shading
from pipelines.datasets.simulated.world import World
from pipelines.geometry import invert_T, make_T
from pipelines.types import Array, Image

_EDGE_CONTRAST = 24  # grey levels between neighbours of different geometry that earn more rays
_SUB_PIXELS = ((-0.125, -0.375), (0.375, -0.125), (0.125, 0.375), (-0.375, 0.125))


@dataclass(frozen=True, slots=True)
class View:
    """One rendered moment. image: (H, W, 3) RGB. depth_m: (H, W) NaN in the sky. labels: (H, W)."""

    image: Image
    depth_m: NDArray[np.float32]
    labels: NDArray[np.int32]


class Renderer:
    """Renders frames of one world; building it draws the textures and the shadow map."""

    def __init__(self, world: World, seed: int = 0) -> None:
        """seed: of the textures' patterns, which no part of the truth depends on."""
        self.world = world
        meshes = [world.static, *(a.mesh for a in world.actors)]
        names = sorted({str(n) for m in meshes for n in np.unique(m.texture)})
        sky_index = len(names) if world.sky else -1
        if world.sky:
            names.append(world.sky)
        # One generator per texture, so that a texture looks the same in every scene.
        atlas = Atlas(
            [world.textures[n](np.random.default_rng([seed, *n.encode()])) for n in names]
        )
        shared: dict[int, Any] = {}
        self._static = _body(world.static, names, atlas, shared)
        self._bodies = [_body(a.mesh, names, atlas, shared) for a in world.actors]
        self._ids = np.array([0, *(a.object_id for a in world.actors)], np.int32)
        self._shading = Shading(world, atlas, sky_index, self._bodies)

    def render(self, index: int, right: bool = False) -> View:
        """Frame `index` from the left camera, or from the right one of the stereo pair."""
        T_scene_camera = self.world.Ts_scene_camera[index]
        if right:
            baseline = np.array([self.world.camera.baseline_m, 0, 0])
            T_scene_camera = T_scene_camera @ make_T(np.eye(3), baseline)
        return self.render_from(T_scene_camera, index)

    def render_from(self, T_scene_camera: Array, index: int) -> View:
        """The world as it is at frame `index`, from any camera pose (4, 4) in the scene."""
        H, W = self.world.camera.height, self.world.camera.width
        placed = self._in_front(T_scene_camera, index)
        v, u = (axis.ravel().astype(np.float32) for axis in np.mgrid[:H, :W])
        slots = np.arange(H * W, dtype=np.int32).reshape(H, W)
        samples = Samples.cast(u, v, slots, 1, placed)
        planes = self._shading.colours(samples, placed, T_scene_camera, index)
        image = cv2.merge([_to_bytes(plane).reshape(H, W) for plane in planes])
        rows, columns = np.nonzero(_edges(image, samples))
        n = len(rows)
        if n:
            slots = np.full((H, W), -1, np.int32)
            slots[rows, columns] = np.arange(n)
            u = np.concatenate([columns + du for du, _ in _SUB_PIXELS]).astype(np.float32)
            v = np.concatenate([rows + dv for _, dv in _SUB_PIXELS]).astype(np.float32)
            finer = Samples.cast(u, v, slots, len(_SUB_PIXELS), placed)
            planes = self._shading.colours(finer, placed, T_scene_camera, index)
            mean = planes.reshape(3, len(_SUB_PIXELS), n).mean(1)
            image[rows, columns] = _to_bytes(mean).T
        depth = samples.t.reshape(H, W)
        depth[~np.isfinite(depth)] = np.nan
        return View(image, depth, self._ids[samples.owner].reshape(H, W))

    def _in_front(self, T_scene_camera: Array, index: int) -> list[PlacedBody]:
        """The still world and all actors whose box may show in the picture."""
        camera = self.world.camera
        whole = (slice(0, camera.height), slice(0, camera.width))
        placed = [PlacedBody.of(self._static, 0, T_scene_camera, camera.K, np.eye(3), whole)]
        actors = zip(self.world.actors, self._bodies, strict=True)
        for owner, (actor, body) in enumerate(actors, start=1):
            if not actor.is_present(index):
                continue
            T = actor.Ts_scene_object[index]
            corners = box_corners(body.low, body.high)
            window = box_window(camera, corners, T_scene_camera, T, self.world.reach_m)
            if window is not None:
                T_body_camera = invert_T(T) @ T_scene_camera
                item = PlacedBody.of(body, owner, T_body_camera, camera.K, T[:3, :3], window)
                placed.append(item)
        return placed


def _body(mesh: Mesh, names: list[str], atlas: Atlas, shared: dict[int, Any]) -> Body:
    """`mesh` ready for rays; meshes that share their vertices (repainted ones) share a scene."""
    import open3d as o3d

    scene = shared.get(id(mesh.vertices))
    if scene is None:
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            o3d.core.Tensor(mesh.vertices.astype(np.float32)),
            o3d.core.Tensor(mesh.triangles.astype(np.uint32)),
        )
        shared[id(mesh.vertices)] = scene
    return Body(scene, TriangleTable.of(mesh, names, atlas.tile_m), *mesh.bounds())


def _edges(image: Image, samples: Samples) -> NDArray[np.bool_]:
    """Pixels (H, W) next to another triangle of clearly another colour."""
    H, W = image.shape[:2]
    part = (samples.triangle + samples.owner * 1_000_003).reshape(H, W)
    edge = np.zeros((H, W), bool)
    everything = slice(None)
    for after, before in (
        ((everything, slice(1, None)), (everything, slice(None, -1))),
        ((slice(1, None), everything), (slice(None, -1), everything)),
    ):
        step = cv2.absdiff(image[after], image[before])
        contrast = np.maximum(np.maximum(step[..., 0], step[..., 1]), step[..., 2])
        differs = (part[after] != part[before]) & (contrast > _EDGE_CONTRAST)
        edge[after] |= differs
        edge[before] |= differs
    return edge


def _to_bytes(colour: NDArray[np.float32]) -> Image:
    return np.clip(colour + np.float32(0.5), 0, 255).astype(np.uint8)
