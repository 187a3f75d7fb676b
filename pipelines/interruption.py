"""Ctrl-C, put off while something is under way that should not be left half done."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType


class Interruption:
    """Within `with Interruption() as ctrl_c:`, Ctrl-C waits for the end of `ctrl_c.put_off()`.

    A second one does not wait. Nothing is changed outside the main thread, nor where somebody else
    hears the signal, as in a background job or a notebook of its own mind.
    """

    def __init__(self) -> None:
        self._busy = self._asked = self._hears = False

    def __enter__(self) -> Interruption:
        in_main = threading.current_thread() is threading.main_thread()
        if in_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
            signal.signal(signal.SIGINT, self._hear)
            self._hears = True
        return self

    def __exit__(self, *_: object) -> None:
        if self._hears:
            signal.signal(signal.SIGINT, signal.default_int_handler)
            self._hears = False

    @contextmanager
    def put_off(self) -> Iterator[None]:
        """Raises KeyboardInterrupt at its end if Ctrl-C was pressed within."""
        self._busy = True
        try:
            yield
        finally:
            self._busy = False
        if self._asked:
            raise KeyboardInterrupt

    def _hear(self, number: int, frame: FrameType | None) -> None:
        if self._busy and not self._asked:
            self._asked = True
            return
        raise KeyboardInterrupt
