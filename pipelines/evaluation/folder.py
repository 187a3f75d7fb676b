"""Evaluation of a result folder: reads its files back and renews its metrics.

Owns which files are compared with which. The definitions are in `camera`, `objects` and `bound`
beside it.
"""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.errors import FormatError
from pipelines.evaluation.bound import evaluate_bound
from pipelines.evaluation.camera import associate, evaluate_camera
from pipelines.evaluation.object_truth import RunFrames
from pipelines.evaluation.objects import LIMITS, evaluate_objects
from pipelines.evaluation.table import metrics_text
from pipelines.evaluation.true_problem import build_true_problem, find_true_objects
from pipelines.io import folder as names
from pipelines.io.files import read_json
from pipelines.io.objects import read_objects
from pipelines.io.observations import read_camera, read_observations
from pipelines.io.result import Result, ResultWriter, load_result
from pipelines.io.trajectory import read_tum
from pipelines.object_types import ObjectEstimates
from pipelines.types import Array, KnownNoise, ObjectTruth


def evaluate_result(folder: Path | str, with_bound: bool = False) -> dict[str, Any]:
    """Renew metrics.json and metrics.txt of a result folder by its other files; all its metrics.

    Without camera_gt_tum.txt there is no "camera" block, and without objects_gt.csv no "objects"
    block; "front_end" holds the same of what a batch started from. with_bound: compare with the
    Cramer-Rao bound too, in the block "bound", where noise_gt.json tells the inputs' noise; that
    takes about as long as a batch. Other blocks stay as they are.
    Raises FormatError where `folder` is no result folder or a file of it is damaged.
    """
    result = load_result(folder)
    own = ("camera", "objects", "front_end", "bound")
    metrics = {key: value for key, value in result.metrics.items() if key not in own}
    metrics |= _errors(result)
    before = front_end_of(result)
    if before is not None:
        metrics["front_end"] = _errors(before)
    if with_bound and (result.folder / names.NOISE_GT).exists():
        metrics |= _bound(result, before)
    writer = ResultWriter(result.folder)
    writer.write_metrics(metrics, metrics_text(metrics, result.timings))
    return metrics


def _errors(result: Result) -> dict[str, Any]:
    """The blocks "camera" and "objects", as far as the truth is known."""
    blocks: dict[str, Any] = {}
    if result.gt_Ts_world_camera is not None:
        blocks["camera"] = evaluate_camera(
            result.timestamps_s, result.Ts_world_camera, *truth_by_frame(result)
        )
    if result.gt_objects is not None:
        frames = processed_frames(result)
        blocks["objects"] = evaluate_objects(result.objects, result.gt_objects, frames)
    return blocks


def _bound(result: Result, before: Result | None) -> dict[str, Any]:
    """The block "bound", where the truth and what each frame saw are known."""
    path = result.folder / names.NOISE_GT
    try:
        noise = KnownNoise(**read_json(path))
    except TypeError as error:
        raise FormatError(
            f"{path}: expected flow_px and disparity_px, found other values ({error}); "
            "run the sequence again"
        ) from error
    log = read_observations(result.folder / names.OBSERVATIONS)
    frames, front_end = processed_frames(result), before or result
    if not log or not np.isfinite(frames.Ts_world_camera).any():
        return {}
    camera = read_camera(result.folder / names.OBSERVATIONS)
    truth = result.gt_objects or ObjectTruth.empty()
    them = find_true_objects(front_end.objects, truth, frames, LIMITS)
    problem = build_true_problem(camera, log, front_end.objects, them, frames, noise)
    if problem.n_frames < 2 or len(problem.tracks) == 0:
        return {}
    Ts = [
        r.Ts_world_camera[associate(problem.timestamps_s, r.timestamps_s)[1]]
        for r in (front_end, result)
    ]
    final = None if before is None else Ts[1]
    blocks = evaluate_bound(problem, Ts[0], front_end.objects, final, result.objects)
    return {"bound": {"noise": asdict(noise), **blocks}}


def front_end_of(result: Result) -> Result | None:
    """The same result with what the front-end had said, where a batch has changed it, or None."""
    kept = result.folder / names.FRONT_END
    if not (kept / names.CAMERA_TUM).exists():
        return None
    stamps, Ts = read_tum(kept / names.CAMERA_TUM)
    objects = ObjectEstimates.empty()
    if (kept / names.OBJECTS_CSV).exists():
        objects = read_objects(kept / names.OBJECTS_CSV)
    return replace(result, timestamps_s=stamps, Ts_world_camera=Ts, objects=objects)


def processed_frames(result: Result) -> RunFrames:
    """The frames that the run processed, with the true camera where it is known.

    They are those of timings.json; without that file, those that objects.csv names, which lacks a
    frame only where no object was tracked in it.
    """
    index = np.array(result.timings.get("frames_index", []), np.int64)
    stamps = np.array(result.timings.get("frames_timestamp_s", []), float)
    if len(index) == 0 or len(index) != len(stamps):
        index, first = np.unique(result.objects.frame_index, return_index=True)
        stamps = result.objects.timestamp_s[first]
    Ts = np.full((len(index), 4, 4), np.nan)
    if result.gt_timestamps_s is not None and result.gt_Ts_world_camera is not None:
        rows, gt_rows = associate(stamps, result.gt_timestamps_s)
        Ts[rows] = result.gt_Ts_world_camera[gt_rows]
    return RunFrames(index, stamps, Ts)


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
