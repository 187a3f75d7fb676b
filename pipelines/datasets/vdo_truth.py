"""Object truth of VDO-SLAM's layout: object_pose.txt in both its forms, and gt_objects.npz.

Owns these two files. In this layout the labels of the masks are the truth's object ids.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects
from scipy.spatial.transform import Rotation

from pipelines.datasets.truth import ever_moves, read_rows
from pipelines.errors import DatasetError, FrameError
from pipelines.types import Array, ObjectTruth

Boxes = dict[tuple[int, int], Array]  # of (frame index, object id): x1 y1 x2 y2
CLASS_NAME = "object"  # this layout names no classes


def read_object_truth(
    root: Path,
    numbers: list[int],
    times_s: Array,
    Ts_world_camera: Array,
    read_mask: Callable[[int], NDArray[np.int32] | None],
) -> ObjectTruth | None:
    """True object states of the frames `numbers`, or None where the folder has none.

    gt_objects.npz (ids, moving, poses in the world for every frame) is exact and goes first.
    object_pose.txt comes as KITTI's `frame id x1 y1 x2 y2 x y z ry` in the camera of its frame
    (origin at the bottom centre, x along the length), or as `frame id x y z rx ry rz 0 0` in the
    world (rotation vector). Boxes that no file states are those of the masks, which also say how
    many pixels of an object are seen.
    """
    index_of = {number: i for i, number in enumerate(numbers)}
    rows: Array = np.empty((0, 10))
    if (root / "object_pose.txt").is_file():
        rows = read_rows(root / "object_pose.txt", 10, "frame, object id and 8 numbers")
        rows = rows[[int(row[0]) in index_of for row in rows]]
    has_boxes = _has_boxes(rows)
    frame_index = np.array([index_of[int(row[0])] for row in rows], np.int64)
    object_id = rows[:, 1].astype(np.int64)
    boxes: Boxes = {}
    if has_boxes:
        boxes = dict(
            zip(
                zip(frame_index.tolist(), object_id.tolist(), strict=True),
                rows[:, 2:6],
                strict=True,
            )
        )
    exact = root / "gt_objects.npz"
    if len(rows) == 0 and not exact.is_file():
        return None
    mask_boxes, counts = _mask_boxes(len(numbers), read_mask)
    if exact.is_file():
        frame_index, object_id, Ts, moving = _read_npz(exact, numbers)
        has_boxes = has_boxes and not counts  # the masks that it was made with show what is seen
    else:
        Ts = _kitti_Ts(rows, Ts_world_camera[frame_index]) if has_boxes else _world_Ts(rows)
        moving = ever_moves(object_id, times_s[frame_index], Ts[:, :3, 3])
    if not has_boxes:
        boxes = mask_boxes
    unseen = np.full(4, np.nan)
    keys = list(zip(frame_index.tolist(), object_id.tolist(), strict=True))
    return ObjectTruth(
        frame_index=frame_index,
        object_id=object_id,
        class_name=np.full(len(object_id), CLASS_NAME),
        Ts_world_object=Ts,
        boxes_px=np.array([boxes.get(key, unseen) for key in keys]).reshape(-1, 4),
        moving=moving,
        n_pixels=np.array([counts.get(key, 0) for key in keys], np.int64) if counts else None,
    )


def _has_boxes(rows: Array) -> bool:
    """Whether object_pose.txt is of KITTI's form: boxes in order, and no padding of zeros."""
    ordered = (rows[:, 4] >= rows[:, 2]).all() and (rows[:, 5] >= rows[:, 3]).all()
    return bool(len(rows) and ordered and (rows[:, 8:] != 0).any())


def _read_npz(
    path: Path, numbers: list[int]
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array, NDArray[np.bool_]]:
    try:
        with np.load(path, allow_pickle=False) as content:
            ids, moving_ids, poses = (content[key] for key in ("ids", "moving", "poses"))
    except (OSError, ValueError, KeyError, EOFError) as error:
        raise DatasetError(f"{path}: expected arrays ids, moving and poses ({error}).") from error
    if poses.ndim != 4 or poses.shape[0] != len(ids) or poses.shape[2:] != (4, 4):
        raise DatasetError(
            f"{path}: expected poses ({len(ids)}, frames, 4, 4), found {poses.shape}."
        )
    index = np.array([i for i, number in enumerate(numbers) if number < poses.shape[1]], np.int64)
    at = np.array(numbers)[index]
    object_id = np.tile(ids.astype(np.int64), len(index))
    Ts = poses[:, at].transpose(1, 0, 2, 3).reshape(-1, 4, 4).astype(np.float64)
    return np.repeat(index, len(ids)), object_id, Ts, np.isin(object_id, moving_ids)


def _kitti_Ts(rows: Array, Ts_world_camera: Array) -> Array:
    """Ts_world_object (M, 4, 4) of rows with position and yaw `ry` about the camera's y axis."""
    Ts_camera_object = np.tile(np.eye(4), (len(rows), 1, 1))
    Ts_camera_object[:, :3, :3] = Rotation.from_euler("y", rows[:, 9:]).as_matrix()
    Ts_camera_object[:, :3, 3] = rows[:, 6:9]
    return Ts_world_camera @ Ts_camera_object


def _world_Ts(rows: Array) -> Array:
    Ts = np.tile(np.eye(4), (len(rows), 1, 1))
    Ts[:, :3, :3] = Rotation.from_rotvec(rows[:, 5:8]).as_matrix()
    Ts[:, :3, 3] = rows[:, 2:5]
    return Ts


def _mask_boxes(
    n_frames: int, read_mask: Callable[[int], NDArray[np.int32] | None]
) -> tuple[Boxes, dict[tuple[int, int], int]]:
    """Boxes and numbers of pixels, by frame index and label, of all that the masks show."""
    boxes: Boxes = {}
    counts: dict[tuple[int, int], int] = {}
    for k in range(n_frames):
        try:
            labels = read_mask(k)
        except FrameError:  # a run skips such a frame, and says so
            continue
        places = [] if labels is None else find_objects(labels)
        for j, place in enumerate(places, start=1):
            if place is not None and labels is not None:
                v, u = place
                boxes[k, j] = np.array([u.start, v.start, u.stop - 1, v.stop - 1], np.float64)
                counts[k, j] = int((labels[place] == j).sum())
    return boxes, counts
