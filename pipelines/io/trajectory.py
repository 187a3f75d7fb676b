"""Camera trajectories as text: TUM (stamped, quaternions) and KITTI (3x4 matrices, one a frame).

Owns the two formats, both camera-to-world. Knows nothing of alignment or status.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.errors import FormatError
from pipelines.geometry import T_from_q_xyzw, orthonormalise, q_xyzw_from_T
from pipelines.io.files import write_text
from pipelines.types import Array

TUM_HEADER = "# timestamp_s tx_m ty_m tz_m qx qy qz qw (camera to world)\n"
QUATERNION_NORM_TOLERANCE = 1e-2  # a row further from 1 than this was never a rotation


def write_tum(path: Path | str, timestamps_s: Array, Ts_world_camera: Array) -> None:
    """Write stamped poses in the TUM format.

    timestamps_s: (N,). Ts_world_camera: (N, 4, 4), finite. N may be 0: the file then holds its
    header alone. Raises ValueError for poses that are not finite, DyObError where the disk refuses.
    """
    Ts = np.asarray(Ts_world_camera, float).reshape(-1, 4, 4)
    stamps = np.asarray(timestamps_s, float)
    if len(stamps) != len(Ts):
        raise ValueError(f"write_tum: expected a stamp per pose, found {len(stamps)}, {len(Ts)}")
    _check_finite("write_tum", Ts)
    lines = [TUM_HEADER]
    if len(Ts):
        rows = np.column_stack([Ts[:, :3, 3], q_xyzw_from_T(Ts)])
        lines += [
            f"{stamp:.9f} " + " ".join(f"{value:.9f}" for value in row) + "\n"
            for stamp, row in zip(stamps, rows, strict=True)
        ]
    write_text(path, "".join(lines))


def read_tum(path: Path | str) -> tuple[Array, Array]:
    """Stamps (N,) in seconds and poses (N, 4, 4), camera-to-world, of a TUM file.

    Raises FormatError, with the line's number, where a row is not eight finite numbers or its
    quaternion is not of unit length.
    """
    rows, numbers = _read_rows(Path(path), 8, "timestamp tx ty tz qx qy qz qw")
    if len(rows) == 0:
        return np.empty(0), np.empty((0, 4, 4))
    norms = np.linalg.norm(rows[:, 4:], axis=1)
    bad = np.flatnonzero(np.abs(norms - 1.0) > QUATERNION_NORM_TOLERANCE)
    if len(bad):
        raise FormatError(
            f"{path}, line {numbers[bad[0]]}: expected a unit quaternion, found one of length "
            f"{norms[bad[0]]:.3f}; the order must be timestamp tx ty tz qx qy qz qw"
        )
    return rows[:, 0], T_from_q_xyzw(rows[:, 1:4], rows[:, 4:])


def write_kitti(path: Path | str, Ts_world_camera: Array) -> None:
    """Write poses (N, 4, 4) as the twelve numbers of [R | t], a row a frame (KITTI odometry)."""
    Ts = np.asarray(Ts_world_camera, float).reshape(-1, 4, 4)
    _check_finite("write_kitti", Ts)
    lines = (" ".join(f"{value:.9f}" for value in T[:3].ravel()) + "\n" for T in Ts)
    write_text(path, "".join(lines))


def read_kitti(path: Path | str) -> Array:
    """Poses (N, 4, 4), camera-to-world, of a KITTI odometry file, rotations made exact.

    Raises FormatError, with the line's number, where a row is not twelve finite numbers or its
    3x3 part is not a rotation.
    """
    rows, numbers = _read_rows(Path(path), 12, "the rows of [R | t]")
    Ts = np.tile(np.eye(4), (len(rows), 1, 1))
    Ts[:, :3] = rows.reshape(-1, 3, 4)
    R = Ts[:, :3, :3]
    away = np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max((1, 2), initial=0.0)
    bad = np.flatnonzero((away > QUATERNION_NORM_TOLERANCE) | (np.linalg.det(R) < 0))
    if len(bad):
        raise FormatError(
            f"{path}, line {numbers[bad[0]]}: expected a rotation matrix in [R | t], found one "
            f"that is off by {away[bad[0]]:.3f}; check that the file holds poses row by row"
        )
    return orthonormalise(Ts) if len(Ts) else Ts


def _check_finite(owner: str, Ts: Array) -> None:
    bad = np.flatnonzero(~np.isfinite(Ts).all((1, 2)))
    if len(bad):
        raise ValueError(f"{owner}: expected finite poses, found NaN in pose {bad[0]}")


def _read_rows(path: Path, columns: int, meaning: str) -> tuple[Array, list[int]]:
    """Numbers (N, columns) of a text table with # comments, and the line number of each row."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(
            f"{path}: expected a trajectory as text, found it unreadable ({error}); check the path"
        ) from error
    rows: list[list[float]] = []
    numbers: list[int] = []
    for number, line in enumerate(lines, 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        try:
            row = [float(word) for word in words]
        except ValueError:
            row = []
        if len(row) != columns or not np.isfinite(row).all():
            raise FormatError(
                f"{path}, line {number}: expected {columns} finite numbers ({meaning}), found "
                f"'{line[:60]}'; remove or repair the line"
            )
        rows.append(row)
        numbers.append(number)
    return np.array(rows, float).reshape(-1, columns), numbers
