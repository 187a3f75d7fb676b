"""The result folder of a run: `ResultWriter` fills it, `load_result` reads it back.

Owns what stands in each file. Computes no errors (that is `pipelines.evaluation`).
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import DyObError
from pipelines.geometry import invert_T, orthonormalise
from pipelines.io import folder as names
from pipelines.io.files import disk_error, read_json, read_yaml, write_json, write_text, write_yaml
from pipelines.io.folder import create_result_folder, open_result_folder
from pipelines.io.object_truth import read_object_truth, write_object_truth
from pipelines.io.objects import read_objects, write_object_trajectories, write_objects
from pipelines.io.ply import read_point_cloud, write_point_cloud
from pipelines.io.timings import summarise_timings
from pipelines.io.trajectory import read_tum, write_kitti, write_tum
from pipelines.object_types import ObjectEstimates, ObjectState
from pipelines.types import (
    Array,
    FrameResult,
    GroundTruth,
    ObjectTruth,
    StaticMap,
    TrackingStatus,
)

__all__ = ["Result", "ResultWriter", "create_result_folder", "load_result", "run_metrics"]


class ResultWriter:
    """Writes the files of one result folder, each whole in one step and as often as one likes.

    So the folder is valid after any call, and a run that ends early leaves what it has.
    """

    def __init__(self, folder: Path | str) -> None:
        self.folder = Path(folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DyObError(disk_error(self.folder, error)) from error

    @contextmanager
    def log_to_file(self, level: int = logging.INFO) -> Iterator[None]:
        """Within the block everything logged under "dyob" also goes to run.log."""
        root = logging.getLogger("dyob")
        try:
            handler = _LogFile(self.folder / names.LOG, encoding="utf-8")
        except OSError as error:
            raise DyObError(disk_error(self.folder / names.LOG, error)) from error
        handler.setLevel(level)
        handler.setFormatter(logging.Formatter("%(asctime)s %(levelname)-7s %(name)s: %(message)s"))
        level_before = root.level
        root.setLevel(min(level, root.level) if root.level else level)
        root.addHandler(handler)
        try:
            yield
        finally:
            root.removeHandler(handler)
            root.setLevel(level_before)
            handler.close()

    def write_config(self, config: dict[str, Any]) -> None:
        """config.yaml: the resolved settings of the run."""
        write_yaml(self.folder / names.CONFIG, config)

    def write_camera(self, results: Sequence[FrameResult]) -> None:
        """camera_tum.txt (measured frames alone) and camera_kitti.txt (every processed frame)."""
        ok = [r for r in results if r.status is TrackingStatus.OK]
        write_tum(self.folder / names.CAMERA_TUM, *_stamped(ok))
        write_kitti(self.folder / names.CAMERA_KITTI, _stamped(results)[1])

    def write_objects(self, results: Sequence[FrameResult]) -> None:
        """objects.csv (a row per object and frame) and a trajectory per object in objects/."""
        objects = ObjectEstimates.concatenate(*(r.objects for r in results))
        write_objects(self.folder / names.OBJECTS_CSV, objects)
        write_object_trajectories(self.folder / names.OBJECTS, objects)

    def write_ground_truth(self, results: Sequence[FrameResult], truth: GroundTruth) -> None:
        """camera_gt_tum.txt, objects_gt.csv, noise_gt.json: the run's truth, moved into our world.

        The camera's is written from the first to the last processed frame, the objects' of the
        processed frames alone, where the truth has any. The noise of the inputs is hardly ever
        known.
        """
        stamps, Ts, T_ours_theirs = _truth_of_run(results, truth)
        if len(Ts) == 0:
            return
        write_tum(self.folder / names.CAMERA_GT_TUM, stamps, Ts)
        if truth.noise is not None:
            write_json(self.folder / names.NOISE_GT, asdict(truth.noise))
        if truth.objects is not None:
            run = np.array([r.frame_index for r in results], np.int64)
            objects = truth.objects[np.isin(truth.objects.frame_index, run)]
            moved = replace(objects, Ts_world_object=T_ours_theirs @ objects.Ts_world_object)
            all_stamps = np.asarray(truth.timestamps_s, float)
            path = self.folder / names.OBJECTS_GT_CSV
            write_object_truth(path, all_stamps[objects.frame_index], moved)

    def write_static_map(self, static_map: StaticMap) -> None:
        """static_map.ply: binary, with colours."""
        write_point_cloud(self.folder / names.STATIC_MAP, static_map.points_m, static_map.colors)

    def write_timings(self, results: Sequence[FrameResult]) -> None:
        """timings.json: see `summarise_timings`."""
        write_json(self.folder / names.TIMINGS, summarise_timings(results))

    def write_metrics(self, metrics: dict[str, Any], text: str) -> None:
        """metrics.json, and the same for people in metrics.txt."""
        write_json(self.folder / names.METRICS_JSON, metrics)
        write_text(self.folder / names.METRICS_TXT, text)

    def write_run(
        self,
        results: Sequence[FrameResult],
        static_map: StaticMap,
        truth: GroundTruth | None = None,
    ) -> None:
        """All that the estimator knows: trajectories, objects, map, timings; and the truth."""
        self.write_camera(results)
        self.write_objects(results)
        self.write_timings(results)
        if truth is not None:
            self.write_ground_truth(results, truth)
        self.write_static_map(static_map)


class _LogFile(logging.FileHandler):
    """A log that goes silent on a full disk: it must not end the run that it tells of."""

    def handleError(self, record: logging.LogRecord) -> None:
        logging.getLogger("dyob").removeHandler(self)


@dataclass(frozen=True, slots=True)
class Result:
    """A result folder in memory.

    timestamps_s: (N,) and Ts_world_camera: (N, 4, 4) of the measured frames. gt_timestamps_s,
    gt_Ts_world_camera: the same of the truth in our world, or None. (M, 3)
    float64 in the world, static_colors: (M, 3) uint8 RGB. metrics: metrics.json, with the blocks
    "run", and "camera", "objects", "batch" where there are such. timings: timings.json, ms a stage.
    config: config.yaml. objects: all rows of objects.csv. gt_objects: the true ones in our world,
    or None.
    """

    folder: Path
    timestamps_s: Array
    Ts_world_camera: Array
    gt_timestamps_s: Array | None
    gt_Ts_world_camera: Array | None
    static_points_m: Array
    static_colors: NDArray[np.uint8]
    metrics: dict[str, Any] = field(default_factory=dict)
    timings: dict[str, Any] = field(default_factory=dict)
    config: dict[str, Any] = field(default_factory=dict)
    objects: ObjectEstimates = field(default_factory=ObjectEstimates.empty)
    gt_objects: ObjectTruth | None = None


def load_result(path: Path | str) -> Result:
    """Read a result folder, or the `latest` link to one.

    >>> result = load_result("results/latest")
    >>> moving = result.objects[result.objects.state == "moving"]

    Only camera_tum.txt must be there: what an interrupted run did not write is empty or None.
    Raises FormatError where the folder is none or one of its files is damaged.
    """
    folder = open_result_folder(path)
    stamps, Ts = read_tum(folder / names.CAMERA_TUM)
    gt_stamps, gt_Ts = None, None
    if (folder / names.CAMERA_GT_TUM).exists():
        gt_stamps, gt_Ts = read_tum(folder / names.CAMERA_GT_TUM)
    points: Array = np.empty((0, 3))
    colors: NDArray[np.uint8] = np.empty((0, 3), np.uint8)
    if (folder / names.STATIC_MAP).exists():
        points, colors = read_point_cloud(folder / names.STATIC_MAP)
    metrics, timings, config = (
        read(folder / name) if (folder / name).exists() else {}
        for name, read in (
            (names.METRICS_JSON, read_json),
            (names.TIMINGS, read_json),
            (names.CONFIG, read_yaml),
        )
    )
    objects, gt_objects = ObjectEstimates.empty(), None
    if (folder / names.OBJECTS_CSV).exists():
        objects = read_objects(folder / names.OBJECTS_CSV)
    if (folder / names.OBJECTS_GT_CSV).exists():
        gt_objects = read_object_truth(folder / names.OBJECTS_GT_CSV)
    return Result(
        folder, stamps, Ts, gt_stamps, gt_Ts, points, colors, metrics, timings, config,
        objects, gt_objects,
    )  # fmt: skip


def run_metrics(
    results: Sequence[FrameResult],
    static_map: StaticMap,
    *,
    sequence: str,
    dataset: str,
    skipped: int = 0,
    interrupted: bool = False,
) -> dict[str, Any]:
    """The "run" block of metrics.json: what happened, without any truth.

    skipped: frames that could not be read. interrupted: whether the run ended before its last.
    """
    tracked = sum(r.status is TrackingStatus.OK for r in results)
    return {
        "sequence": sequence,
        "dataset": dataset,
        "frames": len(results) + skipped,
        "tracked": tracked,
        "lost": len(results) - tracked,
        "skipped": skipped,
        "interrupted": interrupted,
        "keyframes": len(static_map.keyframe_indices),
        "map_points": len(static_map),
        "hypotheses": dict(Counter(str(r.hypothesis) for r in results)),
        "objects": _object_counts(ObjectEstimates.concatenate(*(r.objects for r in results))),
    }


def _object_counts(objects: ObjectEstimates) -> dict[str, Any]:
    """How many lasting objects there were, of which class, and the rows of each state.

    An object's class is that of its last row: detectors grow surer as an object comes nearer.
    """
    last = dict(zip(objects.object_id.tolist(), objects.class_name.tolist(), strict=True))
    moving = objects.object_id[objects.state == str(ObjectState.MOVING)]
    return {
        "tracked": len(last),
        "moving": len(np.unique(moving)),
        "by_class": dict(Counter(last.values())),
        "rows_by_state": dict(Counter(objects.state.tolist())),
    }


def _stamped(results: Sequence[FrameResult]) -> tuple[Array, Array]:
    stamps = np.array([r.timestamp_s for r in results], float)
    Ts = np.array([r.T_world_camera for r in results], float)
    return stamps, Ts.reshape(-1, 4, 4)


def _truth_of_run(results: Sequence[FrameResult], truth: GroundTruth) -> tuple[Array, Array, Array]:
    """Truth from the first to the last processed frame, in our world, and T_ours_theirs (4, 4).

    The world is the first camera, so the first frame that has both poses joins the two frames; it
    is the first of all, unless the truth starts late.
    """
    stamps = np.asarray(truth.timestamps_s, float)
    Ts = np.asarray(truth.Ts_world_camera, float)
    known = np.isfinite(Ts).all((1, 2)) & np.isfinite(stamps)
    if results:
        first, last = results[0].timestamp_s, results[-1].timestamp_s
        known &= (stamps >= first - 1e-6) & (stamps <= last + 1e-6)
    stamps, Ts = stamps[known], orthonormalise(Ts[known])
    if len(Ts) == 0:
        return stamps, Ts, np.eye(4)
    T_ours_theirs = invert_T(Ts[0])
    for result in results:
        row = np.flatnonzero(np.abs(stamps - result.timestamp_s) < 1e-6)
        if result.status is TrackingStatus.OK and len(row):
            T_ours_theirs = result.T_world_camera @ invert_T(Ts[row[0]])
            break
    return stamps, T_ours_theirs @ Ts, T_ours_theirs
