"""The map pictures of a result folder: points, paths and cameras, with scale bar and legend.

Owns the order of drawing and the choice of the renderer. Each layer is a file beside this one.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipelines.errors import DyObError
from pipelines.io import folder as names
from pipelines.io.files import disk_error
from pipelines.io.result import load_result
from pipelines.types import Image
from viz import style
from viz.legend import draw_legend
from viz.lines import draw_polyline
from viz.overlay import write_image
from viz.scene import Scene, View, build_scene, extent_m
from viz.tags import draw_tags
from viz.views import VIEW_NAMES, choose_view

logger = logging.getLogger("dyob.viz")

RENDERERS = ("auto", "open3d", "splat")
POINT_SHARE = 0.001  # radius of a point as a share of the map's extent
LIGHTEST = 0.82  # colours are scaled down to this on white, where lighter ones would vanish


def render_result(
    folder: Path | str,
    *,
    size: tuple[int, int] = (1280, 720),
    views: tuple[str, ...] = VIEW_NAMES,
    background: str = "white",
    renderer: str = "auto",
) -> list[Path]:
    """Write renders/map_<view>.png of a result folder; the paths written.

    size: (width, height) in pixels. background: "white" or "black". renderer: "open3d" (needs
    Vulkan), "splat" (needs nothing) or "auto", the first of them that works here. Raises
    FormatError for a damaged folder, ValueError for an unknown name.
    """
    if background not in style.BACKGROUNDS:
        raise ValueError(
            f"render_result: expected background {' or '.join(style.BACKGROUNDS)}, "
            f"found '{background}'"
        )
    if renderer not in RENDERERS:
        raise ValueError(
            f"render_result: expected renderer {', '.join(RENDERERS)}, found '{renderer}'"
        )
    result = load_result(folder)
    scene = build_scene(result)
    chosen = [choose_view(name, scene, size) for name in views]
    target = result.folder / names.RENDERS
    try:
        target.mkdir(exist_ok=True)
    except OSError as error:
        raise DyObError(disk_error(target, error)) from error
    dark = background != "white"
    written = []
    pictures = draw_points(scene, chosen, background=background, renderer=renderer)
    for view, picture in zip(chosen, pictures, strict=True):
        for line in scene.polylines:
            draw_polyline(picture, view, line, dark=dark)
        taken = draw_legend(picture, scene, view, result, dark=dark)
        draw_tags(picture, view, scene, taken, dark=dark)
        path = target / f"map_{view.name}.png"
        write_image(path, picture)
        written.append(path)
    return written


def draw_points(
    scene: Scene, views: Sequence[View], *, background: str = "white", renderer: str = "auto"
) -> list[Image]:
    """The map's points alone, a picture (H, W, 3) uint8 RGB a view, by the renderer asked for.

    Where Open3D cannot draw, the software renderer does, and a logged sentence says so.
    """
    ground = style.BACKGROUNDS[background]
    colors = scene.colors
    if background == "white":
        colors = np.round(colors * LIGHTEST).astype(np.uint8)
    radius_m = POINT_SHARE * extent_m(scene.path_m, scene.points_m)
    if renderer != "splat" and views:
        from viz.offscreen import render_points

        pictures = render_points(views, scene.points_m, colors, radius_m, ground)
        if pictures is not None:
            return [np.ascontiguousarray(picture) for picture in pictures]
        logger.warning(
            "Open3D cannot render here (it needs a Vulkan driver; on Debian: apt-get install "
            "libvulkan1 mesa-vulkan-drivers), so the software renderer draws the map"
        )
    from viz.splat import splat_points

    return [splat_points(view, scene.points_m, colors, radius_m, ground) for view in views]
