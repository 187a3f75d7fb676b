"""Reads what KITTI tracking says of one sequence: camera, ego poses and labelled boxes.

Owns the three text files of a sequence and their faults. Motion is made of them in
`kitti_motion.py`; the files are the user's own and are only ever read.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import DatasetError
from pipelines.types import Array, StereoCamera

LABELS_VARIABLE = "DYOB_KITTI_TRACKING"
WIDTH_PX, HEIGHT_PX = 1242, 375
# The poses that come with the labels were estimated from stereo and are 3 % too long: cars that
# stand still fit best with this factor in most sequences.
EGO_SCALE = 0.97
_CLASSES = (
    "Car", "Van", "Truck", "Pedestrian", "Person", "Person_sitting", "Cyclist", "Tram", "Misc",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class KittiLabels:
    """One sequence as labelled; parallel arrays of M rows, one per box.

    camera: the left colour pair. Ts_world_camera: (N, 4, 4) of that camera, as estimated, in true
    scale. frame, track: (M,) int64. kind: (M,) KITTI's class. size_m: (M, 3) width, height,
    length. bottom_m: (M, 3) middle of the box's underside in the left colour camera. heading_rad:
    (M,) which way it faces, from the camera's z towards its x.
    """

    camera: StereoCamera
    Ts_world_camera: Array
    frame: NDArray[np.int64]
    track: NDArray[np.int64]
    kind: NDArray[np.str_]
    size_m: Array
    bottom_m: Array
    heading_rad: Array


@dataclass(frozen=True, slots=True)
class KittiFiles:
    """The three files of a sequence, found but not yet read."""

    labels: Path
    calibration: Path
    poses: Path

    @classmethod
    def find(cls, sequence: str, folder: Path | str | None = None) -> KittiFiles:
        """Files of `sequence` ("0000" to "0020") in `folder`, or in $DYOB_KITTI_TRACKING.

        Raises DatasetError that says what is missing and how to give it.
        """
        chosen = folder or os.environ.get(LABELS_VARIABLE)
        wanted = (
            f"label_02/{sequence}.txt",
            f"calib/{sequence}.txt",
            f"orbslam3_poses/{sequence}/CameraTrajectory.txt",
        )
        if not chosen:
            raise DatasetError(
                f"simulated:kitti_{sequence} moves things as KITTI's tracking labels say, and no "
                f"folder of these was given: set {LABELS_VARIABLE} (or the option labels) to the "
                f"folder that holds {', '.join(wanted)}"
            )
        root = Path(chosen)
        missing = [name for name in wanted if not (root / name).is_file()]
        if missing:
            raise DatasetError(
                f"{root}: expected {', '.join(wanted)} for simulated:kitti_{sequence}, found no "
                f"{' and no '.join(missing)}; get the labels, calibration and ego poses (camera to "
                f"world, 12 numbers a line) of KITTI tracking, and set {LABELS_VARIABLE} to the "
                "folder that holds them"
            )
        return cls(*(root / name for name in wanted))

    def digest(self) -> str:
        """A hash of everything in the three files."""
        total = hashlib.sha256()
        for file in (self.labels, self.calibration, self.poses):
            content = file.read_bytes()
            total.update(len(content).to_bytes(8, "little") + content)
        return total.hexdigest()

    def read(self) -> KittiLabels:
        """Everything in them; DatasetError where a file is not of its form."""
        P2, P3 = _projections(self.calibration)
        bf = float(P2[0, 3] - P3[0, 3])
        fx, fy, cx, cy = (float(P2[i, j]) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
        if min(fx, fy, bf) <= 0:
            raise DatasetError(
                f"{self.calibration}: expected P2 and P3 of a stereo pair, "
                f"found fx={fx}, fy={fy}, bf={bf}"
            )
        camera = StereoCamera(WIDTH_PX, HEIGHT_PX, fx, fy, cx, cy, bf)
        Ts = _poses(self.poses)
        # Labels are in camera 0, P2 = K [I | t] says where the left colour camera is.
        to_camera = np.linalg.solve(P2[:, :3], P2[:, 3])
        return _labels(self.labels, camera, Ts, to_camera)


def _projections(file: Path) -> tuple[Array, Array]:
    found = {}
    for line in file.read_text().splitlines():
        name, _, numbers = line.partition(":")
        if name in ("P2", "P3"):
            try:
                found[name] = np.array(numbers.split(), float).reshape(3, 4)
            except ValueError as error:
                raise DatasetError(
                    f"{file}: expected 12 numbers after {name}:, found {numbers!r}"
                ) from error
    if len(found) < 2:
        raise DatasetError(
            f"{file}: expected lines P2: and P3:, found {', '.join(found) or 'none'}"
        )
    return found["P2"], found["P3"]


def _poses(file: Path) -> Array:
    try:
        rows = np.loadtxt(file, ndmin=2)
    except ValueError as error:
        raise DatasetError(f"{file}: expected 12 numbers a line ({error})") from error
    if rows.shape[1:] != (12,) or len(rows) < 3 or not np.isfinite(rows).all():
        raise DatasetError(
            f"{file}: expected at least 3 lines of 12 finite numbers, found {rows.shape}"
        )
    Ts = np.tile(np.eye(4), (len(rows), 1, 1))
    Ts[:, :3] = rows.reshape(-1, 3, 4)
    Ts[:, :3, 3] *= EGO_SCALE
    return Ts


def _labels(file: Path, camera: StereoCamera, Ts: Array, to_camera: Array) -> KittiLabels:
    rows = [line.split() for line in file.read_text().splitlines() if line.strip()]
    rows = [row for row in rows if len(row) < 3 or row[2] in _CLASSES]
    try:
        numbers = np.array([[float(v) for v in (*row[:2], *row[10:17])] for row in rows])
        if rows and numbers.shape != (len(rows), 9):
            raise ValueError(f"{numbers.shape[-1] + 8} columns")
    except ValueError as error:
        raise DatasetError(f"{file}: expected 17 columns a line, found {error}") from error
    numbers = numbers.reshape(-1, 9)
    inside = (numbers[:, 0] >= 0) & (numbers[:, 0] < len(Ts))
    n = numbers[inside]
    h, w, length = n[:, 2:5].T
    return KittiLabels(
        camera,
        Ts,
        n[:, 0].astype(np.int64),
        n[:, 1].astype(np.int64),
        np.array([row[2] for row in rows], str)[inside],
        np.stack([w, h, length], 1),
        n[:, 5:8] + to_camera,
        n[:, 8] + np.pi / 2,  # KITTI's rotation_y is 0 along the camera's x
    )
