"""Textured triangle meshes and the few shapes that everything simulated is built of.

Owns vertices, texture coordinates in metres and corner normals. Knows no images and no scenes.
Axes are OpenCV's: x right, y down, z forward, so "up" is -y.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pipelines.geometry import transform_points
from pipelines.types import Array

WHITE = (255, 255, 255)


@dataclass(frozen=True, slots=True)
class Mesh:
    """Triangles with their own texture coordinates and colours (parallel arrays).

    vertices: (V, 3) float64 in metres. triangles: (M, 3) int64. uv_m: (M, 3, 2) texture coordinates
    of the corners, in metres. normals: (M, 3, 3) corner normals. texture: (M,) names of textures.
    tint: (M, 3) RGB 0-255, multiplies the texture where that says so. painted: (M,) bool, which
    triangles take the colour of an instance in `painted_as`.
    """

    vertices: Array
    triangles: NDArray[np.int64]
    uv_m: Array
    normals: Array
    texture: NDArray[np.str_]
    tint: Array
    painted: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.triangles)

    def placed(self, T: Array) -> Mesh:
        """The mesh moved by the rigid motion `T` (4, 4)."""
        return replace(
            self,
            vertices=transform_points(T, self.vertices),
            normals=self.normals @ T[:3, :3].T,
        )

    def painted_as(self, rgb: ArrayLike) -> Mesh:
        """The mesh with its painted triangles in another colour."""
        tint = np.where(self.painted[:, None], np.asarray(rgb, float), self.tint)
        return replace(self, tint=tint)

    def bounds(self) -> tuple[Array, Array]:
        """Lowest and highest corner (3,) of the axis-aligned box around all vertices."""
        return self.vertices.min(0), self.vertices.max(0)


def merge(meshes: Iterable[Mesh]) -> Mesh:
    """One mesh of many."""
    parts = list(meshes)
    starts = np.cumsum([0, *(len(m.vertices) for m in parts[:-1])])
    joined = {
        f.name: np.concatenate([getattr(m, f.name) for m in parts])
        for f in fields(Mesh)
        if f.name != "triangles"
    }
    triangles = [m.triangles + start for m, start in zip(parts, starts, strict=True)]
    return Mesh(triangles=np.concatenate(triangles), **joined)


def pose(x: float, y: float, z: float, yaw_rad: float = 0.0) -> Array:
    """Upright rigid motion (4, 4); a positive yaw turns forward (z) towards the right (x)."""
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    return np.array([[c, 0, s, x], [0, 1, 0, y], [-s, 0, c, z], [0, 0, 0, 1.0]])


def surface(
    points: ArrayLike,
    texture: str,
    tint: ArrayLike = WHITE,
    uv: ArrayLike | None = None,
    smooth: bool = False,
    painted: bool = False,
) -> Mesh:
    """Mesh of a grid of points (R, C, 3); without `uv` (R, C, 2) it is unrolled by arc length."""
    p = np.asarray(points, float)
    rows, columns = p.shape[:2]
    coordinates = _unrolled(p) if uv is None else np.asarray(uv, float)
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = i[:-1, :-1].ravel(), i[:-1, 1:].ravel(), i[1:, 1:].ravel(), i[1:, :-1].ravel()
    triangles = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    flat = p.reshape(-1, 3)
    corners = flat[triangles]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    keep = np.linalg.norm(cross, axis=1) > 1e-9  # grids close at poles with empty triangles
    triangles, cross = triangles[keep], cross[keep]
    if smooth:
        normals = _smooth_normals(flat, triangles, cross)[triangles]
    else:
        normals = np.repeat(cross[:, None], 3, 1)
    M = len(triangles)
    return Mesh(
        flat,
        triangles,
        coordinates.reshape(-1, 2)[triangles],
        normals / np.linalg.norm(normals, axis=-1, keepdims=True),
        np.full(M, texture),
        np.tile(np.asarray(tint, float), (M, 1)),
        np.full(M, painted),
    )


def _unrolled(p: Array) -> Array:
    """Texture coordinates (R, C, 2) in metres from mean arc lengths along both sides of a grid."""
    u = np.linalg.norm(np.diff(p, axis=1), axis=2).mean(0)
    v = np.linalg.norm(np.diff(p, axis=0), axis=2).mean(1)
    uu, vv = np.meshgrid(np.append(0.0, u.cumsum()), np.append(0.0, v.cumsum()))
    return np.stack([uu, vv], -1)


def _smooth_normals(vertices: Array, triangles: NDArray[np.int64], cross: Array) -> Array:
    """Area-weighted vertex normals; vertices at the same place (seams, poles) share one."""
    _, same = np.unique(np.round(vertices, 5), axis=0, return_inverse=True)
    same = same.reshape(-1)
    total = np.zeros((same.max() + 1, 3))
    for corner in range(3):
        np.add.at(total, same[triangles[:, corner]], cross)
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    return total[same]


def quads(
    corners: ArrayLike,
    texture: str,
    tint: ArrayLike = WHITE,
    uv: ArrayLike | None = None,
    normals: ArrayLike | None = None,
) -> Mesh:
    """Flat four-cornered pieces (N, 4, 3); corners go around from the top left.

    uv: (N, 4, 2) metres; unrolled by the lengths of the upper and right sides where not given.
    normals: (N, 3) to shade with in place of the pieces' own.
    """
    p = np.asarray(corners, float)
    N = len(p)
    if uv is None:
        w = np.linalg.norm(p[:, 1] - p[:, 0], axis=1)
        h = np.linalg.norm(p[:, 2] - p[:, 1], axis=1)
        o = np.zeros(N)
        uv = np.stack([o, o, w, o, w, h, o, h], 1).reshape(N, 4, 2)
    which = np.array([(0, 1, 2), (0, 2, 3)])
    triangles = (np.arange(N)[:, None, None] * 4 + which).reshape(-1, 3)
    flat = p.reshape(-1, 3)
    a, b, c = (flat[triangles[:, k]] for k in range(3))
    cross = np.cross(b - a, c - a)
    length = np.linalg.norm(cross, axis=1)
    shading = cross if normals is None else np.repeat(np.asarray(normals, float), 2, 0)
    keep = length > 1e-9
    triangles, shading = triangles[keep], shading[keep]
    shading = shading / np.linalg.norm(shading, axis=1, keepdims=True)
    M = len(triangles)
    return Mesh(
        flat,
        triangles,
        np.asarray(uv, float).reshape(-1, 2)[triangles],
        np.repeat(shading[:, None], 3, 1),
        np.full(M, texture),
        np.tile(np.asarray(tint, float), (M, 1)),
        np.zeros(M, bool),
    )


def quad(
    corners: ArrayLike, texture: str, tint: ArrayLike = WHITE, uv: ArrayLike | None = None
) -> Mesh:
    """One piece of `quads`: corners (4, 3), texture coordinates (4, 2)."""
    grid_uv = None if uv is None else np.asarray(uv, float)[None]
    return quads(np.asarray(corners, float)[None], texture, tint, grid_uv)


def box(
    size: ArrayLike, texture: str, tint: ArrayLike = WHITE, centre: ArrayLike = (0, 0, 0)
) -> Mesh:
    """Box of `size` (x, y, z) in metres around `centre`, each face textured upright."""
    x, y, z = np.asarray(size, float) / 2
    faces = np.array(
        [
            [(-x, -y, -z), (x, -y, -z), (x, y, -z), (-x, y, -z)],
            [(x, -y, z), (-x, -y, z), (-x, y, z), (x, y, z)],
            [(-x, -y, z), (-x, -y, -z), (-x, y, -z), (-x, y, z)],
            [(x, -y, -z), (x, -y, z), (x, y, z), (x, y, -z)],
            [(-x, -y, z), (x, -y, z), (x, -y, -z), (-x, -y, -z)],
            [(-x, y, -z), (x, y, -z), (x, y, z), (-x, y, z)],
        ]
    )
    return quads(faces + np.asarray(centre, float), texture, tint)


def cylinder(
    start: ArrayLike,
    end: ArrayLike,
    radii: tuple[float, float],
    texture: str,
    tint: ArrayLike = WHITE,
    sides: int = 10,
    caps: bool = True,
) -> Mesh:
    """Round bar, cone or tapered limb between two points, smoothly shaded."""
    a, b = np.asarray(start, float), np.asarray(end, float)
    across = _across(b - a, sides)
    rings = np.stack([a + radii[0] * across, b + radii[1] * across])
    parts = [surface(rings, texture, tint, smooth=True)]
    if caps:
        for centre, radius in ((a, radii[0]), (b, radii[1])):
            rim = centre + radius * across
            parts.append(
                surface(np.stack([np.broadcast_to(centre, rim.shape), rim]), texture, tint)
            )
    return merge(parts)


def _across(axis: Array, sides: int) -> Array:
    """Closed ring (sides + 1, 3) of unit vectors across `axis`."""
    along = axis / np.linalg.norm(axis)
    other = np.array([1.0, 0, 0]) if abs(along[0]) < 0.9 else np.array([0, 1.0, 0])
    e1 = np.cross(along, other)
    e1 /= np.linalg.norm(e1)
    e2 = np.cross(along, e1)
    angle = np.linspace(0, 2 * np.pi, sides + 1)
    return np.cos(angle)[:, None] * e1 + np.sin(angle)[:, None] * e2


def ellipsoid(
    radii: ArrayLike,
    texture: str,
    tint: ArrayLike = WHITE,
    centre: ArrayLike = (0, 0, 0),
    rows: int = 8,
    columns: int = 12,
) -> Mesh:
    """Smoothly shaded ellipsoid with half axes `radii` (x, y, z) in metres."""
    polar, azimuth = np.meshgrid(
        np.linspace(0, np.pi, rows + 1), np.linspace(0, 2 * np.pi, columns + 1), indexing="ij"
    )
    unit = np.stack(
        [np.sin(polar) * np.sin(azimuth), -np.cos(polar), -np.sin(polar) * np.cos(azimuth)], -1
    )
    r = np.asarray(radii, float)
    uv = np.stack([azimuth * r[[0, 2]].mean(), polar * r[1]], -1)
    return surface(unit * r + np.asarray(centre, float), texture, tint, uv, smooth=True)


def limb(
    joints: ArrayLike, radii: ArrayLike, texture: str, tint: ArrayLike = WHITE, sides: int = 8
) -> Mesh:
    """Chain of tapered bars with balls at the joints (J, 3), thick as `radii` (J,)."""
    p, r = np.asarray(joints, float), np.asarray(radii, float)
    bars = [
        cylinder(p[i], p[i + 1], (r[i], r[i + 1]), texture, tint, sides, caps=False)
        for i in range(len(p) - 1)
    ]
    balls = [ellipsoid((q,) * 3, texture, tint, c, 4, sides) for c, q in zip(p, r, strict=True)]
    return merge([*bars, *balls])
