"""Shadows: a variance shadow map of what stands still, and soft dark patches under what moves.

Owns how much of the lamp reaches a point. The map is cast once per world.
"""

from __future__ import annotations

import cv2
import numpy as np

from pipelines.datasets.simulated.meshes import Mesh
from pipelines.datasets.simulated.raytables import Floats
from pipelines.datasets.simulated.world import Light
from pipelines.geometry import invert_T
from pipelines.types import Array

_MAX_TEXELS = 4_000_000
_ROW = 2048


class ShadowMap:
    """Depth of the still world as seen from the lamp, blurred, with its second moment."""

    def __init__(self, mesh: Mesh, light: Light) -> None:
        import open3d as o3d

        towards = np.asarray(light.towards, float)
        towards /= np.linalg.norm(towards)
        side = np.cross(towards, (0.0, 0.0, 1.0))
        side /= np.linalg.norm(side)
        self._axes = np.stack([side, np.cross(side, towards), -towards])  # right, down, away
        casts = mesh.vertices[mesh.triangles][..., 1].min(1) > light.ceiling_m
        local = mesh.vertices @ self._axes.T
        used = local[mesh.triangles[casts].ravel()]
        low, high = used.min(0), used.max(0)
        area = float(np.prod((high - low)[:2]))
        texel = max(light.shadow_texel_m, float(np.sqrt(area / _MAX_TEXELS)))
        w, h = (np.ceil((high - low)[:2] / texel).astype(int) + 4).tolist()
        self._start, self._texel = low[:2] - 2 * texel, texel
        self._far = float(low[2] - 1.0)
        rays = np.empty((h, w, 6), np.float32)
        corner = np.array([*self._start, self._far]) @ self._axes
        for i in range(3):
            row, column = self._axes[1, i] * texel, self._axes[0, i] * texel
            rays[..., i] = corner[i] + np.arange(h)[:, None] * row + np.arange(w) * column
            rays[..., 3 + i] = self._axes[2, i]
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            o3d.core.Tensor(mesh.vertices.astype(np.float32)),
            o3d.core.Tensor(mesh.triangles[casts].astype(np.uint32)),
        )
        depth = scene.cast_rays(o3d.core.Tensor(rays))["t_hit"].numpy()
        depth = np.minimum(depth, float(high[2] - low[2]) + 2.0)
        moments = np.stack([depth, depth**2], -1)
        self._moments = cv2.GaussianBlur(moments, (0, 0), light.shadow_blur_texels)
        self._slack = 2.0 * texel

    def lit(self, points: Floats) -> Floats:
        """Share of the lamp, 0 to 1, that reaches points (3, N) of the scene."""
        x, y, z = points
        N = len(x)
        rows = -(-N // _ROW)
        padded = np.zeros((2, rows * _ROW), np.float32)
        for axis in range(2):
            a, b, c = (self._axes[axis] / self._texel).astype(np.float32)
            start = np.float32(self._start[axis] / self._texel)
            padded[axis, :N] = a * x + b * y + c * z - start
        a, b, c = self._axes[2].astype(np.float32)
        depth = a * x + b * y + c * z - np.float32(self._far + self._slack)
        maps = padded.reshape(2, rows, _ROW)
        found = cv2.remap(
            self._moments, maps[0], maps[1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
        )
        mean, square = found.reshape(-1, 2)[:N].T
        behind = np.maximum(depth - mean, 0)
        # Chebyshev's bound on the share of the texel that lies in front of the point.
        variance = np.maximum(square - mean**2, np.float32(self._slack**2 * 0.25))
        share = variance / (variance + behind**2)
        return np.clip((share - 0.2) / 0.8, 0, 1)


def patch_under(
    points: Floats, T_scene_object: Array, size_m: Array, light: Light
) -> tuple[Floats, Floats]:
    """Darkening by an upright thing near the ground: lamp and surrounding light left (N,), (N,).

    points: (3, N) of the still world. size_m: (3,) of the thing's box, whose underside throws the
    patch. The lamp's patch is drawn away from the lamp, the other lies straight below.
    """
    T = invert_T(T_scene_object).astype(np.float32)
    x, y, z = T[:3, :3] @ points + T[:3, 3:]
    half = (np.asarray(size_m) / 2).astype(np.float32)
    towards = np.asarray(light.towards) / np.linalg.norm(light.towards)
    slope = (T[:3, :3] @ (towards / max(-towards[1], 0.2))).astype(np.float32)
    drop = np.maximum(y - half[1], 0)  # how far below the box
    fall = np.float32(0.5 * light.patch_drop_m + 0.05)
    near = np.exp(-((drop / fall) ** 2)) * (y > half[1] - 0.3)
    below = 1 - 0.72 * near * _soft_box(x, z, half, 0.45)
    reach = drop + half[1]
    grown = half + 0.35 * half[1] * np.abs(slope)
    lamp = 1 - 0.85 * near * _soft_box(x + slope[0] * reach, z + slope[2] * reach, grown, 0.3)
    return lamp, below


def _soft_box(x: Floats, z: Floats, half: Floats, soft_m: float) -> Floats:
    """1 inside the rounded rectangle of half sides `half` (x, ., z), falling to 0 outside."""
    qx, qz = np.maximum(np.abs(x) - half[0] * 0.8, 0), np.maximum(np.abs(z) - half[2] * 0.85, 0)
    return np.exp(-((qx**2 + qz**2) / np.float32(soft_m**2)))
