"""Words beside points of a map picture, each at a disc, where they find room.

Owns their drawing. Knows no object: a tag is a point, words and a colour.
"""

from __future__ import annotations

from collections.abc import Sequence

from pipelines.types import Image
from viz import style
from viz.object_marks import Box, overlaps
from viz.object_paths import Tag
from viz.scene import View


def draw_tags(
    picture: Image, view: View, tags: Sequence[Tag], taken: list[Box], *, dark: bool = False
) -> None:
    """A disc at the end of each moving object's path and its words beside it, in place.

    taken: parts of the picture that must stay free. A tag that finds no room loses its words, and
    one behind the view or outside the picture is not drawn.
    """
    import cv2

    W, H = view.size
    text_px = min(max(10, round(0.82 * W / 75.0)), 34)
    radius = max(3, round(0.34 * text_px))
    ink, panel = (style.WHITE, style.BACKGROUNDS["black"]) if dark else (style.INK, style.WHITE)
    taken, seen = list(taken), []
    for tag in tags:
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
        for left, top in (*beside, (u - w // 2, v - off - h), (u - w // 2, v + off)):
            box = (left, top, left + w, top + h)
            inside = left >= 0 and top >= 0 and box[2] <= W and box[3] <= H
            if inside and not overlaps(box, taken):
                style.draw_panel(picture, box, panel, 0.7)
                at = (left + text_px // 4, top + h - round(0.33 * text_px))
                style.draw_text(picture, tag.text, at, text_px, ink)
                taken.append(box)
                break
