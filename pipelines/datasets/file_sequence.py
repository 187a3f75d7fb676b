"""A sequence whose frames are files: what all folder layouts have in common.

Owns lazy reading of one frame, and what happens when one of its files cannot be used. Each layout
only says which files belong to which frame.
"""

from __future__ import annotations

import difflib
import inspect
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.files import (
    DamagedFileError,
    DepthCoding,
    Size,
    read_depth,
    read_flow,
    read_image,
    read_labels,
)
from pipelines.datasets.mask_classes import read_mask_classes
from pipelines.datasets.sequence import Sequence
from pipelines.datasets.tree import describe_folder
from pipelines.errors import DatasetError, FrameError
from pipelines.types import Array, Frame, StereoCamera

log = logging.getLogger("dyob")
Read = TypeVar("Read")


@dataclass(frozen=True, slots=True)
class FrameFiles:
    """The files of one frame; None where the sequence has no such input at all.

    A path that does not exist is an input missing from this frame alone.
    flow_prev_to_curr: lies on the grid of the previous frame and points into this one.
    classes: json that names the instances of `labels`, see `mask_classes`.
    """

    image: Path
    image_right: Path | None = None
    depth: Path | None = None
    flow_prev_to_curr: Path | None = None
    labels: Path | None = None
    classes: Path | None = None


class FileSequence(Sequence):
    """A `Sequence` read from files, one frame at a time.

    Subclasses have `dataset`, `layout` (the tree in words), `matches` and `open`.
    """

    layout: ClassVar[str]

    def __init__(
        self,
        root: Path,
        camera: StereoCamera,
        timestamps_s: Array,
        frames: list[FrameFiles],
        depth_coding: DepthCoding | None = None,
        frame_numbers: list[int] | None = None,
    ) -> None:
        """`frame_numbers`: as the truth's files count the frames, where that is not 0, 1, 2 ..."""
        self.root, self.name = root, root.resolve().name
        self.camera, self.timestamps_s = camera, timestamps_s
        self._frames, self._depth_coding = frames, depth_coding
        self._numbers = frame_numbers or list(range(len(frames)))
        if len(timestamps_s) != len(frames):
            raise DatasetError(
                f"{root}: expected one timestamp per frame, found {len(timestamps_s)} for "
                f"{len(frames)} frames."
            )

    @classmethod
    def matches(cls, path: Path) -> bool:
        """Whether `path` looks like this layout, judged by names alone."""
        raise NotImplementedError

    @classmethod
    def open(cls, path: Path | str, **options: Any) -> Self:
        """The sequence in `path`; raises DatasetError where something essential is missing."""
        check_options(cls.dataset, cls._open, options)
        root = Path(path)
        if not root.is_dir():
            raise DatasetError(
                f"{root} as {cls.dataset}: expected a folder, found {describe_folder(root)}; "
                f"correct the path. Expected in it: {cls.layout}."
            )
        return cls._open(root, **options)

    @classmethod
    def _open(cls, root: Path) -> Self:
        """What a layout writes: `open` with its own options by name."""
        raise NotImplementedError

    def read(self, index: int) -> Frame:
        """Frame `index`; raises FrameError where its image cannot be used or a size is wrong.

        A depth, right image, flow or mask that is missing or damaged in this frame alone is None
        in it, with a warning: the rest of the frame is still worth having.
        """
        if not 0 <= index < len(self):
            raise IndexError(f"frame {index} of {self.name}, which has {len(self)}")
        files, size = self._frames[index], (self.camera.width, self.camera.height)
        image = read_image(files.image, size)
        right = read_optional(index, "right image", files.image_right, size, read_image)
        if right is not None and right.shape != image.shape:
            raise FrameError(
                f"{files.image_right}: expected the same channels as the left image "
                f"{image.shape}, found {right.shape}; convert one of them."
            )
        labels = read_optional(index, "mask", files.labels, size, read_labels)
        return Frame(
            index=index,
            timestamp_s=float(self.timestamps_s[index]),
            image=image,
            image_right=right,
            depth_m=read_optional(index, "depth", files.depth, size, self._decode_depth),
            flow_prev_to_curr_px=read_optional(
                index, "flow", files.flow_prev_to_curr, size, self._decode_flow
            ),
            instance_labels=labels,
            instance_classes=None if labels is None else self._read_classes(index, labels),
        )

    def files(self, index: int) -> FrameFiles:
        """The files of frame `index`, for those who copy or link them."""
        return self._frames[index]

    @property
    def depth_coding(self) -> DepthCoding | None:
        """How the depth images are read; None where there are none."""
        return self._depth_coding

    def _read_classes(self, index: int, labels: NDArray[np.int32]) -> dict[int, str] | None:
        """Class names of the instances in `labels`, None where the sequence does not say."""
        path, size = self._frames[index].classes, (self.camera.width, self.camera.height)
        if path is None or not path.exists():
            return None  # most masks come without, and no frame is the worse for it
        return read_optional(index, "classes", path, size, lambda p, _: read_mask_classes(p))

    def _decode_flow(self, path: Path, size: Size) -> NDArray[np.float32]:
        return read_flow(path, size)

    def _decode_depth(self, path: Path, size: Size) -> Any:
        if self._depth_coding is None:
            raise DatasetError(f"{path}: depth without a scale; set depth_scale.")
        return read_depth(path, self._depth_coding, size)


def read_optional(
    index: int, what: str, path: Path | None, size: Size, read: Callable[[Path, Size], Read]
) -> Read | None:
    """What `read` makes of `path`; None, with a warning, where that is missing or damaged.

    None as well, without one, where `path` is None. A file of a wrong size or form is FrameError.
    """
    if path is None:
        return None
    if not path.exists():
        log.warning("frame %d has no %s: %s is missing", index, what, path)
        return None
    try:
        return read(path, size)
    except DamagedFileError as error:
        log.warning("frame %d goes without %s: %s", index, what, error)
        return None


def check_options(dataset: str, opener: Callable[..., Any], options: dict[str, Any]) -> None:
    """Raise DatasetError, naming the nearest, for an option that `opener` does not take."""
    known = [name for name in inspect.signature(opener).parameters if name != "root"]
    for name in options:
        if name not in known:
            nearest = difflib.get_close_matches(name, known, 1)
            raise DatasetError(
                f"Data set {dataset}: unknown option {name!r}, "
                + (f"did you mean {nearest[0]!r}?" if nearest else f"known: {', '.join(known)}")
            )


def common_image_size(images: list[Path], settings_size: Size | None, source: str) -> Size:
    """Width and height of a sequence: the settings', else of its first readable image.

    Raises DatasetError where none of the first images can be read, or where most of three images
    contradict the settings: the intrinsics would then belong to other pixels.
    """
    sizes: list[Size] = []
    for path in dict.fromkeys((images[0], images[len(images) // 2], images[-1])):
        try:
            height, width = read_image(path).shape[:2]
        except FrameError as error:
            log.warning("%s", error)
        else:
            sizes.append((width, height))
    if not sizes:
        if settings_size is not None:
            return settings_size
        raise DatasetError(
            f"{images[0].parent}: expected readable images, but the first, middle and last cannot "
            "be read; copy the sequence again."
        )
    size = max(sizes, key=lambda s: (sizes.count(s), s))
    if settings_size is not None and settings_size not in sizes:
        raise DatasetError(
            f"{source}: expected images of {settings_size[0]} x {settings_size[1]} pixels as it "
            f"says, found {size[0]} x {size[1]} in {images[0].parent}; the intrinsics belong to "
            "another image size."
        )
    return settings_size or size
