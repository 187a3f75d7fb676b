"""Smooth lines in space over a picture, cut where they pass behind the view.

Owns their drawing. They lie over the points whatever the depth: a path must be seen whole.
"""

from __future__ import annotations

import numpy as np

from pipelines.types import Array, Image
from viz import style
from viz.scene import Polyline, View

NEAR_M = 0.05
DASH_PX, GAP_PX = 8.0, 6.0
_FAR_PX = 1e5  # what is beyond would overflow the drawing's fixed point numbers


def draw_polyline(
    picture: Image, view: View, line: Polyline, *, dark: bool = False, opacity: float = 1.0
) -> None:
    """Draw a smooth line over the picture, cut off where it passes behind the view."""
    import cv2

    scale = line_scale(view)
    color = style.on_dark(line.color) if dark else line.color
    if opacity < 1.0:
        ground = np.array(style.BACKGROUNDS["black" if dark else "white"])
        mixed = np.round(opacity * np.array(color) + (1.0 - opacity) * ground)
        color = tuple(int(c) for c in mixed)
    # A path that has a name stays legible in the smallest picture.
    width_px = max(2 if line.label else 1, round(line.width_px * scale))
    for points_m in _visible(line, view):
        uv, _ = view.project(points_m)
        fixed = _fixed(uv).reshape(-1, 1, 2)
        cv2.polylines(picture, [fixed], False, color, width_px, cv2.LINE_AA, 4)


def draw_segment(
    picture: Image,
    view: View,
    ends_px: Array,
    color: style.Color,
    width_px: float,
    *,
    dashed: bool = False,
) -> None:
    """A straight line between two pixels (2, 2), as wide as a line of `draw_polyline`."""
    import cv2

    thick = max(1, round(width_px * line_scale(view)))
    length = float(np.hypot(*(ends_px[1] - ends_px[0])))
    step = (DASH_PX + GAP_PX) / length if dashed and 0 < length < _FAR_PX else 1.0
    dash = step * DASH_PX / (DASH_PX + GAP_PX) if step < 1.0 else 1.0
    for at in np.arange(0.0, 1.0 - 1e-9, step):
        ends = np.array([at, min(at + dash, 1.0)])[:, None]
        a, b = _fixed(ends_px[0] + ends * (ends_px[1] - ends_px[0])).tolist()
        cv2.line(picture, a, b, color, thick, cv2.LINE_AA, 4)


def line_scale(view: View) -> float:
    """How much wider than named lines are drawn, so that large pictures look like small ones."""
    return max(view.size[0] / 1280.0, 0.5)


def _fixed(uv_px: Array) -> Array:
    """Pixels as OpenCV takes them, in sixteenths."""
    return np.round(np.clip(uv_px, -_FAR_PX, _FAR_PX) * 16).astype(np.int32)


def _visible(line: Polyline, view: View) -> list[Array]:
    """Pieces of the line in front of the view, cut at NEAR_M."""
    points = line.points_m
    z = view.project(points)[1] - NEAR_M
    if (z > 0).all():
        return [points]
    pieces: list[list[Array]] = [[]]
    for k in range(len(points)):
        if k and (z[k] > 0) != (z[k - 1] > 0):
            share = z[k - 1] / (z[k - 1] - z[k])
            pieces[-1].append(points[k - 1] + (share + 1e-9) * (points[k] - points[k - 1]))
            if z[k] <= 0:
                pieces.append([])
        if z[k] > 0:
            pieces[-1].append(points[k])
    return [np.array(piece) for piece in pieces if len(piece) > 1]
