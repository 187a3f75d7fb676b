"""Runs that are interrupted at a frame, as by Ctrl-C."""

from __future__ import annotations

import signal

from pipelines.types import Frame

QUICK = ("batch.at_end=false",)  # settings of runs whose batch is not what is tested


class Interrupter:
    """A sink at which Ctrl-C is pressed at some frame."""

    def __init__(self, at: int) -> None:
        self.at = at

    def start(self, *_: object) -> None: ...

    def frame(self, frame: Frame, result: object) -> None:
        if frame.index == self.at:
            signal.raise_signal(signal.SIGINT)

    def finish(self) -> None: ...
