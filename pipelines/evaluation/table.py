"""Metrics as rows that people read: one list for the console and for metrics.txt.

Owns labels, order, units and digits. Computes nothing.
"""

from __future__ import annotations

from typing import Any

from pipelines.io.timings import TOTAL, WALL, stage_summaries

Row = tuple[str, str, str]  # label, value as text, unit

RUN_ROWS = (
    ("sequence", "Sequence"),
    ("dataset", "Data set"),
    ("frames", "Frames"),
    ("tracked", "  tracked"),
    ("lost", "  lost"),
    ("skipped", "  skipped (unreadable)"),
    ("keyframes", "Keyframes"),
    ("map_points", "Map points"),
)
CAMERA_ROWS = (
    ("frames_matched", "Frames with truth", "", 0),
    ("path_length_m", "Path length", "m", 2),
    ("ate_rmse_m", "ATE, RMSE (SE(3) aligned)", "m", 4),
    ("ate_mean_m", "  mean", "m", 4),
    ("ate_median_m", "  median", "m", 4),
    ("ate_max_m", "  largest", "m", 4),
    ("rpe_trans_rmse_m", "RPE translation, RMSE", "m/frame", 5),
    ("rpe_trans_mean_m", "  mean", "m/frame", 5),
    ("rpe_trans_median_m", "  median", "m/frame", 5),
    ("rpe_trans_max_m", "  largest", "m/frame", 5),
    ("rpe_rot_rmse_deg", "RPE rotation, RMSE", "deg/frame", 5),
    ("rpe_rot_mean_deg", "  mean", "deg/frame", 5),
    ("rpe_rot_median_deg", "  median", "deg/frame", 5),
    ("rpe_rot_max_deg", "  largest", "deg/frame", 5),
    ("step_length_ratio", "Step length, estimate / truth", "", 4),
    ("kitti_t_rel_percent", "KITTI t_rel (100-800 m)", "%", 3),
    ("kitti_r_rel_deg_per_100m", "KITTI r_rel (100-800 m)", "deg/100 m", 3),
)

TIMING_LABELS = {TOTAL: "Work a frame, all stages", WALL: "Time a frame, reading included"}


def metrics_table(metrics: dict[str, Any], timings: dict[str, Any] | None = None) -> list[Row]:
    """Rows (label, value, unit) of the content of metrics.json, values ready to print.

    Only what there is gets a row. With `timings` (timings.json) the medians of the stages follow.
    """
    rows = _run_rows(metrics.get("run", {}))
    camera = metrics.get("camera", {})
    for key, label, unit, digits in CAMERA_ROWS:
        value = camera.get(key)
        if value is not None:
            rows.append((label, f"{value:.{digits}f}", unit))
    return rows + _timing_rows(timings or {})


def metrics_text(metrics: dict[str, Any], timings: dict[str, Any] | None = None) -> str:
    """The table as aligned plain text, one row a line."""
    rows = metrics_table(metrics, timings)
    if not rows:
        return "No metrics: the run wrote none and there is no ground truth.\n"
    label_width = max(len(label) for label, _, _ in rows)
    value_width = max(len(value) for _, value, _ in rows)
    lines = [
        f"{label:<{label_width}}  {value:>{value_width}}  {unit}".rstrip()
        for label, value, unit in rows
    ]
    if not metrics.get("camera"):
        lines.append("No ground truth: no camera errors.")
    return "\n".join(lines) + "\n"


def _run_rows(run: dict[str, Any]) -> list[Row]:
    rows = [(label, str(run[key]), "") for key, label in RUN_ROWS if run.get(key) is not None]
    for name, count in run.get("hypotheses", {}).items():
        rows.append((f"Pose from {name.replace('_', ' ')}", str(count), "frames"))
    if run.get("interrupted"):
        rows.append(("Interrupted before its end", "yes", ""))
    return rows


def _timing_rows(timings: dict[str, Any]) -> list[Row]:
    rows = []
    for stage, values in stage_summaries(timings).items():
        label = TIMING_LABELS.get(stage, f"  {stage.replace('_', ' ')}")
        rows.append((f"{label}, median", f"{values['median_ms']:.1f}", "ms"))
        if stage in TIMING_LABELS:
            rows.append((f"{label}, 95th percentile", f"{values['p95_ms']:.1f}", "ms"))
    return rows
