"""Viewpoints that show a whole map without being told: from above, and three-quarter.

Owns the choice of still views; those that follow the camera are `viz.chase`'s. Pure geometry, draws
nothing.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from pipelines.geometry import transform_points
from pipelines.types import Array
from viz.scene import Scene, View

# Shares of the picture kept free for title (top), legend and scale bar (bottom), and for looks.
SIDE_MARGIN, TOP_MARGIN, BOTTOM_MARGIN = 0.06, 0.15, 0.12
TOP_DISTANCE = 60.0  # extents above the map: so far that heights hardly shift anything
FIELD_OF_VIEW_DEG = 38.0  # of the three-quarter view, across the picture
ELEVATION_DEG = 38.0  # it looks down so steeply
AZIMUTHS_DEG = (
    40.0,
    55.0,
    -40.0,
    -55.0,
)  # at such angles to the path: by the first two it goes right
MUCH_NEARER = 0.75  # what one must gain in distance to be taken in place of one before it
HAZE = 0.45  # the farthest points turn to the ground's colour so far
ELONGATED = 0.3  # a path this long, against the map's extent, is followed; else the map is viewed
STRAIGHT = 0.05  # so is a path this thin against its length that is this long against the map
NEAR = (0.75, 0.25)  # of the map, what is as far from the path as three quarters of it are, or
NEAR_FACTOR = 2.0  # twice as far as one quarter is; the rest need not be in the picture
OUTSKIRTS = (0.05, 0.95)  # quantiles of the map a side: what is beyond need not be in the picture
VIEW_NAMES = ("top", "iso")


def choose_view(name: str, scene: Scene, size: tuple[int, int]) -> View:
    """The view called `name` ("top" or "iso") for pictures of (width, height) pixels."""
    if name == "top":
        return top_view(scene, size)
    if name == "iso":
        return iso_view(scene, size)
    raise ValueError(f"choose_view: expected one of {', '.join(VIEW_NAMES)}, found '{name}'")


def top_view(scene: Scene, size: tuple[int, int]) -> View:
    """From straight above, the path's long side along the picture's, in (nearly) parallel light."""
    right = _long_axis(scene)
    if size[1] > size[0]:
        right = np.cross(scene.up, right)
    R = view_axes(right, -scene.up)
    framed = _framed(scene) @ R.T
    low, high = framed.min(0), framed.max(0)
    span = np.maximum(high[:2] - low[:2], 0.1)
    px_per_m = float((_free_px(size) / span).min())
    height_m = TOP_DISTANCE * float(np.max(np.array(size) / px_per_m))
    path_depth = float(np.median(scene.path_m @ R[2]))
    centre = np.array([*((low + high) / 2.0)[:2], path_depth - height_m])
    focal = px_per_m * height_m
    return View("top", size, _intrinsics(size, focal), look_from(R, R.T @ centre), px_per_m)


def iso_view(scene: Scene, size: tuple[int, int]) -> View:
    """Of the whole from behind and above at an angle: one of some that fills the picture.

    The map is what the camera saw, so it is looked at from where the camera looked. The way goes to
    the right, as one reads, unless the other side shows much more.
    """
    focal = 0.5 * size[0] / np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2.0)
    framed = _framed(scene)
    along = _direction(scene, framed)
    aside = np.cross(scene.up, along)
    best, nearest_m = np.eye(4), np.inf
    for angle in np.radians(AZIMUTHS_DEG):
        flat = np.cos(angle) * along + np.sin(angle) * aside
        elevation = np.radians(ELEVATION_DEG)
        R = view_axes(
            np.cross(flat, scene.up), np.cos(elevation) * flat - np.sin(elevation) * scene.up
        )
        T = _fit(R, framed, focal, size)
        middle_m = float(np.median(transform_points(T, framed)[:, 2]))
        if middle_m < MUCH_NEARER * nearest_m:
            best, nearest_m = T, middle_m
    depth = transform_points(best, framed)[:, 2]
    haze = (float(np.quantile(depth, 0.3)), float(np.quantile(depth, 0.98)), HAZE)
    return View("iso", size, _intrinsics(size, focal), best, haze=haze)


def _direction(scene: Scene, framed: Array) -> Array:
    """Where the camera went, made level; where it looked at first if it hardly went anywhere."""
    across = scene.path_m - scene.path_m[0]
    across = across - np.outer(across @ scene.up, scene.up)
    reach = np.linalg.norm(across, axis=1)
    if reach.max() < ELONGATED * float(np.linalg.norm(np.ptp(framed, axis=0))):
        return scene.forward
    return _unit(across[int(reach.argmax())])


def _framed(scene: Scene) -> Array:
    """What must be in the picture: paths, and the map near them without its outskirts."""
    ends = np.array([tag.point_m for tag in scene.tags]).reshape(-1, 3)
    if len(scene.points_m) < 20:
        return np.concatenate([scene.path_m, ends, scene.points_m, scene.path_m[:1] + 0.5])
    apart_m = cKDTree(scene.path_m).query(scene.points_m)[0]
    most, some = np.quantile(apart_m, NEAR)
    near = scene.points_m[apart_m <= max(most, NEAR_FACTOR * some)]
    low, high = np.quantile(near, OUTSKIRTS, axis=0)
    inside = ((near >= low) & (near <= high)).all(1)
    return np.concatenate([scene.path_m, ends, near[inside]])


def _long_axis(scene: Scene) -> Array:
    """Horizontal direction of greatest spread, towards the end of the path."""
    framed = _framed(scene)
    path = scene.path_m
    spread = np.linalg.norm(np.ptp(path, axis=0)) / np.linalg.norm(np.ptp(framed, axis=0))
    cloud = path if spread > (STRAIGHT if _is_straight(path) else ELONGATED) else framed
    flat = cloud - cloud.mean(0)
    flat = flat - np.outer(flat @ scene.up, scene.up)
    axis = np.linalg.svd(flat, full_matrices=False)[2][0] if len(flat) > 1 else scene.forward
    axis = axis - scene.up * (axis @ scene.up)
    if np.linalg.norm(axis) < 1e-6:
        axis = scene.forward
    towards = path[-1] - path[0]
    if abs(towards @ axis) < 1e-6:
        towards = scene.forward
    return _unit(axis) * (1.0 if towards @ axis >= 0 else -1.0)


def _is_straight(path_m: Array) -> bool:
    if len(path_m) < 3:
        return False
    length, width = np.linalg.svd(path_m - path_m.mean(0), compute_uv=False)[:2]
    return bool(width < STRAIGHT * length)


def _fit(R: Array, framed: Array, focal: float, size: tuple[int, int]) -> Array:
    """Back off along the view axis until every framed point is in the picture, then centre it."""
    local = framed @ R.T
    centre = (local.min(0) + local.max(0)) / 2.0
    for _ in range(3):  # centring and distance depend on each other; this settles quickly
        offset = np.abs(local[:, :2] - centre[:2])
        half = 0.5 * _free_px(size)
        back = float((offset * focal / half - local[:, 2:]).max())
        depth = local[:, 2:] + back
        px = (local[:, :2] - centre[:2]) / depth * focal
        shift = (px.min(0) + px.max(0)) / 2.0
        centre[:2] += shift * np.median(depth) / focal
    return look_from(R, R.T @ np.array([centre[0], centre[1], -back]))


def view_axes(right: Array, forward: Array) -> Array:
    """Rows x, y, z of a camera that looks `forward` with `right` to its right."""
    x = _unit(right - forward * (right @ forward))
    return np.stack([x, np.cross(forward, x), forward])


def look_from(R: Array, eye: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ eye
    return T


def _intrinsics(size: tuple[int, int], focal: float) -> Array:
    cx = (size[0] - 1) / 2.0
    cy = (size[1] * (1.0 + TOP_MARGIN - BOTTOM_MARGIN) - 1) / 2.0
    return np.array([[focal, 0.0, cx], [0.0, focal, cy], [0.0, 0.0, 1.0]])


def _free_px(size: tuple[int, int]) -> Array:
    """Width and height of the part of the picture that the margins leave."""
    return np.array(size) * [1 - 2 * SIDE_MARGIN, 1 - TOP_MARGIN - BOTTOM_MARGIN]


def _unit(v: Array) -> Array:
    return v / np.linalg.norm(v)
