"""Viewpoints that show a whole map without being told: from above, and along the path.

Owns the choice of views. Pure geometry, draws nothing.
"""

from __future__ import annotations

import numpy as np

from pipelines.types import Array
from viz.scene import Scene, View

# Shares of the picture kept free for title (top), legend and scale bar (bottom), and for looks.
SIDE_MARGIN, TOP_MARGIN, BOTTOM_MARGIN = 0.06, 0.15, 0.12
TOP_DISTANCE = 60.0  # extents above the map: so far that heights hardly shift anything
FIELD_OF_VIEW_DEG = 55.0  # of the perspective view, across the picture
ELONGATED = 0.3  # a path this long, against the map's extent, is followed; else the map is viewed
WIDEST = 0.4  # a path that strays this far aside, against its length, is no way to look along
OUTSKIRTS = (0.05, 0.95)  # quantiles of the map a side: what is beyond need not be in the picture
VIEW_NAMES = ("top", "perspective")


def choose_view(name: str, scene: Scene, size: tuple[int, int]) -> View:
    """The view called `name` ("top" or "perspective") for pictures of (width, height) pixels."""
    if name == "top":
        return top_view(scene, size)
    if name == "perspective":
        return perspective_view(scene, size)
    raise ValueError(f"choose_view: expected one of {', '.join(VIEW_NAMES)}, found '{name}'")


def top_view(scene: Scene, size: tuple[int, int]) -> View:
    """From straight above, the path's long side along the picture's, in (nearly) parallel light."""
    right = _long_axis(scene)
    if size[1] > size[0]:
        right = np.cross(scene.up, right)
    R = _axes(right, -scene.up)
    framed = _framed(scene) @ R.T
    low, high = framed.min(0), framed.max(0)
    span = np.maximum(high[:2] - low[:2], 0.1)
    px_per_m = float((_free_px(size) / span).min())
    height_m = TOP_DISTANCE * float(np.max(np.array(size) / px_per_m))
    path_depth = float(np.median(scene.path_m @ R[2]))
    centre = np.array([*((low + high) / 2.0)[:2], path_depth - height_m])
    focal = px_per_m * height_m
    return View("top", size, _intrinsics(size, focal), _look(R, R.T @ centre), px_per_m)


def perspective_view(scene: Scene, size: tuple[int, int]) -> View:
    """From behind and above: along a long path from its start, or of the whole of a small map."""
    focal = 0.5 * size[0] / np.tan(np.radians(FIELD_OF_VIEW_DEG) / 2.0)
    framed = _framed(scene)
    start, across = scene.path_m[0], scene.path_m - scene.path_m[0]
    across = across - np.outer(across @ scene.up, scene.up)
    reach = np.linalg.norm(across, axis=1)
    length_m = float(reach.max())
    along = across[int(reach.argmax())] / max(length_m, 1e-9)
    aside_m = float(np.linalg.norm(across - np.outer(across @ along, along), axis=1).max())
    is_long = length_m > ELONGATED * float(np.linalg.norm(np.ptp(framed, axis=0)))
    if is_long and aside_m < WIDEST * length_m:
        aside = np.cross(scene.up, along)
        eye = start + length_m * (-0.34 * along + 0.17 * scene.up + 0.04 * aside)
        target = start + 0.35 * length_m * along
        return View("perspective", size, _intrinsics(size, focal), _look_at(eye, target, scene.up))
    direction = _unit(0.87 * scene.forward - 0.50 * scene.up)
    R = _axes(np.cross(scene.forward, scene.up), direction)
    return View("perspective", size, _intrinsics(size, focal), _fit(R, framed, focal, size))


def _framed(scene: Scene) -> Array:
    """The points that must be in the picture: the path, and the map without its outskirts."""
    if len(scene.points_m) < 20:
        return np.concatenate([scene.path_m, scene.points_m, scene.path_m[:1] + 0.5])
    low, high = np.quantile(scene.points_m, OUTSKIRTS, axis=0)
    inside = ((scene.points_m >= low) & (scene.points_m <= high)).all(1)
    return np.concatenate([scene.path_m, scene.points_m[inside]])


def _long_axis(scene: Scene) -> Array:
    """Horizontal direction of greatest spread, towards the end of the path."""
    framed = _framed(scene)
    path = scene.path_m
    spread = np.linalg.norm(np.ptp(path, axis=0))
    cloud = path if spread > ELONGATED * np.linalg.norm(np.ptp(framed, axis=0)) else framed
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
    return _look(R, R.T @ np.array([centre[0], centre[1], -back]))


def _look_at(eye: Array, target: Array, up: Array) -> Array:
    forward = _unit(target - eye)
    return _look(_axes(np.cross(forward, up), forward), eye)


def _axes(right: Array, forward: Array) -> Array:
    """Rows x, y, z of a camera that looks `forward` with `right` to its right."""
    x = _unit(right - forward * (right @ forward))
    return np.stack([x, np.cross(forward, x), forward])


def _look(R: Array, eye: Array) -> Array:
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
