"""KITTI tracking: colour stereo pairs of several sequences side by side, labels, oxts.

Owns this layout. Calibration is in `kitti_calibration`, truth in `kitti_labels` and `oxts`.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Self

import numpy as np

from pipelines.datasets.file_sequence import FileSequence, FrameFiles, common_image_size
from pipelines.datasets.kitti_calibration import (
    T_camera0_camera,
    projection,
    read_kitti_matrices,
    rigid_motion,
    stereo_camera,
)
from pipelines.datasets.kitti_labels import read_kitti_objects
from pipelines.datasets.oxts import read_oxts
from pipelines.datasets.tree import frame_numbers, list_files, tree_error
from pipelines.datasets.truth import read_kitti_poses, read_numbered_poses
from pipelines.errors import DatasetError
from pipelines.geometry import invert_T
from pipelines.types import Array, GroundTruth

log = logging.getLogger("dyob")
LEFT, RIGHT = "image_02", "image_03"
RAW = "data"  # KITTI's raw recordings have image_02/data, and no labels
FPS = 10.0  # of KITTI; this layout has no times
NUMBERED_COLUMNS = 17  # of pose files whose rows begin with the frame's number


class KittiTrackingSequence(FileSequence):
    """One sequence of KITTI tracking, left and right colour images."""

    dataset = "kitti_tracking"
    layout = (
        "image_02/SSSS/000000.png ..., image_03/SSSS/, calib/SSSS.txt (of one sequence SSSS, or of "
        "several, of which --sequence SSSS chooses; image_02/SSSS may be given as the path too); "
        "optional label_02/SSSS.txt, and ego poses without which labels are no truth: "
        "oxts/SSSS.txt, else pose_gt/SSSS.txt or poses/SSSS.txt of camera 0 (3 x 4, or frame and "
        "4 x 4)"
    )

    _poses: Path | None = None
    _pose_camera = 0

    @classmethod
    def matches(cls, path: Path) -> bool:
        return bool(cls.inside(path)) or path.parent.name == LEFT

    @classmethod
    def inside(cls, path: Path) -> list[str]:
        folder = path / LEFT
        if not folder.is_dir():
            return []
        return sorted(p.name for p in folder.iterdir() if p.is_dir() and p.name != RAW)

    @classmethod
    def _open(
        cls,
        root: Path,
        sequence: str | None = None,
        poses: Path | str | None = None,
        pose_camera: int = 0,
    ) -> Self:
        """The sequence in `root`.

        sequence: its name; may be left out where there is one. poses: a file of ego poses, in place
        of those of the layout. pose_camera: the camera whose poses it holds, 0 or 2.
        """
        if root.parent.name == LEFT and not (root / LEFT).is_dir():
            root, sequence = root.parent.parent, root.name
        name = cls._chosen(root, sequence)
        lefts, rights = (list_files(root / folder / name) for folder in (LEFT, RIGHT))
        if not lefts:
            advice = f"Put those of {name} there."
            raise tree_error(cls.dataset, cls.layout, root, "no images", advice)
        if not rights:
            missing = f"stereo is needed, but {LEFT}/{name} comes without {RIGHT}/{name}"
            advice = "Add the right colour images: one camera alone has no scale."
            raise tree_error(cls.dataset, cls.layout, root, missing, advice)
        calibration = root / "calib" / f"{name}.txt"
        if not calibration.is_file():
            advice = f"Copy calib/{name}.txt from KITTI."
            raise tree_error(cls.dataset, cls.layout, root, "missing calibration", advice)
        matrices = read_kitti_matrices(calibration)
        P, P_right = (projection(matrices, number, calibration) for number in (2, 3))
        size = common_image_size(list(lefts.values()), None, str(calibration))
        numbers = frame_numbers(lefts)
        frames = [
            FrameFiles(image, image_right=root / RIGHT / name / image.name)
            for image in lefts.values()
        ]
        camera = stereo_camera(P, P_right, size, calibration)
        opened = cls(root, camera, np.array(numbers) / FPS, frames, frame_numbers=numbers)
        opened.name = name
        opened._poses, opened._pose_camera = Path(poses) if poses else None, pose_camera
        return opened

    @classmethod
    def _chosen(cls, root: Path, sequence: str | None) -> str:
        names = cls.inside(root)
        if not names:
            raise tree_error(cls.dataset, cls.layout, root, "no images", "Put the images there.")
        if sequence is None and len(names) == 1:
            return names[0]
        for name in (sequence, (sequence or "").zfill(4)):
            if name in names:
                return str(name)
        wanted = f"sequence {sequence!r}" if sequence else "one sequence, or --sequence to choose"
        raise DatasetError(
            f"{root}: expected {wanted}, found {', '.join(names)}; name one of them."
        )

    def ground_truth(self) -> GroundTruth | None:
        """Poses of the left colour camera, and objects in the same world.

        Labels alone tell where objects are from the camera, not in a world: without ego poses there
        is no truth, and a warning says so.
        """
        labels = self.root / "label_02" / f"{self.name}.txt"
        calibration = self.root / "calib" / f"{self.name}.txt"
        matrices = read_kitti_matrices(calibration)
        T_camera0_left = T_camera0_camera(projection(matrices, 2, calibration))
        Ts_world_camera0 = self._read_ego_poses(matrices, T_camera0_left)
        if Ts_world_camera0 is None:
            if labels.is_file():
                log.warning(
                    "%s has labels but no ego poses (oxts/%s.txt or poses/%s.txt): no truth",
                    *(self.name,) * 3,
                )
            return None
        objects = None
        if labels.is_file():
            objects = read_kitti_objects(labels, self._numbers, self.timestamps_s, Ts_world_camera0)
        return GroundTruth(self.timestamps_s, Ts_world_camera0 @ T_camera0_left, objects)

    def _read_ego_poses(self, matrices: dict[str, Array], T_camera0_left: Array) -> Array | None:
        """Ts_world_camera0 (N, 4, 4); the world is camera 0 of the first frame where from oxts."""
        near = [
            *(self.root / folder / f"{self.name}.txt" for folder in ("oxts", "pose_gt", "poses")),
            *(self.root / file for file in ("pose_gt.txt", "poses.txt")),
        ]
        path = self._poses or next((p for p in near if p.is_file()), None)
        if path is None:
            return None
        if path.parent.name == "oxts":
            T_camera0_imu = (
                rigid_motion(matrices, ("R_rect", "R0_rect"), path)
                @ rigid_motion(matrices, ("Tr_velo_cam", "Tr_velo_to_cam"), path)
                @ rigid_motion(matrices, ("Tr_imu_velo", "Tr_imu_to_velo"), path)
            )
            return _in_first_camera(read_oxts(path, self._numbers), T_camera0_imu)
        with path.open(errors="replace") as file:
            n_columns = len(file.readline().split())
        read = read_numbered_poses if n_columns == NUMBERED_COLUMNS else read_kitti_poses
        Ts = read(path, self._numbers)
        return Ts if self._pose_camera == 0 else Ts @ invert_T(T_camera0_left)


def _in_first_camera(Ts_world_imu: Array, T_camera0_imu: Array) -> Array:
    """Ts_world_camera0 (N, 4, 4) with the first known camera as world.

    Relative to it, as an Earth-sized world would cost digits.
    """
    known = np.flatnonzero(np.isfinite(Ts_world_imu).all((1, 2)))
    if len(known) == 0:
        return Ts_world_imu
    T_first_world = invert_T(Ts_world_imu[known[0]])
    return T_camera0_imu @ T_first_world @ Ts_world_imu @ invert_T(T_camera0_imu)
