"""Video files: both images of a stereo pair in one, or in two, or colour with depth beside it.

Owns this layout. Decoding is in `video_reader`, the yaml's keys in `calibration`.
"""

from __future__ import annotations

import logging
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self

import numpy as np

from pipelines.datasets.calibration import (
    CAMERA_YAML,
    RGBD_BF,
    Settings,
    bf_of,
    depth_coding_of,
    make_camera,
    number,
    read_camera_yaml,
    required,
    settings_size,
)
from pipelines.datasets.file_sequence import check_options, read_optional
from pipelines.datasets.files import DepthCoding, Size, read_depth
from pipelines.datasets.folder import DEPTH_SUFFIXES, IMAGE_FOLDERS
from pipelines.datasets.sequence import Sequence
from pipelines.datasets.timestamps import frame_times
from pipelines.datasets.tree import describe_folder, first_folder, list_files
from pipelines.datasets.video_reader import VideoReader
from pipelines.errors import DatasetError
from pipelines.types import Array, Frame, Image, StereoCamera

log = logging.getLogger("dyob")
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v")
LEFT_RIGHT, TOP_BOTTOM = "left_right", "top_bottom"
WHERE_SCALE_COMES_FROM = (
    "give it a stereo pair in one video (`stereo: left_right` or `stereo: top_bottom` in "
    "camera.yaml), a right.mp4 beside a left.mp4, or a folder depth/ of 16-bit PNGs beside the "
    "video"
)


@dataclass(frozen=True, slots=True)
class VideoFiles:
    """What lies beside a video. stereo: how both images share it, or None where they do not."""

    video: Path
    right: Path | None
    depths: list[Path]
    stereo: str | None
    yaml: Path
    settings: Settings


class VideoSequence(Sequence):
    """A recording as video: both images of a stereo pair, or colour with depth images beside it."""

    dataset = "video"
    layout: ClassVar[str] = (
        "FILE.mp4 (.avi, .mkv, .mov, .webm), or a folder that holds one, with FILE.yaml or "
        "camera.yaml beside it as `folder` has, and in which `stereo: left_right` (or top_bottom) "
        "says that both rectified images share the video; or left.mp4 and right.mp4; or depth/ "
        "(16-bit PNG, or .npy in metres) beside it, one a frame in order; optional times.txt, else "
        "the rate of the video counts"
    )

    def __init__(
        self,
        files: VideoFiles,
        readers: list[VideoReader],
        camera: StereoCamera,
        timestamps_s: Array,
        depth_coding: DepthCoding | None,
    ) -> None:
        self.root, self.name = files.video, files.video.stem
        self.camera, self.timestamps_s = camera, timestamps_s
        self._files, self._readers, self._depth_coding = files, readers, depth_coding

    @classmethod
    def matches(cls, path: Path) -> bool:
        """A video file, or a folder with one and a yaml that is no folder of images."""
        if path.is_file():
            return path.suffix.lower() in VIDEOS
        videos = list_files(path, VIDEOS).values()
        has_yaml = any(_yaml_beside(video).is_file() for video in videos)
        return has_yaml and first_folder(path, IMAGE_FOLDERS) is None

    @classmethod
    def open(cls, path: Path | str, **options: Any) -> Self:
        """The sequence in a video file, or in the folder that holds it.

        Raises DatasetError where something essential is missing; see `_open` for the options.
        """
        check_options(cls.dataset, cls._open, options)
        return cls._open(_video_of(Path(path)), **options)

    @classmethod
    def _open(
        cls,
        root: Path,
        right: Path | str | None = None,
        depth: Path | str | None = None,
        stereo: str | None = None,
        calibration: Path | str | None = None,
        fps: float | None = None,
        start_s: float = 0.0,
    ) -> Self:
        """The sequence in the video `root`.

        right: video of the right camera. depth: folder of depth images. stereo: "left_right" or
        "top_bottom" where both images share the video. calibration: the yaml. fps: frames a second,
        over the container's. start_s: time of the first frame.
        """
        reader = VideoReader(root)
        yaml = Path(calibration) if calibration else _yaml_beside(root)
        settings = read_camera_yaml(yaml) if yaml.is_file() else {}
        partner = Path(right) if right else _right_beside(root)
        files = VideoFiles(
            root,
            partner,
            _depths_beside(root, depth) if partner is None else [],
            _arrangement(reader, stereo or settings.get("stereo"), settings, yaml),
            yaml,
            settings,
        )
        if files.right is None and not files.depths and files.stereo is None:
            raise DatasetError(
                f"{root}: expected images from which depth follows, found one camera alone "
                f"({reader.width} x {reader.height}), which has no scale; {WHERE_SCALE_COMES_FROM}."
            )
        if not settings:
            raise DatasetError(f"{root}: missing calibration. Add beside it {CAMERA_YAML}.")
        camera = _camera(files, _view_size(files, reader))
        readers = [reader] + ([VideoReader(files.right)] if files.right else [])
        n_frames = _frame_count(files, readers)
        rate = fps or number(settings, "fps", yaml) or reader.fps
        times = None if fps else root.with_name("times.txt")
        times_s = frame_times(times, rate, n_frames, root) + start_s
        coding = depth_coding_of(files.depths, settings, camera.bf, yaml)
        return cls(files, readers, camera, times_s, coding)

    def read(self, index: int) -> Frame:
        """Frame `index`; fastest in order. Raises FrameError where the video cannot be decoded."""
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {self.name}, which has {len(self)}")
        images = [reader.read(index) for reader in self._readers]
        if self._files.stereo and len(images) == 1:
            images = _halves(images[0], self._files.stereo)
        depth_m = None
        if self._files.depths and self._depth_coding is not None:
            coding, size = self._depth_coding, (self.camera.width, self.camera.height)
            path = self._files.depths[index]
            depth_m = read_optional(
                index, "depth", path, size, lambda p, s: read_depth(p, coding, s)
            )
        return Frame(
            index=index,
            timestamp_s=float(self.timestamps_s[index]),
            image=images[0],
            image_right=images[1] if len(images) > 1 else None,
            depth_m=depth_m,
        )


