"""Words beside points of a map picture, each at a disc, where they find room.

Owns their drawing. Knows no object: a tag is a point, words and a colour.
"""

from __future__ import annotations

import numpy as np

from pipelines.types import Image
from viz import style
from viz.legend import text_size_px
from viz.object_marks import Box, overlaps
from viz.scene import Scene, View

PATH_PX = 6


def draw_tags(
    picture: Image, view: View, scene: Scene, taken: list[Box], *, dark: bool = False
) -> None:
    """A disc at the end of each moving object's path and its words beside it, in place.

    taken: parts of the picture that must stay free; the paths rather should. A tag that finds no
    room loses its words, and one behind the view or outside the picture is not drawn.
    """
    import cv2

    W, H = view.size
    text_px = max(10, round(0.85 * text_size_px(view)))
    radius = max(3, round(0.34 * text_px))
    ink, panel = (style.WHITE, style.BACKGROUNDS["black"]) if dark else (style.INK, style.WHITE)
    taken, seen, paths = list(taken), [], _path_parts(scene, view)
    for tag in scene.tags:
        uv, depth = view.project(tag.point_m[None])
        if depth[0] <= 0 or not (0 <= uv[0, 0] < W and 0 <= uv[0, 1] < H):
            continue
        u, v = round(float(uv[0, 0])), round(float(uv[0, 1]))
        cv2.circle(picture, (u, v), radius + max(1, radius // 3), panel, -1, cv2.LINE_AA)
        cv2.circle(picture, (u, v), radius, tag.color, -1, cv2.LINE_AA)
        taken.append((u - radius, v - radius, u + radius, v + radius))
        seen.append((tag, u, v))
    for tag, u, v in seen:
        w, h = style.text_size(tag.text, text_px)[0] + text_px // 2, round(1.3 * text_px)
        off = 2 * radius
        beside = ((u + off, v - h // 2), (u - off - w, v - h // 2))
        corners = (*beside, (u - w // 2, v - off - h), (u - w // 2, v + off))
        places = [(left, top, left + w, top + h) for left, top in corners]
        places = [p for p in places if p[0] >= 0 and p[1] >= 0 and p[2] <= W and p[3] <= H]
        places = [place for place in places if not overlaps(place, taken)]
        box = next((p for p in places if not overlaps(p, paths)), next(iter(places), None))
        if box is not None:
            style.draw_panel(picture, box, panel, 0.7)
            at = (box[0] + text_px // 4, box[3] - round(0.33 * text_px))
            style.draw_text(picture, tag.text, at, text_px, ink)
            taken.append(box)


def _path_parts(scene: Scene, view: View) -> list[Box]:
    """Small squares of the picture along the paths that have a name, one every few pixels."""
    parts: dict[tuple[int, int], Box] = {}
    for line in scene.polylines:
        if line.label:
            uv, depth = view.project(line.points_m)
            for u, v in np.round(uv[depth > 0] / PATH_PX).astype(int).tolist():
                left, top = PATH_PX * u - PATH_PX // 2, PATH_PX * v - PATH_PX // 2
                parts[u, v] = (left, top, left + PATH_PX, top + PATH_PX)
    return list(parts.values())
