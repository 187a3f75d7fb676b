"""How things look: colours, type, and marks on images. Objects' colours are `object_colors`'s.

Owns all other colours and the drawing of text. Colours are (R, G, B) uint8 values and images
(H, W, 3) uint8 RGB, drawn on in place by the functions named `draw_`.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from pipelines import object_colors
from pipelines.object_colors import Color
from pipelines.types import Image

object_color = object_colors.object_color  # the same as in files

WHITE: Color = (255, 255, 255)
INK: Color = (38, 38, 42)
GREY: Color = (150, 150, 150)

ESTIMATE: Color = (0, 100, 190)  # blue: the camera as estimated
TRUTH: Color = (116, 116, 124)  # grey, as no object is: what truly was, in every view
FRUSTUM: Color = (90, 160, 220)
START: Color = (0, 140, 100)
END: Color = (170, 50, 120)

INLIER: Color = (60, 235, 150)
OUTLIER: Color = (255, 70, 60)
UNTRACKED: Color = (165, 165, 170)
STATUS_OK: Color = (0, 135, 95)
STATUS_LOST: Color = (205, 50, 30)

BACKGROUNDS: dict[str, Color] = {"white": WHITE, "black": (16, 18, 22)}


# Lighter kinds of the colours above that would not stand out from a dark ground.
ON_DARK: dict[Color, Color] = {
    ESTIMATE: (90, 180, 255),
    TRUTH: (172, 172, 180),
    START: (70, 215, 165),
    END: (240, 125, 195),
}


def on_dark(color: Color) -> Color:
    """The colour as it is drawn on a dark ground."""
    return ON_DARK.get(color, color)


def ink_on(color: Color) -> Color:
    """White or the dark ink, whichever is the more legible on the colour."""
    r, g, b = color
    return INK if 0.299 * r + 0.587 * g + 0.114 * b > 125 else WHITE


def hex_color(color: Color) -> str:
    """The colour as "#rrggbb"."""
    return "#{:02x}{:02x}{:02x}".format(*color)


@cache
def _font() -> Any:
    import cv2

    return cv2.FontFace("sans")


def text_size(text: str, size_px: int, weight: int = 400) -> tuple[int, int]:
    """Width and height in pixels that `text` takes."""
    import cv2

    _, _, width, _ = cv2.getTextSize((8192, 512), text, (0, 0), _font(), size_px, weight=weight)
    return int(width), int(size_px)


def draw_text(
    image: Image,
    text: str,
    at: tuple[int, int],
    size_px: int = 16,
    color: Color = INK,
    weight: int = 400,
) -> None:
    """Write `text` with its baseline starting at pixel `at` (u, v)."""
    import cv2

    cv2.putText(image, text, at, color, _font(), size_px, weight=weight)


def draw_panel(
    image: Image, box: tuple[int, int, int, int], color: Color = WHITE, opacity: float = 0.85
) -> None:
    """Blend a plain rectangle (u0, v0, u1, v1), the ends not included, over the image."""
    H, W = image.shape[:2]
    u0, v0, u1, v1 = max(box[0], 0), max(box[1], 0), min(box[2], W), min(box[3], H)
    under = image[v0:v1, u0:u1].astype(np.float32)
    image[v0:v1, u0:u1] = np.round(under + opacity * (np.array(color, np.float32) - under))
