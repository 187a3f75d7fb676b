"""One annotated frame: what was seen, what the pose was measured with, and how it went.

Owns the frame picture and the sink that writes it to files. Objects on it are `object_marks`'s.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from contextlib import suppress
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import DyObError
from pipelines.evaluation.table import hypothesis_words
from pipelines.io.files import replacing
from pipelines.io.folder import FRAMES
from pipelines.io.timings import frame_total_ms
from pipelines.types import Array, Frame, FrameResult, Image, TrackingStatus
from viz import style
from viz.object_marks import (
    draw_mask,
    draw_object_areas,
    draw_object_labels,
    object_counts,
)

_POLL_S = 0.002
_WAKE_S = 0.5  # s, after which a thread that should be at its end is called again
logger = logging.getLogger("dyob.viz")


def draw_frame(frame: Frame, result: FrameResult) -> Image:
    """The frame's image with objects, ORB points and a status strip, (H, W, 3) uint8 RGB.

    Green rings: keypoints that agree with the pose. Red crosses: map points that do not. Grey dots:
    keypoints that observe no map point. Objects have their lasting colour; what moves has a strong
    mask, a box and its speed. Without tracked objects the frame's own masks are drawn.
    """
    image = frame.image
    canvas = np.repeat(image[..., None], 3, 2) if image.ndim == 2 else image.copy()
    if result.object_labels is not None:
        draw_object_areas(canvas, result.objects, result.object_labels)
    elif frame.instance_labels is not None:
        for label in np.unique(frame.instance_labels[frame.instance_labels > 0]):
            draw_mask(canvas, frame.instance_labels == label, int(label))
    radius_px = max(2.5, image.shape[0] / 130.0)
    tracked = result.point_ids >= 0
    uv = result.keypoints_px
    groups = (
        (~tracked & ~result.inliers, "dot", max(1.4, radius_px * 0.45), style.UNTRACKED),
        (tracked & ~result.inliers, "cross", radius_px * 1.1, style.OUTLIER),
        (result.inliers, "ring", radius_px, style.INLIER),
    )
    for which, mark, size_px, color in groups:
        stamp_marks(canvas, uv[which], mark, size_px, color)
    if result.object_labels is not None:
        top_px = _strip_sizes(canvas)[1] + 1
        draw_object_labels(canvas, result.objects, result.object_labels, top_px)
    _draw_status(canvas, result)
    return canvas


def stamp_marks(canvas: Image, uv_px: Array, mark: str, radius_px: float, color: Any) -> None:
    """Draw a "dot", "ring" or "cross" with a dark rim at every pixel (N, 2), smooth, in place."""
    if len(uv_px) == 0:
        return
    H, W = canvas.shape[:2]
    for alpha, ink in zip(_sprites(mark, round(radius_px, 1)), ((0, 0, 0), color), strict=True):
        layer = np.zeros((H, W), np.float32)
        half = alpha.shape[0] // 2
        rows, columns = np.nonzero(alpha)
        at = np.round(uv_px).astype(np.int64)
        u = at[:, :1] + (columns - half)
        v = at[:, 1:] + (rows - half)
        inside = (u >= 0) & (v >= 0) & (u < W) & (v < H)
        values = np.broadcast_to(alpha[rows, columns], u.shape)[inside]
        np.maximum.at(layer, (v[inside], u[inside]), values)
        touched = layer > 0
        a = layer[touched][:, None]
        canvas[touched] = np.round(canvas[touched] * (1 - a) + np.array(ink, np.float32) * a)


@cache
def _sprites(mark: str, radius_px: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Coverage 0..1 of the dark rim and of the mark itself, drawn large and averaged down."""
    import cv2

    scale, half = 8, int(np.ceil(radius_px + 2))
    side = (2 * half + 1) * scale
    centre, r = side // 2, radius_px * scale
    layers = []
    for rim in (1.0, 0.0):
        big = np.zeros((side, side), np.float32)
        line = max(1, round((1.3 + 1.1 * rim) * scale))
        if mark == "dot":
            cv2.circle(big, (centre, centre), round(r + 0.6 * rim * scale), 1.0, -1)
        elif mark == "ring":
            cv2.circle(big, (centre, centre), round(r), 1.0, line)
        elif mark == "cross":
            d = round(r / np.sqrt(2.0))
            for sign in (1, -1):
                a, b = (centre - d, centre - sign * d), (centre + d, centre + sign * d)
                cv2.line(big, a, b, 1.0, line)
        else:
            raise ValueError(f"stamp_marks: expected dot, ring or cross, found '{mark}'")
        small = cv2.resize(big, (2 * half + 1,) * 2, interpolation=cv2.INTER_AREA)
        layers.append(small * (0.55 if rim else 1.0))
    return layers[0], layers[1]


def _draw_status(canvas: Image, result: FrameResult) -> None:
    """A dark strip along the top; what does not fit into a narrow image is left out."""
    W = canvas.shape[1]
    size_px, strip_px = _strip_sizes(canvas)
    baseline = round(1.23 * size_px)
    style.draw_panel(canvas, (0, 0, W, strip_px), (14, 16, 20), 0.72)
    ok = result.status is TrackingStatus.OK
    label_width = style.text_size(str(result.status), size_px, 600)[0]
    u = label_width + round(1.2 * size_px)
    pill = style.STATUS_OK if ok else style.STATUS_LOST
    style.draw_panel(canvas, (0, 0, u, strip_px), pill, 1.0)
    draw = style.draw_text
    draw(canvas, str(result.status), (round(0.6 * size_px), baseline), size_px, style.WHITE, 600)
    for text in _status_texts(result):
        u += round(0.9 * size_px)
        width = style.text_size(text, size_px)[0]
        if u + width > W - 4:
            return
        draw(canvas, text, (u, baseline), size_px, style.WHITE)
        u += width


