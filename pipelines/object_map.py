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


def write_object_map(folder: Path, log: Sequence[FrameObservations] | None = None) -> None:
    """Write objects_map.ply of a result folder from its trajectory, objects and observations.

    log: the observations, where they are at hand; without any the map holds the ways alone.
    """
    if log is None:
        log = read_observations(folder / names.OBSERVATIONS)
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
    the object from there. timestamps_s (F,), Ts_world_camera (F, 4, 4): of the tracked frames.
    """
    seen = Sightings.concatenate(*(entry.sightings for entry in log))
    seen = seen[seen.object_id != STATIC]
    camera_of = _cameras(log, timestamps_s, Ts_world_camera)
    known = np.isfinite(objects.Ts_world_object).all((1, 2))
    known &= objects.state != str(ObjectState.COASTING)
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
    Ls = objects.Ts_world_object[[row_of[pair] for pair in pairs]].reshape(-1, 4, 4)
    last_Ls = objects.Ts_world_object[[last_row[j] for j, _ in pairs]].reshape(-1, 4, 4)
    Xs = np.array([camera_of[frame] for _, frame in pairs]).reshape(-1, 4, 4)
    moved = last_Ls @ invert_T(Ls) @ Xs
    points_m = np.einsum("nij,nj->ni", moved[:, :3, :3], seen.position_m) + moved[:, :3, 3]
    return points_m, seen.object_id


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
