"""Diagrams of moving objects: their speeds against the truth, and who was seen when.

Owns what is drawn into figures that `plots` makes and saves. Colours are those of the frames.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.evaluation.folder import processed_frames
from pipelines.evaluation.object_matching import match_objects
from pipelines.evaluation.object_truth import ObjectLimits, true_steps
from pipelines.io.result import Result
from pipelines.object_types import ObjectEstimates, ObjectState
from pipelines.types import Array
from viz import style
from viz.style import hex_color

KMH = 3.6
INTERVAL_95 = 1.96
MIN_MOVING_FRAMES = 5  # fewer are no track to draw
MOST_SPEEDS, MOST_ROWS = 9, 40
# How much of an object's colour a state keeps; the rest is white.
SHADES = {ObjectState.MOVING: 1.0, ObjectState.STOPPED: 0.42, ObjectState.UNKNOWN: 0.2}


def moving_ids(objects: ObjectEstimates) -> list[int]:
    """Ids of the objects that moved for some frames, those that moved the longest first."""
    ids, counts = np.unique(
        objects.object_id[objects.state == str(ObjectState.MOVING)], return_counts=True
    )
    order = np.argsort(-counts, kind="stable")
    return [int(ids[n]) for n in order if counts[n] >= MIN_MOVING_FRAMES]


def plot_object_speeds(figure: Any, result: Result) -> None:
    """A small diagram an object: eq. (6)'s speed, the filter's with its interval, and the truth."""
    objects = result.objects
    shown = sorted(moving_ids(objects)[:MOST_SPEEDS])
    columns = min(3, len(shown))
    lines = -(-len(shown) // columns)
    figure.set_size_inches(9.0, 1.4 + 2.1 * lines)
    grid = figure.subplots(lines, columns, sharex=True, squeeze=False)
    start_s = float(objects.timestamp_s.min())
    truths = _true_speeds(result, shown)
    for axes, object_id in zip(grid.ravel(), shown, strict=False):
        own = objects[objects.object_id == object_id]
        seconds, color = own.timestamp_s - start_s, hex_color(style.object_color(object_id))
        low, high = _interval(own)
        axes.fill_between(seconds, low, high, color=color, alpha=0.25, lw=0)
        axes.plot(seconds, KMH * own.smoothed_speed_mps, color=color, lw=1.6, label="filter, 95 %")
        measured = np.where(own.state == str(ObjectState.MOVING), KMH * own.speed_mps, np.nan)
        axes.plot(seconds, measured, ".", color=color, ms=5, mec="white", mew=0.4, label="eq. (6)")
        if object_id in truths:
            stamps, speeds = truths[object_id]
            axes.plot(stamps - start_s, speeds, "--", color="#1c1c20", lw=1.1, label="truth")
        axes.set_title(f"{object_id} {own.class_name[-1]}", fontsize=10.5, loc="left")
        axes.set_ylim(0.0, _top_kmh(measured, KMH * own.smoothed_speed_mps, truths.get(object_id)))
    for axes in grid.ravel()[len(shown) :]:
        axes.set_axis_off()
    for column in range(columns):
        lowest = [row for row in range(lines) if row * columns + column < len(shown)][-1]
        grid[lowest, column].set_xlabel("time (s)")
        grid[lowest, column].tick_params(labelbottom=True)
    for row in grid:
        row[0].set_ylabel("km/h")
    entries: dict[str, Any] = {}
    for axes in grid.ravel():
        handles, names = axes.get_legend_handles_labels()
        entries |= dict(zip(names, handles, strict=True))
    figure.legend(entries.values(), entries.keys(), loc="outside lower center", ncols=3)
    figure.suptitle("Speed of moving objects")


def plot_object_timeline(figure: Any, result: Result) -> None:
    """A bar an object over the frames it was known in; what it did then is the shade."""
    objects = result.objects
    ids, counts = np.unique(objects.object_id, return_counts=True)
    longest = np.sort(ids[np.argsort(-counts, kind="stable")[:MOST_ROWS]])
    figure.set_size_inches(9.0, 1.6 + 0.26 * len(longest))
    axes = figure.subplots()
    names = []
    for row, object_id in enumerate(longest.tolist()):
        own = objects[objects.object_id == object_id]
        names.append(f"{object_id} {own.class_name[-1]}")
        color = style.object_color(object_id)
        for state, frames in ((s, own.frame_index[own.state == str(s)]) for s in ObjectState):
            spans = [(a - 0.5, b - a + 1.0) for a, b in _stretches(frames, result)]
            if state is ObjectState.COASTING:
                axes.broken_barh(spans, (row - 0.09, 0.18), color=hex_color(color), lw=0)
            else:
                shade = hex_color(_mixed(color, SHADES[state]))
                axes.broken_barh(spans, (row - 0.36, 0.72), color=shade, lw=0)
    axes.set_yticks(range(len(names)), names, fontsize=9)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    more = f" (the {len(longest)} longest of {len(ids)})" if len(ids) > len(longest) else ""
    axes.set(xlabel="frame", title=f"Which objects were tracked when{more}")
    _explain_shades(figure)


def _explain_shades(figure: Any) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    ink = style.ESTIMATE
    handles: list[Any] = [
        Patch(color=hex_color(_mixed(ink, share)), label=str(state))
        for state, share in SHADES.items()
    ]
    handles.append(Line2D([], [], color=hex_color(ink), lw=2.0, label="not seen, predicted"))
    figure.legend(handles=handles, loc="outside lower center", ncols=4)


def _true_speeds(result: Result, object_ids: list[int]) -> dict[int, tuple[Array, Array]]:
    """By own id, stamps and speeds in km/h of the true object that it showed most often."""
    if result.gt_objects is None or len(result.gt_objects) == 0:
        return {}
    truth, frames = result.gt_objects, processed_frames(result)
    limits = ObjectLimits()
    steps = true_steps(truth, frames, limits)
    row = match_objects(result.objects, truth, steps.is_judged, limits.min_overlap).truth_row
    stamp_of = dict(zip(frames.index.tolist(), frames.timestamp_s.tolist(), strict=True))
    speeds = {}
    for object_id in object_ids:
        rows = row[(result.objects.object_id == object_id) & (row >= 0)]
        if len(rows) == 0:
            continue
        ids, counts = np.unique(truth.object_id[rows], return_counts=True)
        own = np.flatnonzero((truth.object_id == ids[counts.argmax()]) & steps.is_judged)
        stamps = np.array([stamp_of.get(int(k), np.nan) for k in truth.frame_index[own]])
        speeds[object_id] = stamps, steps.speed_kmh[own]
    return speeds


def _interval(own: ObjectEstimates) -> tuple[Array, Array]:
    speed, std = own.smoothed_speed_mps, own.velocity_std_mps
    return KMH * np.maximum(speed - INTERVAL_95 * std, 0.0), KMH * (speed + INTERVAL_95 * std)


def _top_kmh(measured: Array, smoothed: Array, truth: tuple[Array, Array] | None) -> float:
    """An upper limit that shows all but a few wild values."""
    values = np.concatenate([measured, smoothed, *([truth[1]] if truth else [])])
    values = values[np.isfinite(values)]
    return 1.25 * float(np.quantile(values, 0.98)) + 1.0 if len(values) else 1.0


def _stretches(frames: NDArray[np.int64], result: Result) -> list[tuple[float, float]]:
    """First and last frame of each run of neighbouring processed frames."""
    if len(frames) == 0:
        return []
    all_frames = np.unique(result.timings.get("frames_index") or result.objects.frame_index)
    at = np.searchsorted(all_frames, np.sort(frames))
    pieces = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
    return [(float(all_frames[piece[0]]), float(all_frames[piece[-1]])) for piece in pieces]


def _mixed(color: style.Color, share: float) -> style.Color:
    r, g, b = (round(share * channel + (1.0 - share) * 255) for channel in color)
    return r, g, b
