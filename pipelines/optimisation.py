"""The batch on a result folder: reads what the run recorded, and renews the run's answers.

Owns which files are read, kept beside and replaced. What is optimised is in `backend`.
"""

from __future__ import annotations

import logging
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.backend.batch_outcome import (
    corrections,
    map_after,
    objects_after,
    static_track_ids,
    trajectory_after,
)
from pipelines.backend.global_batch import BatchResult, run_global_batch
from pipelines.backend.guard import MIN_HELD_OUT
from pipelines.backend.partial_batch import run_partial_batch
from pipelines.backend.point_motion_batch import run_point_motion_batch
from pipelines.config import BatchConfig
from pipelines.errors import DyObError, FormatError
from pipelines.evaluation import evaluate_result
from pipelines.frame_observations import FrameObservations
from pipelines.frontend.disparity_offset import with_last_offset
from pipelines.io import folder as names
from pipelines.io.files import disk_error, read_json, write_json
from pipelines.io.folder import open_result_folder
from pipelines.io.objects import cell, read_objects, write_object_trajectories, write_objects
from pipelines.io.objects import write_table as write_csv
from pipelines.io.observations import read_camera, read_map_points, read_observations
from pipelines.io.ply import read_point_cloud, write_point_cloud
from pipelines.io.trajectory import write_kitti, write_tum
from pipelines.object_map import write_object_map
from pipelines.object_types import ObjectEstimates
from pipelines.types import Array

BATCH = "batch"  # block of metrics.json
_KEPT = (names.CAMERA_TUM, names.CAMERA_KITTI, names.OBJECTS_CSV, names.STATIC_MAP)
_STD_COLUMNS = (
    "frame", "timestamp_s", "std_rx_deg", "std_ry_deg", "std_rz_deg",
    "std_x_m", "std_y_m", "std_z_m",
)  # fmt: skip
_log = logging.getLogger("dyob.batch")

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class _Start:
    """What a batch starts from: the log, and the front-end's files, read back."""

    log: list[FrameObservations]
    objects: ObjectEstimates
    kept: Path


def optimise_result(
    path: Path | str, config: BatchConfig, progress: Progress = lambda done, total: None
) -> dict[str, Any]:
    """Run a batch on a finished run, write what it makes better, and evaluate anew.

    The front-end's answers are kept in `front_end/`, and each batch starts from them, however often
    it is run. What the batch would make worse stays as it was, with a sentence in the log. Returns
    all metrics; the block "batch" says what was done. Raises FormatError where the folder is no
    result, or where its run recorded no observations.
    """
    folder = open_result_folder(path)
    begin = time.perf_counter()
    start = _read_start(folder)
    camera = read_camera(folder / names.OBSERVATIONS)
    if config.method == "partial":
        result = run_partial_batch(camera, start.log, config, progress)
    elif config.method == "point_motion":
        result = run_point_motion_batch(camera, start.log, start.objects, config, progress)
    else:
        result = run_global_batch(camera, start.log, start.objects, config, progress)
    if result is None or not result.accepted:
        _restore(folder, start)
    else:
        _write(folder, start, result)
    write_object_map(folder, start.log)
    block = _block(result, config, time.perf_counter() - begin)
    _tell(result, block)
    metrics_path = folder / names.METRICS_JSON
    metrics = read_json(metrics_path) if metrics_path.exists() else {}
    write_json(metrics_path, {**metrics, BATCH: block})
    return evaluate_result(folder)


def _read_start(folder: Path) -> _Start:
    log = read_observations(folder / names.OBSERVATIONS)
    if not log:
        raise FormatError(
            f"{folder}: expected recorded observations in {names.OBSERVATIONS}/, found none; run "
            "the sequence again with batch.record=true"
        )
    kept = folder / names.FRONT_END
    if not (kept / names.CAMERA_TUM).exists():
        _keep(folder, kept)
    objects = ObjectEstimates.empty()
    if (kept / names.OBJECTS_CSV).exists():
        objects = read_objects(kept / names.OBJECTS_CSV)
    log = with_last_offset(read_camera(folder / names.OBSERVATIONS), log)
    return _Start(log, objects, kept)


def _keep(folder: Path, kept: Path) -> None:
    """Copy the front-end's answers aside, the trajectory last: where it is, the copy is whole."""
    try:
        kept.mkdir(exist_ok=True)
        for name in (*_KEPT[1:], _KEPT[0]):
            if (folder / name).exists():
                shutil.copy2(folder / name, kept / f"{name}.part")
                (kept / f"{name}.part").replace(kept / name)
    except OSError as error:
        raise DyObError(disk_error(kept, error)) from error


