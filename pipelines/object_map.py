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
    frames, Xs = _cameras(log, timestamps_s, Ts_world_camera)
    known = np.isfinite(objects.Ts_world_object).all((1, 2))
    known &= np.isin(objects.state, [str(state) for state in _MEASURED])
    rows = np.flatnonzero(known)
    row_of = _RowsByFrame(objects.object_id[rows], objects.frame_index[rows])
    at, at_frame = row_of.find(seen.object_id, seen.frame_index), _find(frames, seen.frame_index)
    usable = np.flatnonzero((seen.object_id != STATIC) & (at >= 0) & (at_frame >= 0))
    # Of each point's sightings the last, as the log goes by frames
    point = np.column_stack([seen.object_id[usable], seen.track_id[usable]])[::-1]
    _, last = np.unique(point, axis=0, return_index=True)
    chosen = usable[::-1][last]
    seen, Xs, at = seen[chosen], Xs[at_frame[chosen]], rows[at[chosen]]
    _, last_of_object = np.unique(objects.object_id[rows][::-1], return_index=True)
    last_rows = rows[::-1][last_of_object]
    last_rows = last_rows[np.searchsorted(objects.object_id[last_rows], seen.object_id)]
    on_object = _moved(invert_T(objects.Ts_world_object[at]) @ Xs, seen.position_m)
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
) -> tuple[NDArray[np.int64], Array]:
    """Frame indices (F,), ascending, and T_world_camera (F, 4, 4) of the log's tracked frames."""
    times = np.array([entry.timestamp_s for entry in log])
    frames = np.array([entry.frame_index for entry in log], np.int64)
    row = np.searchsorted(timestamps_s, times - _SAME_S)
    row = np.minimum(row, len(timestamps_s) - 1)
    tracked = np.abs(timestamps_s[row] - times) < _SAME_S if len(timestamps_s) else row >= 0
    return frames[tracked], Ts_world_camera[row[tracked]]


class _RowsByFrame:
    """Finds the row of an object in a frame."""

    def __init__(self, object_id: NDArray[np.int64], frame_index: NDArray[np.int64]) -> None:
        self._stride = int(frame_index.max(initial=0)) + 1
        key = object_id * self._stride + frame_index
        self._order = np.argsort(key, kind="stable")
        self._key = key[self._order]

    def find(
        self, object_id: NDArray[np.int64], frame_index: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """(N,) rows, -1 where there is none."""
        at = _find(self._key, object_id * self._stride + frame_index)
        at[(frame_index < 0) | (frame_index >= self._stride)] = -1
        return np.where(at >= 0, np.append(self._order, -1)[at], -1)


def _find(ascending: NDArray[np.int64], wanted: NDArray[np.int64]) -> NDArray[np.int64]:
    """(N,) where each is in an ascending array, -1 where it is not."""
    if len(ascending) == 0:
        return np.full(len(wanted), -1)
    at = np.minimum(np.searchsorted(ascending, wanted), len(ascending) - 1)
    return np.where(ascending[at] == wanted, at, -1)
