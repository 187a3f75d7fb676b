"""Drawn things of a room: pictures, book spines, cardboard, a door, a window's view, toys.

Owns textures that show indoor things; plain wood, cloth and wallpaper are in `textures.py`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pipelines.datasets.simulated.canvas import Canvas
from pipelines.datasets.simulated.textures import Texture

BOOKS_M = (1.0, 0.3)
PICTURE_M = (0.8, 0.6)
_SPINES = (
    (150, 44, 40), (38, 72, 110), (48, 92, 66), (206, 172, 90), (96, 60, 40), (186, 186, 176),
    (84, 50, 92), (202, 110, 56), (54, 58, 64), (124, 148, 160),
)  # fmt: skip


def _landscape(rng: np.random.Generator) -> Texture:
    """Hills, a lake and a sun."""
    canvas = Canvas((256, 256), PICTURE_M, (60, 44, 32))
    canvas.fade((0.04, 0.04, 0.76, 0.56), (92, 146, 196), (244, 216, 168))
    canvas.ellipse((0.56, 0.2), (0.055, 0.055), (252, 236, 180))
    for base, colour in ((0.27, (112, 132, 152)), (0.33, (84, 112, 110)), (0.4, (66, 96, 62))):
        along = np.linspace(0.04, 0.76, 24)
        ridge = base + 0.05 * np.sin(along * 9 + base * 40) + 0.03 * np.sin(along * 23 + base * 90)
        foot = np.array([(0.76, 0.56), (0.04, 0.56)])
        canvas.polygon(np.concatenate([np.stack([along, ridge], 1), foot]), colour)
    canvas.fade((0.04, 0.47, 0.76, 0.56), (120, 152, 168), (64, 96, 122))
    for x in (0.12, 0.17, 0.24, 0.66, 0.71):
        height = rng.uniform(0.08, 0.14)
        trunk = [(x - 0.025, 0.47), (x, 0.47 - height), (x + 0.025, 0.47)]
        canvas.polygon(trunk, (38, 62, 42))
    return canvas.texture(rng, 0.03)


def _still_life(rng: np.random.Generator) -> Texture:
    """A vase of flowers and fruit on a table."""
    canvas = Canvas((256, 256), PICTURE_M, (164, 132, 70))
    canvas.fade((0.04, 0.04, 0.76, 0.4), (70, 62, 58), (120, 96, 78))
    canvas.fade((0.04, 0.4, 0.76, 0.56), (156, 110, 70), (112, 74, 46))
    half_vase = np.array([(0.05, 0.46), (0.09, 0.34), (0.04, 0.28)])
    other_half = half_vase[::-1] * (-1, 1)
    canvas.polygon(np.concatenate([half_vase, other_half]) + np.array([0.39, 0]), (72, 104, 144))
    for _ in range(16):
        at = np.array([0.39, 0.2]) + rng.normal(0, (0.075, 0.05))
        canvas.line([(0.39, 0.29), tuple(at)], (62, 92, 52), 0.008)
        colour = ((206, 74, 66), (236, 196, 92), (226, 222, 214), (176, 96, 150))[
            rng.integers(0, 4)
        ]
        for k in range(5):
            petal = at + 0.022 * np.array([np.cos(k * 1.257), np.sin(k * 1.257)])
            canvas.ellipse(petal, (0.016, 0.016), colour)
        canvas.ellipse(at, (0.01, 0.01), (120, 82, 40))
    for x, colour in ((0.54, (196, 60, 44)), (0.61, (214, 140, 44)), (0.2, (110, 142, 62))):
        canvas.ellipse((x, 0.45), (0.042, 0.04), colour)
        canvas.ellipse((x - 0.012, 0.435), (0.012, 0.01), (240, 220, 200))
    return canvas.texture(rng, 0.03)


def _abstract(rng: np.random.Generator) -> Texture:
    canvas = Canvas((256, 256), PICTURE_M, (34, 34, 36))
    canvas.rect(0.03, 0.03, 0.77, 0.57, (236, 230, 216))
    blocks = (
        (0.03, 0.03, 0.25, 0.3, (190, 48, 42)), (0.25, 0.03, 0.52, 0.18, (236, 230, 216)),
        (0.52, 0.03, 0.77, 0.36, (44, 84, 146)), (0.03, 0.3, 0.36, 0.57, (232, 192, 70)),
        (0.36, 0.36, 0.56, 0.57, (236, 230, 216)), (0.56, 0.36, 0.77, 0.57, (190, 48, 42)),
    )  # fmt: skip
    for x0, y0, x1, y1, colour in blocks:
        canvas.rect(x0, y0, x1, y1, (24, 24, 26))
        canvas.rect(x0 + 0.008, y0 + 0.008, x1 - 0.008, y1 - 0.008, colour)
    canvas.ellipse((0.4, 0.27), (0.09, 0.09), (24, 24, 26))
    canvas.ellipse((0.4, 0.27), (0.075, 0.075), (86, 130, 96))
    return canvas.texture(rng, 0.03)


def _books(rng: np.random.Generator) -> Texture:
    canvas = Canvas((512, 128), BOOKS_M, (38, 30, 24))
    x = 0.0
    while x < 0.985:
        w, h = min(rng.uniform(0.02, 0.05), 1.0 - x), rng.uniform(0.2, 0.285)
        colour = np.array(_SPINES[rng.integers(0, len(_SPINES))]) * rng.uniform(0.8, 1.15)
        top = BOOKS_M[1] - h
        canvas.rect(x, top, x + w - 0.002, BOOKS_M[1], colour)
        canvas.rect(x, top, x + 0.004, BOOKS_M[1], colour * 0.7)
        for share in (0.12, 0.82):
            y = top + share * h
            canvas.rect(x + 0.004, y, x + w - 0.004, y + 0.012, colour * 0.55 + 96)
        for y in np.arange(top + 0.3 * h, top + 0.7 * h, 0.014):
            canvas.rect(x + w * 0.35, y, x + w * 0.65, y + 0.007, colour * 0.4 + 140)
        x += w
    return canvas.texture(rng, 0.03)


def _cardboard(rng: np.random.Generator) -> Texture:
    """Corrugated box with tape, a label and printed arrows; one tile is one face."""
    canvas = Canvas((256, 256), (0.5, 0.5), (184, 142, 96))
    for x in np.arange(0.004, 0.5, 0.011):
        canvas.line([(x, 0), (x, 0.5)], (178, 136, 91), 0.004)
    canvas.rect(0.215, 0, 0.285, 0.5, (206, 172, 122))
    canvas.line([(0.25, 0), (0.25, 0.5)], (120, 88, 56), 0.004)
    canvas.rect(0.32, 0.07, 0.46, 0.17, (238, 236, 230))
    canvas.text("DyOb", (0.39, 0.095), 0.025, (40, 40, 44))
    for i, y in enumerate((0.12, 0.132, 0.144)):
        canvas.rect(0.335, y, 0.43 - 0.02 * i, y + 0.005, (90, 90, 96))
    for x in np.arange(0.335, 0.44, 0.009):
        canvas.rect(x, 0.153, x + rng.uniform(0.002, 0.006), 0.166, (30, 30, 32))
    for x in (0.07, 0.14):  # this side up
        arrow = [(x, 0.28), (x + 0.028, 0.33), (x + 0.012, 0.33), (x + 0.012, 0.4),
                 (x - 0.012, 0.4), (x - 0.012, 0.33), (x - 0.028, 0.33)]  # fmt: skip
        canvas.polygon(arrow, (86, 56, 38))
    canvas.rect(0.04, 0.41, 0.17, 0.418, (86, 56, 38))
    canvas.text("FRAGILE", (0.385, 0.37), 0.032, (168, 44, 38))
    canvas.line([(0.31, 0.342), (0.46, 0.342), (0.46, 0.398), (0.31, 0.398), (0.31, 0.342)],
                (168, 44, 38), 0.005)  # fmt: skip
    for edge in (
        (0, 0, 0.5, 0.006),
        (0, 0.494, 0.5, 0.5),
        (0, 0, 0.006, 0.5),
        (0.494, 0, 0.5, 0.5),
    ):
        x0, y0, x1, y1 = edge
        canvas.rect(x0, y0, x1, y1, (140, 104, 66))
    return canvas.texture(rng, 0.035)


def _gift(rng: np.random.Generator) -> Texture:
    """Wrapping paper with stars, and a ribbon."""
    canvas = Canvas((256, 256), (0.4, 0.4), (52, 92, 138))
    for row in range(6):
        for column in range(6):
            x, y = column * 0.067 + 0.033 * (row % 2) + 0.02, row * 0.067 + 0.033
            angle = np.arange(10) * np.pi / 5
            radius = np.where(np.arange(10) % 2 == 0, 0.02, 0.009)
            star = np.stack([x + radius * np.sin(angle), y - radius * np.cos(angle)], 1)
            canvas.polygon(star, (240, 214, 120))
    canvas.rect(0.17, 0, 0.23, 0.4, (196, 44, 50))
    canvas.rect(0, 0.17, 0.4, 0.23, (196, 44, 50))
    canvas.rect(0.177, 0, 0.181, 0.4, (236, 150, 140))
    canvas.rect(0, 0.177, 0.4, 0.181, (236, 150, 140))
    return canvas.texture(rng, 0.03)


def _toy_block(rng: np.random.Generator) -> Texture:
    """Six faces of a letter cube, in a 4 x 2 sheet of 0.36 m squares."""
    canvas = Canvas((512, 256), (1.44, 0.72), (226, 190, 132))
    colours = (
        (196, 52, 48),
        (46, 94, 160),
        (66, 130, 76),
        (220, 150, 40),
        (130, 74, 140),
        (40, 130, 140),
    )
    for i, letter in enumerate("DYOBSL"):
        x, y = (i % 4) * 0.36, (i // 4) * 0.36
        canvas.rect(x, y, x + 0.36, y + 0.36, colours[i])
        canvas.rect(x + 0.035, y + 0.035, x + 0.325, y + 0.325, (240, 222, 182))
        canvas.text(letter, (x + 0.18, y + 0.18), 0.2, colours[i])
        for dx, dy in ((0.06, 0.06), (0.3, 0.06), (0.06, 0.3), (0.3, 0.3)):
            canvas.ellipse((x + dx, y + dy), (0.014, 0.014), colours[(i + 1) % 6])
    return canvas.texture(rng, 0.035)


def _ball(rng: np.random.Generator) -> Texture:
    """Beach ball: six coloured wedges round the ball (1 m of the tile), with dots."""
    canvas = Canvas((256, 128), (1.0, 0.5), (240, 238, 230))
    colours = (
        (206, 50, 46),
        (240, 238, 230),
        (48, 102, 172),
        (240, 200, 64),
        (240, 238, 230),
        (70, 146, 84),
    )
    for i, colour in enumerate(colours):
        canvas.rect(i / 6, 0, (i + 1) / 6, 0.5, colour)
        canvas.rect(i / 6, 0, i / 6 + 0.006, 0.5, (120, 116, 110))
        for y in (0.17, 0.33):
            canvas.ellipse(((i + 0.5) / 6, y), (0.024, 0.024), colours[(i + 2) % 6])
    for y in (0.03, 0.47):
        canvas.rect(0, y - 0.03, 1.0, y + 0.03, (236, 236, 232))
    return canvas.texture(rng, 0.025)


def _door(rng: np.random.Generator) -> Texture:
    canvas = Canvas((256, 512), (1.0, 2.1), (232, 228, 216))
    canvas.rect(0.06, 0.06, 0.94, 2.1, (120, 114, 104))
    canvas.rect(0.075, 0.075, 0.925, 2.1, (206, 196, 176))
    for y0, y1 in ((0.22, 0.95), (1.12, 1.95)):
        for x0, x1 in ((0.17, 0.46), (0.54, 0.83)):
            canvas.rect(x0, y0, x1, y1, (150, 140, 122))
            canvas.rect(x0 + 0.012, y0 + 0.016, x1, y1, (222, 214, 196))
            canvas.rect(x0 + 0.04, y0 + 0.05, x1 - 0.03, y1 - 0.04, (198, 188, 168))
    canvas.ellipse((0.86, 1.06), (0.025, 0.045), (150, 128, 70))
    canvas.rect(0.8, 1.05, 0.88, 1.07, (190, 164, 92))
    return canvas.texture(rng, 0.02)


def _window_view(rng: np.random.Generator) -> Texture:
    """A window with a garden behind its panes."""
    canvas = Canvas((512, 512), (1.6, 1.4), (236, 234, 226))
    canvas.fade((0.06, 0.06, 1.54, 0.8), (150, 190, 226), (222, 232, 234))
    canvas.fade((0.06, 0.8, 1.54, 1.34), (132, 160, 92), (96, 132, 66))
    for _ in range(240):
        at = (rng.uniform(0.08, 1.52), rng.normal(0.72, 0.1))
        green = np.array((74, 110, 52)) * rng.uniform(0.6, 1.5)
        canvas.ellipse(at, rng.uniform(0.02, 0.06, 2), green)
    for x in (0.4, 1.2):
        canvas.rect(x - 0.02, 0.7, x + 0.02, 0.98, (96, 74, 54))
    frame = (240, 238, 230)
    for x in (0.03, 0.55, 1.05, 1.57):
        canvas.rect(x - 0.035, 0, x + 0.035, 1.4, frame)
        canvas.rect(x + 0.03, 0, x + 0.036, 1.4, (170, 166, 156))
    for y in (0.03, 0.6, 1.37):
        canvas.rect(0, y - 0.03, 1.6, y + 0.03, frame)
        canvas.rect(0, y + 0.026, 1.6, y + 0.032, (170, 166, 156))
    return canvas.texture(rng, 0.01)


def _poster(rng: np.random.Generator) -> Texture:
    """A travel poster."""
    canvas = Canvas((256, 256), (0.6, 0.8), (236, 226, 200))
    canvas.fade((0.03, 0.03, 0.57, 0.6), (232, 120, 70), (246, 206, 120))
    canvas.ellipse((0.3, 0.36), (0.13, 0.13), (250, 236, 190))
    peak = [(0.03, 0.6), (0.2, 0.3), (0.28, 0.42), (0.38, 0.22), (0.57, 0.6)]
    canvas.polygon(peak, (70, 82, 110))
    canvas.polygon([(0.33, 0.32), (0.38, 0.22), (0.43, 0.32), (0.39, 0.3)], (240, 240, 238))
    canvas.polygon([(0.16, 0.37), (0.2, 0.3), (0.235, 0.355), (0.2, 0.35)], (240, 240, 238))
    canvas.text("ALPINE", (0.3, 0.665), 0.06, (160, 60, 44))
    canvas.text("EXPRESS", (0.3, 0.745), 0.045, (54, 64, 92))
    return canvas.texture(rng, 0.03)


def _curtain(rng: np.random.Generator) -> Texture:
    canvas = Canvas((256, 64), (0.8, 0.4), (255, 255, 255, 255))
    for i in range(10):
        x = i * 0.08
        canvas.rect(x, 0, x + 0.03, 0.4, (206, 206, 206, 255))
        canvas.rect(x + 0.03, 0, x + 0.045, 0.4, (170, 170, 170, 255))
    return canvas.texture(rng, 0.05)


INTERIORS: dict[str, Callable[[np.random.Generator], Texture]] = {
    "landscape": _landscape,
    "still_life": _still_life,
    "abstract": _abstract,
    "poster": _poster,
    "books": _books,
    "cardboard": _cardboard,
    "gift": _gift,
    "toy_block": _toy_block,
    "ball": _ball,
    "door": _door,
    "window_view": _window_view,
    "curtain": _curtain,
}
