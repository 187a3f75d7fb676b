"""KITTI odometry: rectified stereo pairs, projection matrices, times and poses.

Owns this layout. Decoding is in `files`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Self

import numpy as np

from pipelines.datasets.file_sequence import FileSequence, FrameFiles, common_image_size
from pipelines.datasets.files import DepthCoding, DepthForm, Size
from pipelines.datasets.kitti_calibration import T_camera0_camera, stereo_camera
from pipelines.datasets.timestamps import frame_times
from pipelines.datasets.tree import first_folder, frame_numbers, list_files, tree_error
from pipelines.datasets.truth import read_kitti_poses
from pipelines.errors import DatasetError
from pipelines.types import Array, GroundTruth, StereoCamera

PAIRS = {"image_0": ("image_1", 0), "image_2": ("image_3", 2)}  # left: right, number of its P
DISPARITY_FACTOR = 256.0  # KITTI's development kit: disparity PNG = px * 256
FPS = 10.0  # of KITTI, where there is no times.txt


class KittiOdometrySequence(FileSequence):
    """One sequence folder of KITTI odometry, grey (image_0, image_1) or colour (image_2, image_3).

    depth/ is read where there are no right images.
    """

    dataset = "kitti_odometry"
    layout = (
        "image_0/ and image_1/ (grey) or image_2/ and image_3/ (colour) with 000000.png ..., "
        "calib.txt (P0 ... P3); optional times.txt, poses.txt or poses/NAME.txt, "
        "depth/ (16-bit PNG, disparity * 256) instead of right images"
    )

    @classmethod
    def matches(cls, path: Path) -> bool:
        left = first_folder(path, PAIRS)
        if left is None or (path / "semantic").exists() or (path / "camera.yaml").exists():
            return False
        return (path / "calib.txt").is_file() or (
            (path / PAIRS[left.name][0]).is_dir() and not any(path.glob("*.y*ml"))
        )

    @classmethod
    def _open(
        cls,
        root: Path,
        images: str | None = None,
        depth_source: str = "stereo",
        depth_form: DepthForm = "disparity",
        depth_factor: float = DISPARITY_FACTOR,
    ) -> Self:
        """The sequence in `root`.

        images: left folder, "image_0" or "image_2"; the first that is there. depth_source: "files"
        for depth/ in place of right images. depth_form, depth_factor: see DepthCoding.
        """
        if images is not None and images not in PAIRS:
            raise DatasetError(f"Option images: expected {' or '.join(PAIRS)}, found {images!r}.")
        left_folder = first_folder(root, (images,) if images else PAIRS)
        lefts = list_files(left_folder) if left_folder else {}
        if left_folder is None or not lefts:
            raise tree_error(cls.dataset, cls.layout, root, "no images", "Put the images there.")
        right_name, number = PAIRS[left_folder.name]
        rights, depths = list_files(root / right_name), list_files(root / "depth")
        if not rights and not depths:
            missing = f"stereo is needed, but {left_folder.name}/ comes without {right_name}/"
            advice = f"Add {right_name}/ or depth/: one camera alone has no scale."
            raise tree_error(cls.dataset, cls.layout, root, missing, advice)
        if not (root / "calib.txt").is_file():
            advice = "Copy calib.txt of this sequence from KITTI."
            raise tree_error(cls.dataset, cls.layout, root, "missing calibration", advice)
        size = common_image_size(list(lefts.values()), None, "calib.txt")
        camera = _read_camera(root / "calib.txt", number, size)
        stereo = bool(rights) and not (depths and depth_source == "files")
        coding = None if stereo else DepthCoding(depth_form, depth_factor, camera.bf)
        times_file = root / "times.txt"
        fps = None if times_file.is_file() else FPS
        frames = [
            FrameFiles(
                image,
                image_right=root / right_name / image.name if stereo else None,
                depth=None if stereo else root / "depth" / f"{stem}.png",
            )
            for stem, image in lefts.items()
        ]
        times_s = frame_times(times_file, fps, len(lefts), root)
        return cls(root, camera, times_s, frames, coding, frame_numbers(lefts))

    def ground_truth(self) -> GroundTruth | None:
        """Poses of the left camera in use, from poses.txt or poses/NAME.txt near the sequence."""
        name = self.root.resolve().name
        near = (
            self.root / "poses.txt",
            self.root / "poses" / f"{name}.txt",
            self.root.resolve().parent / "poses" / f"{name}.txt",
            self.root.resolve().parent.parent / "poses" / f"{name}.txt",
        )
        path = next((p for p in near if p.is_file()), None)
        if path is None:
            return None
        Ts_world_camera0 = read_kitti_poses(path, self._numbers)
        number = PAIRS[self._frames[0].image.parent.name][1]
        P = _read_projections(self.root / "calib.txt")[number]
        return GroundTruth(self.timestamps_s, Ts_world_camera0 @ T_camera0_camera(P))


def _read_projections(path: Path) -> dict[int, Array]:
    """Projection matrices (3, 4) by camera number, from lines `P0: ...` or bare rows in order."""
    projections: dict[int, Array] = {}
    for row, line in enumerate(filter(None, map(str.strip, path.read_text().splitlines()))):
        tag, _, rest = line.rpartition(":")
        if tag and not (tag.startswith("P") and tag[1:].isdigit()):
            continue  # Tr and other matrices
        try:
            values = np.array([float(word) for word in rest.split()])
        except ValueError:
            values = np.empty(0)
        if values.size != 12:
            raise DatasetError(
                f"{path}, line {row + 1}: expected the 12 numbers of a 3 x 4 projection matrix, "
                f"found {values.size or 'other text'}; copy calib.txt again."
            )
        projections[int(tag[1:]) if tag else row] = values.reshape(3, 4)
    return projections


def _read_camera(path: Path, number: int, size: Size) -> StereoCamera:
    projections = _read_projections(path)
    # Two bare rows are the pair in use, whichever it is.
    left, right = (0, 1) if set(projections) == {0, 1} else (number, number + 1)
    if left not in projections or right not in projections:
        raise DatasetError(
            f"{path}: missing calibration, expected P{number} and P{number + 1}, found "
            f"{', '.join(f'P{n}' for n in projections) or 'none'}; copy calib.txt from KITTI."
        )
    return stereo_camera(projections[left], projections[right], size, path)
