"""An image brought to a size that a network takes, and the way back.

Owns scaling and padding. Coordinates are of pixel edges here, as networks have them: the top left
pixel reaches from 0 to 1, and its centre is at 0.5.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.types import Image

PAD_VALUE = 114  # grey level that YOLO networks are trained with


@dataclass(frozen=True, slots=True)
class Letterbox:
    """x_network = scale_xy * x_image + offset_xy, in px of edges; size: (width, height), px."""

    size: tuple[int, int]
    scale_xy: tuple[float, float]
    offset_xy: tuple[float, float]

    @classmethod
    def fixed(cls, image_shape: tuple[int, ...], size: tuple[int, int]) -> Letterbox:
        """The largest image of the same proportions in the middle of `size` = (width, height)."""
        height, width = image_shape[:2]
        scale = min(size[0] / width, size[1] / height)
        return cls._centred(image_shape, size, scale)

    @classmethod
    def flexible(cls, image_shape: tuple[int, ...], width_px: int, multiple: int) -> Letterbox:
        """The image at a width of `width_px`, on sides that are rounded up to a `multiple`."""
        height, width = image_shape[:2]
        scale = width_px / width
        sides = (max(round(side * scale), 1) for side in (width, height))
        padded_width, padded_height = (-(-side // multiple) * multiple for side in sides)
        return cls._centred(image_shape, (padded_width, padded_height), scale)

    @classmethod
    def _centred(
        cls, image_shape: tuple[int, ...], size: tuple[int, int], scale: float
    ) -> Letterbox:
        height, width = image_shape[:2]
        inner = (max(round(width * scale), 1), max(round(height * scale), 1))
        offset = tuple((outer - side) // 2 for outer, side in zip(size, inner, strict=True))
        return cls(
            size, (inner[0] / width, inner[1] / height), (float(offset[0]), float(offset[1]))
        )

    def apply(self, image: Image) -> Image:
        """(height, width, 3) uint8 of `size`; grey images become three equal channels."""
        image = to_rgb(image)
        inner = tuple(
            round(side * scale)
            for side, scale in zip(image.shape[1::-1], self.scale_xy, strict=True)
        )
        if inner != image.shape[1::-1]:
            image = np.asarray(cv2.resize(image, inner, interpolation=cv2.INTER_LINEAR), np.uint8)
        left, top = (int(offset) for offset in self.offset_xy)
        padded = np.full((self.size[1], self.size[0], 3), PAD_VALUE, np.uint8)
        padded[top : top + inner[1], left : left + inner[0]] = image
        return padded

    def to_image(self, boxes_px: NDArray[np.float32]) -> NDArray[np.float32]:
        """Boxes (N, 4) x1 y1 x2 y2 of the network's input in px of the image."""
        offset, scale = np.tile(self.offset_xy, 2), np.tile(self.scale_xy, 2)
        return ((boxes_px - offset) / scale).astype(np.float32)


def to_rgb(image: Image) -> Image:
    """(H, W, 3) of a grey (H, W) or RGB image; grey becomes three equal channels."""
    if image.ndim == 3:
        return image
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_GRAY2RGB), np.uint8)


def to_tensor(image: NDArray[Any]) -> NDArray[np.float32]:
    """(3, H, W) float32 in 0 to 1 of an (H, W, 3) image of grey levels, 0 to 255."""
    return np.multiply(image.transpose(2, 0, 1), np.float32(1 / 255), dtype=np.float32, order="C")
