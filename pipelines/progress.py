"""What a run has done so far, and how it goes into a checkpoint and out of one.

Owns what a run's checkpoint is of. Its files are `checkpoint`, the order of things is `runner`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from pipelines.checkpoint import Checkpoints, frame_digest, read_checkpoint
from pipelines.datasets.sequence import Sequence
from pipelines.dyob_slam import DyObSlam
from pipelines.errors import FormatError, FrameError
from pipelines.io import folder as names
from pipelines.io.observations import ObservationRecorder
from pipelines.object_types import ObjectEstimates
from pipelines.types import Frame, FrameResult


@dataclass(slots=True)
class Progress:
    """What a run has done so far. n_done: of the chosen frames. skipped: that could not be read.

    last: the last frame that could. earlier: objects of the map that it began with. in_frame:
    whether a frame is under way. n_corrections: of the map, that the sinks were told.
    """

    results: list[FrameResult] = field(default_factory=list)
    n_done: int = 0
    skipped: int = 0
    recorder: ObservationRecorder | None = None
    last: Frame | None = None
    earlier: ObjectEstimates = field(default_factory=ObjectEstimates.empty)
    in_frame: bool = False
    n_corrections: int = 0
    interrupted: bool = False

    def keep(self, checkpoints: Checkpoints, slam: DyObSlam) -> None:
        """Write a checkpoint; none before the first frame, nor while one is half done."""
        if self.last is None or self.in_frame:
            return
        recorder = None if self.recorder is None else self.recorder.state()
        checkpoints.write(
            {
                "slam": slam.state(),
                "results": self.results,
                "n_done": self.n_done,
                "skipped": self.skipped,
                "recorder": recorder,
                "earlier": self.earlier,
                "last": (self.last.index, frame_digest(self.last)),
            }
        )


def resume_progress(
    folder: Path, sequence: Sequence, slam: DyObSlam, origin: Mapping[str, Any]
) -> Progress:
    """What an interrupted run had done by its last checkpoint; the new system goes on from there.

    folder: of the result. Raises FormatError where there is no checkpoint of a run of this origin,
    or the last frame is not the one that it saw.
    """
    state = read_checkpoint(folder / names.CHECKPOINT, origin, slam.fixed_parts())
    index, digest = state["last"]
    last = _read_again(folder, sequence, index)
    if frame_digest(last) != digest:
        raise FormatError(
            f"{folder}: expected the data of the interrupted run, found another frame {index}; "
            "give --resume the same data, or run again without it"
        )
    slam.restore(state["slam"])
    recorder = None
    if state["recorder"] is not None:
        recorder = ObservationRecorder.go_on(folder / names.OBSERVATIONS, *state["recorder"])
    results = [slam.arrays.keep(result) for result in state["results"]]
    return Progress(results, state["n_done"], state["skipped"], recorder, last, state["earlier"])


def _read_again(folder: Path, sequence: Sequence, index: int) -> Frame:
    try:
        return sequence.read(index)
    except FrameError as error:
        raise FormatError(
            f"{folder}: expected frame {index} as the interrupted run saw it, found that it cannot "
            f"be read ({error}); restore it, or run again without --resume"
        ) from error
