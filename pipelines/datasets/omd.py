"""Oxford Multimotion Dataset as its authors publish it: RGB-D or stereo images, Vicon poses.

Owns this layout. VDO-SLAM's prepared copy of it is read by `vdo`.
"""

from __future__ import annotations

import csv
import logging
import re
from pathlib import Path
from typing import Self

import numpy as np

from pipelines.datasets.calibration import RGBD_BF, make_camera
from pipelines.datasets.file_sequence import FileSequence, FrameFiles, common_image_size
from pipelines.datasets.files import DepthCoding, Size
from pipelines.datasets.omd_calibration import (
    OmdCamera,
    T_left_camera,
    camera_of_size,
    read_omd_cameras,
    read_T_apparatus_left,
)
from pipelines.datasets.omd_vicon import object_truth, read_vicon, rig_of
from pipelines.datasets.tree import first_file, list_files, tree_error
from pipelines.datasets.truth import poses_at
from pipelines.errors import DatasetError
from pipelines.geometry import rotation_angle_deg
from pipelines.types import Array, GroundTruth, StereoCamera

log = logging.getLogger("dyob")
IMAGES = {"rgbd": "_color", "stereo": "_left"}  # folder: end of its images' stems
PARTNERS = {"rgbd": "_aligned_depth", "stereo": "_right"}
MILLIMETRES = 1000.0  # depth PNG = mm, as a RealSense gives it
FPS = {"rgbd": 30.0, "stereo": 16.0}  # of the two cameras, where no list of times is there
MAX_TILT_DEG = 1.0  # between two images that may pass as rectified
MAX_DISTORTION = 0.05  # first radial coefficient of images that may pass as undistorted


class OmdSequence(FileSequence):
    """One segment of the Oxford Multimotion Dataset, its RGB-D or its stereo camera."""

    dataset = "omd"
    layout = (
        "rgbd/ with 000000_color.png, 000000_aligned_depth.png (mm) ..., rgbd.csv (number, "
        "time_sec, time_nsec), or stereo/ with 000000_left.png, 000000_right.png, stereo.csv, "
        "rectified beforehand; kalibr*.yaml or manufacturer*.yaml here or one folder up; optional "
        "optical_flow/*.flo, instance_masks/*.png by the same numbers; truth, without boxes: "
        "vicon.csv with vicon*.yaml and kalibr*.yaml. VDO-SLAM's copy of it is a vdo folder"
    )
    _camera_kind: str
    _vicon_offset_s: float

    @classmethod
    def matches(cls, path: Path) -> bool:
        return _camera_folder(path, None) is not None

    @classmethod
    def _open(
        cls,
        root: Path,
        camera: str | None = None,
        depth_scale: float = MILLIMETRES,
        vicon_offset_s: float = 0.0,
    ) -> Self:
        """The sequence in `root`.

        camera: "rgbd" or "stereo", the first that is there. depth_scale: value of 1 m in the depth
        images. vicon_offset_s: what to add to a camera time to get Vicon's; the two clocks were
        not synchronised.
        """
        if camera not in (None, *IMAGES):
            raise DatasetError(f"Option camera: expected {' or '.join(IMAGES)}, found {camera!r}.")
        folder = _camera_folder(root, camera)
        if folder is None:
            raise tree_error(cls.dataset, cls.layout, root, "no images", "Put the images there.")
        kind = folder.name
        numbered = _by_number(folder, IMAGES[kind])
        partners = _by_number(folder, PARTNERS[kind])
        if not partners:
            missing = f"no depth and no right images: {kind}/ has no *{PARTNERS[kind]}.png"
            advice = "Add them: one camera alone has no scale."
            raise tree_error(cls.dataset, cls.layout, root, missing, advice)
        size = common_image_size(list(numbered.values()), None, str(folder))
        made = cls._camera(root, kind, size)
        numbers, times_s = _times(folder, list(numbered), FPS[kind])
        flows = _by_number(root / "optical_flow", "", (".flo", ".npy"))
        masks = _by_number(root / "instance_masks", "", (".png", ".npy", ".txt"))
        frames = []
        for k, number in enumerate(numbers):
            image = numbered[number]
            partner = image.with_name(image.name.replace(IMAGES[kind], PARTNERS[kind]))
            follows = k > 0 and numbers[k - 1] == number - 1
            frames.append(
                FrameFiles(
                    image,
                    image_right=partner if kind == "stereo" else None,
                    depth=partner if kind == "rgbd" else None,
                    flow_prev_to_curr=flows.get(number - 1) if follows else None,
                    labels=masks.get(number),
                )
            )
        coding = DepthCoding("metric", depth_scale) if kind == "rgbd" else None
        opened = cls(root, made, times_s, frames, coding, numbers)
        opened._camera_kind, opened._vicon_offset_s = kind, vicon_offset_s
        return opened

    @classmethod
    def _camera(cls, root: Path, kind: str, size: Size) -> StereoCamera:
        """The factory's values, by which depth was aligned to colour, go before Kalibr's."""
        source = _calibration(root, "manufacturer") or _calibration(root, "kalibr")
        if kind == "stereo":
            source = _calibration(root, "kalibr") or source
        if source is None:
            advice = "Copy kalibr.yaml or manufacturer.yaml of the data set there."
            raise tree_error(cls.dataset, cls.layout, root, "missing calibration", advice)
        cameras = read_omd_cameras(source)
        if kind == "stereo":
            return _rectified_pair(cameras, size, source)
        found = camera_of_size(cameras, size, source)
        if _is_distorted(found):
            log.warning("%s: the lens distortion of %s is not removed", source, found.name)
        fx, fy, cx, cy = found.intrinsics
        return make_camera(size, fx, fy, cx, cy, RGBD_BF, source, is_rgbd=True)

    def ground_truth(self) -> GroundTruth | None:
        """Vicon's poses at the times of the images, moved from the rig to the camera in use."""
        path = self.root / "vicon.csv"
        if not path.is_file():
            return None
        rig_yaml, kalibr = _calibration(self.root, "vicon"), _calibration(self.root, "kalibr")
        if rig_yaml is None or kalibr is None:
            log.warning("%s: no vicon.yaml or no kalibr.yaml, so no truth", self.root)
            return None
        T_apparatus_camera = read_T_apparatus_left(rig_yaml)
        if self._camera_kind == "rgbd":
            cameras = read_omd_cameras(kalibr)
            camera = camera_of_size(cameras, (self.camera.width, self.camera.height), kalibr)
            T_apparatus_camera = T_apparatus_camera @ T_left_camera(cameras, camera, kalibr)
        bodies = read_vicon(path)
        times_s = self.timestamps_s + self._vicon_offset_s
        Ts_world_apparatus = poses_at(bodies.pop(rig_of(bodies, path)), times_s)
        objects = object_truth(bodies, times_s)
        return GroundTruth(self.timestamps_s, Ts_world_apparatus @ T_apparatus_camera, objects)


