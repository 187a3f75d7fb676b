"""Dense optical flow previous -> current: the table of methods.

Adding one is one file and one line here; the contract tests then run on it.
"""

from __future__ import annotations

import difflib
from importlib import import_module
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import ConfigError
from pipelines.types import Image

FLOWS = {
    "dis": "pipelines.flow.dis:DisFlow",
    "files": "pipelines.flow.files:FilesFlow",
}


class Flow(Protocol):
    """What every method of the table offers."""

    def compute(
        self, previous_gray: Image, gray: Image, given: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32] | None:
        """Flow (H, W, 2) float32 in pixels on the grid of the previous image, NaN where unknown.

        previous_gray, gray: (H, W) uint8. given: the flow that the frame brings, or None. None
        where there is no flow to be had.
        """
        ...


def load_flow(name: str, **options: Any) -> Flow:
    """The method called `name` with its options; raises ConfigError for an unknown name."""
    if name not in FLOWS:
        nearest = difflib.get_close_matches(name, FLOWS, 1, 0.4)
        hint = f"did you mean {nearest[0]!r}? " if nearest else ""
        raise ConfigError(f"Unknown flow {name!r}; {hint}There are: {', '.join(FLOWS)}.")
    module, method = FLOWS[name].split(":")
    return getattr(import_module(module), method)(**options)
