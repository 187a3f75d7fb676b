"""The map's points as pictures, by Open3D or by the software renderer.

Owns the choice of the renderer, and how large and how dark points are drawn.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence

import numpy as np

from pipelines.types import Image
from viz import style
from viz.scene import Scene, View, extent_m

logger = logging.getLogger("dyob.viz")

RENDERERS = ("auto", "open3d", "splat")
POINT_SHARE = 0.001  # radius of a point as a share of the map's extent
LIGHTEST = 0.82  # colours are scaled down to this on white, where lighter ones would vanish


def check_names(background: str, renderer: str) -> None:
    """Raises ValueError for a background or a renderer that there is not."""
    for kind, word, known in (
        ("background", background, tuple(style.BACKGROUNDS)),
        ("renderer", renderer, RENDERERS),
    ):
        if word not in known:
            raise ValueError(f"expected a {kind} of {', '.join(known)}, found '{word}'")


def draw_points(
    scene: Scene, views: Sequence[View], *, background: str = "white", renderer: str = "auto"
) -> Iterator[Image]:
    """The map's points alone, a picture (H, W, 3) uint8 RGB a view, as each is ready.

    All views are of one size. Where Open3D cannot draw, the software renderer does, and a logged
    sentence says so.
    """
    ground = style.BACKGROUNDS[background]
    colors = scene.colors
    if background == "white":
        colors = np.round(colors * LIGHTEST).astype(np.uint8)
    radius_m = POINT_SHARE * extent_m(scene.path_m, scene.points_m)
    done = 0
    if renderer != "splat" and views:
        from viz.offscreen import render_points

        for picture in render_points(views, scene.points_m, colors, radius_m, ground):
            done += 1
            yield picture
        if done < len(views):
            logger.warning(
                "Open3D cannot render here (it needs a Vulkan driver; on Debian: apt-get install "
                "libvulkan1 mesa-vulkan-drivers), so the software renderer draws the map"
            )
    from viz.splat import splat_points

    for view in views[done:]:
        yield splat_points(view, scene.points_m, colors, radius_m, ground)