def _camera_folder(root: Path, camera: str | None) -> Path | None:
    for kind in (camera,) if camera else IMAGES:
        if next((root / kind).glob(f"*{IMAGES[kind]}.*"), None) is not None:
            return root / kind
    return None


def _by_number(
    folder: Path, end: str, suffixes: tuple[str, ...] = (".png", ".jpg")
) -> dict[int, Path]:
    """Files of `folder` by the number that their names begin with, of those that end on `end`."""
    found = {}
    for stem, path in list_files(folder, suffixes).items():
        match = re.fullmatch(rf"\D*(\d+){end or '.*'}", stem)
        if match:
            found[int(match.group(1))] = path
    return found


def _calibration(root: Path, name: str) -> Path | None:
    """The yaml called `name`, with its date or without, in the folder or the one above."""
    patterns = (f"{name}.yaml", f"{name}*.yaml")
    return first_file(root, patterns) or first_file(root.resolve().parent, patterns)


def _times(folder: Path, numbers: list[int], fps: float) -> tuple[list[int], Array]:
    """Numbers that have a time, and these times (N,) in seconds, by rgbd.csv or stereo.csv.

    Without the list they follow from `fps`.
    """
    name = f"{folder.name}.csv"
    path = next((p for p in (folder / name, folder.parent / name) if p.is_file()), None)
    if path is None:
        log.warning("%s: no %s; using %.4g frames a second", folder, name, fps)
        return numbers, np.array(numbers) / fps
    time_of = {}
    with path.open(newline="", encoding="utf-8", errors="replace") as file:
        for row, words in enumerate(csv.reader(file), start=1):
            try:
                number, sec, nsec = (int(float(word)) for word in words[:3])
            except ValueError as error:
                if row == 1:
                    continue  # the head
                raise DatasetError(
                    f"{path}, line {row}: expected number, time_sec and time_nsec, found "
                    f"{','.join(words)[:40]!r}; copy the file again."
                ) from error
            time_of[number] = sec + nsec * 1e-9
    kept = [number for number in numbers if number in time_of]
    if len(kept) < len(numbers):
        log.warning("%s: no time of %d of the images", path, len(numbers) - len(kept))
    times_s = np.array([time_of[number] for number in kept])
    if len(kept) == 0 or not np.all(np.diff(times_s) > 0):
        raise DatasetError(
            f"{path}: expected increasing times of the images, found "
            f"{'others' if kept else 'none'}; copy the file again."
        )
    return kept, times_s


def _is_distorted(camera: OmdCamera) -> bool:
    return bool(camera.distortion.size and abs(camera.distortion[0]) > MAX_DISTORTION)


def _rectified_pair(cameras: list[OmdCamera], size: Size, path: Path) -> StereoCamera:
    """cam0 and cam1 as one camera; raises DatasetError unless they can pass as rectified."""
    pair = [c for c in cameras if c.number in (0, 1) and c.size == size]
    T = pair[1].T_camera_previous if len(pair) == 2 else None
    if T is None:
        raise DatasetError(
            f"{path}: missing calibration, expected cam0 and cam1 of {size[0]} x {size[1]} pixels "
            "with T_cn_cnm1, found others; copy kalibr.yaml of the data set."
        )
    tilt_deg = float(rotation_angle_deg(T))
    if tilt_deg > MAX_TILT_DEG or any(_is_distorted(camera) for camera in pair):
        raise DatasetError(
            f"{path}: expected a rectified pair, found cameras {tilt_deg:.1f} deg apart"
            f"{' with lens distortion' if any(map(_is_distorted, pair)) else ''}; rectify the "
            "images first, or use camera rgbd."
        )
    fx, fy, cx, cy = pair[0].intrinsics
    return make_camera(size, fx, fy, cx, cy, fx * abs(T[0, 3]), path)
