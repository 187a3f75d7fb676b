"""The server of a run that goes on: it tells each browser what has been, and then what comes.

Owns what is kept for browsers that come late. Messages are text (JSON) or bytes: four bytes that
say what follows, the map (-1) as meshcat takes it or the picture of a frame (its position).
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Sequence
from typing import Any

from viz.browser.cloud import Cloud
from viz.browser.page import served_page, to_json
from viz.browser.server import PageServer, Rules, guarded

KEPT_BYTES = 64_000_000  # of pictures, for browsers that come late; the oldest go first
_MAP = struct.pack("<i", -1)
_AT_ONCE = 200  # frames in one message


class LiveServer(PageServer):
    """Serves one run. Its `tell_` methods may be called from any thread and return at once."""

    def __init__(
        self, setup: dict[str, Any], *, host: str | None = None, port: int | None = None
    ) -> None:
        super().__init__(host, port)
        self.page = served_page("live", setup["theme"])
        self._setup = to_json({"type": "setup", "setup": setup})
        # All below belong to the server's thread.
        self._frames: list[dict[str, Any]] = []
        self._map: tuple[str, bytes] | None = None
        self._pictures: deque[bytes] = deque()
        self._picture_bytes = 0
        self._browsers: set[Any] = set()

    @property
    def n_browsers(self) -> int:
        """How many are looking."""
        return len(self._browsers)

    def tell_frame(self, record: dict[str, Any]) -> None:
        """One more frame, as `records.frame_record` makes it."""
        self._loop.call_soon_threadsafe(self._take_frames, [record], False)

    def tell_all_frames(self, records: Sequence[dict[str, Any]]) -> None:
        """All frames anew: they have moved."""
        self._loop.call_soon_threadsafe(self._take_frames, list(records), True)

    def tell_map(self, cloud: Cloud) -> None:
        """The map in place of the one before."""
        facts = to_json({"type": "map", "facts": cloud.facts})
        self._loop.call_soon_threadsafe(self._take_map, facts, _MAP + cloud.message)

    def tell_picture(self, k: int, jpeg: bytes) -> None:
        """The annotated frame at a position; one that lags behind gets the newest when it can."""
        self._loop.call_soon_threadsafe(self._take_picture, struct.pack("<i", k) + jpeg)

    # ---- in the server's thread

    def _take_frames(self, records: list[dict[str, Any]], anew: bool) -> None:
        self._frames = records if anew else self._frames + records
        kind = "reset" if anew else "frames"
        for browser in self._browsers:
            browser.say(to_json({"type": kind, "frames": records}))

    def _take_map(self, facts: str, message: bytes) -> None:
        self._map = (facts, message)
        for browser in self._browsers:
            browser.say(facts)
            browser.say(message)

    def _take_picture(self, message: bytes) -> None:
        self._pictures.append(message)
        self._picture_bytes += len(message)
        while self._picture_bytes > KEPT_BYTES:
            self._picture_bytes -= len(self._pictures.popleft())
        for browser in self._browsers:
            browser.show(message)

    def _welcome(self, browser: Any) -> None:
        """All that has been, in the order in which it makes sense."""
        browser.say(self._setup)
        for first in range(0, len(self._frames), _AT_ONCE):
            part = self._frames[first : first + _AT_ONCE]
            browser.say(to_json({"type": "frames", "frames": part}))
        for message in self._map or ():
            browser.say(message)
        browser.say(to_json({"type": "ready"}))
        for picture in self._pictures:
            browser.say(picture)
        self._browsers.add(browser)

    async def last_words(self) -> None:
        for browser in list(self._browsers):
            browser.say(to_json({"type": "end"}))
            browser.close()

    def rules(self) -> Rules:
        from tornado.websocket import WebSocketClosedError, WebSocketHandler

        @guarded
        class Live(WebSocketHandler):
            """One browser. tornado lets in pages of this very origin alone."""

            writing = 0  # messages that are under way
            owed: bytes | None = None  # the newest picture, which came meanwhile

            def open(self) -> None:
                self.server._welcome(self)

            def say(self, message: str | bytes) -> None:
                """Send; a browser that has gone away is forgotten."""
                try:
                    sent = self.write_message(message, binary=isinstance(message, bytes))
                except WebSocketClosedError:
                    return
                self.writing += 1
                sent.add_done_callback(self._said)

            def _said(self, sent: Any) -> None:
                self.writing -= 1
                if not sent.cancelled():
                    sent.exception()  # of a browser that was closed meanwhile
                if self.owed is not None and self.writing == 0:
                    picture, self.owed = self.owed, None
                    self.say(picture)

            def show(self, picture: bytes) -> None:
                if self.writing == 0:
                    self.say(picture)
                else:
                    self.owed = picture

            def on_close(self) -> None:
                self.server._browsers.discard(self)

        return [*super().rules(), (r"/live", Live, {"server": self})]
