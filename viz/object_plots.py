"""Diagrams of moving objects: speeds against the truth, errors of motion, who was seen when.

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
from viz.figures import metric_unit, two_digits, whole_ticks
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
    ids = moving_ids(objects)
    shown = sorted(ids[:MOST_SPEEDS])
    columns = min(3, len(shown))
    lines = -(-len(shown) // columns)
    figure.set_size_inches(figure.get_figwidth(), 1.5 + 2.1 * lines)
    grid = figure.subplots(lines, columns, sharex=True, squeeze=False)
    start_s = float(objects.timestamp_s.min())
    truths = _true_speeds(result, shown)
    for axes, object_id in zip(grid.ravel(), shown, strict=False):
        own = objects[objects.object_id == object_id]
        _plot_speed(axes, own, start_s, truths.get(object_id))
    for axes in grid.ravel()[len(shown) :]:
        axes.set_axis_off()
    for column in range(columns):
        lowest = [row for row in range(lines) if row * columns + column < len(shown)][-1]
        grid[lowest, column].set_xlabel("time (s)")
        grid[lowest, column].tick_params(labelbottom=True)
    for row in grid:
        row[0].set_ylabel("km/h")
    _explain_speeds(figure, with_truth=bool(truths))
    more = f" (the {len(shown)} that moved longest, of {len(ids)})" if len(ids) > len(shown) else ""
    figure.suptitle(f"Speed of moving objects{more}", fontsize=12)


def _plot_speed(
    axes: Any, own: ObjectEstimates, start_s: float, truth: tuple[Array, Array] | None
) -> None:
    """The rows of one object; what is only predicted is drawn fainter."""
    object_id = int(own.object_id[0])
    color = style.object_color(object_id)
    seconds, filtered = own.timestamp_s - start_s, KMH * own.smoothed_speed_mps
    low, high = _interval(own)
    seen = own.state != str(ObjectState.COASTING)
    predicted = ~seen | np.append(~seen[1:], False)  # from the last frame in which it was seen
    for which, alpha, line in ((predicted, 0.1, ":"), (seen, 0.28, "-")):
        axes.fill_between(
            seconds, low, high, where=which, color=hex_color(color), alpha=alpha, lw=0
        )
        known = np.where(which, filtered, np.nan)
        axes.plot(seconds, known, color=hex_color(color), lw=1.7, ls=line)
    measured = np.where(own.state == str(ObjectState.MOVING), KMH * own.speed_mps, np.nan)
    axes.plot(seconds, measured, ".", color=hex_color(_darker(color)), ms=4, mew=0)
    if truth is not None:
        axes.plot(truth[0] - start_s, truth[1], "--", color=hex_color(style.TRUTH), lw=1.4)
    axes.set_title(f"{object_id} {own.class_name[-1]}", fontsize=10.5, loc="left")
    axes.set_ylim(*_limits_kmh(measured, np.where(seen, filtered, np.nan), truth))


def _explain_speeds(figure: Any, with_truth: bool) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    color = hex_color(style.ESTIMATE)
    interval = Patch(color=color, alpha=0.28, lw=0)
    line = Line2D([], [], color=color, lw=1.7)
    dot = Line2D([], [], color=hex_color(_darker(style.ESTIMATE)), marker=".", ls="", ms=7)
    entries: dict[str, Any] = {
        "filter, with its 95 % interval": (interval, line),
        "measured, eq. (6)": dot,
        "not seen, predicted": Line2D([], [], color=color, lw=1.7, ls=":"),
    }
    if with_truth:
        entries["truth"] = Line2D([], [], color=hex_color(style.TRUTH), lw=1.4, ls="--")
    figure.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=len(entries)
    )


def judged_objects(result: Result) -> list[dict[str, Any]]:
    """Those of metrics.json's objects whose motion was compared with the truth, the first first."""
    blocks = result.metrics.get("objects", {}).get("per_object", {}).values()
    judged = [block for block in blocks if block["object_frames"] > 0]
    return sorted(judged, key=lambda block: _own_ids(block)[0])


def _own_ids(block: dict[str, Any]) -> list[int]:
    """The ids that a true object's motion was told under."""
    return list(block.get("scored_ids") or block["estimated_ids"])


