"""An MP4 file that browsers play, written picture by picture with its own times.

Owns the encoding: H.264 in 4:2:0, with its index in front so that it plays while it loads.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.errors import DyObError
from pipelines.io.files import replacing
from pipelines.types import Array, Image

TICKS_PER_S = 90_000
QUALITY = "21"  # x264's constant rate factor: smaller is better
KEY_EVERY_S = 1.0  # a player can only jump to whole pictures
BT709, LIMITED_RANGE = 1, 1  # the colours that players assume; untagged ones turn out differently


class Mp4Writer:
    """Takes pictures (H, W, 3) uint8 RGB of one size, both sides even, each with its time."""

    def __init__(self, container: Any, size: tuple[int, int], durations_s: Array) -> None:
        if size[0] % 2 or size[1] % 2:
            raise ValueError(f"Mp4Writer: expected even sides, found {size[0]}x{size[1]}")
        ticks = np.concatenate([[0.0], np.cumsum(durations_s)]) * TICKS_PER_S
        self._ticks = np.round(ticks).astype(np.int64)
        self._container = container
        rate = 1.0 / float(np.median(durations_s))
        options = {
            "crf": QUALITY,
            "preset": "veryfast",
            "g": str(max(1, round(KEY_EVERY_S * rate))),
        }
        stream = container.add_stream(
            "libx264", rate=Fraction(rate).limit_denominator(1000), options=options
        )
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        context = stream.codec_context
        context.time_base = Fraction(1, TICKS_PER_S)
        context.color_range = LIMITED_RANGE
        context.colorspace = context.color_primaries = context.color_trc = BT709
        self._stream, self._n = stream, 0

    def add(self, image: Image) -> None:
        """The next picture."""
        import av

        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
        frame.pts, frame.time_base = int(self._ticks[self._n]), Fraction(1, TICKS_PER_S)
        frame.duration = int(self._ticks[self._n + 1] - self._ticks[self._n])
        self._n += 1
        self._write(self._stream.encode(frame))

    def end(self) -> None:
        """Write what the encoder still holds."""
        self._write(self._stream.encode(None))

    def _write(self, packets: Any) -> None:
        for packet in packets:
            self._container.mux(packet)


@contextmanager
def open_mp4(path: Path | str, size: tuple[int, int], durations_s: Array) -> Iterator[Mp4Writer]:
    """A writer for as many pictures as there are durations (seconds); the file appears at the end.

    Raises DyObError where the file cannot be written.
    """
    import av

    with replacing(path) as fresh:
        try:
            with av.open(
                str(fresh), "w", format="mp4", options={"movflags": "+faststart"}
            ) as container:
                writer = Mp4Writer(container, size, durations_s)
                yield writer
                writer.end()
        except av.error.FFmpegError as error:
            raise DyObError(
                f"{path}: expected to write this video, found '{error.strerror}'; make room or "
                "choose another folder, and see that the av package is the pinned one"
            ) from error
