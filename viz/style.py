"""How things look: colours that colour-blind eyes can tell apart, type, and marks on images.

Owns the palette (Okabe and Ito 2008) and drawing of text. Colours are (R, G, B) uint8 values and
images (H, W, 3) uint8 RGB, drawn on in place by the functions named `draw_`.
"""

from __future__ import annotations

import colorsys
from functools import cache
from typing import Any

import numpy as np

from pipelines.types import Image

Color = tuple[int, int, int]

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

OBJECT_COLORS: tuple[Color, ...] = (
    (230, 159, 0),
    (86, 180, 233),
    (204, 121, 167),
    (240, 228, 66),
    (213, 94, 0),
    (0, 158, 115),
    (120, 110, 220),
    (170, 220, 90),
)
# Past the palette's end its hues are taken again, turned, at these lightnesses in turn. The first
# 64 differ the most of what was tried, and none is lost on a white or a dark ground.
_TURN, _LIGHTNESSES, _FULLEST = 0.046, (0.42, 0.55, 0.62), 0.9
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


def object_color(object_id: int) -> Color:
    """The colour of an object, the same in every picture and run: it depends on its id alone."""
    base = OBJECT_COLORS[(object_id - 1) % len(OBJECT_COLORS)]
    turn = (object_id - 1) // len(OBJECT_COLORS)
    if turn == 0:
        return base
    hue, _, saturation = colorsys.rgb_to_hls(*(channel / 255.0 for channel in base))
    lightness = _LIGHTNESSES[(turn - 1) % len(_LIGHTNESSES)]
    red, green, blue = colorsys.hls_to_rgb(
        (hue + _TURN * turn) % 1.0, lightness, min(saturation, _FULLEST)
    )
    return round(255 * red), round(255 * green), round(255 * blue)


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
