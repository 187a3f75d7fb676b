"""Vicon's measurements of the Oxford Multimotion Dataset: poses of the rig and of each object.

Owns vicon.csv. Truth: the estimator never calls this module.
"""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np

from pipelines.datasets.truth import ever_moves, poses_at
from pipelines.errors import DatasetError
from pipelines.types import Array, ObjectTruth

RIG = ("sensor", "payload", "apparatus")  # parts of the name that the cameras' rig has
N_COLUMNS = 10  # time_sec time_nsec object qx qy qz qw tx ty tz; its 4 x 4 may follow


def read_vicon(path: Path) -> dict[str, Array]:
    """Rows (M, 8) `time tx ty tz qx qy qz qw` of each tracked body by its name, in order of time.

    Raises DatasetError, with the line, where a row is another.
    """
    rows: dict[str, list[list[float]]] = {}
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        for number, words in enumerate(csv.reader(file), start=1):
            if number == 1 or not words:
                continue
            try:
                sec, nsec, *values = (float(w) for w in words[:2] + words[3:N_COLUMNS])
            except ValueError:
                values = []
            if len(values) != 7:
                raise DatasetError(
                    f"{path}, line {number}: expected time_sec, time_nsec, object, qx qy qz qw and "
                    f"tx ty tz, found {','.join(words)[:40]!r}; copy vicon.csv again."
                )
            rows.setdefault(words[2].strip(), []).append(
                [sec + nsec * 1e-9, *values[4:], *values[:4]]
            )
    return {name: np.array(found) for name, found in rows.items()}


def rig_of(bodies: dict[str, Array], path: Path) -> str:
    """Name of the body that carries the cameras."""
    found = [name for name in bodies if any(part in name.lower() for part in RIG)]
    if len(found) != 1:
        raise DatasetError(
            f"{path}: expected one body that carries the cameras, such as sensor_payload, found "
            f"{', '.join(found or bodies) or 'no body at all'}."
        )
    return found[0]


def object_truth(bodies: dict[str, Array], timestamps_s: Array) -> ObjectTruth:
    """States of all `bodies` at (N,) camera times, in Vicon's world.

    An object's origin is where Vicon has it. Ids are the numbers at the ends of the names (box3 is
    3), or 1, 2, ... where names have none. Boxes are unknown: nothing measures them.
    """
    names = sorted(bodies)
    numbers = [int(m.group(1)) for name in names if (m := re.search(r"(\d+)$", name))]
    ids = numbers if len(set(numbers)) == len(names) and 0 not in numbers else None
    index, object_id, classes, Ts = [], [], [], []
    for j, name in enumerate(names):
        poses = poses_at(bodies[name], timestamps_s)
        known = np.flatnonzero(np.isfinite(poses).all((1, 2)))
        index.append(known)
        object_id.append(np.full(len(known), ids[j] if ids else j + 1))
        classes += [re.sub(r"[\d_]+$", "", name) or name] * len(known)
        Ts.append(poses[known])
    frame_index = np.concatenate([np.empty(0), *index]).astype(np.int64)
    which = np.concatenate([np.empty(0), *object_id]).astype(np.int64)
    states = np.concatenate([np.empty((0, 4, 4)), *Ts])
    order = np.lexsort((which, frame_index))
    frame_index, which, states = frame_index[order], which[order], states[order]
    return ObjectTruth(
        frame_index=frame_index,
        object_id=which,
        class_name=np.array(classes, np.str_)[order],
        Ts_world_object=states,
        boxes_px=np.full((len(which), 4), np.nan),
        moving=ever_moves(which, timestamps_s[frame_index], states[:, :3, 3]),
    )
