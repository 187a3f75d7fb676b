"""Metrics as text that people read: one layout for the console and for metrics.txt.

Owns labels, order, units and digits. Computes nothing.
"""

from __future__ import annotations

from typing import Any

from pipelines.io.timings import TOTAL, WALL, stage_summaries

Row = tuple[str, ...]

ERRORS = "Camera errors"
TIMES = "Time a frame"
STATISTICS = ("rmse", "mean", "median", "max")
ERROR_ROWS = (  # label, unit, digits, keys of the statistics with {} for their name
    ("ATE, SE(3) aligned", "m", 4, "ate_{}_m"),
    ("RPE, translation", "m a frame", 5, "rpe_trans_{}_m"),
    ("RPE, rotation", "deg a frame", 5, "rpe_rot_{}_deg"),
)
SINGLE_ROWS = (
    ("step_length_ratio", "Step length, estimate / truth", "", 4),
    ("kitti_t_rel_percent", "KITTI t_rel (100-800 m)", "%", 3),
    ("kitti_r_rel_deg_per_100m", "KITTI r_rel (100-800 m)", "deg in 100 m", 3),
)
TIMING_LABELS = {TOTAL: "all work, in two threads", WALL: "on the clock, with reading"}
HYPOTHESES = {"pnp_ransac": "PnP RANSAC", "rgbd_odometry": "RGB-D odometry"}


def metrics_text(metrics: dict[str, Any], timings: dict[str, Any] | None = None) -> str:
    """The content of metrics.json as aligned plain text, with what there is of it.

    First what was run, then errors, one a row with its statistics side by side, then `timings`
    (timings.json). Below 80 columns but for long names.
    """
    facts = run_facts(metrics)
    errors, singles = error_rows(metrics), single_rows(metrics)
    times = timing_rows(timings or {})
    if not (facts or errors or times):
        return "No metrics: the run wrote none and there is no ground truth.\n"
    blocks = ["\n".join(f"{label:<10}  {words}" for label, words in facts)] if facts else []
    if errors or singles:
        heading = (ERRORS, "RMSE", "mean", "median", "largest", "")
        blocks.append(_block([heading, *errors, *singles]))
    else:
        blocks.append("No ground truth: no camera errors.")
    if times:
        blocks.append(_block([(TIMES, "median", "95 %", ""), *times]))
    return "\n\n".join(blocks) + "\n"


def run_facts(metrics: dict[str, Any]) -> list[Row]:
    """Rows (label, words) of what was run and how far it went."""
    run, camera = metrics.get("run", {}), metrics.get("camera", {})
    rows: list[Row] = []
    if run.get("sequence"):
        of = f" ({run['dataset']})" if run.get("dataset") else ""
        rows.append(("Sequence", f"{run['sequence']}{of}"))
    if run.get("frames") is not None:
        words = f"{run.get('tracked', 0)} of {run['frames']} tracked"
        words += "".join(
            f", {run[key]} {meaning}"
            for key, meaning in (("lost", "lost"), ("skipped", "skipped as unreadable"))
            if run.get(key) is not None
        )
        rows.append(("Frames", words + (", stopped before the end" * bool(run.get("interrupted")))))
    if run.get("map_points") is not None:
        rows.append(("Map", f"{run['map_points']:,} points, {run.get('keyframes', 0)} keyframes"))
    if run.get("hypotheses"):
        counts = sorted(run["hypotheses"].items(), key=lambda item: -item[1])
        rows.append(("Poses by", ", ".join(f"{hypothesis_words(n)} {c}" for n, c in counts)))
    if camera.get("path_length_m") is not None:
        known = camera.get("frames_matched")
        rows.append(("True path", f"{camera['path_length_m']:.2f} m, known at {known} frames"))
    return rows


def error_rows(metrics: dict[str, Any]) -> list[Row]:
    """Rows (label, RMSE, mean, median, largest, unit) of the camera's errors."""
    camera = metrics.get("camera", {})
    rows = []
    for label, unit, digits, key in ERROR_ROWS:
        values = [camera.get(key.format(name)) for name in STATISTICS]
        if values[0] is not None:
            rows.append((label, *("" if v is None else f"{v:.{digits}f}" for v in values), unit))
    return rows


def single_rows(metrics: dict[str, Any]) -> list[Row]:
    """Rows (label, value, unit) of what has one value a run."""
    camera = metrics.get("camera", {})
    return [
        (label, f"{camera[key]:.{digits}f}", unit)
        for key, label, unit, digits in SINGLE_ROWS
        if camera.get(key) is not None
    ]


def timing_rows(timings: dict[str, Any]) -> list[Row]:
    """Rows (label, median, 95th percentile, unit) of the stages and their sums."""
    return [
        (
            TIMING_LABELS.get(stage, f"  {stage.replace('_', ' ')}"),
            f"{values['median_ms']:.1f}",
            f"{values['p95_ms']:.1f}",
            "ms",
        )
        for stage, values in stage_summaries(timings).items()
    ]


def hypothesis_words(name: Any) -> str:
    """How a motion hypothesis is called in text."""
    return HYPOTHESES.get(str(name), str(name).replace("_", " "))


def _block(rows: list[Row]) -> str:
    """Labels to the left, units to the right, the values between them under each other."""
    label_width = max(len(row[0]) for row in rows)
    lines = []
    for label, *values, unit in rows:
        cells = "".join(f"{value:>10}" for value in values)
        lines.append(f"{label:<{label_width}}{cells}  {unit}".rstrip())
    return "\n".join(lines)
