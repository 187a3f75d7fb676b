"""Words beside points of a map picture, each at a disc, where they find room: paths' ends.

Owns their drawing. Knows no object: a tag is a point, words and a colour.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipelines.types import Array, Image
from viz import style
from viz.legend import text_size_px
from viz.object_marks import Box, overlaps
from viz.scene import Scene, View

PATH_PX = 6


def draw_ends(
    picture: Image, view: View, scene: Scene, taken: list[Box], *, dark: bool = False
) -> list[Box]:
    """A disc and a word at the first and the last camera, off the parts `taken` and off paths.

    Returns the parts that are taken now.
    """
    import cv2

    panel = style.BACKGROUNDS["black" if dark else "white"]
    text_px = text_size_px(view)
    W, H = view.size
    r, pad = max(4, round(0.42 * text_px)), text_px // 4
    taken, seen = list(taken), []
    ends = (("end", scene.path_m[-1:], style.END), ("start", scene.path_m[:1], style.START))
    for word, point, color in ends:
        uv, depth = view.project(point)
        if depth[0] <= 0 or not (0 <= uv[0, 0] < W and 0 <= uv[0, 1] < H):
            continue
        u, v = round(float(uv[0, 0])), round(float(uv[0, 1]))
        shown = style.on_dark(color) if dark else color
        cv2.circle(picture, (u, v), r + max(1, r // 4), panel, -1, cv2.LINE_AA)
        cv2.circle(picture, (u, v), r, shown, -1, cv2.LINE_AA)
        taken.append((u - r, v - r, u + r, v + r))
        seen.append((word, u, v, shown))
    paths = _path_parts(scene, view)
    discs = [_around(tag.point_m, view, r) for tag in scene.tags]  # which are drawn later
    for word, u, v, shown in seen:
        w, h = style.text_size(word, text_px, 600)[0] + 2 * pad, round(1.3 * text_px)
        corners = ((u - w // 2, v + r + 2), (u - w // 2, v - r - 2 - h))
        corners += ((u - r - 4 - w, v - h // 2), (u + r + 4, v - h // 2))
        box = _free_place(view, corners, (w, h), taken + discs, paths)
        if box is not None:
            style.draw_panel(picture, box, panel, 0.7)
            at = (box[0] + pad, box[3] - round(0.33 * text_px))
            style.draw_text(picture, word, at, text_px, shown, 600)
            taken.append(box)
    return taken


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
        box = _free_place(view, corners, (w, h), taken, paths)
        if box is not None:
            style.draw_panel(picture, box, panel, 0.7)
            at = (box[0] + text_px // 4, box[3] - round(0.33 * text_px))
            style.draw_text(picture, tag.text, at, text_px, ink)
            taken.append(box)


def _around(point_m: Array, view: View, radius: int) -> Box:
    """The part of the picture about a point; an empty one where the point is behind the view."""
    uv, depth = view.project(point_m[None])
    if depth[0] <= 0:
        return (-1, -1, -1, -1)
    u, v = np.round(np.clip(uv[0], -1e6, 1e6)).astype(int).tolist()
    return (u - radius, v - radius, u + radius, v + radius)


def _free_place(
    view: View,
    corners: Sequence[tuple[int, int]],
    size: tuple[int, int],
    taken: list[Box],
    paths: list[Box],
) -> Box | None:
    """The first place of that size in the picture that is not taken, rather one off the paths."""
    (w, h), (W, H) = size, view.size
    places = [(u, v, u + w, v + h) for u, v in corners if 0 <= u <= W - w and 0 <= v <= H - h]
    places = [place for place in places if not overlaps(place, taken)]
    return next((p for p in places if not overlaps(p, paths)), next(iter(places), None))


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
