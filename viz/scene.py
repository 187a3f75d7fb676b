"""A result as a scene of points, polylines and camera frustums, and the views to look at it from.

Pure geometry in the world of the result (first camera, metres): draws nothing and reads no file.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.geometry import transform_points
from pipelines.io.result import Result
from pipelines.types import Array
from viz import style
from viz.object_paths import (
    Polyline,
    Tag,
    object_paths,
    split_at_gaps,
    true_object_paths,
)

STRAY_QUANTILE = 0.95  # of the points' distances to the path: what lies far beyond is stray
STRAY_FACTOR = 1.6
N_FRUSTUMS = 15
FRUSTUM_SHARE = 0.013  # frustum depth as a share of the scene's extent
TURNED = 0.01  # variance of the horizontal axes from which they count more than the mean upward one
MOST_TILTED = 0.5  # cosine of the angle to the mean beyond which they are not believed


@dataclass(frozen=True, slots=True)
class Scene:
    """What there is to draw.

    points_m: (N, 3) without stray far points. colors: (N, 3) uint8. path_m: (F, 3) camera centres
    in order. up: (3,) unit vector. forward: (3,) unit, across up: where the camera looked first.
    tags: one at the end of each moving object's path. true_paths: (N, 3) each, where the camera and
    all that moves truly went, as far as that is known.
    """

    points_m: Array
    colors: NDArray[np.uint8]
    path_m: Array
    polylines: tuple[Polyline, ...]
    up: Array
    forward: Array
    tags: tuple[Tag, ...] = ()
    true_paths: tuple[Array, ...] = ()


@dataclass(frozen=True, slots=True)
class View:
    """A pinhole view of the scene: axes of the view as a camera's, size in pixels (width, height).

    px_per_m: scale of a map seen from above, or None where the scale varies with distance.
    near_m: points nearer than this are left out. haze: depths at which points begin to turn to the
    colour of the ground and at which they have done so, and how far they do (0 to 1), or None.
    """

    name: str
    size: tuple[int, int]
    K: Array
    T_view_world: Array
    px_per_m: float | None = None
    near_m: float = 1e-3
    haze: tuple[float, float, float] | None = None

    @property
    def follows(self) -> bool:
        """Whether it is another one in each frame of a run."""
        return self.name == "chase"

    def project(self, points_m: Array) -> tuple[Array, Array]:
        """Pixels (N, 2) and depths (N,) in metres of world points (N, 3)."""
        camera = transform_points(self.T_view_world, points_m)
        with np.errstate(divide="ignore", invalid="ignore"):
            homogeneous = camera @ self.K.T
            return homogeneous[:, :2] / homogeneous[:, 2:], camera[:, 2]


def build_scene(result: Result, *, keyframe_every: int | None = None) -> Scene:
    """Scene of a result: points, the estimated and the true path, moving objects, some frustums.

    keyframe_every: a frustum at every n-th pose; by default about fifteen along the path.
    """
    Ts = result.Ts_world_camera
    path = Ts[:, :3, 3] if len(Ts) else np.zeros((1, 3))
    up, forward = level_axes(Ts)
    keep = near_path(result.static_points_m, path)
    points, colors = result.static_points_m[keep], result.static_colors[keep]
    polylines, tags = object_paths(result.objects)  # below the camera's path, which they may hide
    true_paths: list[Array] = []
    if result.gt_Ts_world_camera is not None and result.gt_timestamps_s is not None:
        truth = result.gt_Ts_world_camera[:, :3, 3]
        true_paths = split_at_gaps(result.gt_timestamps_s, truth)
        polylines += [Polyline(piece, style.TRUTH, 6.0, "ground truth") for piece in true_paths]
    if result.gt_objects is not None:
        true_paths += true_object_paths(result.gt_objects)
    if len(Ts):
        size_m = FRUSTUM_SHARE * extent_m(path, points)
        length_m = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
        n = int(np.clip(length_m / (2.0 * size_m), 1, N_FRUSTUMS))  # more would be one heap
        step = keyframe_every or max(1, round(len(Ts) / n))
        polylines += [Polyline(f, style.FRUSTUM, 1.0) for f in frustums(Ts[::step], size_m)]
    for piece in split_at_gaps(result.timestamps_s, path[: len(Ts)]):
        polylines.append(Polyline(piece, style.ESTIMATE, 2.4, "camera, estimated"))
    return Scene(
        points, colors, path, tuple(polylines), up, forward, tuple(tags), tuple(true_paths)
    )


def near_path(points_m: Array, path_m: Array) -> NDArray[np.bool_]:
    """Which points (N, 3) are no strays: finite, and not far beyond what most of the map spans."""
    finite = np.isfinite(points_m).all(1)
    if not finite.any():
        return finite
    distance = np.full(len(points_m), np.inf)
    distance[finite] = cKDTree(path_m).query(points_m[finite])[0]
    return distance <= STRAY_FACTOR * np.quantile(distance[finite], STRAY_QUANTILE)


def frustums(
    Ts_world_camera: Array, size_m: float, opening: tuple[float, float] = (0.62, 0.4)
) -> list[Array]:
    """Closed outlines (K of (10, 3)) of small pyramids that open the way the cameras look.

    opening: half of the width and of the height of a picture at distance 1.
    """
    x, y, z = opening[0] * size_m, opening[1] * size_m, size_m
    corners = np.array([[-x, -y, z], [x, -y, z], [x, y, z], [-x, y, z]])
    apex = np.zeros(3)
    order = [apex, *corners, corners[0], apex, corners[1], corners[2], apex, corners[3]]
    outline = np.array(order)
    return [transform_points(T, outline) for T in Ts_world_camera]


def extent_m(path_m: Array, points_m: Array) -> float:
    """Diagonal of the box around the path and the middle 90 % of the points; at least 0.1 m."""
    lows, highs = [path_m.min(0)], [path_m.max(0)]
    if len(points_m):
        low, high = np.quantile(points_m, [0.05, 0.95], axis=0)
        lows.append(low)
        highs.append(high)
    return max(float(np.linalg.norm(np.max(highs, 0) - np.min(lows, 0))), 0.1)


def level_axes(Ts_world_camera: Array) -> tuple[Array, Array]:
    """The scene's up and forward, (3,) unit vectors, as its cameras (F, 4, 4) tell them."""
    up = _up(Ts_world_camera)
    return up, _forward(Ts_world_camera, up)


