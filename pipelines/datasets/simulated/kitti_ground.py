"""The ground of a replayed KITTI sequence: asphalt wherever anything drives, pavement, grass.

Owns one level field over the plane, metres outside the asphalt (negative on it), and the mesh of
its bands. Kerbs are flush, so that whatever crosses them neither sinks nor floats.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import cKDTree

from pipelines.datasets.simulated.meshes import Mesh, merge, quads
from pipelines.types import Array

CELL_M = 0.5
_BANDS = (  # from, to in metres outside the asphalt; texture
    (-np.inf, 0.0, "asphalt"),
    (0.0, 0.3, "concrete"),
    (0.3, 3.4, "paving"),
    (3.4, np.inf, "grass"),
)
_FAR_M = 30.0  # the field is not followed farther


@dataclass(frozen=True, slots=True)
class Ground:
    """The field on a grid. x_m: (X,), z_m: (Z,) its lines. outside_m: (X, Z)."""

    x_m: Array
    z_m: Array
    outside_m: Array

    @classmethod
    def around(cls, driven: list[tuple[Array, float]], low: Array, high: Array) -> Ground:
        """Asphalt within each radius of its points (N, 2), on a grid from `low` to `high` (2,)."""
        x, z = (np.arange(a, b + CELL_M, CELL_M) for a, b in zip(low, high, strict=True))
        nodes = np.stack(np.meshgrid(x, z, indexing="ij"), -1).reshape(-1, 2)
        outside = np.full(len(nodes), _FAR_M)
        for points, radius_m in driven:
            if len(points):
                reach = _FAR_M + radius_m
                away, _ = cKDTree(points).query(nodes, distance_upper_bound=reach)
                outside = np.minimum(outside, np.minimum(away, reach) - radius_m)
        return cls(x, z, outside.reshape(len(x), len(z)))

    def at(self, points: Array) -> Array:
        """Metres outside the asphalt (N,) at points (N, 2); far away beyond the grid."""
        field = RegularGridInterpolator(
            (self.x_m, self.z_m), self.outside_m, bounds_error=False, fill_value=_FAR_M
        )
        return np.asarray(field(points))

    def mesh(self) -> Mesh:
        """The plane y = 0 in bands. Cells of one band are joined in rows, others are cut."""
        limits = np.array([band[0] for band in _BANDS[1:]])
        f = self.outside_m
        corners = np.stack([f[:-1, :-1], f[1:, :-1], f[1:, 1:], f[:-1, 1:]], -1)
        bands = np.searchsorted(limits, corners, side="right")
        whole = (bands == bands[..., :1]).all(-1)
        band = np.where(whole, bands[..., 0], -1)
        parts = [m for k in range(len(_BANDS)) if len(m := self._joined(band, k))]
        pieces: list[list[Array]] = [[] for _ in _BANDS]
        for i, j in zip(*np.nonzero(~whole), strict=True):
            self._cut(int(i), int(j), corners[i, j], pieces)
        for k, found in enumerate(pieces):
            if found:
                parts.append(_flat(np.array(found), _BANDS[k][2]))
        return merge(parts)

    def _joined(self, band: Array, k: int) -> Mesh:
        """Cells of band `k` as one strip per run along z."""
        mine = np.pad(band == k, ((0, 0), (1, 1))).astype(int)
        edge = np.diff(mine, axis=1)
        i, start = np.nonzero(edge == 1)
        _, stop = np.nonzero(edge == -1)
        x0, x1 = self.x_m[i], self.x_m[i + 1]
        z0, z1 = self.z_m[start], self.z_m[stop]
        around = np.stack([x0, z0, x1, z0, x1, z1, x0, z1], 1).reshape(-1, 4, 2)
        return _flat(around, _BANDS[k][2])

    def _cut(self, i: int, j: int, f: Array, pieces: list[list[Array]]) -> None:
        """Share the two triangles of one cell out to the bands that they lie in."""
        x, z = self.x_m, self.z_m
        p = np.array([(x[i], z[j]), (x[i + 1], z[j]), (x[i + 1], z[j + 1]), (x[i], z[j + 1])])
        for which in ([0, 1, 2], [0, 2, 3]):
            for k, (low, high, _) in enumerate(_BANDS):
                shape = _clipped(p[which], f[which], low, 1.0)
                if len(shape[0]):
                    shape = _clipped(*shape, high, -1.0)
                for a in range(1, len(shape[0]) - 1):
                    c = shape[0]
                    pieces[k].append(np.array([c[0], c[a], c[a + 1], c[a + 1]]))


def _clipped(p: Array, f: Array, limit: float, sign: float) -> tuple[Array, Array]:
    """The part of a polygon (N, 2), with field values (N,), where sign * (f - limit) >= 0."""
    if not np.isfinite(limit):
        return p, f
    points, values = [], []
    g = sign * (f - limit)
    for a in range(len(p)):
        b = (a + 1) % len(p)
        if g[a] >= 0:
            points.append(p[a])
            values.append(f[a])
        if (g[a] >= 0) != (g[b] >= 0):
            share = g[a] / (g[a] - g[b])
            points.append(p[a] + share * (p[b] - p[a]))
            values.append(limit)
    return np.array(points).reshape(-1, 2), np.array(values)


def _flat(around: Array, texture: str) -> Mesh:
    """Level pieces (N, 4, 2) at y = 0, textured by their place so that seams do not show."""
    corners = np.stack([around[..., 0], np.zeros(around.shape[:2]), around[..., 1]], -1)
    up = np.tile((0.0, -1.0, 0.0), (len(around), 1))
    return quads(corners, texture, uv=around, normals=up)
