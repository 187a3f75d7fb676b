"""The lasting colour of each object, the same in every file, picture and run.

Owns the palette (Okabe and Ito 2008), whose colours colour-blind eyes can tell apart.
"""

from __future__ import annotations

import colorsys

Color = tuple[int, int, int]  # R, G, B, 0 to 255

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