def _video_of(path: Path) -> Path:
    """The video that a path means: itself, or the one, or the left one, of a folder."""
    if path.is_file():
        return path
    videos = list(list_files(path, VIDEOS).values())
    lefts = [video for video in videos if _right_beside(video) is not None]
    found = lefts or videos
    if len(found) != 1:
        names = ", ".join(video.name for video in found) or describe_folder(path)
        raise DatasetError(
            f"{path} as video: expected a video file or a folder with one, found {names}; "
            "give the path of the video."
        )
    return found[0]


def _yaml_beside(video: Path) -> Path:
    own = video.with_suffix(".yaml")
    return own if own.is_file() else video.with_name("camera.yaml")


def _right_beside(video: Path) -> Path | None:
    """right.mp4 of left.mp4, and the like; None where there is none."""
    name = re.sub("left", "right", video.name, count=1, flags=re.IGNORECASE)
    partner = video.with_name(name)
    return partner if name != video.name and partner.is_file() else None


def _depths_beside(video: Path, depth: Path | str | None) -> list[Path]:
    """Depth images in order: of the folder `depth`, else of depth/ or NAME_depth/ beside it."""
    near = (video.with_name(f"{video.stem}_depth"), video.with_name("depth"))
    for folder in (Path(depth),) if depth else near:
        found = list(list_files(folder, DEPTH_SUFFIXES).values())
        if found:
            return found
    if depth:
        raise DatasetError(
            f"{depth}: expected a folder of depth images, found {describe_folder(Path(depth))}."
        )
    return []


def _arrangement(
    reader: VideoReader, stated: str | None, settings: Settings, yaml: Path
) -> str | None:
    """How two images share the video: as stated, or as the size in the yaml tells."""
    if stated is not None:
        if stated not in (LEFT_RIGHT, TOP_BOTTOM):
            raise DatasetError(
                f"{yaml}: expected stereo to be {LEFT_RIGHT} or {TOP_BOTTOM}, found {stated!r}."
            )
        return stated
    size = settings_size(settings, yaml)
    if size == (reader.width // 2, reader.height):
        return LEFT_RIGHT
    return TOP_BOTTOM if size == (reader.width, reader.height // 2) else None


def _view_size(files: VideoFiles, reader: VideoReader) -> Size:
    """Width and height of one camera's image; raises DatasetError where the yaml says otherwise."""
    across = 2 if files.stereo == LEFT_RIGHT and not files.right else 1
    down = 2 if files.stereo == TOP_BOTTOM and not files.right else 1
    if reader.width % across or reader.height % down:
        raise DatasetError(
            f"{files.video}: expected two images of one size in it ({files.stereo}), found "
            f"{reader.width} x {reader.height}, which cannot be halved."
        )
    size = (reader.width // across, reader.height // down)
    stated = settings_size(files.settings, files.yaml)
    if stated is not None and stated != size:
        raise DatasetError(
            f"{files.yaml}: expected images of {stated[0]} x {stated[1]} pixels as it says, found "
            f"{size[0]} x {size[1]} in {files.video.name}; the intrinsics belong to another size."
        )
    return size


def _camera(files: VideoFiles, size: Size) -> StereoCamera:
    fx, fy, cx, cy = required(files.settings, ("fx", "fy", "cx", "cy"), files.yaml)
    bf = bf_of(files.settings, files.yaml)
    if bf is None and not files.depths:
        raise DatasetError(
            f"{files.yaml}: missing calibration, expected bf (px * m) or baseline_m of the stereo "
            "pair, found neither; add one."
        )
    return make_camera(size, fx, fy, cx, cy, bf or RGBD_BF, files.yaml, is_rgbd=bf is None)


def _frame_count(files: VideoFiles, readers: list[VideoReader]) -> int:
    """Frames that all inputs have; a difference is worth a warning."""
    sizes = {(reader.width, reader.height) for reader in readers}
    if len(sizes) > 1:
        raise DatasetError(
            f"{files.right}: expected images of {readers[0].width} x {readers[0].height} as "
            f"{files.video.name} has, found {readers[1].width} x {readers[1].height}."
        )
    counts = [reader.n_frames for reader in readers]
    counts += [len(files.depths)] if files.depths else []
    if len(set(counts)) > 1:
        log.warning(
            "%s: found %s frames in its parts, taking the first %d of each",
            files.video,
            " and ".join(map(str, counts)),
            min(counts),
        )
    return min(counts)


def _halves(image: Image, stereo: str) -> list[Image]:
    """The left (upper) and right (lower) image of a shared one, each its own memory."""
    return [
        np.ascontiguousarray(half) for half in np.split(image, 2, 1 if stereo == LEFT_RIGHT else 0)
    ]
