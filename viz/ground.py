"""A faint grid on the ground beneath the camera, which gives a picture its depth and its scale.

Owns where the ground is taken to be, and the drawing of the grid beneath the points.
"""

from __future__ import annotations

import numpy as np

from pipelines.types import Array, Image
from viz import style
from viz.lines import NEAR_M
from viz.playback import Playback
from viz.scene import View
from viz.smoothing import smoothed

LOWEST = 0.04  # quantile of the points' heights about the camera: that is where the ground is
MOST_MEASURED = 200  # frames; what lies between is interpolated
ABOUT = 1.5  # reaches round the camera in which points tell of the ground
STEP, SPAN = 0.35, 3.0  # reaches: most that the lines are apart, and how far they go
STEPS_M = tuple(base * 10.0**power for power in range(-3, 4) for base in (1, 2, 5))
GREY_ON_WHITE, GREY_ON_BLACK = (214, 219, 226), (52, 57, 66)


def ground_levels_m(playback: Playback, reach_m: float) -> Array:
    """Height (F,) of the ground along the scene's up in each frame; NaN where nothing tells it."""
    scene = playback.scene
    heights = scene.points_m @ scene.up
    levels = np.full(len(playback), np.nan)
    measured = np.linspace(0, max(len(playback) - 1, 0), min(len(playback), MOST_MEASURED))
    for k in np.unique(measured.astype(int)).tolist():
        center = playback.Ts_world_camera[k, :3, 3]
        apart = scene.points_m - center
        near = (apart * apart).sum(1) < (ABOUT * reach_m) ** 2
        near &= heights < center @ scene.up
        if near.sum() > 10:
            levels[k] = np.quantile(heights[near], LOWEST)
    known = np.flatnonzero(np.isfinite(levels))
    if len(known) == 0:
        return levels
    levels = np.interp(np.arange(len(levels)), known, levels[known])
    return smoothed(levels, playback.timestamps_s)


def grid_step_m(reach_m: float) -> float:
    """Metres between the lines of the grid."""
    return max((step for step in STEPS_M if step <= STEP * reach_m), default=STEPS_M[0])


def draw_grid(
    picture: Image,
    view: View,
    playback: Playback,
    k: int,
    level_m: float,
    reach_m: float,
    *,
    dark: bool = False,
) -> None:
    """Draw the grid of the k-th frame in place, where the picture shows nothing else yet."""
    import cv2

    if not np.isfinite(level_m):
        return
    scene, step_m = playback.scene, grid_step_m(reach_m)
    axes = np.stack([scene.forward, np.cross(scene.forward, scene.up)])
    middle = np.round(axes @ playback.Ts_world_camera[k, :3, 3] / step_m)
    n = int(SPAN * reach_m / step_m)
    ground = np.array(style.BACKGROUNDS["black" if dark else "white"], np.uint8)
    color = GREY_ON_BLACK if dark else GREY_ON_WHITE
    sheet = np.empty_like(picture)
    sheet[:] = ground
    share = np.linspace(-1.0, 1.0, 9)[:, None]  # so that what is behind the view can be cut off
    for axis in (0, 1):
        for line in range(-n, n + 1):
            place = np.tile(middle * step_m, (len(share), 1))
            place[:, axis] += line * step_m
            place[:, 1 - axis] += share[:, 0] * n * step_m
            uv, depth = view.project(place @ axes + level_m * scene.up)
            pairs = np.flatnonzero((depth[:-1] > NEAR_M) & (depth[1:] > NEAR_M))
            fixed = np.round(np.clip(uv, -1e5, 1e5) * 16).astype(np.int32)
            segments = [fixed[i : i + 2].reshape(-1, 1, 2) for i in pairs]
            cv2.polylines(sheet, segments, False, color, 1, cv2.LINE_AA, 4)
    free = (picture == ground).all(2)
    picture[free] = sheet[free]
