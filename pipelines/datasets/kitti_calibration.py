"""Calibration as KITTI states it: projection matrices of rectified cameras, and rigid motions.

Owns reading `calib.txt` in its spellings, and what follows from a pair of projection matrices.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pipelines.datasets.calibration import make_camera
from pipelines.datasets.files import Size
from pipelines.errors import DatasetError
from pipelines.geometry import make_T
from pipelines.types import Array, StereoCamera


def read_kitti_matrices(path: Path) -> dict[str, Array]:
    """Numbers of each line by its name, from `P2: ...` and `R_rect ...` alike (float64, flat).

    Raises DatasetError where the file cannot be read or a named line holds other text.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{path}: expected KITTI's calibration, found no text of it.") from error
    matrices = {}
    for row, line in enumerate(lines, start=1):
        words = line.split()
        if not words:
            continue
        try:
            matrices[words[0].rstrip(":")] = np.array([float(word) for word in words[1:]])
        except ValueError as error:
            raise DatasetError(
                f"{path}, line {row}: expected a name and numbers, found {line[:40]!r}; "
                "copy the calibration again."
            ) from error
    return matrices


def projection(matrices: dict[str, Array], number: int, path: Path) -> Array:
    """P of camera `number` (3, 4); raises DatasetError where it is absent or of another size."""
    values = matrices.get(f"P{number}", np.empty(0))
    if values.size != 12:
        found = f"{values.size} numbers" if values.size else ", ".join(matrices) or "nothing"
        raise DatasetError(
            f"{path}: missing calibration, expected the 12 numbers of P{number}, found {found}; "
            "copy the calibration from KITTI."
        )
    return values.reshape(3, 4)


def rigid_motion(matrices: dict[str, Array], names: Iterable[str], path: Path) -> Array:
    """T (4, 4) from the first of `names` that is there: 9 numbers of R or 12 of [R | t]."""
    names = list(names)
    values = next((matrices[name] for name in names if name in matrices), np.empty(0))
    if values.size not in (9, 12):
        raise DatasetError(
            f"{path}: missing calibration, expected 9 or 12 numbers of {' or '.join(names)}, found "
            f"{values.size or 'none'}; copy the calibration from KITTI."
        )
    matrix = values.reshape(3, -1)
    return make_T(matrix[:, :3], matrix[:, 3] if values.size == 12 else np.zeros(3))


def stereo_camera(P_left: Array, P_right: Array, size: Size, path: Path) -> StereoCamera:
    """The rectified pair of two projection matrices (3, 4); see `make_camera` for errors."""
    P = P_left
    return make_camera(size, P[0, 0], P[1, 1], P[0, 2], P[1, 2], P[0, 3] - P_right[0, 3], path)


def T_camera0_camera(P: Array) -> Array:
    """Pose (4, 4) in rectified camera 0 of the camera that P = K [I | t] (3, 4) belongs to.

    KITTI's poses and labels are camera 0's; the colour camera is 6 cm beside it.
    """
    return make_T(np.eye(3), -np.linalg.solve(P[:, :3], P[:, 3]).astype(np.float64))
