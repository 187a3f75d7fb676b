"""One frame of a run over the map's points: camera, objects as boxes, and their ways until then.

Owns what is shown of a frame and in which order. The points are `viz.points`'s.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.types import Array, Image
from viz import style
from viz.box_marks import draw_box_labels, draw_boxes
from viz.chase import view_reach_m
from viz.ground import draw_grid, ground_levels_m
from viz.legend import text_size_px
from viz.lines import draw_polyline
from viz.object_marks import Box
from viz.object_paths import Polyline
from viz.playback import Playback
from viz.scene import View, frustums

FRUSTUM_SHARE = 0.05  # of the reach: depth of the camera's pyramid
OLD_S = 3.0  # s, after which the way of an object that is gone grows pale
PALE = 0.35
TRAIL_PX, CAMERA_PX, FRUSTUM_PX = 3.0, 3.4, 1.8


@dataclass(frozen=True, slots=True)
class Stage:
    """A run with the measures that its moments are drawn by.

    reach_m: how far the camera typically saw. ground_m: (F,) height of the ground in each frame.
    """

    playback: Playback
    reach_m: float
    ground_m: Array


def build_stage(playback: Playback) -> Stage:
    """Measure a run once for all its moments."""
    reach_m = view_reach_m(playback)
    return Stage(playback, reach_m, ground_levels_m(playback, reach_m))


def draw_moment(picture: Image, view: View, stage: Stage, k: int, *, dark: bool = False) -> None:
    """Draw the k-th frame of the run over a picture of the points, in place, without words."""
    playback = stage.playback
    if view.px_per_m is None:
        draw_grid(picture, view, playback, k, stage.ground_m[k], stage.reach_m, dark=dark)
    now_s = playback.timestamps_s[k]
    for trail in playback.trails:
        until = int(np.searchsorted(trail.frames, k, side="right"))
        if until < 2:
            continue
        is_old = now_s - playback.timestamps_s[trail.frames[until - 1]] > OLD_S
        color = style.object_color(trail.object_id)
        line = Polyline(trail.points_m[:until], color, TRAIL_PX, "trail")
        draw_polyline(picture, view, line, dark=dark, opacity=PALE if is_old else 1.0)
    for piece in _camera_path(playback, k):
        line = Polyline(piece, style.ESTIMATE, CAMERA_PX, "camera")
        draw_polyline(picture, view, line, dark=dark)
    color = style.ESTIMATE if playback.is_tracked[k] else style.STATUS_LOST
    size_m = FRUSTUM_SHARE * stage.reach_m
    opening = (0.62, 0.4)
    if playback.camera is not None:
        camera = playback.camera
        opening = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    for outline in frustums(playback.Ts_world_camera[k : k + 1], size_m, opening):
        draw_polyline(picture, view, Polyline(outline, color, FRUSTUM_PX, "camera"), dark=dark)
    draw_boxes(picture, view, playback.boxes[k], dark=dark)


def draw_moment_labels(
    picture: Image, view: View, playback: Playback, k: int, taken: list[Box]
) -> None:
    """The words at the objects of the k-th frame, in place, off the parts `taken`."""
    text_px = round(0.94 * text_size_px(view))
    draw_box_labels(picture, view, playback.boxes[k], taken, text_px)


def _camera_path(playback: Playback, k: int) -> list[Array]:
    """The camera's way until frame k, in pieces that end where it was lost."""
    tracked = playback.is_tracked[: k + 1]
    centers = playback.Ts_world_camera[: k + 1, :3, 3]
    breaks = np.flatnonzero(tracked[1:] != tracked[:-1]) + 1
    pieces = np.split(np.arange(len(tracked)), breaks)
    return [centers[rows] for rows in pieces if len(rows) > 1 and tracked[rows[0]]]
