"""The browser viewer of a run that goes on: a sink with a thread of its own.

Owns what is shown of a frame, and what is left out: pictures that come faster than one looks, or
than they are drawn, never frames, and nothing of the run. The run hands each frame over and goes on
at once. Pictures are drawn in a process of their own, as Python runs one thread at a time.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.worker import ProcessWorker
from pipelines.types import Array, Frame, FrameResult
from viz.browser.cloud import build_cloud
from viz.browser.live_map import LiveFrame, LiveFrames, LiveMap
from viz.browser.live_server import LiveServer
from viz.browser.pictures import LIVE, encode_jpeg
from viz.browser.records import frame_record, page_setup
from viz.overlay import draw_frame
from viz.scene import level_axes

WAITING = 4  # frames that wait with their images
MAP_EVERY_S = 2.0
PICTURE_EVERY_S = 0.25  # to draw each one would take the run half a core
NICE = 10  # what the process of the pictures lets go before it
MAX_LIVE_POINTS = 60_000  # as the map is sent anew each time
TILTED = np.cos(np.radians(2.0))  # by less, nothing is turned while the run goes on
logger = logging.getLogger("dyob.viz")


@dataclass(slots=True)
class _Seen:
    """A frame that waits; its images are gone where it has waited too long."""

    frame: Frame | None
    result: FrameResult


@dataclass(slots=True)
class _Moved:
    """Keyframes as a correction has left them."""

    frame_index: NDArray[np.int64]
    Ts_world_camera: Array


@dataclass(frozen=True, slots=True)
class _Drawn:
    """The picture of a frame; None where the process that drew it has died."""

    position: int
    jpeg: bytes | None


@dataclass(frozen=True, slots=True)
class _Sketch:
    """What the picture of a frame is drawn from."""

    position: int
    frame: Frame
    result: FrameResult


class LiveViewer:
    """A sink that shows a run in the browser while it goes on; see `server.PageServer`.

    host, port: where to serve. announce: called with the URL once it can be opened.
    """

    def __init__(
        self,
        host: str | None = None,
        port: int | None = None,
        announce: Callable[[str], None] = lambda url: None,
    ) -> None:
        self.host, self.port, self.announce = host, port, announce
        self.n_left_out = 0  # pictures
        self._waiting: deque[_Seen | _Moved | _Drawn] = deque()
        self._is_over = False
        self._has_come = threading.Condition()
        self._thread: threading.Thread | None = None

    def start(self, sequence: Any, n_frames: int, config: Any, folder: Path) -> None:
        """Begin to serve. Raises DyObError where no port is to be had."""
        del n_frames, folder  # the sinks' contract
        setup = page_setup(sequence.name, None, sequence.camera)
        self._server = LiveServer(setup, host=self.host, port=self.port)
        self._frames = LiveFrames()
        self._axes = level_axes(np.empty((0, 4, 4)))
        self._map = LiveMap(config.mapping.min_observations)
        self._have_moved, self._map_due_s = False, 0.0
        self._sketch: _Sketch | None = None  # the newest that is not drawn yet
        self._is_drawing, self._picture_due_s = False, 0.0
        self._painter = ProcessWorker()
        self._painter.submit(os.nice, NICE)
        self._server.start()
        self._thread = threading.Thread(target=self._show_all, name="live-viewer", daemon=True)
        self._thread.start()
        self.announce(self._server.url)

    def frame(self, frame: Frame, result: FrameResult) -> None:
        """Hand one frame over; its picture is drawn later, if the view keeps up."""
        light = replace(frame, image_right=None, depth_m=None, flow_prev_to_curr_px=None)
        with self._has_come:
            self._waiting.append(_Seen(light, result))
            self._drop_the_late()
            self._has_come.notify()

    def keyframes(self, frame_index: NDArray[np.int64], Ts_world_camera: Array) -> None:
        """The back-end has moved keyframes; see `runner.KeyframeSink`."""
        with self._has_come:
            self._waiting.append(_Moved(frame_index, Ts_world_camera))
            self._has_come.notify()

    def finish(self) -> None:
        """Show what was handed over, and end; the page stays as it is in the browsers."""
        if self._thread is None:
            return
        with self._has_come:
            self._is_over = True
            self._has_come.notify()
        self._thread.join()
        self._thread = None
        self._painter.close()
        self._server.stop()

    def _drop_the_late(self) -> None:
        """Let go of the images of the frame that has waited longest, where too many wait."""
        whole = [item for item in self._waiting if isinstance(item, _Seen) and item.frame]
        for item in whole[:-WAITING]:
            item.frame, item.result = None, replace(item.result, object_labels=None)
            self.n_left_out += 1

    # ---- in the viewer's thread

    def _show_all(self) -> None:
        while (items := self._take()) is not None:
            try:
                for item in items:
                    self._show(item)
                if self._draws_in_s == 0:
                    self._draw()
                if time.monotonic() >= self._map_due_s:
                    self._show_map()
            except Exception:  # whatever goes wrong in the view, the run goes on
                logger.exception("the browser viewer has missed something")
        self._show_map(is_last=True)

    def _take(self) -> list[_Seen | _Moved | _Drawn] | None:
        """What has come, nothing where a picture is due before that; None when all is shown."""
        with self._has_come:
            self._has_come.wait_for(self._has_news, self._draws_in_s)
            items = list(self._waiting)
            self._waiting.clear()
            is_end = self._is_over and not (items or self._is_drawing or self._sketch)
            return None if is_end else items

    def _has_news(self) -> bool:
        return bool(self._waiting) or (self._is_over and not self._is_drawing)

    @property
    def _draws_in_s(self) -> float | None:
        """How long until the next picture is drawn; None where none is to be."""
        if self._sketch is None or self._is_drawing:
            return None
        return 0.0 if self._is_over else max(self._picture_due_s - time.monotonic(), 0.0)

    def _show(self, item: _Seen | _Moved | _Drawn) -> None:
        if isinstance(item, _Moved):
            self._have_moved |= self._frames.follow(item.frame_index, item.Ts_world_camera)
        elif isinstance(item, _Drawn):
            self._is_drawing = False
            if item.jpeg is not None:
                self._server.tell_picture(item.position, item.jpeg)
        else:
            self._show_frame(item.frame, item.result)

    def _show_frame(self, frame: Frame | None, result: FrameResult) -> None:
        now = self._frames.add(result)
        self._server.tell_frame(_record(now))
        if frame is None:
            return
        if result.observations is not None:
            self._map.add(result.observations, self._frames, frame.image)
        self.n_left_out += self._sketch is not None
        position = len(self._frames.list) - 1
        self._sketch = _Sketch(position, frame, replace(result, observations=None))

    def _draw(self) -> None:
        """Begin with the picture of the newest frame."""
        assert self._sketch is not None
        sketch, self._sketch = self._sketch, None
        self._picture_due_s = time.monotonic() + PICTURE_EVERY_S

        def take(drawing: Future[bytes]) -> None:
            jpeg = None if drawing.exception() else drawing.result()
            with self._has_come:
                self._waiting.append(_Drawn(sketch.position, jpeg))
                self._has_come.notify()

        drawing = self._painter.submit(draw_jpeg, sketch.frame, sketch.result)
        self._is_drawing = True
        drawing.add_done_callback(take)

    def _show_map(self, *, is_last: bool = False) -> None:
        """Send the map where it has changed; the last one goes by all that is known of up."""
        if self._have_moved:
            self._server.tell_all_frames([_record(frame) for frame in self._frames.list])
        if is_last or self._have_moved or self._map.changed:
            Ts = self._frames.Ts_world_camera
            axes = level_axes(Ts)
            if is_last or axes[0] @ self._axes[0] < TILTED:
                self._axes = axes
            points, colors = self._map.cloud(Ts)
            if len(points):
                seen = points, colors, Ts[:, :3, 3], self._axes
                self._server.tell_map(build_cloud(*seen, max_points=MAX_LIVE_POINTS))
        self._have_moved = False
        self._map_due_s = time.monotonic() + MAP_EVERY_S


def draw_jpeg(frame: Frame, result: FrameResult) -> bytes:
    """The annotated frame as JPEG."""
    return encode_jpeg(draw_frame(frame, result), *LIVE)


def _record(frame: LiveFrame) -> dict[str, Any]:
    return frame_record(
        frame.index,
        frame.timestamp_s,
        frame.T_world_camera,
        frame.boxes,
        is_tracked=frame.is_tracked,
    )
