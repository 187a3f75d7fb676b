"""What explains a map picture: title, legend and scale bar.

Owns words over a drawn map; those at places in it are the tags'. Knows no renderer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from pipelines.io.result import Result
from pipelines.types import Image
from viz import style
from viz.figures import digits
from viz.lines import draw_segment
from viz.object_marks import Box
from viz.scene import Polyline, Scene, View

BAR_STEPS = (1.0, 2.0, 5.0)
MOST_COLORS = 4  # in the sample of a legend entry for lines of many colours


@dataclass(frozen=True, slots=True)
class KeyEntry:
    """A line of the legend: words beside a sample of the line that they explain."""

    label: str
    colors: tuple[style.Color, ...]
    width_px: float
    dashed: bool = False


def draw_legend(
    picture: Image, scene: Scene, view: View, result: Result, *, dark: bool = False
) -> list[Box]:
    """Title at the top left, legend below, scale bar at the bottom right where there is a scale.

    Returns the parts of the picture (u0, v0, u1, v1) that they take.
    """
    entries: dict[str, list[Polyline]] = {}
    for line in scene.polylines:
        if line.label:
            entries.setdefault(line.label, []).append(line)
    key = [
        KeyEntry(label, tuple(line.color for line in lines), lines[0].width_px)
        for label, lines in reversed(entries.items())
    ]
    title = draw_title(picture, view, title_lines(result), dark=dark)
    return [title, *draw_key_and_scale(picture, view, key, scene, dark=dark)]


def draw_key_and_scale(
    picture: Image, view: View, key: Sequence[KeyEntry], scene: Scene, *, dark: bool = False
) -> list[Box]:
    """Legend at the bottom left, or right where paths lead through there; scale bar opposite.

    A view that follows the camera has it at the left always. Returns the parts that they take.
    """
    at_right = not view.follows and _is_left_crowded(scene, view, len(key))
    taken = draw_key(picture, view, key, at_right=at_right, dark=dark)
    if view.px_per_m is not None:
        taken.append(_draw_scale_bar(picture, view, dark, at_left=at_right))
    return taken


def _is_left_crowded(scene: Scene, view: View, n_rows: int) -> bool:
    """Whether paths lead through the place at the bottom left, and fewer at the right."""
    text_px, margin = _sizes(view)
    W, H = view.size
    paths = np.concatenate(
        [line.points_m for line in scene.polylines if line.label] or [scene.path_m]
    )
    uv, depth = view.project(paths)
    low = (depth > 0) & (uv[:, 1] > H - 2 * margin - 1.6 * text_px * n_rows)
    left, right = (low & (uv[:, 0] < 0.25 * W)).sum(), (low & (uv[:, 0] > 0.75 * W)).sum()
    return bool(left > right)


def draw_points_legend(picture: Image, view: View, result: Result, *, dark: bool = False) -> None:
    """What stands on a picture of the points alone: whose they are, and how large the map is."""
    name, facts = title_lines(result)[:2]
    points = next(fact for fact in facts.split(",  ") if fact.endswith("map points"))
    draw_title(picture, view, [name, f"static map,  {points}"], dark=dark)
    if view.px_per_m is not None:
        _draw_scale_bar(picture, view, dark)


def scale_bar_m(px_per_m: float, longest_px: float) -> float:
    """The longest of 1, 2, 5, 10, ... metres (or 0.5, 0.2, ...) that fits `longest_px`."""
    power = 10.0 ** np.floor(np.log10(longest_px / px_per_m))
    return float(max(s * power for s in BAR_STEPS if s * power * px_per_m <= longest_px * 1.0001))


def title_lines(result: Result) -> list[str]:
    """The run and, where the truth is known, its errors, in words."""
    run: dict[str, Any] = result.metrics.get("run", {})
    camera: dict[str, Any] = result.metrics.get("camera", {})
    frames = len(result.timestamps_s)
    of = f" of {run['frames']}" if run.get("frames") else ""
    lines = [str(run.get("sequence") or result.folder.name)]
    facts = [f"{frames}{of} frames tracked", f"{len(result.static_points_m):,} map points"]
    if camera.get("path_length_m") is not None:
        facts.append(f"{camera['path_length_m']:.1f} m of path")
    lines.append(",  ".join(facts))
    if camera.get("ate_rmse_m") is not None and camera.get("rpe_trans_rmse_m") is not None:
        lines.append(
            f"ATE {digits(100 * camera['ate_rmse_m'])} cm,  "
            f"RPE {digits(100 * camera['rpe_trans_rmse_m'])} cm and "
            f"{digits(camera['rpe_rot_rmse_deg'])}° a frame"
        )
    return lines


def text_size_px(view: View) -> int:
    """Size of words over a map picture, legible whatever the picture's size."""
    W = view.size[0]
    return int(np.clip(max(W / 75.0, min(15.0, W / 50.0)), 11, 40))


