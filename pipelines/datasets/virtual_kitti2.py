"""Virtual KITTI 2: rendered streets with exact depth, flow and instance masks.

Owns this layout and its coding of flow. Its text files are in `virtual_kitti2_tables`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.calibration import make_camera
from pipelines.datasets.file_sequence import FileSequence, FrameFiles, common_image_size
from pipelines.datasets.files import DepthCoding, Size, read_normalised_flow
from pipelines.datasets.tree import frame_numbers, list_files, tree_error
from pipelines.datasets.virtual_kitti2_tables import (
    first_intrinsics,
    read_camera_poses,
    read_classes,
    read_virtual_objects,
)
from pipelines.errors import DatasetError
from pipelines.types import GroundTruth

BASELINE_M = 0.532725  # of Camera_0 and Camera_1
CENTIMETRES = 100.0  # depth PNG = cm; 65535 is the sky
FPS = 10.0  # of the KITTI sequences that the scenes are clones of; there are no times
SCENES, RGB = "Scene*", Path("frames") / "rgb"
DEPTH_SOURCES = ("files", "stereo")


class VirtualKitti2Sequence(FileSequence):
    """One variation of one scene, such as Scene01/clone; masks name their classes."""

    dataset = "virtual_kitti2"
    layout = (
        "SceneXX/VARIATION/ (clone, fog, 15-deg-left ...) with frames/rgb/Camera_0/rgb_00000.jpg "
        "..., frames/depth/Camera_0/ (PNG, cm) or frames/rgb/Camera_1/, intrinsic.txt; optional "
        "frames/forwardFlow/, frames/instanceSegmentation/, info.txt, and extrinsic.txt, pose.txt, "
        "bbox.txt as truth; unpack all archives into one folder; give a variation, a scene "
        "(clone is taken), or the folder of the scenes with --sequence SceneXX"
    )
    _classes: dict[int, str]
    _camera_number: int

    @classmethod
    def matches(cls, path: Path) -> bool:
        if not path.is_dir():
            return False
        patterns = (f"{RGB}/Camera_*", f"*/{RGB}/Camera_*", f"{SCENES}/*/{RGB}/Camera_*")
        return any(next(path.glob(pattern), None) is not None for pattern in patterns)

    @classmethod
    def _open(
        cls,
        root: Path,
        variation: str | None = None,
        camera: int = 0,
        depth_source: str | None = None,
    ) -> Self:
        """The sequence in `root`: a variation's folder, or a scene's with `variation` ("clone").

        camera: 0 or 1. depth_source: "files" for the exact depth, "stereo" for right images in
        place of it; files where there are any.
        """
        if depth_source not in (None, *DEPTH_SOURCES):
            raise DatasetError(
                f"Option depth_source: expected {' or '.join(DEPTH_SOURCES)}, "
                f"found {depth_source!r}."
            )
        folder = cls._variation_folder(root, variation)
        frames = folder / "frames"
        images = list_files(folder / RGB / f"Camera_{camera}")
        if not images:
            missing = f"no images of camera {camera}"
            raise tree_error(cls.dataset, cls.layout, folder, missing, "Put the images there.")
        there = {
            "files": bool(list_files(frames / "depth" / f"Camera_{camera}")),
            "stereo": camera == 0 and bool(list_files(folder / RGB / "Camera_1")),
        }
        wanted = DEPTH_SOURCES if depth_source is None else (depth_source,)
        source = next((name for name in wanted if there[name]), None)
        if source is None:
            missing = "no depth and no right images" if depth_source is None else "no such depth"
            advice = "Unpack the depth archive, or the images of both cameras, into this folder."
            raise tree_error(cls.dataset, cls.layout, folder, missing, advice)
        stereo = source == "stereo"
        calibration = folder / "intrinsic.txt"
        if not calibration.is_file():
            advice = "Unpack the archive of texts (textgt) into this folder."
            raise tree_error(cls.dataset, cls.layout, folder, "missing calibration", advice)
        fx, fy, cx, cy = first_intrinsics(calibration, camera)
        size = common_image_size(list(images.values()), None, str(calibration))
        made = make_camera(size, fx, fy, cx, cy, fx * BASELINE_M, calibration)
        numbers = frame_numbers(images)
        files = _frame_files(frames, list(images.values()), numbers, camera, stereo)
        coding = None if stereo else DepthCoding("metric", CENTIMETRES)
        opened = cls(folder, made, np.array(numbers) / FPS, files, coding, numbers)
        if folder.resolve().parent.name.startswith("Scene"):
            opened.name = f"{folder.resolve().parent.name}_{opened.name}"
        info = folder / "info.txt"
        opened._classes = read_classes(info) if info.is_file() else {}
        opened._camera_number = camera
        return opened

    @classmethod
    def _variation_folder(cls, root: Path, variation: str | None) -> Path:
        """The folder that has frames/rgb: `root` itself or the wanted one below it."""
        if (root / RGB).is_dir():
            return root
        found = sorted(p.parent.parent for p in root.glob(f"*/{RGB}"))
        found = found or sorted(p.parent.parent for p in root.glob(f"{SCENES}/*/{RGB}"))
        if not found:
            raise tree_error(cls.dataset, cls.layout, root, "no images", "Put the images there.")
        chosen = [p for p in found if p.name == (variation or "clone")]
        if not chosen and variation is None:
            chosen = found
        if len(chosen) != 1:
            names = ", ".join(str(p.relative_to(root)) for p in chosen or found)
            raise DatasetError(
                f"{root} as {cls.dataset}: expected one sequence, found {names}; give the path of "
                "one of them, or its name with --sequence."
            )
        return chosen[0]

    def ground_truth(self) -> GroundTruth | None:
        """Truth from extrinsic.txt, with objects where pose.txt and bbox.txt are there."""
        if not (self.root / "extrinsic.txt").is_file():
            return None
        number = self._camera_number
        Ts = read_camera_poses(self.root / "extrinsic.txt", self._numbers, number)
        objects = None
        if all((self.root / name).is_file() for name in ("pose.txt", "bbox.txt")):
            objects = read_virtual_objects(self.root, self._numbers, number, self._classes)
        return GroundTruth(self.timestamps_s, Ts, objects)

    def _decode_flow(self, path: Path, size: Size) -> NDArray[np.float32]:
        return read_normalised_flow(path, size)

    def _read_classes(self, index: int, labels: NDArray[np.int32]) -> dict[int, str] | None:
        if not self._classes:
            return None
        seen = np.unique(labels).tolist()
        return {label: self._classes[label] for label in seen if label in self._classes}


def _frame_files(
    frames: Path, images: list[Path], numbers: list[int], camera: int, stereo: bool
) -> list[FrameFiles]:
    """The files of each frame by its number; a folder that is absent gives no path at all."""

    def folder_of(kind: str) -> Path | None:
        folder = frames / kind / f"Camera_{camera}"
        return folder if list_files(folder, (".png",)) else None

    flows, masks = folder_of("forwardFlow"), folder_of("instanceSegmentation")
    depths = frames / "depth" / f"Camera_{camera}"
    rights = frames / "rgb" / "Camera_1"
    return [
        FrameFiles(
            image=image,
            image_right=rights / image.name if stereo else None,
            depth=None if stereo else depths / f"depth_{number:05d}.png",
            # forwardFlow/flow_k points from k to k + 1; a gap in the images has none.
            flow_prev_to_curr=flows / f"flow_{number - 1:05d}.png"
            if flows and k > 0 and numbers[k - 1] == number - 1
            else None,
            labels=masks / f"instancegt_{number:05d}.png" if masks else None,
        )
        for k, (image, number) in enumerate(zip(images, numbers, strict=True))
    ]