def _restore(folder: Path, start: _Start) -> None:
    """Put the front-end's answers back, where an earlier batch may have changed them."""
    try:
        for name in _KEPT:
            if (start.kept / name).exists():
                shutil.copy2(start.kept / name, folder / f".{name}.part")
                (folder / f".{name}.part").replace(folder / name)
        (folder / names.CAMERA_STD).unlink(missing_ok=True)
    except OSError as error:
        raise DyObError(disk_error(folder, error)) from error
    write_object_trajectories(folder / names.OBJECTS, start.objects)


def _write(folder: Path, start: _Start, result: BatchResult) -> None:
    """The renewed files, each whole in one step."""
    moved = corrections(start.log, result)
    Ts = trajectory_after(start.log, moved)
    tracked = np.array([entry.is_tracked for entry in start.log], bool)
    stamps = np.array([entry.timestamp_s for entry in start.log])
    write_tum(folder / names.CAMERA_TUM, stamps[tracked], Ts[tracked])
    write_kitti(folder / names.CAMERA_KITTI, Ts)
    objects, pose_std = objects_after(start.objects, start.log, moved, result)
    write_objects(folder / names.OBJECTS_CSV, objects, pose_std)
    write_object_trajectories(folder / names.OBJECTS, objects)
    if (start.kept / names.STATIC_MAP).exists():
        points_m, colors = read_point_cloud(start.kept / names.STATIC_MAP)
        track_ids = read_map_points(folder / names.OBSERVATIONS)
        log_ids = static_track_ids(result.before, start.log)
        points_m = map_after(points_m, track_ids, log_ids, result)
        write_point_cloud(folder / names.STATIC_MAP, points_m, colors)
    if result.covariances is None:
        (folder / names.CAMERA_STD).unlink(missing_ok=True)
    else:
        _write_camera_std(folder / names.CAMERA_STD, result, result.covariances.cameras)


def _write_camera_std(path: Path, result: BatchResult, covariances: Array) -> None:
    """camera_std.csv: standard deviations of each tracked frame's pose, in the camera's axes."""
    std = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0.0))
    std[:, :3] = np.degrees(std[:, :3])
    problem = result.before
    rows = (
        [str(index), f"{stamp:.9f}", *(cell(value, 6) for value in row)]
        for index, stamp, row in zip(problem.frame_index, problem.timestamps_s, std, strict=True)
    )
    write_csv(path, _STD_COLUMNS, rows)


def _block(result: BatchResult | None, config: BatchConfig, time_s: float) -> dict[str, Any]:
    """The "batch" block of metrics.json."""
    if result is None:
        return {"method": config.method, "accepted": False, "time_s": time_s, "frames": 0}
    verdicts = {
        str(v.object_id): {
            "held_out": v.n_held_out,
            "error_before": v.before,
            "error_after": v.after,
            "accepted": v.accepted,
        }
        for v in result.verdicts
    }
    return {
        "method": config.method,
        "accepted": result.accepted,
        "time_s": time_s,
        "frames": result.before.n_frames,
        "points": result.before.tracks.n_tracks,
        "sightings": len(result.before.tracks),
        "object_poses": len(result.before.Ts_world_object),
        "outliers": result.n_outliers,
        "motions_kept": int(result.kept_motions.sum()),
        "cost_before": result.cost_before,
        "cost_after": result.cost_after,
        "camera": verdicts.pop("0"),
        "objects": verdicts,
    }


def _tell(result: BatchResult | None, block: dict[str, Any]) -> None:
    if result is None:
        _log.info("batch: too few frames or points to optimise; the front-end's answers stay")
        return
    for verdict in result.verdicts:
        if verdict.accepted:
            continue
        what = f"object {verdict.object_id}" if verdict.object_id else "the camera"
        if verdict.n_held_out < MIN_HELD_OUT:
            _log.info(
                "batch not believed for %s: %d held-out sightings are too few to judge it; the "
                "front-end's answer is kept", what, verdict.n_held_out,
            )  # fmt: skip
            continue
        _log.info(
            "batch refused for %s: held-out error %.3f before, %.3f after; the front-end's "
            "answer is kept", what, verdict.before, verdict.after,
        )  # fmt: skip
    if result.kept_motions.any():
        _log.info(
            "batch refused for %d single motions of objects, which fit what was seen of them worse "
            "than the front-end's", int(result.kept_motions.sum()),
        )  # fmt: skip
    _log.info(
        "batch: %d frames, %d sightings of %d points, cost %.0f -> %.0f, held-out error of the "
        "camera %.3f -> %.3f, %.1f s", block["frames"], block["sightings"], block["points"],
        result.cost_before, result.cost_after, result.verdicts[0].before,
        result.verdicts[0].after, block["time_s"],
    )  # fmt: skip
