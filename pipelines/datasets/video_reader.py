"""Frames of a video file by their number, decoded in order.

Owns the decoder's place in the file. Knows no cameras.
"""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np

from pipelines.errors import DatasetError, FrameError
from pipelines.types import Image

SEEK_FROM = 250  # frames: a jump farther than this is left to the container's index


class VideoReader:
    """A video, read one frame after the other; not from two threads at a time.

    The next frame costs its own decoding. Frames are skipped by decoding them, which is exact; a
    far jump uses the container's index, and a jump back begins anew. n_frames: as the container
    says. fps: None where it does not say.
    """

    def __init__(self, path: Path) -> None:
        """Opens the file and decodes its first frame; raises DatasetError where that fails."""
        # Else the decoder prints sentences of its own, before ours.
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
        self.path = path
        self._capture = cv2.VideoCapture(str(path))
        self._next, self._last = 0, None
        try:
            height, width = self.read(0).shape[:2]
        except FrameError as error:
            raise DatasetError(
                f"{path}: expected a video, found a file of {_bytes(path)} bytes that cannot be "
                "decoded; copy it again, or convert it to H.264 in .mp4."
            ) from error
        self.width, self.height = width, height
        fps = float(self._capture.get(cv2.CAP_PROP_FPS))
        self.fps = fps if np.isfinite(fps) and 0 < fps < 10000 else None
        self.n_frames = max(int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT)), 1)

    _last: Image | None

    def read(self, index: int) -> Image:
        """Frame `index` (H, W, 3) RGB uint8. Raises FrameError where the file ends before it."""
        if self._last is not None and index == self._next - 1:
            return self._last
        if not self._go_to(index):
            raise self._cut_short(index)
        decoded, pixels = self._capture.read()
        if not decoded or pixels is None:
            self._next = -1  # the place in the file is not known any more
            raise self._cut_short(index)
        self._next = index + 1
        self._last = np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB), np.uint8)
        self._last.setflags(write=False)  # it may be handed out again
        return self._last

    def _go_to(self, index: int) -> bool:
        """Bring the decoder before frame `index`; False where the file ends first."""
        if not 0 <= index - self._next <= SEEK_FROM or self._next < 0:
            self._next = index if index > SEEK_FROM and self._seek(index) else self._rewind()
        while self._next < index:
            if not self._capture.grab():
                self._next = -1
                return False
            self._next += 1
        return True

    def _seek(self, index: int) -> bool:
        self._capture.set(cv2.CAP_PROP_POS_FRAMES, index)
        return int(self._capture.get(cv2.CAP_PROP_POS_FRAMES)) == index

    def _rewind(self) -> int:
        self._capture.release()
        self._capture = cv2.VideoCapture(str(self.path))
        return 0

    def _cut_short(self, index: int) -> FrameError:
        return FrameError(
            f"{self.path}: expected frame {index}, found the end of the video or a damaged part; "
            "copy the file again, or stop before with --frames."
        )


def _bytes(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
