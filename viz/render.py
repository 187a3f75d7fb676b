"""The pictures of a result folder: its map, the paths in it, and one moment of the run.

Owns which pictures there are and the order of drawing. Each layer is a file beside this one.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.errors import DyObError
from pipelines.io import folder as names
from pipelines.io.files import disk_error
from pipelines.io.result import Result, load_result
from pipelines.types import Image
from viz.chase import chase_views, telling_frame
from viz.legend import draw_key_and_scale, draw_legend, draw_points_legend
from viz.lines import draw_polyline
from viz.moment import build_stage, draw_moment, draw_moment_labels
from viz.moment_legend import draw_moment_title, moment_key
from viz.overlay import write_image
from viz.playback import Playback, build_playback
from viz.points import check_names, draw_points
from viz.scene import View
from viz.tags import draw_ends, draw_tags
from viz.views import VIEW_NAMES as STILL_VIEWS
from viz.views import choose_view

VIEW_NAMES = (*STILL_VIEWS, "chase")
COMPRESSION = 7  # there are few of these pictures, and they are shown to others
COLOR_STEP = 3  # a difference of one that no eye sees makes files a fifth lighter


def render_result(
    folder: Path | str,
    *,
    size: tuple[int, int] = (1280, 720),
    views: Sequence[str] = VIEW_NAMES,
    frame: int | None = None,
    background: str = "white",
    renderer: str = "auto",
) -> list[Path]:
    """Write renders/ of a result folder; the paths written.

    "top" and "iso" give static_<view>.png, the map's points alone, and map_<view>.png, with the
    paths of the camera and of all that moved. "chase" gives map_chase.png, from behind the camera
    at one frame with the objects' boxes then: `frame`, by its index in the run, or the most telling
    one. size: (width, height) in pixels. background: "white" or "black". renderer: "open3d" (needs
    Vulkan), "splat" (needs nothing) or "auto", the first of them that works here. Raises
    FormatError for a damaged folder, DyObError for a frame that was not processed, ValueError for
    an unknown name.
    """
    check_names(background, renderer)
    if unknown := [name for name in views if name not in VIEW_NAMES]:
        raise ValueError(f"expected views of {', '.join(VIEW_NAMES)}, found '{unknown[0]}'")
    result = load_result(folder)
    playback = build_playback(result)
    following = chase_views(playback, size) if "chase" in views else []
    k = _position(playback, following, frame)
    chosen = []
    for name in dict.fromkeys(views):
        if name != "chase":
            chosen.append(choose_view(name, playback.scene, size))
        elif following:
            chosen.append(following[k])
    target = renders_folder(result)
    written = []
    dark = background != "white"
    pictures = draw_points(playback.scene, chosen, background=background, renderer=renderer)
    for view, picture in zip(chosen, pictures, strict=True):
        if view.name == "chase":
            stage = build_stage(playback)
            draw_moment(picture, view, stage, k, dark=dark)
            taken = [draw_moment_title(picture, view, result, playback, k, dark=dark)]
            key = moment_key(stage, view, playback.boxes[k])
            taken += draw_key_and_scale(picture, view, key, playback.scene, dark=dark)
            draw_moment_labels(picture, view, playback, k, taken)
        else:
            alone = picture.copy()
            draw_points_legend(alone, view, result, dark=dark)
            _draw_paths(picture, view, result, playback, dark)
        written.append(target / f"map_{view.name}.png")
        _write(written[-1], picture)
        if view.name != "chase":
            written.append(target / f"static_{view.name}.png")
            _write(written[-1], alone)
    return written


def renders_folder(result: Result) -> Path:
    """The result's folder for pictures and videos of the map, made if need be."""
    target = result.folder / names.RENDERS
    try:
        target.mkdir(exist_ok=True)
    except OSError as error:
        raise DyObError(disk_error(target, error)) from error
    return target


def _write(path: Path, picture: Image) -> None:
    levels = COLOR_STEP * np.round(np.arange(256) / COLOR_STEP)  # 0 and 255 stay
    write_image(path, levels.astype(np.uint8)[picture], compression=COMPRESSION)


def _draw_paths(picture: Image, view: View, result: Result, playback: Playback, dark: bool) -> None:
    scene = playback.scene
    for line in scene.polylines:
        draw_polyline(picture, view, line, dark=dark)
    taken = draw_legend(picture, scene, view, result, dark=dark)
    taken = draw_ends(picture, view, scene, taken, dark=dark)
    draw_tags(picture, view, scene, taken, dark=dark)


def _position(playback: Playback, following: list[View], frame: int | None) -> int:
    """Where in the playback the frame is that was asked for, else the most telling one."""
    if not following:
        return 0
    if frame is None:
        return telling_frame(playback, following)
    at = np.flatnonzero(playback.frame_index == frame)
    if len(at) == 0:
        first, last = playback.frame_index[[0, -1]]
        raise DyObError(
            f"expected a frame of this run, {first} to {last}, found {frame}; "
            "the names of the pictures in frames/ are these numbers"
        )
    return int(at[0])
