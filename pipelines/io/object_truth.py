"""True objects of a run as text: objects_gt.csv, in the world of the estimate.

Owns its columns. The estimator never sees this file; the evaluator reads nothing else.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.io.objects import BOX, POSE, Table, cell, pose_cells, write_table
from pipelines.types import Array, ObjectTruth

IDENTITY = ("frame", "timestamp_s", "object_id", "class_name", "moving")
COLUMNS = (*IDENTITY, *BOX, "n_pixels", *POSE)


def write_object_truth(path: Path | str, timestamps_s: Array, truth: ObjectTruth) -> None:
    """Write the truth (M rows) with the stamps (M,) of its frames; what is unknown is empty."""
    poses = pose_cells(truth.Ts_world_object)
    rows = (
        [
            str(truth.frame_index[i]), f"{timestamps_s[i]:.9f}", str(truth.object_id[i]),
            str(truth.class_name[i]), str(int(truth.moving[i])),
            *(cell(value, 7) for value in truth.boxes_px[i]),
            "" if truth.n_pixels is None else str(truth.n_pixels[i]), *poses[i],
        ]
        for i in range(len(truth))
    )  # fmt: skip
    write_table(path, COLUMNS, rows)


def read_object_truth(path: Path | str) -> ObjectTruth:
    """The rows of objects_gt.csv. Raises FormatError where the file is damaged."""
    table = Table(Path(path))
    n_pixels = table.numbers(("n_pixels",))[:, 0]
    return ObjectTruth(
        frame_index=table.integers("frame"),
        object_id=table.integers("object_id"),
        class_name=table.words("class_name"),
        Ts_world_object=table.poses(POSE),
        boxes_px=table.numbers(BOX),
        moving=table.integers("moving").astype(bool),
        n_pixels=n_pixels.astype(np.int64) if np.isfinite(n_pixels).all() else None,
    )
