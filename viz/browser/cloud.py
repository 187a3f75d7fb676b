"""The static map as meshcat is told of it: one message with its points, and facts about it.

Owns how large clouds are thinned. The page draws the points with a material of its own.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.types import Array

PATH = ("dyob", "map")  # in meshcat's scene tree
MAX_POINTS = 150_000  # what a browser draws smoothly without a graphics card, and 3 MB of page
GROUND_QUANTILE = 0.04  # of the heights of points near the path
NEAR_QUANTILE = 0.25  # of the distances of points to the path
SCALES_M = (0.3, 12.0)  # a car is seen well from the last, however far the houses are
EXTENT_QUANTILES = (0.03, 0.97)
_SEED = 0


@dataclass(frozen=True, slots=True)
class Cloud:
    """A map for the page. message: as meshcat's viewer takes it, packed.

    n_points: in it; n_all: in the map. scale_m: how far from the path near things are, by which
    the view is sized. up, forward: the scene's axes. ground_m: height of the ground along up.
    extent_m: the lowest and the highest of most points, each to the right, forward and up; empty
    where there are none.
    """

    message: bytes
    n_points: int
    n_all: int
    up: list[float]
    forward: list[float]
    scale_m: float
    ground_m: float
    extent_m: list[list[float]]

    @property
    def facts(self) -> dict[str, Any]:
        """All but the message, for JSON."""
        return {name: value for name, value in asdict(self).items() if name != "message"}


def build_cloud(
    points_m: Array,
    colors: NDArray[np.uint8],
    path_m: Array,
    axes: tuple[Array, Array],
    max_points: int = MAX_POINTS,
) -> Cloud:
    """Points (N, 3) in m with colours (N, 3), at most `max_points` of them, chosen at random.

    path_m: (F, 3) camera centres. axes: the scene's up and forward, (3,) unit vectors.
    """
    n_all = len(points_m)
    sizes = _sizes(points_m, path_m, axes)
    if n_all > max_points:
        chosen = np.sort(np.random.default_rng(_SEED).choice(n_all, max_points, replace=False))
        points_m, colors = points_m[chosen], colors[chosen]
    message = _message(points_m.astype(np.float32), colors)
    up, forward = (axis.round(6).tolist() for axis in axes)
    return Cloud(message, len(points_m), n_all, up, forward, *sizes)


def _sizes(
    points_m: Array, path_m: Array, axes: tuple[Array, Array]
) -> tuple[float, float, list[list[float]]]:
    if len(points_m) == 0 or len(path_m) == 0:
        return 10.0, -1.5, []
    distance = cKDTree(path_m).query(points_m)[0]
    scale_m = float(np.clip(np.quantile(distance, NEAR_QUANTILE), *SCALES_M))
    near = points_m[distance <= max(3 * scale_m, float(np.median(distance)))]
    up, forward = axes
    placed = near @ np.array([np.cross(forward, up), forward, up]).T
    ground_m = float(np.quantile(placed[:, 2], GROUND_QUANTILE))
    extent_m = np.quantile(placed, EXTENT_QUANTILES, axis=0).round(2).tolist()
    return round(scale_m, 3), round(ground_m, 3), extent_m


def _message(points_m: NDArray[np.float32], colors: NDArray[np.uint8]) -> bytes:
    import umsgpack
    from meshcat.commands import SetObject
    from meshcat.geometry import Points, PointsGeometry, PointsMaterial
    from meshcat.path import Path

    cloud = Points(PointsGeometry(points_m.T, np.ascontiguousarray(colors).T), PointsMaterial(1.0))
    # meshcat's own names hold the machine's network address; these are the same in every page.
    parts = (cloud.geometry, cloud.material, cloud)
    for part, name in zip(parts, ("geometry", "material", "points"), strict=True):
        part.uuid = f"dyob-map-{name}"
    lowered = SetObject(cloud, path=Path(PATH)).lower()
    (geometry,) = lowered["object"]["geometries"]
    geometry["data"]["attributes"]["color"]["normalized"] = True
    return bytes(umsgpack.packb(lowered))