def plot_object_motion(figure: Any, result: Result) -> None:
    """Two bars an object, its motion's RMSE in translation and in rotation, with the median."""
    judged = judged_objects(result)
    most = sorted(judged, key=lambda block: -block["object_frames"])[:MOST_ROWS]
    shown = [block for block in judged if block in most]
    figure.set_size_inches(figure.get_figwidth(), 1.7 + 0.32 * len(shown))
    left, right = figure.subplots(1, 2, sharey=True)
    labels, colors = [], []
    for block in shown:
        ids = _own_ids(block)
        frames = f"{block['object_frames']} frame{'s' * (block['object_frames'] > 1)}"
        own_class = result.objects.class_name[result.objects.object_id == ids[0]][-1:]
        name = next(iter(own_class), block["class_name"])  # as this object is called elsewhere
        labels.append(f"{'+'.join(map(str, ids))} {name}, {frames}")
        colors.append(hex_color(style.object_color(ids[0])))
    factor, unit = metric_unit(np.array([block["trans_rmse_m"] for block in shown]))
    for axes, name, scale, words in (
        (left, "trans_{}_m", factor, f"translation ({unit} a frame)"),
        (right, "rot_{}_deg", 1.0, "rotation (deg a frame)"),
    ):
        rmse = scale * np.array([block[name.format("rmse")] for block in shown])
        medians = [block.get(name.format("median")) for block in shown]
        median = scale * np.array([np.nan if m is None else m for m in medians])
        rows = np.arange(len(shown))
        axes.barh(rows, rmse, color=colors, height=0.7)
        for ink, width in ((style.WHITE, 4.0), (style.INK, 1.8)):  # seen on any bar
            axes.plot(median, rows, "|", color=hex_color(ink), ms=12 + width, mew=width)
        ends = np.fmax(rmse, median)
        for row, value in enumerate(rmse):
            at = (ends[row], row)
            axes.annotate(two_digits(value), at, (5, 0), textcoords="offset points", va="center")
        axes.set(xlabel=words, xlim=(0.0, 1.2 * max(*ends, 1e-9)), ylim=(len(shown) - 0.4, -0.6))
        axes.grid(visible=False, axis="y")
    left.set_yticks(range(len(labels)), labels)
    right.tick_params(labelleft=False)
    figure.suptitle(
        f"Motion error of moving objects{_left_out(result, judged, shown)}", fontsize=12
    )
    _explain_motion(figure)


def _left_out(result: Result, judged: list[Any], shown: list[Any]) -> str:
    """In brackets, which objects have no bars."""
    blocks = result.metrics["objects"]["per_object"].values()
    unsolved = sum(block["moves"] and block["object_frames"] == 0 for block in blocks)
    words = [f"the {len(shown)} longest of {len(judged)}"] if len(judged) > len(shown) else []
    if unsolved:
        words.append(f"{unsolved} more moved, with no motion told")
    return f" ({'; '.join(words)})" if words else ""


def _explain_motion(figure: Any) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    ink = hex_color(style.INK)
    handles = [
        Patch(color=hex_color(style.ESTIMATE), label="RMSE (number)"),
        Line2D([], [], color=ink, marker="|", ls="", ms=12, mew=1.6, label="median"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)


def plot_object_timeline(figure: Any, result: Result) -> None:
    """A bar an object over the frames it was known in; what it did then is the shade."""
    objects = result.objects
    ids, counts = np.unique(objects.object_id, return_counts=True)
    longest = np.sort(ids[np.argsort(-counts, kind="stable")[:MOST_ROWS]])
    figure.set_size_inches(figure.get_figwidth(), 1.6 + 0.26 * len(longest))
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
                # The edge lets pale shades stand out from the page.
                edge = hex_color(_mixed(color, 0.6))
                axes.broken_barh(spans, (row - 0.36, 0.72), facecolor=shade, edgecolor=edge, lw=0.5)
    axes.set_yticks(range(len(names)), names, fontsize=9)
    axes.set_ylim(len(names) - 0.4, -0.6)
    axes.grid(visible=False, axis="y")
    more = f" (the {len(longest)} longest of {len(ids)})" if len(ids) > len(longest) else ""
    axes.set(xlabel="frame", title=f"Which objects were tracked when{more}")
    axes.margins(x=0.01)
    whole_ticks(axes.xaxis)
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
    """By own id, stamps and speeds in km/h of the true object that it showed while it moved."""
    if result.gt_objects is None or len(result.gt_objects) == 0:
        return {}
    truth, frames = result.gt_objects, processed_frames(result)
    limits = ObjectLimits()
    steps = true_steps(truth, frames, limits)
    row = match_objects(result.objects, truth, steps.is_judged, limits.min_overlap).truth_row
    stamp_of = dict(zip(frames.index.tolist(), frames.timestamp_s.tolist(), strict=True))
    speeds = {}
    moving = result.objects.state == str(ObjectState.MOVING)
    for object_id in object_ids:
        rows = row[(result.objects.object_id == object_id) & (row >= 0) & moving]
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


def _limits_kmh(
    measured: Array, smoothed: Array, truth: tuple[Array, Array] | None
) -> tuple[float, float]:
    """Limits that show all but a few wild values, from 0 unless all are far from it."""
    values = np.concatenate([measured, smoothed, *([truth[1]] if truth else [])])
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return 0.0, 1.0
    low, high = np.quantile(values, (0.02, 0.98))
    top = 1.15 * float(high) + 1.0
    bottom = min(float(low) - 0.15 * top, 0.6 * top)
    return (bottom if bottom > 0.3 * top else 0.0), top


def _stretches(frames: NDArray[np.int64], result: Result) -> list[tuple[float, float]]:
    """First and last frame of each run of neighbouring processed frames."""
    if len(frames) == 0:
        return []
    all_frames = np.unique(result.timings.get("frames_index") or result.objects.frame_index)
    at = np.searchsorted(all_frames, np.sort(frames))
    pieces = np.split(at, np.flatnonzero(np.diff(at) > 1) + 1)
    return [(float(all_frames[piece[0]]), float(all_frames[piece[-1]])) for piece in pieces]


def _darker(color: style.Color) -> style.Color:
    r, g, b = (round(0.6 * channel) for channel in color)
    return r, g, b


def _mixed(color: style.Color, share: float) -> style.Color:
    r, g, b = (round(share * channel + (1.0 - share) * 255) for channel in color)
    return r, g, b