def _sizes(view: View) -> tuple[int, int]:
    """Text size and margin in pixels."""
    text = text_size_px(view)
    return text, round(1.2 * text)


def _inks(dark: bool) -> tuple[style.Color, style.Color]:
    """The colours of words, and of the panels beneath them."""
    return (style.WHITE if dark else style.INK), style.BACKGROUNDS["black" if dark else "white"]


def draw_title(
    picture: Image, view: View, lines: list[str], *, large: bool = True, dark: bool = False
) -> Box:
    """Lines of text at the top left, the first `large` or not; the part that they take."""
    ink, panel = _inks(dark)
    text_px, margin = _sizes(view)
    sizes = [round((1.35 if large else 1.0) * text_px)] + [text_px] * (len(lines) - 1)
    weights = [600 if large else 400] + [400] * (len(lines) - 1)
    widths = [style.text_size(*args)[0] for args in zip(lines, sizes, weights, strict=True)]
    height = sum(round(1.45 * size) for size in sizes)
    pad = round(0.6 * text_px)
    box = (0, 0, margin + max(widths) + pad, margin + height + pad // 2)
    style.draw_panel(picture, box, panel)
    v = margin
    for line, size, weight in zip(lines, sizes, weights, strict=True):
        v += round(1.45 * size)
        style.draw_text(picture, line, (margin, v - round(0.45 * size)), size, ink, weight)
    return box


def draw_key(
    picture: Image,
    view: View,
    key: Sequence[KeyEntry],
    *,
    at_right: bool = False,
    dark: bool = False,
) -> list[Box]:
    """The legend at the bottom left or right; the part that it takes."""
    if not key:
        return []
    ink, panel = _inks(dark)
    text_px, margin = _sizes(view)
    step, sample = round(1.6 * text_px), round(2.6 * text_px)
    width = sample + text_px + max(style.text_size(entry.label, text_px)[0] for entry in key)
    top = view.size[1] - margin - step * len(key)
    pad = round(0.6 * text_px)
    left_px = view.size[0] - margin - width if at_right else margin
    # Panels reach to the picture's edge, so that no stump of a line peeps out beside them.
    sides = (left_px - pad, view.size[0]) if at_right else (0, left_px + width)
    box = (sides[0], top - pad // 2, sides[1], view.size[1])
    style.draw_panel(picture, box, panel)
    for row, entry in enumerate(key):
        v = top + row * step + step // 2
        most = 2 if entry.dashed else MOST_COLORS  # a dash needs room to be one
        colors = list(dict.fromkeys(entry.colors))[:most]
        at_px = np.linspace(left_px, left_px + sample, len(colors) + 1)
        for color, left, right in zip(colors, at_px, at_px[1:], strict=False):
            shown = style.on_dark(color) if dark else color
            ends = np.array([[left, v], [right, v]])
            draw_segment(picture, view, ends, shown, entry.width_px, dashed=entry.dashed)
        at = (left_px + sample + text_px // 2, v + round(0.36 * text_px))
        style.draw_text(picture, entry.label, at, text_px, ink)
    return [box]


def _draw_scale_bar(picture: Image, view: View, dark: bool, *, at_left: bool = False) -> Box:
    import cv2

    assert view.px_per_m is not None
    ink, panel = _inks(dark)
    text_px, margin = _sizes(view)
    W, H = view.size
    length_m = scale_bar_m(view.px_per_m, 0.22 * W)
    length_px = round(length_m * view.px_per_m)
    left = margin if at_left else W - margin - length_px
    right, v = left + length_px, H - margin - text_px // 4
    pad = round(0.6 * text_px)
    box = (left - pad, v - 2 * text_px - pad // 2, right + pad, v + pad)
    style.draw_panel(picture, box, panel)
    tick, thick = text_px // 3, max(2, text_px // 7)
    for a, b in (
        ((left, v), (right, v)),
        ((left, v - tick), (left, v + tick)),
        ((right, v - tick), (right, v + tick)),
    ):
        cv2.line(picture, a, b, ink, thick, cv2.LINE_AA)
    label = f"{length_m:g} m"
    at = ((left + right - style.text_size(label, text_px)[0]) // 2, v - round(0.6 * text_px))
    style.draw_text(picture, label, at, text_px, ink)
    return box
