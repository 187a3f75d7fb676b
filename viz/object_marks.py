"""Moving objects on a frame: masks, boxes and labels, in each object's lasting colour.

Owns how an object's state looks, and where its label finds room. What moves stands out; what
stands still stays in the background.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.object_types import ObjectEstimates, ObjectState
from pipelines.types import Array, Image
from viz import style

KMH = 3.6
MASK_OPACITY = {ObjectState.MOVING: 0.46, ObjectState.UNKNOWN: 0.26, ObjectState.STOPPED: 0.20}
DARK_PANEL = (14, 16, 20)
ORDER = (ObjectState.MOVING, ObjectState.COASTING, ObjectState.UNKNOWN, ObjectState.STOPPED)
DASH_PX, GAP_PX = 7, 5

Box = tuple[int, int, int, int]  # u0 v0 u1 v1, the ends not included


@dataclass(frozen=True, slots=True)
class Label:
    """A label that has found its place: text with its lower left corner in `box`."""

    object_id: int
    text: str
    box: Box
    size_px: int
    state: ObjectState


def draw_object_areas(canvas: Image, objects: ObjectEstimates, labels: NDArray[np.int32]) -> None:
    """Masks (H, W) by lasting id with their contours, and boxes; dashed where only predicted."""
    import cv2

    states = dict(zip(objects.object_id.tolist(), objects.state.tolist(), strict=True))
    order = {state: -rank for rank, state in enumerate(ORDER)}  # what moves is drawn last
    ids = [int(i) for i in np.unique(labels) if i > 0]
    for object_id in sorted(ids, key=lambda i: order[_state(states.get(i))]):
        draw_mask(canvas, labels == object_id, object_id, _state(states.get(object_id)))
    for row in np.argsort([order[_state(s)] for s in objects.state], kind="stable"):
        state = _state(objects.state[row])
        box = object_box(objects, int(row), labels)
        if box is None:
            continue
        color = style.object_color(int(objects.object_id[row]))
        corners = (int(box[0]), int(box[1])), (int(box[2]), int(box[3]))
        if state is ObjectState.COASTING:
            _draw_dashed(canvas, *corners, color)
        elif state is ObjectState.MOVING:
            cv2.rectangle(canvas, *corners, DARK_PANEL, 4, cv2.LINE_AA)
            cv2.rectangle(canvas, *corners, color, 2, cv2.LINE_AA)


def draw_mask(
    canvas: Image, mask: NDArray[np.bool_], object_id: int, state: ObjectState = ObjectState.MOVING
) -> None:
    """Tint the pixels of `mask` (H, W) and draw their contour; thinner where nothing moves."""
    import cv2

    color = style.object_color(object_id)
    opacity = MASK_OPACITY.get(state, MASK_OPACITY[ObjectState.UNKNOWN])
    tint = np.array(color, np.float32)
    canvas[mask] = np.round(canvas[mask] * (1 - opacity) + tint * opacity)
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    width = 2 if state is ObjectState.MOVING else 1
    cv2.drawContours(canvas, contours, -1, color, width, cv2.LINE_AA)


def draw_object_labels(
    canvas: Image, objects: ObjectEstimates, labels: NDArray[np.int32] | None, top_px: int
) -> None:
    """A label "id class speed" at each object; none above row `top_px` and none over another."""
    for label in place_labels(objects, labels, canvas.shape[:2], top_px):
        color = style.object_color(label.object_id)
        u0, v0, _, v1 = label.box
        at = (u0 + round(0.35 * label.size_px), v1 - round(0.36 * label.size_px))
        if label.state is ObjectState.MOVING:
            style.draw_panel(canvas, label.box, color, 1.0)
            style.draw_text(canvas, label.text, at, label.size_px, style.ink_on(color), 600)
        else:
            style.draw_panel(canvas, label.box, DARK_PANEL, 0.62)
            style.draw_panel(canvas, (u0, v0, u0 + 3, v1), color, 1.0)
            style.draw_text(canvas, label.text, (at[0] + 3, at[1]), label.size_px, (226, 226, 230))


def label_text(objects: ObjectEstimates, row: int) -> str:
    """As "3 car 43 km/h": eq. (6)'s speed where it moves, the filter's (~) where only predicted."""
    name = f"{objects.object_id[row]} {objects.class_name[row]}"
    state = _state(objects.state[row])
    speed, smoothed = objects.speed_mps[row], objects.smoothed_speed_mps[row]
    if state is ObjectState.STOPPED:
        return f"{name} stopped"
    if state is ObjectState.UNKNOWN:
        return f"{name} ?"
    about = "~" if state is ObjectState.COASTING else ""
    known = smoothed if state is ObjectState.COASTING or not np.isfinite(speed) else speed
    return f"{name} {about}{speed_words(KMH * known)}" if np.isfinite(known) else f"{name} ?"


def speed_words(speed_kmh: float) -> str:
    """A speed with two digits that count."""
    return f"{speed_kmh:.{0 if speed_kmh >= 9.95 else 1}f} km/h"


def object_counts(objects: ObjectEstimates) -> str:
    """As "3 moving, 8 stopped"; empty where there are neither."""
    counts = {
        state: int((objects.state == str(state)).sum())
        for state in (ObjectState.MOVING, ObjectState.STOPPED)
    }
    return ", ".join(f"{count} {state}" for state, count in counts.items() if count)


def place_labels(
    objects: ObjectEstimates,
    labels: NDArray[np.int32] | None,
    shape: tuple[int, ...],
    top_px: int,
) -> list[Label]:
    """Where labels go on an image of (H, W) = shape[:2]: inside it, and none over another.

    Those of moving objects choose first, large ones before small ones, and look further and further
    away until they find room; the others stay away where there is none near them, or where the
    object is lower than its label.
    """
    H, W = shape[:2]
    large = int(np.clip(min(H / 24.0, W / 46.0), 11, 22))
    boxes = [object_box(objects, row, labels) for row in range(len(objects))]
    rank = {state: n for n, state in enumerate(ORDER)}
    rows = [row for row, box in enumerate(boxes) if box is not None]
    rows.sort(key=lambda row: (rank[_state(objects.state[row])], -_area(boxes[row])))
    movers = [_whole(boxes[row]) for row in rows if objects.state[row] == str(ObjectState.MOVING)]
    placed: list[Label] = []
    for row in rows:
        state, text = _state(objects.state[row]), label_text(objects, row)
        moves = state is ObjectState.MOVING
        size_px = large if moves else max(11, round(0.82 * large))
        width = style.text_size(text, size_px, 600 if moves else 400)[0]
        size = (width + round(0.7 * size_px) + (0 if moves else 3), round(1.35 * size_px))
        own = _whole(boxes[row])
        least = size[1] * (2 if state is ObjectState.UNKNOWN else 1)
        if not moves and state is not ObjectState.COASTING and own[3] - own[1] < least:
            continue  # a parked car far away: its label would hide more than it tells
        others = [box for box in movers if box != own]
        taken = [label.box for label in placed]
        places = [p for p in _near_places(own, size, (W, H), top_px) if not overlaps(p, taken)]
        # Rather a place that hides no other moving object, but rather such a one than none.
        clear = [p for p in places if not overlaps(p, others)]
        far = _far_places(own, size, (W, H), top_px) if moves and not places else iter(())
        box = next(iter(clear or places), None) or next(
            (p for p in far if not overlaps(p, taken)), None
        )
        if box is not None:
            placed.append(Label(int(objects.object_id[row]), text, box, size_px, state))
    return placed


def object_box(
    objects: ObjectEstimates, row: int, labels: NDArray[np.int32] | None
) -> Array | None:
    """The box (4,) of a row, else that of its mask, else None."""
    box = objects.boxes_px[row]
    if np.isfinite(box).all():
        return np.asarray(box)
    if labels is None:
        return None
    v, u = np.nonzero(labels == objects.object_id[row])
    return np.array([u.min(), v.min(), u.max(), v.max()], float) if len(u) else None


def _near_places(own: Box, size: tuple[int, int], image: tuple[int, int], top: int) -> list[Box]:
    """Above, below, inside, then one step further up and down; pushed into the image."""
    (u0, v0, u1, v1), (w, h) = own, size
    rows = [v0 - h - 2, v1 + 2, v0 + 3, v1 - h - 3, v0 - 2 * h - 4, v1 + h + 4]
    columns = [u0, u1 - w, (u0 + u1 - w) // 2]
    inside = [_pushed((u, v, u + w, v + h), image, top) for v in rows[:2] for u in columns]
    return inside + [_pushed((u, v, u + w, v + h), image, top) for v in rows[2:] for u in columns]


def _far_places(own: Box, size: tuple[int, int], image: tuple[int, int], top: int) -> Iterator[Box]:
    """The whole image in steps of half a label, those nearest to the object first."""
    (W, H), (w, h) = image, size
    v, u = np.mgrid[top : max(H - h, top) + 1 : max(h // 2, 1), 0 : max(W - w, 0) + 1 : max(h, 1)]
    centre = np.array([(own[0] + own[2] - w) / 2.0, (own[1] + own[3] - h) / 2.0])
    distance = np.hypot(u.ravel() - centre[0], v.ravel() - centre[1])
    for n in np.argsort(distance, kind="stable"):
        left, upper = int(u.ravel()[n]), int(v.ravel()[n])
        yield _pushed((left, upper, left + w, upper + h), image, top)


def _pushed(box: Box, image: tuple[int, int], top: int) -> Box:
    u0, v0, u1, v1 = box
    u = int(np.clip(u0, 0, max(image[0] - (u1 - u0), 0)))
    v = int(np.clip(v0, top, max(image[1] - (v1 - v0), top)))
    return u, v, u + u1 - u0, v + v1 - v0


def overlaps(box: Box, others: list[Box]) -> bool:
    """Whether `box` shares a pixel with one of the others."""
    return any(box[0] < o[2] and o[0] < box[2] and box[1] < o[3] and o[1] < box[3] for o in others)


def _whole(box: Any) -> Box:
    u0, v0, u1, v1 = (round(float(x)) for x in box)
    return u0, v0, u1 + 1, v1 + 1


def _area(box: Any) -> float:
    return float((box[2] - box[0]) * (box[3] - box[1]))


def _state(value: Any) -> ObjectState:
    return ObjectState(str(value)) if value is not None else ObjectState.UNKNOWN


def _draw_dashed(canvas: Image, low: tuple[int, int], high: tuple[int, int], color: Any) -> None:
    import cv2

    corners = [low, (high[0], low[1]), high, (low[0], high[1])]
    for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
        start, step = np.array(a, float), np.array(b, float) - a
        length = float(np.hypot(*step))
        for at in np.arange(0.0, length, DASH_PX + GAP_PX):
            p = start + step * (at / length)
            q = start + step * (min(at + DASH_PX, length) / length)
            ends = tuple(np.round(p).astype(int).tolist()), tuple(np.round(q).astype(int).tolist())
            cv2.line(canvas, *ends, color, 2, cv2.LINE_AA)
