"""Diagrams of a result: the table of what there is, and those of the camera and of time.

Owns which diagram a result allows. `object_plots` draws the objects, `figures` makes the paper.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.errors import DyObError
from pipelines.evaluation.camera import align, associate, relative_errors
from pipelines.evaluation.folder import truth_by_frame
from pipelines.geometry import rotation_angle_deg
from pipelines.io import folder as names
from pipelines.io.files import disk_error
from pipelines.io.result import Result, load_result
from pipelines.io.timings import TOTAL, WALL, stage_summaries
from pipelines.types import Array
from viz import object_plots, style
from viz.figures import digits, metric_unit, new_figure, save_figure, whole_ticks
from viz.scene import level_axes
from viz.style import hex_color as _hex

STILL_M = 0.05  # to either side is shown at the least
FEW_FRAMES = 20  # each has a mark
SHOWN_MS = 0.05  # a stage that takes less, such as reading depth that is given, has no bar


@dataclass(frozen=True, slots=True)
class Plot:
    """A diagram: the function that draws it, and whether a result has what it needs."""

    draw: Callable[[Any, Result], None]
    is_possible: Callable[[Result], bool]
    needs: str


def plot_result(folder: Path | str) -> list[Path]:
    """Write plots/NAME.png of a result folder, those of PLOTS that its files allow; the paths.

    Raises FormatError for a damaged folder.
    """
    result = load_result(folder)
    target = result.folder / names.PLOTS
    try:
        target.mkdir(exist_ok=True)
    except OSError as error:
        raise DyObError(disk_error(target, error)) from error
    written = []
    for name in possible_plots(result):
        save_figure(figure_of(result, name), target / f"{name}.png")
        written.append(target / f"{name}.png")
    return written


def possible_plots(result: Result) -> list[str]:
    """Names of the diagrams that a result allows, in the order of PLOTS."""
    return [name for name, plot in PLOTS.items() if plot.is_possible(result)]


def figure_of(result: Result | Path | str, name: str) -> Any:
    """The diagram `name` of PLOTS as a matplotlib figure; no file is written.

    A notebook shows it where it is the last value of a cell. Raises DyObError for an unknown name
    and where the result lacks what it needs.
    """
    if name not in PLOTS:
        raise DyObError(f"expected a diagram of {', '.join(PLOTS)}, found '{name}'; name one")
    if not isinstance(result, Result):
        result = load_result(result)
    if not PLOTS[name].is_possible(result):
        raise DyObError(
            f"{result.folder}: the diagram '{name}' needs {PLOTS[name].needs}, and this result has "
            f"none; it allows {', '.join(possible_plots(result)) or 'no diagram'}"
        )
    with new_figure() as figure:
        PLOTS[name].draw(figure, result)
    return figure


def plot_trajectory(figure: Any, result: Result) -> None:
    """The ground plane from above, the longer side across; where the truth is known, the error."""
    up, ahead = level_axes(result.Ts_world_camera)
    on_ground = np.stack([np.cross(ahead, up), ahead])  # the first camera may have looked down
    path = result.Ts_world_camera[:, :3, 3] @ on_ground.T
    stamps_s, errors_m = _position_errors(result)
    if len(errors_m) > 1:
        axes, below = figure.subplots(2, 1, height_ratios=(3, 1.4))
        _plot_position_errors(below, stamps_s - result.timestamps_s[0], errors_m)
    else:
        axes = figure.subplots()
    words = ["to the right (m)", "ahead (m)"]
    turned = np.ptp(path[:, 1]) > np.ptp(path[:, 0])
    if turned:  # a drive ahead would be a thin upright line in a wide, empty picture
        on_ground, path, words = on_ground[::-1], path[:, ::-1], words[::-1]
    if result.gt_Ts_world_camera is not None:
        truth = result.gt_Ts_world_camera[:, :3, 3] @ on_ground.T
        axes.plot(*truth.T, color=_hex(style.TRUTH), lw=5, label="ground truth")
    axes.plot(*path.T, color=_hex(style.ESTIMATE), lw=1.8, label="estimate")
    axes.plot(*path[0], "o", color=_hex(style.START), ms=8, label="start")
    axes.plot(*path[-1], "o", color=_hex(style.END), ms=8, label="end")
    axes.set(xlabel=words[0], ylabel=words[1], title="Camera path from above")
    axes.set_aspect("equal", adjustable="datalim")
    # The noise of a camera that stands still is no path to fill the picture with.
    centre = path.mean(axis=0)
    axes.update_datalim([centre - STILL_M, centre + STILL_M])
    if turned:
        axes.invert_yaxis()  # looking ahead is to the right here, so the right is downward
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _position_errors(result: Result) -> tuple[Array, Array]:
    """Stamps (N,) and distances (N,) in metres to the truth after alignment; empty without one."""
    if result.gt_Ts_world_camera is None or result.gt_timestamps_s is None:
        return np.empty(0), np.empty(0)
    rows, gt_rows = associate(result.timestamps_s, result.gt_timestamps_s)
    if len(rows) < 2:
        return np.empty(0), np.empty(0)
    truth = result.gt_Ts_world_camera[gt_rows, :3, 3]
    aligned = align(result.Ts_world_camera[rows, :3, 3], truth)
    return result.timestamps_s[rows], np.linalg.norm(aligned - truth, axis=1)


def _plot_position_errors(axes: Any, seconds: Array, errors_m: Array) -> None:
    factor, unit = metric_unit(errors_m)
    rmse = factor * float(np.sqrt(np.mean(errors_m**2)))
    axes.plot(seconds, factor * errors_m, ".-", color=_hex(style.ESTIMATE), lw=1.0, ms=4)
    axes.axhline(rmse, color=_hex(style.INK), lw=1.0, ls="--", label=f"ATE {digits(rmse)} {unit}")
    title = "Distance to the truth after alignment"
    axes.set(xlabel="time (s)", ylabel=f"off by ({unit})", title=title)
    axes.margins(y=0.25)
    axes.set_ylim(bottom=0.0)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))


def plot_rpe(figure: Any, result: Result) -> None:
    """The error of every step from frame to frame; a gap where a frame was lost."""
    stamps, gt = truth_by_frame(result)
    rows, gt_rows = associate(result.timestamps_s, stamps)
    known = np.isfinite(gt[gt_rows]).all((1, 2))
    rows, gt_rows = rows[known], gt_rows[known]
    consecutive = np.diff(gt_rows) == 1
    E = relative_errors(result.Ts_world_camera[rows], gt[gt_rows])[consecutive]
    at = gt_rows[1:][consecutive]
    index = np.array(result.timings.get("frames_index") or [0, 1])
    stride = np.diff(index).min() if len(index) > 1 else 1
    frames = index[0] + stride * np.arange(len(stamps))
    trans_m = np.linalg.norm(E[:, :3, 3], axis=1)
    factor, unit = metric_unit(trans_m)
    errors = (
        (factor * trans_m, "translation", unit, style.ESTIMATE),
        (rotation_angle_deg(E), "rotation", "deg", style.END),
    )
    upper, lower = figure.subplots(2, 1, sharex=True)
    for axes, (values, label, unit, color) in zip((upper, lower), errors, strict=True):
        by_frame = np.full(len(stamps), np.nan)  # lost frames leave a gap in the line
        by_frame[at] = values
        axes.plot(frames, by_frame, ".-", color=_hex(color), lw=1.0, ms=4)
        if len(values):
            rmse = float(np.sqrt(np.mean(values**2)))
            axes.axhline(
                rmse,
                color=_hex(style.INK),
                lw=1.0,
                ls="--",
                label=f"RMSE {digits(rmse)} {unit}",
            )
            axes.legend(loc="upper right")
            axes.margins(y=0.35)  # room for the legend
        axes.set(ylabel=f"{label} ({unit})")
        axes.set_ylim(bottom=0.0)
    upper.set_title("Relative pose error of each step")
    lower.set_xlabel("frame")
    whole_ticks(lower.xaxis)


def plot_timings(figure: Any, result: Result) -> None:
    """Cost over frames above, medians and 95th percentiles of the stages below."""
    stages = {
        name: values
        for name, values in stage_summaries(result.timings).items()
        if values["p95_ms"] >= SHOWN_MS or name in (TOTAL, WALL)
    }
    figure.set_size_inches(figure.get_figwidth(), 3.0 + 0.26 * len(stages))
    upper, lower = figure.subplots(2, 1, height_ratios=(1.0, 0.35 + 0.16 * len(stages)))
    _plot_frame_times(upper, np.array(result.timings.get("frames_total_ms", []), float))
    sums = {TOTAL: "all work", WALL: "on the clock"}
    labels = [sums.get(name, name.replace("_", " ")) for name in stages]
    medians = np.array([values["median_ms"] for values in stages.values()])
    p95 = np.array([values["p95_ms"] for values in stages.values()])
    colors = [_hex(style.INK if name in (TOTAL, WALL) else style.ESTIMATE) for name in stages]
    lower.barh(labels, p95, color="#d5dce4")
    lower.barh(labels, medians, color=colors, height=0.5)
    for row, value in enumerate(medians):
        words = f"{value:.1f}  ({p95[row]:.1f})"
        lower.annotate(words, (p95[row], row), (4, 0), textcoords="offset points", va="center")
    lower.invert_yaxis()
    lower.grid(visible=False, axis="y")
    lower.margins(x=0.18)
    lower.set(xlabel="ms a frame: median, and the 95th percentile (light bar, in brackets)")


def _plot_frame_times(axes: Any, totals_ms: Array) -> None:
    """Each frame's time; where few frames took far longer, the axis leaves them out and says so."""
    mark = "." if len(totals_ms) < FEW_FRAMES else ""
    axes.plot(totals_ms, color=_hex(style.ESTIMATE), lw=1.0, marker=mark)
    axes.set(xlabel="frame", ylabel="ms a frame", title="Time a frame, reading included")
    whole_ticks(axes.xaxis)
    axes.set_ylim(bottom=0.0)
    if len(totals_ms) == 0:
        return
    median_ms = float(np.median(totals_ms))
    words = f"median {median_ms:.1f} ms"
    axes.axhline(median_ms, color=_hex(style.INK), lw=1.0, ls="--", label=words)
    slowest = int(totals_ms.argmax())
    usual_ms = 1.6 * float(np.quantile(totals_ms, 0.95))
    if totals_ms[slowest] > 1.5 * usual_ms:
        axes.set_ylim(0.0, usual_ms)
        words = f"slowest {totals_ms[slowest]:.0f} ms, frame {slowest}"
        axes.plot([], [], color=_hex(style.ESTIMATE), lw=1.0, label=words)
    else:
        axes.set_ylim(0.0, 1.35 * totals_ms[slowest])
    axes.legend(loc="upper right", ncols=2)


def _has_path(result: Result) -> bool:
    return len(result.timestamps_s) > 0


def _has_true_steps(result: Result) -> bool:
    truth = result.gt_Ts_world_camera
    return truth is not None and len(truth) > 1 and len(result.timestamps_s) > 1


PLOTS: dict[str, Plot] = {
    "trajectory": Plot(plot_trajectory, _has_path, "a tracked frame"),
    "rpe": Plot(plot_rpe, _has_true_steps, "the camera's ground truth"),
    "timings": Plot(plot_timings, lambda r: bool(stage_summaries(r.timings)), "timings.json"),
    "objects_speed": Plot(
        object_plots.plot_object_speeds,
        lambda r: len(object_plots.moving_ids(r.objects)) > 0,
        f"an object that moved for {object_plots.MIN_MOVING_FRAMES} frames",
    ),
    "objects_motion": Plot(
        object_plots.plot_object_motion,
        lambda r: len(object_plots.judged_objects(r)) > 0,
        "moving objects with ground truth",
    ),
    "objects_timeline": Plot(
        object_plots.plot_object_timeline, lambda r: len(r.objects) > 0, "a tracked object"
    ),
}
