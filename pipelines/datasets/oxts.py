"""Ego poses from KITTI's GPS and inertial unit: rows of `oxts`, 30 numbers a frame.

Owns the rows and their projection onto a plane. Truth: the estimator never calls this module.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pipelines.datasets.truth import read_rows
from pipelines.types import Array

EARTH_RADIUS_M = 6378137.0  # of the Mercator projection
N_COLUMNS = 30  # lat lon alt (deg, deg, m), roll pitch yaw (rad), then speeds and accuracies


def read_oxts(path: Path, numbers: list[int]) -> Array:
    """Ts_world_imu (N, 4, 4) of frames `numbers`; NaN where the file has no row.

    Row n is frame number n; but as many rows as frames are the frames in order. The world is east,
    north, up, in Mercator's projection scaled at the first row's latitude (KITTI raw data
    development kit). Raises DatasetError where the file holds other rows.
    """
    rows = read_rows(path, N_COLUMNS, "rows of oxts (lat lon alt roll pitch yaw ...)")
    Ts = np.full((len(numbers), 4, 4), np.nan)
    at = np.arange(len(rows)) if len(rows) == len(numbers) else np.array(numbers)
    known = at < len(rows)
    if known.any():
        Ts[known] = poses_of_oxts(rows)[at[known]]
    return Ts


def poses_of_oxts(rows: Array) -> Array:
    """Ts_world_imu (N, 4, 4) of rows (N, >= 6): latitude, longitude in degrees, altitude in m,
    roll, pitch, yaw in rad; the inertial unit looks along x, with y to its left."""
    latitude, longitude = np.radians(rows[:, 0]), np.radians(rows[:, 1])
    scale_m = EARTH_RADIUS_M * np.cos(latitude[0])
    Ts = np.tile(np.eye(4), (len(rows), 1, 1))
    Ts[:, 0, 3] = scale_m * longitude
    Ts[:, 1, 3] = scale_m * np.log(np.tan(np.pi / 4 + latitude / 2))
    Ts[:, 2, 3] = rows[:, 2]
    Ts[:, :3, :3] = Rotation.from_euler("ZYX", rows[:, [5, 4, 3]]).as_matrix()
    return Ts
