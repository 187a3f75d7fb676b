"""What every data set offers: a `Sequence` of frames, and its ground truth behind a separate door.

Owns the contract; each layout is one file beside this one.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path

from pipelines.types import Array, Frame, GroundTruth, StereoCamera


class Sequence(ABC):
    """Frames in order of time. `read` never returns truth; `ground_truth` is the evaluator's.

    name: short name for result folders. dataset: the layout's name in the table of data sets.
    timestamps_s: (N,) float64, increasing.
    """

    name: str
    dataset: str
    root: Path
    camera: StereoCamera
    timestamps_s: Array

    @classmethod
    def inside(cls, path: Path) -> list[str]:
        """Names of the sequences that a folder of this layout holds in common sub-folders.

        Empty where each sequence has a folder of its own, which is then given by its path. Where it
        is not, the layout's option `sequence` takes one of the names.
        """
        return []

    def __len__(self) -> int:
        return len(self.timestamps_s)

    @abstractmethod
    def read(self, index: int) -> Frame:
        """Frame `index`, 0 <= index < len(self).

        Raises FrameError where a file of this frame cannot be read or has the wrong size.
        """

    def ground_truth(self) -> GroundTruth | None:
        """The truth of all frames, or None where the sequence has none."""
        return None
