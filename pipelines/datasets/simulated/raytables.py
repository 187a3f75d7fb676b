"""Per-triangle numbers that turn a ray's hit into texture coordinates and light, without corners.

Owns the precomputed side of shading. For a plane, everything a pixel needs is linear in the pixel:
with the ray p = o + t d, d = d0 + u du + v dv, a triangle's texture coordinates are c + t (G d).
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.simulated.meshes import Mesh
from pipelines.types import Array

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class TriangleTable:
    """A mesh in the form that shading reads (parallel arrays).

    normal: (M, 3) of the plane. corner: (M, 3) one corner. corner_tiles: (M, 2) its texture
    coordinates in tiles. gradient_tiles: (M, 2, 3) change of them per metre. texture: (M,) index.
    tint: (3, M) 0-1. corner_normals: (M, 3, 3) smooth normals. dual: (M, 2, 3) turns an offset
    from the corner into weights of the other two corners.
    """

    normal: Array
    corner: Array
    corner_tiles: Array
    gradient_tiles: Array
    texture: NDArray[np.int32]
    tint: Floats
    corner_normals: Floats
    dual: Floats

    @classmethod
    def of(cls, mesh: Mesh, names: list[str], tile_m: Array) -> TriangleTable:
        """Table of `mesh`, whose texture names are looked up in `names` (sizes `tile_m`)."""
        p = mesh.vertices[mesh.triangles]
        e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
        normal = np.cross(e1, e2)
        area2 = (normal**2).sum(1, keepdims=True)
        # Dual basis of the edges: b1 . e1 = 1, b1 . e2 = 0, and the other way round.
        b1, b2 = np.cross(e2, normal) / area2, np.cross(normal, e1) / area2
        present, index = np.unique(mesh.texture, return_inverse=True)
        texture = np.array([names.index(name) for name in present], np.int32)[index.reshape(-1)]
        tiles = mesh.uv_m / tile_m[texture][:, None]
        d1, d2 = tiles[:, 1] - tiles[:, 0], tiles[:, 2] - tiles[:, 0]
        gradient = d1[:, :, None] * b1[:, None] + d2[:, :, None] * b2[:, None]
        return cls(
            normal / np.sqrt(area2),
            p[:, 0],
            tiles[:, 0],
            gradient,
            texture,
            _contiguous(mesh.tint.T / 255),
            mesh.normals.astype(np.float32),
            np.stack([b1, b2], 1).astype(np.float32),
        )

    def __len__(self) -> int:
        return len(self.normal)

    def rows(self, which: NDArray[np.int64]) -> TriangleTable:
        """The table of some triangles only, in that order."""
        own = {f.name: getattr(self, f.name)[which] for f in fields(self) if f.name != "tint"}
        return TriangleTable(**own, tint=self.tint[:, which])

    def smooth_normals(self, triangle: NDArray[np.int32], points: Floats) -> Floats:
        """Unit normals (N, 3) between the corner normals, at points (3, N) on triangles (N,)."""
        offset = points.T - self.corner.astype(np.float32)[triangle]
        weights = np.einsum("nki,ni->nk", self.dual[triangle], offset)
        corners = self.corner_normals[triangle]
        normal = corners[:, 0] * (1 - weights.sum(1, keepdims=True))
        normal += corners[:, 1] * weights[:, :1] + corners[:, 2] * weights[:, 1:]
        return normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-6)


@dataclass(frozen=True, slots=True)
class ViewTable:
    """What a camera sees of a `TriangleTable`: linear functions of the pixel, for each triangle.

    tiles0: (2, M) texture coordinates at the camera's centre. G: (3, 2, M) their change along the
    ray for [d0, du, dv]. nd: (3, M) the plane's normal times [d0, du, dv]. side: (M,) +1 where
    the camera is on the side that `corner_normals` point to, else -1.
    """

    tiles0: Floats
    G: Floats
    nd: Floats
    side: Floats

    @classmethod
    def of(cls, table: TriangleTable, origin: Array, rays: Array) -> ViewTable:
        """View from `origin` (3,) with ray directions d0 + u du + v dv, `rays` (3, 3) as rows."""
        from_corner = origin - table.corner
        offset = np.einsum("mij,mj->mi", table.gradient_tiles, from_corner)
        tiles0 = table.corner_tiles + offset
        # The whole part changes nothing in a tiled texture, and costs float32 its precision.
        tiles0 -= np.floor(tiles0)
        M = len(table.normal)
        G = (rays @ table.gradient_tiles.reshape(-1, 3).T).reshape(3, M, 2).swapaxes(1, 2)
        nd = rays @ table.normal.T
        shading = table.corner_normals.sum(1)
        side = np.sign((from_corner * table.normal).sum(1)) * np.sign(
            (shading * table.normal).sum(1)
        )
        return cls(_contiguous(tiles0.T), _contiguous(G), _contiguous(nd), _contiguous(side))

    def texture_at(
        self, triangle: NDArray[np.int32], t: Floats, u: Floats, v: Floats
    ) -> tuple[Floats, Floats, Floats]:
        """Texture coordinates (2, N) in tiles and their change per pixel (2, N) right and down.

        triangle, t, u, v: (N,) hits: triangle, distance along the ray, and pixel.
        """
        nd_u, nd_v = self.nd[1][triangle], self.nd[2][triangle]
        nd = self.nd[0][triangle] + u * nd_u + v * nd_v
        nd[np.abs(nd) < 1e-9] = 1e-9
        shrink_u, shrink_v = t * nd_u / nd, t * nd_v / nd
        tiles = np.empty((2, len(t)), np.float32)
        right, down = np.empty_like(tiles), np.empty_like(tiles)
        for axis in range(2):
            Gu, Gv = self.G[1, axis][triangle], self.G[2, axis][triangle]
            Gd = self.G[0, axis][triangle] + u * Gu + v * Gv
            tiles[axis] = self.tiles0[axis][triangle] + t * Gd
            right[axis] = t * Gu - Gd * shrink_u
            down[axis] = t * Gv - Gd * shrink_v
        return tiles, right, down


def _contiguous(array: Array) -> Floats:
    return np.ascontiguousarray(array, np.float32)