def _strip_sizes(canvas: Image) -> tuple[int, int]:
    """Height of the status strip's text, and of the strip, in pixels."""
    H, W = canvas.shape[:2]
    size_px = int(np.clip(min(H / 24.0, W / 46.0), 11, 28))
    return size_px, round(1.75 * size_px)


def _status_texts(result: FrameResult) -> list[str]:
    texts = [f"frame {result.frame_index}", f"{result.timestamp_s:.2f} s"]
    if counts := object_counts(result.objects):
        texts.append(counts)
    tracked = int((result.point_ids >= 0).sum())
    texts.append(f"{int(result.inliers.sum())} of {tracked} points agree")
    texts.append(hypothesis_words(result.hypothesis))
    total_ms = frame_total_ms(result)
    if total_ms > 0:
        texts.append(f"{total_ms:.0f} ms")
    if np.isfinite(result.reprojection_rmse_px):
        texts.append(f"{result.reprojection_rmse_px:.2f} px error")
    if result.is_keyframe:
        texts.append("keyframe")
    return texts


class FrameWriter:
    """A sink that writes every n-th annotated frame to a folder from a thread of its own.

    JPEG is made in a small part of the time of a PNG, and takes a quarter of its room.
    The run loop waits only when the thread is `WAITING` pictures behind, so that memory stays flat
    and no picture is lost. A disk that refuses ends the pictures with a warning, not the run.
    """

    WAITING = 32

    def __init__(self, every: int = 1, suffix: str = ".jpg") -> None:
        if every < 1:
            raise ValueError(f"FrameWriter: expected every >= 1, found {every}")
        self.every, self.suffix = every, suffix
        self.folder = Path()
        self._queue: queue.Queue[tuple[Frame, FrameResult] | None] = queue.Queue(self.WAITING)
        self._thread: threading.Thread | None = None
        self._failed = False
        self._n_seen = 0

    def start(self, sequence: Any, n_frames: int, config: Any, folder: Path) -> None:
        """Make `frames` in the result folder and start the thread."""
        del sequence, n_frames, config  # the sinks' contract
        self.folder = folder / FRAMES
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DyObError(
                f"{self.folder}: expected a folder for annotated frames, found '{error.strerror}'; "
                "choose another --output"
            ) from error
        self._queue = queue.Queue(self.WAITING)
        self._thread = threading.Thread(target=self._write_all, name="frame-writer", daemon=True)
        self._thread.start()

    def frame(self, frame: Frame, result: FrameResult) -> None:
        """Hand one frame over; it is drawn later."""
        wanted = self._n_seen % self.every == 0
        self._n_seen += 1
        if self._thread is None or self._failed or not wanted:
            return
        light = replace(frame, image_right=None, depth_m=None, flow_prev_to_curr_px=None)
        self._queue.put((light, result))

    def go_on(self, n_done: int) -> None:
        """Count from so many frames on, whose pictures an interrupted run has drawn."""
        self._n_seen = n_done

    def flush(self) -> None:
        """Wait until all that was handed over is drawn; the thread goes on."""
        while self._thread is not None and self._thread.is_alive() and self._queue.unfinished_tasks:
            time.sleep(_POLL_S)

    def finish(self) -> None:
        """Wait until all that was handed over is written."""
        if self._thread is None:
            return
        self._queue.put(None)
        while self._thread.is_alive():
            self._thread.join(_WAKE_S)
            with suppress(queue.Full):  # Ctrl-C within a `put` may have cost its wake-up call
                self._queue.put_nowait(None)
        self._thread = None

    def _write_all(self) -> None:
        while (item := self._queue.get()) is not None:
            if not self._failed:  # else keep the queue flowing: the run loop waits for it
                self._write(*item)
            self._queue.task_done()

    def _write(self, frame: Frame, result: FrameResult) -> None:
        try:
            path = self.folder / f"{frame.index:06d}{self.suffix}"
            write_image(path, draw_frame(frame, result), sync=False)
        except DyObError as error:
            self._failed = True
            logger.warning("no more annotated frames: %s", error)


def write_image(path: Path | str, image: Image, *, sync: bool = True, compression: int = 1) -> None:
    """Write an RGB image in one step, as its suffix says. Raises DyObError where it cannot.

    compression: of PNG files, 1 (fast, for pictures by the hundred) to 9 (small).
    """
    import cv2

    path = Path(path)
    png = [cv2.IMWRITE_PNG_COMPRESSION, compression]
    jpeg = [cv2.IMWRITE_JPEG_QUALITY, 92]  # colours at full size: marks are thin
    jpeg += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    options = jpeg if path.suffix in (".jpg", ".jpeg") else png
    try:
        ok, data = cv2.imencode(path.suffix, np.ascontiguousarray(image[..., ::-1]), options)
    except cv2.error:
        ok, data = False, None
    if not ok:
        raise DyObError(f"{path}: expected .png or .jpg, found '{path.suffix}'; rename the output")
    with replacing(path, sync=sync) as fresh:
        fresh.write_bytes(data.tobytes())
