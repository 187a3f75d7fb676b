"""The flow that comes with the sequence.

Owns nothing: it hands on what the frame brings, in the place of a computed flow.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.types import Image


class FilesFlow:
    """`compute` returns the frame's own flow."""

    def compute(
        self, previous: Image, image: Image, given: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32] | None:
        """`given`, untouched; None where the frame brings none. See `pipelines.flow.Flow`."""
        return given