def _up(Ts: Array) -> Array:
    """Upward axis: across the cameras' horizontal axes, near the mean of their upward ones.

    A camera in a hand looks down more often than up, but is hardly ever held askew: where it turned
    about, its horizontal axes tell what is level. Where it did not, tilts must average out.
    """
    if len(Ts) == 0:
        return np.array([0.0, -1.0, 0.0])
    mean = -Ts[:, :3, 1].sum(0)
    length = np.linalg.norm(mean)
    if length < 1e-6:
        return np.array([0.0, -1.0, 0.0])
    mean = mean / length
    right = Ts[:, :3, 0]
    spread = right.T @ right / len(Ts) - TURNED * np.outer(mean, mean)
    up = np.linalg.eigh(spread)[1][:, 0]
    up = up * np.sign(up @ mean)
    return up if up @ mean > MOST_TILTED else mean


def _forward(Ts: Array, up: Array) -> Array:
    """Viewing direction of the first camera, made horizontal."""
    forward = Ts[0, :3, 2] if len(Ts) else np.array([0.0, 0.0, 1.0])
    forward = forward - up * (forward @ up)
    length = np.linalg.norm(forward)
    if length < 1e-6:  # the camera looks straight up or down
        forward = np.cross(up, Ts[0, :3, 0] if len(Ts) else np.array([1.0, 0.0, 0.0]))
        length = max(float(np.linalg.norm(forward)), 1e-9)
    return forward / length
