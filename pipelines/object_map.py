"""objects_map.ply: points of objects where they were last seen, and the ways of those that moved.

Owns what is in this map, which goes with the static one. Estimates nothing: it is what a finished
run tells of its objects, put together as points in their lasting colours.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.frame_observations import STATIC, FrameObservations, Sightings
from pipelines.geometry import invert_T
from pipelines.io import folder as names
from pipelines.io.objects import read_objects
from pipelines.io.observations import read_observations
from pipelines.io.ply import write_point_cloud
from pipelines.io.trajectory import read_tum
from pipelines.object_colors import object_color
from pipelines.object_types import ObjectEstimates, ObjectState
from pipelines.types import Array

_SAME_S = 1e-6
_MEASURED = (ObjectState.MOVING, ObjectState.STOPPED)  # of others, depth is too poor for a shape
_MARGIN = 1.3  # extents, as they leave out the outermost points


def write_object_map(folder: Path, log: Sequence[FrameObservations] | None = None) -> None:
    """Write objects_map.ply of a result folder from its trajectory, objects and observations.

    log: the observations, where they are at hand; without any the map holds the ways alone.
    """
    if log is None:
        log = read_observations(folder / names.OBSERVATIONS)
    objects = ObjectEstimates.empty()
    if (folder / names.OBJECTS_CSV).exists():
        objects = read_objects(folder / names.OBJECTS_CSV)
    trajectory = read_tum(folder / names.CAMERA_TUM)
    points_m, ids = object_points(objects, log, *trajectory)
    moving = objects[objects.state == str(ObjectState.MOVING)]
    points_m = np.concatenate([points_m, moving.centers_m])
    ids = np.concatenate([ids, moving.object_id])
    known = np.isfinite(points_m).all(axis=1)
    colors = np.array([object_color(j) for j in ids[known].tolist()], np.uint8).reshape(-1, 3)
    write_point_cloud(folder / names.OBJECTS_MAP, points_m[known], colors)


def object_points(
    objects: ObjectEstimates,
    log: Sequence[FrameObservations],
    timestamps_s: Array,
    Ts_world_camera: Array,
) -> tuple[Array, NDArray[np.int64]]:
    """Points (N, 3) in the world and the ids (N,) of their objects, each at its object's last pose.

    A point is taken from the last frame that saw it, when its filter knew it best, and rides on
    the object from there. What lies far beyond the object's extent is none of it: masks spill.
    timestamps_s (F,), Ts_world_camera (F, 4, 4): of the tracked frames.
    """
    seen = Sightings.concatenate(*(entry.sightings for entry in log))
    seen = seen[seen.object_id != STATIC]
    camera_of = _cameras(log, timestamps_s, Ts_world_camera)
    known = np.isfinite(objects.Ts_world_object).all((1, 2))
    known &= np.isin(objects.state, [str(state) for state in _MEASURED])
    row_of = {
        (int(objects.object_id[row]), int(objects.frame_index[row])): row
        for row in np.flatnonzero(known).tolist()
    }
    last_row = {object_id: row for (object_id, _), row in row_of.items()}
    last_seen: dict[tuple[int, int], int] = {}
    for n, (object_id, track_id, frame) in enumerate(
        zip(seen.object_id.tolist(), seen.track_id.tolist(), seen.frame_index.tolist(), strict=True)
    ):
        if (object_id, frame) in row_of and frame in camera_of:
            last_seen[object_id, track_id] = n
    chosen = np.array(list(last_seen.values()), np.int64)
    seen = seen[chosen]
    pairs = list(zip(seen.object_id.tolist(), seen.frame_index.tolist(), strict=True))
    rows = np.array([row_of[pair] for pair in pairs], np.int64)
    last_rows = np.array([last_row[j] for j, _ in pairs], np.int64)
    Xs = np.array([camera_of[frame] for _, frame in pairs]).reshape(-1, 4, 4)
    on_object = _moved(invert_T(objects.Ts_world_object[rows]) @ Xs, seen.position_m)
    last_Ls = objects.Ts_world_object[last_rows]
    centers = _moved(invert_T(last_Ls), objects.centers_m[last_rows])
    reach = 0.5 * _MARGIN * objects.extents_m[last_rows]
    belongs = (np.abs(on_object - centers) <= reach).all(axis=1)
    return _moved(last_Ls, on_object)[belongs], seen.object_id[belongs]


def _moved(Ts: Array, points_m: Array) -> Array:
    """Each of the points (N, 3) by its own transform of (N, 4, 4)."""
    return np.asarray(np.einsum("nij,nj->ni", Ts[:, :3, :3], points_m) + Ts[:, :3, 3])


def _cameras(
    log: Sequence[FrameObservations], timestamps_s: Array, Ts_world_camera: Array
) -> dict[int, Array]:
    """Frame index -> T_world_camera (4, 4) of the tracked frames of the log."""
    cameras = {}
    for entry in log:
        row = int(np.searchsorted(timestamps_s, entry.timestamp_s - _SAME_S))
        if row < len(timestamps_s) and abs(timestamps_s[row] - entry.timestamp_s) < _SAME_S:
            cameras[entry.frame_index] = Ts_world_camera[row]
    return cameras
