"""What the benchmark takes from a run's metrics.json, and how it is headed and rounded.

Owns the keys of bench.json's errors. The definitions are in `pipelines.evaluation`.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np


@dataclass(frozen=True, slots=True)
class Measure:
    """A figure of a run: where metrics.json has it, its heading, digits, and unit factor."""

    key: str
    path: tuple[str, ...]
    heading: str
    digits: int
    factor: float = 1.0


MEASURES = (
    Measure("ate_m", ("camera", "ate_rmse_m"), "ATE m", 4),
    Measure("rpe_trans_m", ("camera", "rpe_trans_rmse_m"), "RPE m", 5),
    Measure("rpe_rot_deg", ("camera", "rpe_rot_rmse_deg"), "RPE deg", 5),
    Measure("t_rel_percent", ("camera", "kitti_t_rel_percent"), "t_rel %", 3),
    Measure("r_rel_deg", ("camera", "kitti_r_rel_deg_per_100m"), "r_rel deg/100 m", 3),
    Measure("motion_trans_m", ("objects", "motion", "trans_rmse_m"), "motion m", 5),
    Measure("motion_rot_deg", ("objects", "motion", "rot_rmse_deg"), "motion deg", 4),
    Measure("speed_kmh", ("objects", "speed", "error_mean_kmh"), "speed km/h", 3),
    Measure("coverage_share", ("objects", "coverage", "share"), "coverage %", 1, 100.0),
    Measure("false_movers", ("objects", "false_movers"), "false movers", 0),
    Measure("id_switches", ("objects", "id_switches_while_moving"), "ID switches", 0),
)
# Beside the table of accuracy: the signed mean is eq. (8) of the paper, over all frames.
FURTHER = (
    Measure("speed_signed_kmh", ("objects", "speed", "signed_mean_kmh"), "speed, signed km/h", 3),
    Measure("object_frames", ("objects", "object_frames"), "object-frames", 0),
)
FRAME_TIME = Measure("frame_ms", (), "ms a frame", 1)  # from timings.json, not metrics.json


def errors_of(metrics: dict[str, Any]) -> dict[str, float | None]:
    """All measures of one run's metrics.json; None where it has no such figure."""
    return {m.key: _at(metrics, m.path) for m in (*MEASURES, *FURTHER)}


def _at(metrics: Any, path: tuple[str, ...]) -> float | None:
    for key in path:
        metrics = metrics.get(key) if isinstance(metrics, dict) else None
    return None if metrics is None else float(metrics)


def means_of(errors: Iterable[dict[str, float | None]]) -> dict[str, float | None]:
    """The mean of each measure over some runs; None where no run has it."""
    columns: dict[str, list[float]] = {}
    for run in errors:
        for key, value in run.items():
            columns.setdefault(key, [])
            if value is not None:
                columns[key].append(value)
    return {key: float(np.mean(values)) if values else None for key, values in columns.items()}


def cell(measure: Measure, value: float | None) -> str:
    """A figure of ours in a table, a dash where it is unknown; a mean of counts has a tenth."""
    if value is None:
        return "-"
    if measure.digits == 0:
        return f"{round(value, 1):g}"
    return f"{measure.factor * value:.{measure.digits}f}"


def published_cell(measure: Measure, value: float | None) -> str:
    """A figure of others, with the digits that they give."""
    return "-" if value is None else f"{measure.factor * value:.6g}"
