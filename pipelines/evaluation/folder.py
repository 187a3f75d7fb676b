"""Evaluation of a result folder: reads its files back and renews its metrics.

Owns which files are compared with which. The definitions are in `pipelines.evaluation.camera`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from pipelines.evaluation.camera import associate, evaluate_camera
from pipelines.evaluation.table import metrics_text
from pipelines.io.result import Result, ResultWriter, load_result
from pipelines.types import Array


def evaluate_result(folder: Path | str) -> dict[str, Any]:
    """Renew the "camera" block of metrics.json and metrics.txt in a result folder; all its metrics.

    Without camera_gt_tum.txt there is no "camera" block. Other blocks stay as they are. Raises
    FormatError where `folder` is no result folder or a file of it is damaged.
    """
    result = load_result(folder)
    metrics = {key: value for key, value in result.metrics.items() if key != "camera"}
    if result.gt_Ts_world_camera is not None:
        metrics["camera"] = evaluate_camera(
            result.timestamps_s, result.Ts_world_camera, *truth_by_frame(result)
        )
    writer = ResultWriter(result.folder)
    writer.write_metrics(metrics, metrics_text(metrics, result.timings))
    return metrics


def truth_by_frame(result: Result) -> tuple[Array, Array]:
    """The truth as one row for each frame of the run: stamps (M,) and poses (M, 4, 4), NaN unknown.

    The TUM file leaves unknown poses out, so two of its rows can be neighbours though frames lie
    between them. timings.json knows the frames; a frame that was skipped gets a row too.
    """
    assert result.gt_timestamps_s is not None and result.gt_Ts_world_camera is not None
    gt_stamps, gt_Ts = result.gt_timestamps_s, result.gt_Ts_world_camera
    stamps = np.array(result.timings.get("frames_timestamp_s", []), float)
    index = np.array(result.timings.get("frames_index", []), int)
    if len(stamps) == 0 or len(stamps) != len(index):
        return gt_stamps, gt_Ts
    step = np.diff(index)
    gaps = np.flatnonzero(step > step.min(initial=np.iinfo(int).max))
    between_s = (stamps[:-1] + stamps[1:])[gaps] / 2.0
    frame_stamps = np.insert(stamps, gaps + 1, between_s)
    Ts = np.full((len(frame_stamps), 4, 4), np.nan)
    rows, gt_rows = associate(frame_stamps, gt_stamps)
    Ts[rows] = gt_Ts[gt_rows]
    return frame_stamps, Ts
