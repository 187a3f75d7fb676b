"""The folder that `prepare` fills: its files by frame, what made them, and how each is written.

Owns paths, codings and the record `prepared.json`; the layout is that of the data set
`folder`. Computes nothing.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.files import (
    SATURATED,
    Size,
    read_depth_values,
    read_flow,
    read_image,
    read_labels,
)
from pipelines.datasets.folder import PREPARED, FolderSequence
from pipelines.datasets.mask_classes import mask_classes_text
from pipelines.datasets.sequence import Sequence
from pipelines.errors import ConfigError, DatasetError, FrameError
from pipelines.io.files import read_json, replacing, write_json, write_text
from pipelines.object_types import Detections
from pipelines.types import Image

SUFFIXES = {"images": ".png", "right": ".png", "depth": ".png", "flow": ".flo", "masks": ".png"}
UNKNOWN_FLOW = np.float32(1e10)  # Middlebury: beyond 1e9 px a vector is unknown
SOURCE = "source"  # entry of the record: the sequence that the folder was made of
DATA_FILES = "files"  # method of an entry whose files came with the sequence


class PreparedFolder:
    """A folder of one sequence, and which of its files are there already.

    stems: name of each frame's files. size: width, height of all of them in px. in_place: whether
    it is the sequence's own folder, whose other files are not touched.
    """

    def __init__(self, root: Path, stems: list[str], size: Size, in_place: bool) -> None:
        self.root, self.stems, self.size, self.in_place = root, stems, size, in_place
        self._record = read_json(root / PREPARED) if (root / PREPARED).is_file() else {}

    @classmethod
    def within(cls, sequence: FolderSequence) -> PreparedFolder:
        """The sequence's own folder."""
        stems = [sequence.files(k).image.stem for k in range(len(sequence))]
        size = (sequence.camera.width, sequence.camera.height)
        return cls(sequence.root, stems, size, in_place=True)

    @classmethod
    def beside(cls, root: Path, sequence: Sequence) -> PreparedFolder:
        """A new folder, or one that was begun for the same sequence. Raises DatasetError."""
        root.mkdir(parents=True, exist_ok=True)
        if any(root.iterdir()) and not (root / PREPARED).is_file():
            raise DatasetError(
                f"{root}: expected an empty folder, or one that prepare began, found other files; "
                "choose another --output."
            )
        stems = [f"{k:06d}" for k in range(len(sequence))]
        size = (sequence.camera.width, sequence.camera.height)
        folder = cls(root, stems, size, in_place=False)
        source = {
            "name": sequence.name,
            "dataset": sequence.dataset,
            "frames": len(sequence),
            "size": list(size),
        }
        begun = folder._record.setdefault(SOURCE, source)
        if begun != source:
            raise DatasetError(
                f"{root}: expected a folder prepared from {sequence.name} ({sequence.dataset}, "
                f"{len(sequence)} frames), found one of {begun}; choose another --output."
            )
        write_json(root / PREPARED, folder._record)
        return folder

    # ------------------------------------------------------------------ what is there

    def path(self, kind: str, index: int, suffix: str | None = None) -> Path:
        """File of frame `index`; of flow it leads from this frame to the next."""
        return self.root / kind / f"{self.stems[index]}{suffix or SUFFIXES[kind]}"

    def has(self, kind: str, index: int) -> bool:
        """Whether the file of a computed `kind` is there and whole."""
        readers: dict[str, Callable[[Path, Size], Any]] = {
            "images": read_image,
            "right": read_image,
            "depth": read_depth_values,
            "flow": read_flow,
            "masks": read_labels,
        }
        path = self.path(kind, index)
        if not path.is_file():
            return False
        try:
            readers[kind](path, self.size)
        except FrameError:
            return False
        return True

    def claim(self, kind: str, settings: dict[str, Any], overwrite: bool) -> None:
        """Note that files of `kind` are made with `settings`, before the first is written.

        Raises ConfigError where there are files made with others, unless they may be overwritten:
        all of them then go at once, so that an interruption never leaves a mixture.
        """
        before = self._record.get(kind)
        if before is not None and before != settings and not overwrite:
            changed = sorted(k for k in {*before, *settings} if before.get(k) != settings.get(k))
            raise ConfigError(
                f"{self.root / kind}: found files made with other settings "
                f"({', '.join(f'{k}: {before.get(k)}, now {settings.get(k)}' for k in changed)}); "
                f"take the same settings, or --overwrite, or leave {kind} out with --what."
            )
        if before is not None and overwrite:
            for index in range(len(self.stems)):
                self.path(kind, index).unlink(missing_ok=True)
                self.path(kind, index, ".json").unlink(missing_ok=True)
        (self.root / kind).mkdir(exist_ok=True)
        if before != settings:
            self._record[kind] = settings
            write_json(self.root / PREPARED, self._record)

    # ------------------------------------------------------------------ writing

    def write_disparity(self, index: int, disparity_px: NDArray[np.float32], scale: float) -> None:
        """16-bit PNG of disparities (H, W) in px times `scale`; 0 where NaN or out of range."""
        values = np.rint(np.nan_to_num(disparity_px, nan=0.0, posinf=0.0) * np.float32(scale))
        values[(values < 0) | (values >= SATURATED)] = 0
        self._write_image(self.path("depth", index), values.astype(np.uint16))

    def write_depth_m(self, index: int, depth_m: NDArray[np.float32]) -> None:
        """Metres (H, W) float32 as .npy, exactly; for depth whose own coding is not known."""
        with (
            replacing(self.path("depth", index, ".npy"), sync=False) as fresh,
            fresh.open("wb") as file,
        ):
            np.save(file, depth_m)

    def write_flow(self, index: int, flow_px: NDArray[np.float32]) -> None:
        """.flo of flow (H, W, 2) in px from frame `index` to the next; NaN becomes unknown."""
        height, width = flow_px.shape[:2]
        known = np.where(np.isfinite(flow_px), flow_px, UNKNOWN_FLOW).astype("<f4")
        head = b"PIEH" + np.array([width, height], "<i4").tobytes()
        with replacing(self.path("flow", index), sync=False) as fresh:
            fresh.write_bytes(head + known.tobytes())

    def write_masks(self, index: int, found: Detections) -> None:
        """PNG of labels (H, W), and json of classes and scores, which comes first.

        A mask that is there therefore has its classes.
        """
        entries = {
            int(label): (str(name), float(score) if np.isfinite(score) else None)
            for label, name, score in zip(
                found.label_ids, found.class_names, found.scores, strict=True
            )
        }
        write_text(self.path("masks", index, ".json"), mask_classes_text(entries))
        pixels = np.uint8 if found.labels.max(initial=0) < 256 else np.uint16
        self._write_image(self.path("masks", index), found.labels.astype(pixels))

    def write_image(self, kind: str, index: int, image: Image) -> None:
        """PNG of an image (H, W) grey or (H, W, 3) RGB."""
        bgr = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
        self._write_image(self.path(kind, index), np.asarray(bgr))

    def link(self, kind: str, index: int, source: Path) -> None:
        """The file `source` itself by another name, or a copy where the disks differ."""
        target = self.path(kind, index, source.suffix)
        if target.is_file() or not source.is_file():
            return
        target.parent.mkdir(exist_ok=True)
        with replacing(target, sync=False) as fresh:
            try:
                os.link(source.resolve(), fresh)
            except OSError:
                shutil.copyfile(source, fresh)

    @staticmethod
    def _write_image(path: Path, pixels: NDArray) -> None:
        path.parent.mkdir(exist_ok=True)
        _, content = cv2.imencode(path.suffix, pixels)
        with replacing(path, sync=False) as fresh:
            fresh.write_bytes(content.tobytes())


def set_camera_key(path: Path, key: str, value: float) -> None:
    """Set one key of a camera.yaml and leave the rest of the file as it is."""
    lines = path.read_text(encoding="utf-8").splitlines()
    wanted = f"{key}: {float(value)!r}"
    if wanted not in lines:
        kept = [line for line in lines if not line.startswith(f"{key}:")]
        write_text(path, "\n".join([*kept, wanted]) + "\n")
