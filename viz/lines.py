"""Smooth lines in space over a picture, cut where they pass behind the view.

Owns their drawing. They lie over the points whatever the depth: a path must be seen whole.
"""

from __future__ import annotations

import numpy as np

from pipelines.types import Array, Image
from viz import style
from viz.scene import Polyline, View

NEAR_M = 0.05


def draw_polyline(picture: Image, view: View, line: Polyline, *, dark: bool = False) -> None:
    """Draw a smooth line over the picture, cut off where it passes behind the view."""
    import cv2

    scale = line_scale(view)
    color = style.on_dark(line.color) if dark else line.color
    # A path that has a name stays legible in the smallest picture.
    width_px = max(2 if line.label else 1, round(line.width_px * scale))
    for points_m in _visible(line, view):
        uv, _ = view.project(points_m)
        fixed = np.round(np.clip(uv, -1e5, 1e5) * 16).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(picture, [fixed], False, color, width_px, cv2.LINE_AA, 4)


def line_scale(view: View) -> float:
    """How much wider than named lines are drawn, so that large pictures look like small ones."""
    return max(view.size[0] / 1280.0, 0.5)


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
