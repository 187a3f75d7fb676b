"""Object truth of KITTI tracking: the rows of label_02, in the world of the ego poses.

Owns these rows. Truth: the estimator never calls this module.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from pipelines.datasets.kitti_classes import class_of_kitti
from pipelines.datasets.truth import ever_moves
from pipelines.errors import DatasetError
from pipelines.types import Array, ObjectTruth

NO_OBJECT = "DontCare"  # regions that nobody labelled
N_COLUMNS = 17  # frame track type truncated occluded alpha x1 y1 x2 y2 h w l x y z ry


def read_label_rows(path: Path) -> tuple[list[str], Array]:
    """Types (M,) and numbers (M, 16) of the rows that are objects: the columns without the type.

    Raises DatasetError, with the line, where a row has other columns.
    """
    types, rows = [], []
    for number, line in enumerate(path.read_text(errors="replace").splitlines(), start=1):
        words = line.split()
        if not words:
            continue
        try:
            values = [float(word) for word in words[:2] + words[3:N_COLUMNS]]
        except ValueError:
            values = []
        if len(values) != N_COLUMNS - 1:
            raise DatasetError(
                f"{path}, line {number}: expected frame, track, type and 14 numbers, found "
                f"{line[:40]!r}; copy the labels again."
            )
        if words[2] != NO_OBJECT:
            types.append(words[2])
            rows.append(values)
    return types, np.array(rows).reshape(-1, N_COLUMNS - 1)


def read_kitti_objects(
    path: Path, numbers: list[int], times_s: Array, Ts_world_camera0: Array
) -> ObjectTruth:
    """True object states of the frames `numbers`, (N,) times and (N, 4, 4) poses of camera 0.

    An object's origin is the centre of its 3-D box (labels give that of its bottom); x is along its
    length, y down. Rows of frames without a pose are left out.
    """
    types, rows = read_label_rows(path)
    index_of = {number: i for i, number in enumerate(numbers)}
    frame_index = np.array([index_of.get(int(row[0]), -1) for row in rows], np.int64)
    known = frame_index >= 0
    known[known] = np.isfinite(Ts_world_camera0[frame_index[known]]).all((1, 2))
    rows, frame_index = rows[known], frame_index[known]
    object_id = rows[:, 1].astype(np.int64)
    Ts = Ts_world_camera0[frame_index] @ Ts_camera0_object(rows)
    names = [class_of_kitti(kind) for kind, row in zip(types, known, strict=True) if row]
    return ObjectTruth(
        frame_index=frame_index,
        object_id=object_id,
        class_name=np.array(names, np.str_),
        Ts_world_object=Ts,
        boxes_px=rows[:, 5:9],
        moving=ever_moves(object_id, times_s[frame_index], Ts[:, :3, 3]),
    )


def Ts_camera0_object(rows: Array) -> Array:
    """(M, 4, 4) in rectified camera 0, of rows (M, 16): h w l, x y z of the bottom, ry."""
    Ts = np.tile(np.eye(4), (len(rows), 1, 1))
    if len(rows):
        Ts[:, :3, :3] = Rotation.from_euler("y", rows[:, 15:16]).as_matrix()
    Ts[:, :3, 3] = rows[:, 12:15]
    Ts[:, 1, 3] -= rows[:, 9] / 2
    return Ts
