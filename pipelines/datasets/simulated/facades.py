"""Drawn house fronts: storeys of windows, shop fronts, front doors, and what hangs in a street.

Owns textures that show built things outdoors; the walls behind them come from `textures.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from pipelines.datasets.simulated.canvas import PAINT, Canvas
from pipelines.datasets.simulated.textures import SURFACES, Texture

STOREY_M = 3.1
BAY_M = 3.2
GROUND_M = 3.8  # height of the ground floor
_BAYS = 4
_STOREYS = 4


def _glass(
    canvas: Canvas, box: tuple[float, float, float, float], rng: np.random.Generator
) -> None:
    """Window glass with sky in it and, often, a curtain or a blind behind."""
    x0, y0, x1, y1 = box
    sky = rng.uniform(0.55, 1.0)
    canvas.fade(box, np.array((128, 148, 164)) * sky, np.array((58, 68, 78)) * sky)
    kind = rng.integers(0, 5)
    if kind in (0, 1):  # curtains on both sides
        cloth = np.array(((214, 206, 190), (182, 150, 132), (198, 204, 210))[rng.integers(0, 3)])
        w = (x1 - x0) * rng.uniform(0.16, 0.34)
        for a, b, inner in ((x0, x0 + w, x0 + w * 0.6), (x1 - w, x1, x1 - w * 0.6)):
            edge = inner if a == x0 else b
            start = a if a == x0 else inner
            canvas.polygon([(a, y0), (b, y0), (edge, y1), (start, y1)], cloth * 0.86)
            for fold in np.linspace(a, b, 5)[1:-1]:
                canvas.line(
                    [(fold, y0), (fold * 0.7 + (start + edge) * 0.15, y1)], cloth * 0.7, 0.02
                )
    elif kind == 2:  # a roller blind
        y = y0 + (y1 - y0) * rng.uniform(0.2, 0.7)
        canvas.rect(x0, y0, x1, y, (206, 200, 184))
        canvas.line([(x0, y), (x1, y)], (140, 134, 120), 0.03)
    elif kind == 3:  # something on the window sill inside
        for x in np.linspace(x0, x1, 5)[1:-1]:
            canvas.ellipse((x, y1 - 0.12), (0.09, 0.14), (52, 82, 44))
            canvas.rect(x - 0.06, y1 - 0.08, x + 0.06, y1, (150, 84, 56))
    glint = x0 + (x1 - x0) * rng.uniform(0.1, 0.5)
    canvas.line([(glint, y1 - 0.1), (glint + 0.3 * (x1 - x0), y0 + 0.1)], (150, 166, 178), 0.02)


def _window(canvas: Canvas, x: float, y: float, style: int, rng: np.random.Generator) -> None:
    """One window of a storey, its lintel, frame, panes and sill; (x, y) is the top left."""
    w, h = ((1.15, 1.75), (1.9, 1.55), (1.0, 1.85))[style]
    stone = (206, 200, 188)
    canvas.rect(x - 0.12, y - 0.26, x + w + 0.12, y, stone)
    canvas.rect(x - 0.12, y - 0.05, x + w + 0.12, y, (150, 144, 134))
    canvas.rect(x - 0.04, y, x + w + 0.04, y + h, (58, 54, 50))  # shadow of the reveal
    frame = ((238, 236, 230), (94, 66, 46), (234, 234, 232))[style]
    canvas.rect(x + 0.03, y + 0.08, x + w, y + h, frame)
    columns, rows = ((2, 2), (3, 1), (2, 3))[style]
    for i in range(columns):
        for j in range(rows):
            pane_x = x + 0.08 + i * (w - 0.1) / columns
            pane_y = y + 0.13 + j * (h - 0.18) / rows
            x1, y1 = pane_x + (w - 0.1) / columns - 0.06, pane_y + (h - 0.18) / rows - 0.06
            _glass(canvas, (pane_x, pane_y, x1, y1), rng)
    if style == 2:  # shutters
        for side in (x - 0.5, x + w + 0.06):
            canvas.rect(side, y, side + 0.44, y + h, (66, 92, 84))
            for slat in np.arange(y + 0.1, y + h - 0.05, 0.12):
                canvas.line([(side + 0.05, slat), (side + 0.39, slat)], (42, 62, 58), 0.03)
    canvas.rect(x - 0.15, y + h, x + w + 0.15, y + h + 0.12, stone)
    canvas.rect(x - 0.13, y + h + 0.12, x + w + 0.13, y + h + 0.18, (96, 90, 84))
    if style == 0 and rng.random() < 0.3:  # flower box
        canvas.rect(x, y + h - 0.14, x + w, y + h + 0.02, (112, 70, 50))
        for _ in range(26):
            at = (x + rng.uniform(0, w), y + h - rng.uniform(0.08, 0.34))
            colours = ((70, 104, 52), (86, 118, 60), (196, 52, 62), (226, 190, 90))
            canvas.ellipse(at, (0.06, 0.05), colours[rng.choice(4, p=(0.4, 0.3, 0.2, 0.1))])


def _storeys(rng: np.random.Generator, wall: str, style: int) -> Texture:
    size_m = (_BAYS * BAY_M, _STOREYS * STOREY_M)
    canvas = Canvas((1024, 1024), size_m, (0, 0, 0))
    surface = SURFACES[wall](rng)
    canvas.paste(surface.rgba, surface.tile_m)
    for storey in range(_STOREYS):
        top = storey * STOREY_M
        canvas.rect(0, top, size_m[0], top + 0.1, (186, 180, 168, 90))
        canvas.rect(0, top + 0.1, size_m[0], top + 0.14, (112, 106, 98))
        for bay in range(_BAYS):
            w = (1.15, 1.9, 1.0)[style]
            _window(canvas, bay * BAY_M + (BAY_M - w) / 2, top + 0.68, style, rng)
    for x in (0.12, size_m[0] / 2):  # down pipes
        canvas.rect(x, 0, x + 0.1, size_m[1], (112, 110, 106))
        canvas.rect(x + 0.1, 0, x + 0.13, size_m[1], (72, 70, 68))
    return canvas.texture(rng, 0.02)


_SHOPS = (
    ("BAKERY", (122, 46, 38), (240, 220, 176)),
    ("BOOKS", (38, 66, 54), (232, 216, 160)),
    ("CAFE LUNA", (42, 56, 92), (238, 236, 226)),
    ("FLOWERS", (92, 108, 66), (250, 240, 224)),
    ("PHARMACY", (226, 228, 224), (34, 124, 70)),
    ("BIKES", (196, 140, 44), (48, 40, 34)),
    ("RECORDS", (46, 42, 46), (230, 190, 80)),
    ("GREENGROCER", (64, 96, 52), (244, 240, 220)),
)
_GOODS = (
    (176, 74, 52),
    (206, 164, 74),
    (92, 116, 66),
    (196, 186, 166),
    (84, 92, 130),
    (150, 96, 60),
)


def _shop(canvas: Canvas, x: float, w: float, which: int, rng: np.random.Generator) -> None:
    name, paint, letters = _SHOPS[which % len(_SHOPS)]
    dark = np.array(paint) * 0.7
    canvas.rect(x, 0.25, x + w, GROUND_M, paint)
    canvas.rect(x + 0.06, 0.3, x + w - 0.06, 0.92, dark)
    canvas.text(name, (x + w / 2, 0.62), 0.34, letters)
    canvas.rect(x, 0.95, x + w, 1.02, dark * 0.6)
    door_x = x + w - 1.25
    canvas.fade((x + 0.18, 1.1, door_x - 0.12, 3.15), (74, 82, 88), (44, 42, 40))
    for shelf in (1.75, 2.4, 3.1):  # goods behind the glass
        at = x + 0.3
        while at < door_x - 0.5:
            width, height = rng.uniform(0.12, 0.34), rng.uniform(0.15, 0.42)
            goods = np.array(_GOODS[rng.integers(0, len(_GOODS))]) * rng.uniform(0.6, 1.05)
            canvas.rect(at, shelf - height, at + width, shelf, goods)
            canvas.rect(at, shelf - height * 0.6, at + width, shelf - height * 0.4, goods * 1.2)
            at += width + rng.uniform(0.03, 0.18)
        canvas.rect(x + 0.18, shelf, door_x - 0.12, shelf + 0.06, (118, 98, 76))
    glint = [(x + 0.5, 3.1), (x + 1.3, 1.15)]
    canvas.line(glint, (98, 108, 116), 0.03)
    middle = (x + 0.18 + door_x - 0.12) / 2
    canvas.rect(middle - 0.04, 1.1, middle + 0.04, 3.15, paint)
    canvas.rect(x + 0.1, 3.2, door_x - 0.1, 3.66, dark)  # the plinth below
    canvas.rect(door_x, 1.1, x + w - 0.15, GROUND_M - 0.04, dark * 0.75)
    canvas.fade((door_x + 0.14, 1.25, x + w - 0.3, 3.1), (96, 108, 114), (52, 54, 54))
    canvas.rect(door_x + 0.3, 1.5, door_x + 0.75, 1.75, (226, 222, 208))
    canvas.rect(x + w - 0.42, 2.6, x + w - 0.36, 2.95, (206, 186, 120))


def _shops(rng: np.random.Generator, first: int) -> Texture:
    canvas = Canvas((1024, 256), (_BAYS * BAY_M, GROUND_M), (196, 188, 174))
    for i, x in enumerate((0.15, 4.35, 8.6)):
        _shop(canvas, x, 4.0, first + i, rng)
    canvas.rect(0, 0, _BAYS * BAY_M, 0.12, (206, 200, 188))
    canvas.rect(0, 0.12, _BAYS * BAY_M, 0.18, (110, 104, 96))
    return canvas.texture(rng, 0.02)


def _homes(rng: np.random.Generator) -> Texture:
    """Ground floor of houses: stone base, front doors with steps, windows."""
    canvas = Canvas((1024, 256), (_BAYS * BAY_M, GROUND_M), (0, 0, 0))
    stone = SURFACES["ashlar"](rng)
    canvas.paste(stone.rgba, stone.tile_m)
    canvas.rect(0, 3.1, _BAYS * BAY_M, GROUND_M, (134, 128, 120))
    canvas.rect(0, 3.08, _BAYS * BAY_M, 3.14, (84, 80, 76))
    doors = ((46, 74, 62), (126, 40, 40), (44, 58, 98), (112, 78, 48))
    for bay in range(_BAYS):
        x = bay * BAY_M
        if bay % 2 == 0:
            paint = np.array(doors[rng.integers(0, 4)])
            canvas.rect(x + 0.9, 0.45, x + 2.3, GROUND_M, (212, 206, 194))
            canvas.rect(x + 1.02, 0.6, x + 2.18, GROUND_M - 0.25, (64, 58, 54))
            canvas.rect(x + 1.07, 1.12, x + 2.14, GROUND_M - 0.25, paint)
            _glass(canvas, (x + 1.07, 0.66, x + 2.14, 1.06), rng)
            for py in (1.3, 2.2):
                for px in (1.17, 1.66):
                    canvas.rect(x + px, py, x + px + 0.38, py + 0.75, paint * 0.72)
                    canvas.rect(x + px + 0.04, py + 0.05, x + px + 0.36, py + 0.73, paint * 1.15)
            canvas.ellipse((x + 2.06, 2.35), (0.05, 0.05), (220, 196, 110))
            canvas.rect(x + 0.8, GROUND_M - 0.22, x + 2.4, GROUND_M, (176, 170, 160))
            canvas.text(str(int(rng.integers(2, 98))), (x + 2.55, 1.5), 0.18, (40, 40, 44))
        else:
            _window(canvas, x + 1.0, 0.85, 0, rng)
    return canvas.texture(rng, 0.02)


def _sign(rng: np.random.Generator, kind: str) -> Texture:
    """Round and square road signs, 0.7 m; what lies outside the sign's own mesh is never seen."""
    canvas = Canvas((128, 128), (0.7, 0.7), (236, 236, 232))
    if kind == "limit":
        canvas.rect(0, 0, 0.7, 0.7, (186, 30, 36))
        canvas.ellipse((0.35, 0.35), (0.26, 0.26), (238, 238, 234))
        canvas.text("30", (0.35, 0.35), 0.22, (24, 24, 26))
    elif kind == "parking":
        canvas.rect(0, 0, 0.7, 0.7, (28, 76, 158))
        canvas.text("P", (0.35, 0.35), 0.42, (240, 240, 240))
    else:  # a crossing
        canvas.rect(0, 0, 0.7, 0.7, (28, 76, 158))
        canvas.polygon([(0.35, 0.1), (0.62, 0.56), (0.08, 0.56)], (240, 240, 240))
        canvas.ellipse((0.36, 0.27), (0.035, 0.04), (20, 20, 22))
        canvas.line([(0.35, 0.32), (0.34, 0.43), (0.27, 0.53)], (20, 20, 22), 0.035)
        canvas.line([(0.34, 0.43), (0.42, 0.53)], (20, 20, 22), 0.035)
        canvas.line([(0.27, 0.39), (0.35, 0.33), (0.43, 0.4)], (20, 20, 22), 0.025)
    return canvas.texture(rng, 0.015)


