"""Text files of Virtual KITTI 2: tables with a head, poses of cameras and of objects.

Owns these tables, of which `intrinsic.txt` and `info.txt` are inputs and the others truth.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pipelines.datasets.kitti_classes import class_of_kitti
from pipelines.errors import DatasetError
from pipelines.geometry import invert_T
from pipelines.object_types import UNNAMED_CLASS
from pipelines.types import Array, ObjectTruth

WORDS = {"True": "1", "False": "0"}
EXTRINSIC_COLUMNS, BBOX_COLUMNS, POSE_COLUMNS, INTRINSIC_COLUMNS = 18, 11, 19, 6


def read_table(path: Path, n_columns: int) -> Array:
    """Numbers (M, n_columns) below the head of a table; True and False are 1 and 0.

    Raises DatasetError, with the line, where a row is another.
    """
    rows = []
    for number, words in _rows(path):
        try:
            values = [float(WORDS.get(word, word)) for word in words]
        except ValueError:
            values = []
        if len(values) != n_columns:
            raise DatasetError(
                f"{path}, line {number}: expected {n_columns} numbers, found "
                f"{' '.join(words)[:40]!r}; copy the file again."
            )
        rows.append(values)
    return np.array(rows).reshape(-1, n_columns)


def read_classes(path: Path) -> dict[int, str]:
    """Class name of each label of the instance masks, which are trackID + 1, from info.txt."""
    classes = {}
    for number, words in _rows(path):
        if len(words) < 2 or not words[0].isdecimal():
            raise DatasetError(
                f"{path}, line {number}: expected trackID, label, model and colour, found "
                f"{' '.join(words)[:40]!r}; copy the file again."
            )
        classes[int(words[0]) + 1] = class_of_kitti(words[1])
    return classes


def read_camera_poses(path: Path, numbers: list[int], camera: int) -> Array:
    """Ts_world_camera (N, 4, 4) of frames `numbers` from extrinsic.txt, which holds inverses."""
    rows = read_table(path, EXTRINSIC_COLUMNS)
    by_number = {int(row[0]): row[2:].reshape(4, 4) for row in rows if row[1] == camera}
    unknown = np.full((4, 4), np.nan)
    return np.stack([invert_T(by_number.get(number, unknown)) for number in numbers])


def read_virtual_objects(
    root: Path, numbers: list[int], camera: int, classes: dict[int, str]
) -> ObjectTruth:
    """True object states of frames `numbers` as `camera` sees them, from pose.txt and bbox.txt.

    object_id: trackID + 1, as in the masks. An object's origin is the centre of its 3-D box; x is
    along its length. It moves if bbox.txt says so of any frame.
    """
    rows = read_table(root / "pose.txt", POSE_COLUMNS)
    boxes = read_table(root / "bbox.txt", BBOX_COLUMNS)
    index_of = {number: i for i, number in enumerate(numbers)}
    rows = rows[(rows[:, 1] == camera) & [int(row[0]) in index_of for row in rows]]
    box_of = {(int(row[0]), int(row[2])): row[[3, 5, 4, 6]] for row in boxes if row[1] == camera}
    moving = {int(row[2]) for row in boxes if row[10]}
    unseen = np.full(4, np.nan)
    keys = [(int(row[0]), int(row[2])) for row in rows]
    return ObjectTruth(
        frame_index=np.array([index_of[number] for number, _ in keys], np.int64),
        object_id=np.array([track + 1 for _, track in keys], np.int64),
        class_name=np.array([classes.get(j + 1, UNNAMED_CLASS) for _, j in keys], np.str_),
        Ts_world_object=_Ts_world_object(rows),
        boxes_px=np.array([box_of.get(key, unseen) for key in keys]).reshape(-1, 4),
        moving=np.array([track in moving for _, track in keys], bool),
    )


def _Ts_world_object(rows: Array) -> Array:
    """(M, 4, 4) of rows of pose.txt: size in columns 4-6, bottom centre in 7-9, angles in 10-12.

    Angles are about y, x and z, applied in Unity's order: z first, then x, then y.
    """
    Ts = np.tile(np.eye(4), (len(rows), 1, 1))
    if len(rows):
        Ts[:, :3, :3] = Rotation.from_euler("YXZ", rows[:, 10:13]).as_matrix()
    # y points down: the centre is half a height above the bottom.
    Ts[:, :3, 3] = rows[:, 7:10] - Ts[:, :3, 1] * rows[:, 5:6] / 2
    return Ts


def first_intrinsics(path: Path, camera: int) -> NDArray[np.float64]:
    """fx, fy, cx, cy (4,) in px of `camera`, which are the same in every frame of this data set."""
    rows = read_table(path, INTRINSIC_COLUMNS)
    rows = rows[rows[:, 1] == camera]
    if len(rows) == 0:
        raise DatasetError(
            f"{path}: missing calibration, expected rows of camera {camera}, found none; "
            "choose camera 0 or 1, or copy the file again."
        )
    return rows[0, 2:]


def _rows(path: Path) -> list[tuple[int, list[str]]]:
    """Line number and words of each row below the head."""
    lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    rows = [(number, line.split()) for number, line in enumerate(lines, start=1)]
    if lines and rows[0][1] and rows[0][1][0] not in ("frame", "trackID"):
        raise DatasetError(
            f"{path}: expected a table whose head begins with frame or trackID, found "
            f"{lines[0][:40]!r}; copy the file again."
        )
    return [(number, words) for number, words in rows[1:] if words]
