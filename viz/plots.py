"""Diagrams of a result folder: the path against the truth, errors over frames, time a stage.

Owns matplotlib. Needs no display.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.errors import DyObError
from pipelines.evaluation.camera import align, associate, relative_errors
from pipelines.evaluation.folder import truth_by_frame
from pipelines.geometry import rotation_angle_deg
from pipelines.io import folder as names
from pipelines.io.files import disk_error, replacing
from pipelines.io.result import Result, load_result
from pipelines.io.timings import TOTAL, WALL, stage_summaries
from pipelines.types import Array
from viz import style
from viz.object_plots import moving_ids, plot_object_speeds, plot_object_timeline
from viz.style import hex_color as _hex

SETTINGS = {
    "font.size": 11,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e4e4",
    "axes.axisbelow": True,
    "legend.framealpha": 0.9,
    "legend.edgecolor": "none",
    "figure.dpi": 110,
}


def plot_result(folder: Path | str) -> list[Path]:
    """Write plots/*.png of a result folder, those that its files allow; the paths written.

    trajectory.png: the path from above, with the truth. rpe.png: error of every step. timings.png:
    what a frame costs. objects_speed.png and objects_timeline.png: moving objects, see
    `object_plots`. Raises FormatError for a damaged folder.
    """
    result = load_result(folder)
    target = result.folder / names.PLOTS
    try:
        target.mkdir(exist_ok=True)
    except OSError as error:
        raise DyObError(disk_error(target, error)) from error
    written = []
    truth = result.gt_Ts_world_camera is not None and len(result.gt_Ts_world_camera) > 1
    jobs = [("trajectory.png", _plot_trajectory, len(result.timestamps_s) > 0)]
    jobs.append(("rpe.png", _plot_rpe, truth and len(result.timestamps_s) > 1))
    jobs.append(("timings.png", _plot_timings, bool(stage_summaries(result.timings))))
    jobs.append(("objects_speed.png", plot_object_speeds, len(moving_ids(result.objects)) > 0))
    jobs.append(("objects_timeline.png", plot_object_timeline, len(result.objects) > 0))
    for name, plot, possible in jobs:
        if possible:
            with _figure(target / name) as figure:
                plot(figure, result)
            written.append(target / name)
    return written


@contextmanager
def _figure(path: Path) -> Iterator[Any]:
    """A figure that is written to `path` when the block ends; no global state of matplotlib."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with mpl.rc_context(SETTINGS):
        figure = Figure(figsize=(9.0, 5.2), layout="constrained")
        FigureCanvasAgg(figure)
        yield figure
        with replacing(path) as fresh:
            figure.savefig(fresh)


def _plot_trajectory(figure: Any, result: Result) -> None:
    """The ground plane from above, the longer side across; where the truth is known, the error."""
    path = result.Ts_world_camera[:, :3, 3]
    truth = None if result.gt_Ts_world_camera is None else result.gt_Ts_world_camera[:, :3, 3]
    stamps_s, errors_m = _position_errors(result)
    if len(errors_m) > 1:
        axes, below = figure.subplots(2, 1, height_ratios=(3, 1.4))
        _plot_position_errors(below, stamps_s - result.timestamps_s[0], errors_m)
    else:
        axes = figure.subplots()
    spans = np.ptp(path, axis=0)
    # A drive ahead would be a thin upright line in a wide, empty picture.
    across, upward = (2, 0) if spans[2] > spans[0] else (0, 2)
    if truth is not None:
        axes.plot(
            *truth[:, [across, upward]].T, color=_hex(style.TRUTH), lw=5, label="ground truth"
        )
    axes.plot(*path[:, [across, upward]].T, color=_hex(style.ESTIMATE), lw=1.8, label="estimate")
    axes.plot(*path[0, [across, upward]], "o", color=_hex(style.START), ms=8, label="start")
    axes.plot(*path[-1, [across, upward]], "o", color=_hex(style.END), ms=8, label="end")
    names = {0: "x, to the right (m)", 2: "z, ahead (m)"}
    axes.set(xlabel=names[across], ylabel=names[upward], title="Camera path from above")
    axes.set_aspect("equal", adjustable="datalim")
    if across == 2:
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
    rmse_cm = 100.0 * float(np.sqrt(np.mean(errors_m**2)))
    axes.plot(seconds, 100.0 * errors_m, ".-", color=_hex(style.ESTIMATE), lw=1.0, ms=4)
    axes.axhline(rmse_cm, color=_hex(style.INK), lw=1.0, ls="--", label=f"ATE {rmse_cm:.3g} cm")
    axes.set(xlabel="time (s)", ylabel="off by (cm)", title="Distance to the truth after alignment")
    axes.margins(y=0.25)
    axes.set_ylim(bottom=0.0)
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))


def _plot_rpe(figure: Any, result: Result) -> None:
    stamps, gt = truth_by_frame(result)
    rows, gt_rows = associate(result.timestamps_s, stamps)
    known = np.isfinite(gt[gt_rows]).all((1, 2))
    rows, gt_rows = rows[known], gt_rows[known]
    consecutive = np.diff(gt_rows) == 1
    E = relative_errors(result.Ts_world_camera[rows], gt[gt_rows])[consecutive]
    at = gt_rows[1:][consecutive]
    errors = (
        (1000.0 * np.linalg.norm(E[:, :3, 3], axis=1), "translation", "mm", style.ESTIMATE),
        (rotation_angle_deg(E), "rotation", "deg", style.END),
    )
    upper, lower = figure.subplots(2, 1, sharex=True)
    for axes, (values, label, unit, color) in zip((upper, lower), errors, strict=True):
        by_frame = np.full(len(stamps), np.nan)  # lost frames leave a gap in the line
        by_frame[at] = values
        axes.plot(by_frame, ".-", color=_hex(color), lw=1.0, ms=4)
        if len(values):
            rmse = float(np.sqrt(np.mean(values**2)))
            axes.axhline(
                rmse, color=_hex(style.INK), lw=1.0, ls="--", label=f"RMSE {rmse:.3g} {unit}"
            )
            axes.legend(loc="upper right")
            axes.margins(y=0.25)  # room for the legend
        axes.set(ylabel=f"{label} ({unit})")
        axes.set_ylim(bottom=0.0)
    upper.set_title("Relative pose error of each step")
    lower.set_xlabel("frame")


def _plot_timings(figure: Any, result: Result) -> None:
    """Cost over frames above, medians and 95th percentiles of the stages below."""
    stages = stage_summaries(result.timings)
    totals_ms = np.array(result.timings.get("frames_total_ms", []), float)
    upper, lower = figure.subplots(2, 1, height_ratios=(1.0, 0.35 + 0.16 * len(stages)))
    upper.plot(totals_ms, color=_hex(style.ESTIMATE), lw=1.0)
    if len(totals_ms):
        median_ms = float(np.median(totals_ms))
        upper.axhline(
            median_ms, color=_hex(style.INK), lw=1.0, ls="--", label=f"median {median_ms:.1f} ms"
        )
        upper.legend(loc="upper right")
        upper.margins(y=0.3)
    upper.set(xlabel="frame", ylabel="ms a frame", title="Time a frame, reading included")
    upper.set_ylim(bottom=0.0)
    sums = {TOTAL: "all work", WALL: "on the clock"}
    labels = [sums.get(name, name.replace("_", " ")) for name in stages]
    medians = np.array([values["median_ms"] for values in stages.values()])
    p95 = np.array([values["p95_ms"] for values in stages.values()])
    colors = [_hex(style.INK if name in (TOTAL, WALL) else style.ESTIMATE) for name in stages]
    lower.barh(labels, p95, color="#d5dce4", label="95th percentile")
    lower.barh(labels, medians, color=colors, height=0.5, label="median")
    for row, value in enumerate(medians):
        lower.annotate(
            f"{value:.1f}", (p95[row], row), (4, 0), textcoords="offset points", va="center"
        )
    lower.invert_yaxis()
    lower.margins(x=0.08)
    lower.set(xlabel="ms a frame: median (number) and 95th percentile (light)")
