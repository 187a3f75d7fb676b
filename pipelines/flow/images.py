"""What every computed flow asks of its two images.

Owns the check; how a method prepares them is its own.
"""

from __future__ import annotations

import numpy as np

from pipelines.types import Image

_RGB = 3


def check_pair(method: str, previous: Image, image: Image) -> None:
    """Raise ValueError unless both are (H, W) grey or both (H, W, 3) RGB uint8, of one size."""
    shape = previous.shape
    fits = len(shape) == 2 or (len(shape) == 3 and shape[2] == _RGB)
    if not fits or image.shape != shape or {previous.dtype, image.dtype} != {np.dtype(np.uint8)}:
        raise ValueError(
            f"{method}: expected two uint8 images of one size, both (H, W) grey or (H, W, 3) RGB, "
            f"found {shape} {previous.dtype} and {image.shape} {image.dtype}"
        )
