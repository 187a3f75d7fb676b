"""Metrics as text that people read: one layout for the console and for metrics.txt.

Owns labels, order, units and digits. Computes nothing.
"""

from __future__ import annotations

from typing import Any

from pipelines.io.timings import TOTAL, WALL, stage_summaries

Row = tuple[str, ...]

ERRORS = "Camera errors"
OBJECTS = "Object errors"
FOUND = "Objects found"
TIMES = "Time a frame"
BATCH = "Global batch"
BOUND = "Over the Cramer-Rao bound"
HEADINGS = (
    ERRORS,
    OBJECTS,
    FOUND,
    BATCH,
    BOUND,
    TIMES,
)  # a block's first line begins with one of them
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
OBJECT_ROWS = (  # label, unit, digits, block, keys of the statistics with {} for their name
    ("Motion, translation", "m a frame", 4, "motion", "trans_{}_m"),
    ("Motion, rotation", "deg a frame", 4, "motion", "rot_{}_deg"),
    ("Speed", "km/h", 3, "speed", "error_{}_kmh"),
    ("Speed, smoothed", "km/h", 3, "smoothed_speed", "error_{}_kmh"),
    ("Pose, translation", "m", 4, "pose", "trans_{}_m"),
    ("Pose, rotation", "deg", 3, "pose", "rot_{}_deg"),
)
BOUND_ROWS = (  # block, label
    ("motion_only_ba", "Camera step"),
    ("object_motion", "Object motion"),
    ("batch_camera_step", "Batch: camera step"),
    ("batch_camera", "Batch: camera pose"),
    ("batch_object_motion", "Batch: object motion"),
    ("batch_object_pose", "Batch: object pose"),
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
    objects, found = object_error_rows(metrics), object_facts(metrics)
    if objects:
        blocks.append(_block([(OBJECTS, "RMSE", "mean", "median", "largest", ""), *objects]))
    if found:
        width = max(len(label) for label, _ in found)
        lines = [f"{label:<{width}}  {words}" for label, words in found]
        blocks.append("\n".join([FOUND, *lines]))
    batch = batch_rows(metrics)
    if batch:
        blocks.append(_block([(BATCH, "before", "after", ""), *batch]))
    bounds = bound_rows(metrics)
    if bounds:
        blocks.append(_block([(BOUND, "RMSE", "bound", "ratio", ""), *bounds]))
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
    tracked = run.get("objects", {})
    if tracked.get("tracked"):
        kinds = sorted(tracked["by_class"].items(), key=lambda item: -item[1])
        words = ", ".join(f"{count} {name}" for name, count in kinds)
        moved = f", {tracked['moving']} of them seen moving"
        rows.append(("Objects", f"{tracked['tracked']} tracked ({words}){moved}"))
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


def object_error_rows(metrics: dict[str, Any]) -> list[Row]:
    """Rows (label, RMSE, mean, median, largest, unit) of the errors of moving objects."""
    objects = metrics.get("objects", {})
    rows = []
    for label, unit, digits, block, key in OBJECT_ROWS:
        values = [objects.get(block, {}).get(key.format(name)) for name in STATISTICS]
        if values[0] is not None:
            rows.append((label, *("" if v is None else f"{v:.{digits}f}" for v in values), unit))
    return rows


def batch_rows(metrics: dict[str, Any]) -> list[Row]:
    """Rows (label, before, after, unit) of what a batch did: RMSEs where the truth is known."""
    batch, before = metrics.get("batch"), metrics.get("front_end", {})
    if not batch:
        return []
    rows: list[Row] = []
    held = batch.get("camera")
    if held and held["error_before"] is not None:
        cells = (f"{held['error_before']:.3f}", f"{held['error_after']:.3f}")
        rows.append(("Held-out sightings, camera", *cells, "standard deviations"))
    for label, unit, digits, key in ERROR_ROWS:
        values = [m.get("camera", {}).get(key.format("rmse")) for m in (before, metrics)]
        if None not in values:
            rows.append((label, *(f"{value:.{digits}f}" for value in values), unit))
    for label, unit, digits, block, key in OBJECT_ROWS:
        values = [
            m.get("objects", {}).get(block, {}).get(key.format("rmse")) for m in (before, metrics)
        ]
        if None not in values:
            rows.append((f"Objects: {label.lower()}", *(f"{v:.{digits}f}" for v in values), unit))
    objects = batch.get("objects", {})
    kept = sorted(int(i) for i, verdict in objects.items() if not verdict["accepted"])
    if not batch["accepted"]:
        rows.append(("Refused: the front-end's answers are kept", "", "", ""))
    elif kept:
        what = "object" if len(kept) == 1 else "objects"
        rows.append((f"Refused for {what} {', '.join(map(str, kept))}", "", "", ""))
    return rows


def bound_rows(metrics: dict[str, Any]) -> list[Row]:
    """Rows (label, RMSE, bound, ratio, unit) of the errors beside the least that they could be."""
    rows: list[Row] = []
    for key, label in BOUND_ROWS:
        block = metrics.get("bound", {}).get(key, {})
        for name, unit, digits, words in (("trans", "m", 5, ""), ("rot", "deg", 4, ", rotation")):
            values = [block.get(f"{name}_{column}_{unit}") for column in ("rmse", "bound")]
            ratio = block.get(f"{name}_ratio")
            if ratio is not None:
                cells = (*(f"{value:.{digits}f}" for value in values), f"{ratio:.2f}")
                rows.append((label + words, *cells, unit))
    return rows


def object_facts(metrics: dict[str, Any]) -> list[Row]:
    """Rows (label, words) of how many of the true objects were found, and of false ones."""
    objects = metrics.get("objects")
    if not objects:
        return []
    limits, coverage, speed = objects["limits"], objects["coverage"], objects["speed"]
    rows: list[Row] = []
    if coverage["truth"]:
        words = f"{100 * coverage['share']:.1f} % ({coverage['found']} of {coverage['truth']}"
        words += f" with > {limits['moving_kmh']:g} km/h within {limits['max_distance_m']:g} m)"
        rows.append(("Coverage", words))
    words = f"{objects['false_movers']} that stand still, {objects['ghosts']} that are nothing"
    rows.append(("False movers", words))
    if speed["signed_mean_kmh"] is not None:
        words = f"{speed['signed_mean_kmh']:+.3f} km/h on average"
        if speed["inside_95_share"] is not None:
            words += f", {100 * speed['inside_95_share']:.0f} % inside the 95 % interval"
        rows.append(("Speed off by", words))
    for label, key in (("All tracks", "tracking"), ("Moving ones", "tracking_moving")):
        tracking = objects[key]
        if tracking["mota"] is not None:
            words = f"MOTA {tracking['mota']:.3f}, IDF1 {tracking['idf1']:.3f}, "
            words += f"{tracking['id_switches']} ID switches, "
            rows.append((label, words + f"{tracking['fragmentations']} interruptions"))
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