def _signal(rng: np.random.Generator) -> Texture:
    canvas = Canvas((64, 128), (0.4, 1.0), (34, 36, 36))
    for y, colour in ((0.2, (232, 56, 44)), (0.5, (92, 72, 28)), (0.8, (24, 74, 44))):
        canvas.ellipse((0.2, y), (0.14, 0.14), (14, 14, 14))
        canvas.ellipse((0.2, y), (0.11, 0.11), colour)
    return canvas.texture(rng, 0.02)


def _awning(rng: np.random.Generator) -> Texture:
    canvas = Canvas((256, 64), (2.0, 1.2), (236, 230, 216))
    for i in range(5):
        canvas.rect(0.4 * i, 0, 0.4 * i + 0.2, 1.2, PAINT)
    return canvas.texture(rng, 0.03)


FACADES: dict[str, Callable[[np.random.Generator], Texture]] = {
    "storeys_brick": partial(_storeys, wall="brick", style=0),
    "storeys_plaster": partial(_storeys, wall="plaster", style=2),
    "storeys_ashlar": partial(_storeys, wall="ashlar", style=0),
    "storeys_modern": partial(_storeys, wall="plaster", style=1),
    "shops_a": partial(_shops, first=0),
    "shops_b": partial(_shops, first=3),
    "shops_c": partial(_shops, first=6),
    "homes": _homes,
    "sign_limit": partial(_sign, kind="limit"),
    "sign_parking": partial(_sign, kind="parking"),
    "sign_crossing": partial(_sign, kind="crossing"),
    "signal": _signal,
    "awning": _awning,
}
