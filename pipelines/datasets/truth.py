"""Ground truth files of the known layouts, read only when the evaluator asks.

Owns parsing of trajectories and object poses into camera-to-world motions per frame. The estimator
never calls this module.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.timestamps import ASSOCIATE_MAX_S
from pipelines.errors import DatasetError
from pipelines.geometry import T_from_q_xyzw
from pipelines.types import Array

MAX_GAP_S = 0.15  # poses farther apart than this are not interpolated between
MOVING_MPS = 1.0  # an object that moves faster than this over a second moves at all


def read_rows(path: Path, n_columns: int, what: str) -> Array:
    """Rows (N, n_columns) of numbers from a text file; raises DatasetError where it has others."""
    try:
        rows = np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: expected {what}, found other text ({error}).") from error
    if rows.size and rows.shape[1] != n_columns:
        raise DatasetError(
            f"{path}: expected {what}, {n_columns} numbers a row, found {rows.shape[1]}."
        )
    return rows.reshape(-1, n_columns)


def read_tum_poses(path: Path, timestamps_s: Array) -> Array:
    """Ts_world_camera (N, 4, 4) at `timestamps_s` from `time tx ty tz qx qy qz qw` rows.

    See `poses_at` for what lies between two rows.
    """
    return poses_at(read_rows(path, 8, "time tx ty tz qx qy qz qw"), timestamps_s)


def poses_at(rows: Array, timestamps_s: Array) -> Array:
    """Poses (N, 4, 4) at `timestamps_s` from rows (M, 8): time, position in m, q_xyzw.

    Between two rows at most 0.15 s apart: linear in position, slerp in rotation. Else the nearest
    row within 0.02 s. NaN where there is neither.
    """
    from scipy.spatial.transform import Rotation, Slerp

    rows = rows[np.isfinite(rows).all(1) & (np.linalg.norm(rows[:, 4:], axis=1) > 0.5)]
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]
    Ts = np.full((len(timestamps_s), 4, 4), np.nan)
    if len(rows) == 0:
        return Ts
    times_s = rows[:, 0]
    after = np.searchsorted(times_s, timestamps_s).clip(0, len(rows) - 1)
    before = (after - 1).clip(0)
    to_before = np.abs(times_s[before] - timestamps_s)
    to_after = np.abs(times_s[after] - timestamps_s)
    nearest = np.where(to_before < to_after, before, after)
    gap_s = np.minimum(to_before, to_after)
    inside = (times_s[0] <= timestamps_s) & (timestamps_s <= times_s[-1])
    between = inside & (times_s[after] - times_s[before] <= MAX_GAP_S) & (gap_s > 1e-6)
    near = ~between & (gap_s <= ASSOCIATE_MAX_S)
    Ts[near] = T_from_q_xyzw(rows[nearest[near], 1:4], rows[nearest[near], 4:])
    if between.any():
        t_s = timestamps_s[between]
        position = np.stack([np.interp(t_s, times_s, rows[:, i]) for i in (1, 2, 3)], -1)
        q_xyzw = Slerp(times_s, Rotation.from_quat(rows[:, 4:]))(t_s).as_quat()
        Ts[between] = T_from_q_xyzw(position, q_xyzw)
    return Ts


def read_kitti_poses(path: Path, numbers: list[int]) -> Array:
    """Ts_world_camera (N, 4, 4) of camera 0 from KITTI rows of 3 x 4; NaN where there is no row.

    Row n is frame number n; but as many rows as frames are the frames in order.
    """
    rows = read_rows(path, 12, "3 x 4 poses")
    Ts = np.full((len(numbers), 4, 4), np.nan)
    at = np.arange(len(rows)) if len(rows) == len(numbers) else np.array(numbers)
    known = at < len(rows)
    Ts[known] = np.eye(4)
    Ts[known, :3] = rows[at[known]].reshape(-1, 3, 4)
    return Ts


def read_numbered_poses(path: Path, numbers: list[int]) -> Array:
    """Ts_world_camera (N, 4, 4) of frames `numbers` from rows `frame, 4 x 4`; NaN where absent."""
    rows = read_rows(path, 17, "frame and a 4 x 4 pose")
    by_number = {int(row[0]): row[1:].reshape(4, 4) for row in rows}
    unknown = np.full((4, 4), np.nan)
    return np.stack([by_number.get(number, unknown) for number in numbers])


def ever_moves(
    object_id: NDArray[np.int64], times_s: Array, positions_m: Array
) -> NDArray[np.bool_]:
    """Which rows (M,) belong to an object that moves at > 1 m/s over some second of its life.

    positions_m: (M, 3) in the world. Shorter lives are judged as a whole; slower apparent motion
    is what labels and camera poses of KITTI show of parked cars.
    """
    moving = np.zeros(len(object_id), bool)
    for j in np.unique(object_id):
        rows = np.flatnonzero(object_id == j)
        rows = rows[np.argsort(times_s[rows])]
        t, p = times_s[rows], positions_m[rows]
        span_s = min(1.0, t[-1] - t[0])
        end = np.searchsorted(t, t + span_s - 1e-6)
        start = np.flatnonzero(end < len(t))
        path_m = np.linalg.norm(p[end[start]] - p[start], axis=1)
        moving[rows] = bool(span_s > 0 and (path_m > MOVING_MPS * span_s).any())
    return moving
