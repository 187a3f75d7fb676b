"""What each frame and stage cost, as it is kept in a result folder.

Owns the summary of `FrameResult.timings_ms`. Measures nothing itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pipelines.types import FrameResult

TOTAL, WALL = "total", "wall"


def frame_total_ms(result: FrameResult) -> float:
    """Time of one frame: on the wall's clock, else its "total", else the sum of its stages."""
    if WALL in result.timings_ms:
        return float(result.timings_ms[WALL])
    if TOTAL in result.timings_ms:
        return float(result.timings_ms[TOTAL])
    return float(sum(result.timings_ms.values()))


def summarise_timings(results: Sequence[FrameResult]) -> dict[str, Any]:
    """{stage: {median_ms, mean_ms, p95_ms, max_ms, n}} over the frames that ran the stage.

    Beside the stages stand parallel lists with one entry a frame: `frames_total_ms`,
    `frames_index`, `frames_timestamp_s`, `frames_status`, `frames_keyframe`, `frames_inliers`.
    """
    stages: dict[str, list[float]] = {}
    for result in results:
        for stage, value_ms in result.timings_ms.items():
            stages.setdefault(stage, []).append(float(value_ms))
    summary: dict[str, Any] = {stage: _summary(values) for stage, values in stages.items()}
    summary["frames_total_ms"] = [frame_total_ms(result) for result in results]
    summary["frames_index"] = [int(result.frame_index) for result in results]
    summary["frames_timestamp_s"] = [float(result.timestamp_s) for result in results]
    summary["frames_status"] = [str(result.status) for result in results]
    summary["frames_keyframe"] = [bool(result.is_keyframe) for result in results]
    summary["frames_inliers"] = [result.n_inliers for result in results]
    return summary


def stage_summaries(timings: dict[str, Any]) -> dict[str, dict[str, float]]:
    """The stages alone of what `summarise_timings` returned, "total" and "wall" last."""
    stages = {key: value for key, value in timings.items() if isinstance(value, dict)}
    last = {TOTAL: 1, WALL: 2}
    return dict(sorted(stages.items(), key=lambda item: last.get(item[0], 0)))


def _summary(values_ms: list[float]) -> dict[str, float]:
    values = np.array(values_ms)
    return {
        "median_ms": float(np.median(values)),
        "mean_ms": float(values.mean()),
        "p95_ms": float(np.percentile(values, 95)),
        "max_ms": float(values.max()),
        "n": len(values),
    }
