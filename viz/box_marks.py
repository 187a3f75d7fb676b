"""Objects of one frame in a map picture: oriented boxes in perspective with labels above them.

Owns their drawing. What moves stands out, as it does on the annotated frames.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipelines.object_types import ObjectState
from pipelines.types import Array, Image
from viz import style
from viz.boxes import ObjectBox
from viz.lines import NEAR_M, draw_segment
from viz.object_marks import DARK_PANEL, ORDER, Box, overlaps
from viz.scene import View

# Corners of a box by number (bits 0, 1, 2: the side in x, y, z), face by face and in a ring each.
FACES = ((1, 3, 7, 5), (0, 2, 6, 4), (2, 3, 7, 6), (0, 1, 5, 4), (4, 5, 7, 6), (0, 1, 3, 2))
EDGES = tuple((a, a | 1 << bit) for a in range(8) for bit in range(3) if not a & 1 << bit)
FRONT_OPACITY, SIDE_OPACITY = 0.42, 0.16  # of what moves; its front shows where it goes
WIDTHS_PX = {ObjectState.MOVING: 2.4, ObjectState.COASTING: 1.4}
STILL_WIDTH_PX = 1.0


def draw_boxes(
    picture: Image, view: View, boxes: Sequence[ObjectBox], *, dark: bool = False
) -> None:
    """The boxes that are in the picture, from far to near, in place."""
    for box in reversed(_shown(view, boxes)):
        _draw_box(picture, view, box, dark)


def draw_box_labels(
    picture: Image, view: View, boxes: Sequence[ObjectBox], taken: list[Box], text_px: int
) -> None:
    """Words above the boxes, in place, those of what moves first; `taken` stays free of them."""
    rank = {str(state): n for n, state in enumerate(ORDER)}
    taken, shown = list(taken), _shown(view, boxes)
    movers = {b.object_id: _outline(view, b) for b in shown if b.state == str(ObjectState.MOVING)}
    for box in sorted(shown, key=lambda b: rank[b.state]):
        others = [part for number, part in movers.items() if part and number != box.object_id]
        _draw_label(picture, view, box, taken, others, text_px)


def _shown(view: View, boxes: Sequence[ObjectBox]) -> list[ObjectBox]:
    """Those wholly before the view and at least partly in the picture, from near to far."""
    before = [box for box in boxes if (view.project(box.corners_m)[1] > NEAR_M).all()]
    shown = [box for box in before if _outline(view, box) is not None]
    return sorted(shown, key=lambda b: float(view.project(b.T_world_box[None, :3, 3])[1][0]))


def _draw_box(picture: Image, view: View, box: ObjectBox, dark: bool) -> None:
    import cv2

    corners = box.corners_m
    uv = view.project(corners)[0]
    state = ObjectState(box.state)
    color = style.on_dark(box.color) if dark else box.color
    if state is ObjectState.MOVING:
        eye = -view.T_view_world[:3, :3].T @ view.T_view_world[:3, 3]
        for number, face in enumerate(FACES):
            middle = corners[list(face)].mean(0)
            if (middle - box.T_world_box[:3, 3]) @ (eye - middle) <= 0 and number:
                continue  # the far sides; the front is shown even through the box
            ring = np.round(uv[list(face)] * 16).astype(np.int32).reshape(-1, 1, 2)
            (u0, v0), (u1, v1) = ring.min((0, 1)) // 16 - 1, ring.max((0, 1)) // 16 + 2
            u0, v0 = max(u0, 0), max(v0, 0)
            part = picture[v0 : max(v1, v0), u0 : max(u1, u0)]
            if part.size == 0:
                continue
            ink = part.copy()
            cv2.fillPoly(ink, [ring - [[[16 * u0, 16 * v0]]]], color, cv2.LINE_AA, 4)
            opacity = FRONT_OPACITY if number == 0 else SIDE_OPACITY
            cv2.addWeighted(ink, opacity, part, 1.0 - opacity, 0.0, dst=part)
    width = WIDTHS_PX.get(state, STILL_WIDTH_PX)
    for a, b in EDGES:
        dashed = state is ObjectState.COASTING
        draw_segment(picture, view, uv[[a, b]], color, width, dashed=dashed)


def _draw_label(
    picture: Image,
    view: View,
    box: ObjectBox,
    taken: list[Box],
    others: list[Box],
    text_px: int,
) -> None:
    """The words above the box, else near it; those of what does not move only where it is large.

    Rather a place that hides no other moving object, but rather such a one than none.
    """
    outline = _outline(view, box)
    assert outline is not None
    moves = box.state == str(ObjectState.MOVING)
    size_px = text_px if moves else max(10, round(0.85 * text_px))
    if not moves and outline[3] - outline[1] < 1.6 * size_px:
        return
    width = style.text_size(box.words, size_px, 600 if moves else 400)[0]
    w, h = width + round(0.7 * size_px) + (0 if moves else 3), round(1.4 * size_px)
    places = [p for p in _places(view, outline, (w, h)) if not overlaps(p, taken)]
    clear = [place for place in places if not overlaps(place, others)]
    if place := next(iter(clear or (places if moves else [])), None):
        taken.append(place)
        _write(picture, place, box, size_px, moves)


def _places(view: View, outline: Box, size: tuple[int, int]) -> list[Box]:
    """Above, below, beside, then further above and below; those that lie in the picture."""
    (u0, v0, u1, v1), (w, h), (W, H) = outline, size, view.size
    columns = ((u0 + u1 - w) // 2, u0, u1 - w)
    near = [(u, v) for v in (v0 - h - 3, v1 + 3) for u in columns]
    beside = [(u1 + 4, (v0 + v1 - h) // 2), (u0 - w - 4, (v0 + v1 - h) // 2)]
    far = [(u, v) for v in (v0 - 2 * h - 5, v1 + h + 5, v0 - 3 * h - 7) for u in columns]
    pushed = [(min(max(u, 0), max(W - w, 0)), v) for u, v in near + beside + far]
    return [(u, v, u + w, v + h) for u, v in pushed if v >= 0 and v + h <= H]


def _write(picture: Image, place: Box, box: ObjectBox, size_px: int, moves: bool) -> None:
    at = (place[0] + round(0.35 * size_px), place[3] - round(0.39 * size_px))
    if moves:
        style.draw_panel(picture, place, box.color, 1.0)
        style.draw_text(picture, box.words, at, size_px, style.ink_on(box.color), 600)
    else:
        style.draw_panel(picture, place, DARK_PANEL, 0.62)
        style.draw_panel(picture, (place[0], place[1], place[0] + 3, place[3]), box.color, 1.0)
        style.draw_text(picture, box.words, (at[0] + 3, at[1]), size_px, (226, 226, 230))


def _outline(view: View, box: ObjectBox) -> tuple[int, int, int, int] | None:
    """What the box takes in the picture, or None where that is nothing."""
    uv: Array = view.project(box.corners_m)[0]
    low, high = np.floor(uv.min(0)).astype(int), np.ceil(uv.max(0)).astype(int)
    if (high < 0).any() or (low >= np.array(view.size)).any():
        return None
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])
