"""Surfaces that repeat: asphalt, bricks, wood, foliage, cloth and their like, drawn in numpy.

Owns the `Texture` and natural materials; windows and shop fronts are in `facades`, cars in
`vehicles`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from pipelines.types import Array, Image


@dataclass(frozen=True, slots=True)
class Texture:
    """A picture that tiles the plane.

    rgba: (H, W, 4) uint8, sides powers of two. Alpha is no opacity: it says how much the tint of
    the triangle colours the pixel (255 = wholly). tile_m: width and height of one tile in metres.
    """

    rgba: Image
    tile_m: tuple[float, float]

    def __post_init__(self) -> None:
        H, W = self.rgba.shape[:2]
        if self.rgba.ndim != 3 or self.rgba.shape[2] != 4 or W & (W - 1) or H & (H - 1):
            raise ValueError(
                "Texture.rgba: expected (H, W, 4) with sides that are powers of two, "
                f"found {self.rgba.shape}"
            )


def smooth_noise(size: int, cells: int, rng: np.random.Generator) -> Array:
    """Tileable smooth noise (size, size), zero mean and unit deviation, `cells` bumps across."""
    grid = rng.standard_normal((cells, cells)).astype(np.float32)
    pad = 2
    padded = np.pad(grid, pad, mode="wrap")
    scale = size / cells
    grown = cv2.resize(padded, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
    start = round(pad * scale)
    out = grown[start : start + size, start : start + size]
    return (out - out.mean()) / out.std()


def fractal_noise(
    size: int, rng: np.random.Generator, coarsest: int = 4, fall: float = 0.7
) -> Array:
    """Tileable noise (size, size) of unit deviation with detail at every scale."""
    cells, weight = coarsest, 1.0
    total = np.zeros((size, size), np.float32)
    while cells <= size:
        total += weight * smooth_noise(size, cells, rng)
        cells, weight = cells * 2, weight * fall
    return total / total.std()


def grain(size: int, rng: np.random.Generator, sigma_px: float = 0.7) -> Array:
    """Tileable fine grain (size, size) of unit deviation."""
    noise = rng.standard_normal((size, size)).astype(np.float32)
    out = cv2.GaussianBlur(np.pad(noise, 8, mode="wrap"), (0, 0), sigma_px)[8:-8, 8:-8]
    return out / out.std()


def coloured(rgb: ArrayLike, light: Array, tinted: float = 0.0) -> Image:
    """RGBA of one colour times brightness `light` (H, W), which is 1 on average."""
    colour = np.asarray(rgb, np.float32) * light[..., None].astype(np.float32)
    alpha = np.full((*light.shape, 1), 255.0 * tinted, np.float32)
    return np.clip(np.concatenate([colour, alpha], -1) + 0.5, 0, 255).astype(np.uint8)


def courses(
    size: int, rows: int, columns: int, joint_px: int, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Running bond: (size, size) random value of each brick, and mask 0-1 of the bricks.

    Every second row is shifted by half a brick; it tiles when `rows` is even.
    """
    y, x = np.mgrid[:size, :size]
    row = y * rows // size
    shifted = (x + (row % 2) * (size // columns // 2)) % size
    column = shifted * columns // size
    value = rng.standard_normal((rows, columns))[row, column]
    inside_y = (y * rows % size) // rows >= joint_px
    inside_x = (shifted * columns % size) // columns >= joint_px
    mask = cv2.blur((inside_y & inside_x).astype(np.float32), (2, 2), borderType=cv2.BORDER_REFLECT)
    return value.astype(np.float32), mask


def _asphalt(rng: np.random.Generator) -> Texture:
    size = 1024
    stones = grain(size, rng, 0.8)
    light = 1 + 0.13 * stones + 0.05 * fractal_noise(size, rng, 3)
    light += 0.35 * np.clip(grain(size, rng, 1.1) - 2.1, 0, 2)  # pale chippings
    rgba = coloured((112, 112, 114), light)
    for _ in range(5):  # cracks, and the patches of old repairs
        walk = rng.normal((0, 0), (11, 11), (60, 2)) + rng.normal(0, 7, 2)
        line = (rng.uniform(0, size, 2) + walk.cumsum(0)).astype(np.int32)
        cv2.polylines(rgba, [line], False, (66, 66, 68, 0), 2, cv2.LINE_AA)
    for _ in range(4):
        x, y = rng.integers(60, size - 300, 2)
        w, h = rng.integers(60, 240, 2)
        patch = rgba[y : y + h, x : x + w].astype(np.float32) * rng.uniform(0.78, 0.92)
        rgba[y : y + h, x : x + w] = patch.astype(np.uint8)
        cv2.rectangle(rgba, (x, y), (x + w, y + h), (60, 60, 62, 0), 2)
    return Texture(rgba, (7.0, 7.0))


def _paving(rng: np.random.Generator) -> Texture:
    value, mask = courses(512, 8, 8, 3, rng)
    light = (1 + 0.07 * value + 0.07 * grain(512, rng) + 0.05 * fractal_noise(512, rng)) * (
        0.62 + 0.38 * mask
    )
    return Texture(coloured((168, 161, 150), light), (4.0, 4.0))


def _brick(rng: np.random.Generator) -> Texture:
    value, mask = courses(512, 32, 8, 2, rng)
    light = 1 + 0.13 * value + 0.07 * grain(512, rng) + 0.04 * fractal_noise(512, rng)
    rgba = coloured((235, 235, 235), light * 0.93, tinted=1.0).astype(np.float32)
    mortar = coloured((176, 168, 156), 1 + 0.06 * grain(512, rng)).astype(np.float32)
    mixed = mortar + mask[..., None] * (rgba - mortar)
    return Texture(np.clip(mixed, 0, 255).astype(np.uint8), (2.0, 2.4))


def _plaster(rng: np.random.Generator) -> Texture:
    light = 0.94 + 0.05 * grain(512, rng, 1.0) + 0.028 * fractal_noise(512, rng, 6)
    return Texture(coloured((245, 245, 245), light, tinted=1.0), (3.0, 3.0))


def _ashlar(rng: np.random.Generator) -> Texture:
    value, mask = courses(512, 8, 4, 3, rng)
    light = (0.95 + 0.05 * value + 0.05 * grain(512, rng) + 0.04 * fractal_noise(512, rng)) * (
        0.72 + 0.28 * mask
    )
    return Texture(coloured((240, 240, 240), light, tinted=1.0), (2.8, 2.8))


def _roof(rng: np.random.Generator) -> Texture:
    value, mask = courses(512, 16, 16, 3, rng)
    y = np.mgrid[:512, :512][0]
    lip = 0.8 + 0.3 * (y * 16 % 512) / 512
    light = (0.9 + 0.11 * value + 0.06 * grain(512, rng)) * (0.6 + 0.4 * mask) * lip
    return Texture(coloured((235, 235, 235), light, tinted=1.0), (4.0, 4.0))


def _foliage(rng: np.random.Generator) -> Texture:
    size = 512
    shade = fractal_noise(size, rng, 10, 0.8)
    rgba = coloured((84, 108, 50), np.clip(0.75 + 0.28 * shade, 0.25, 1.4), tinted=1.0)
    for _ in range(2600):
        x, y = rng.integers(6, size - 6, 2)
        bright = rng.uniform(0.55, 1.5)
        colour = (80 * bright + rng.uniform(0, 24), 116 * bright, 46 * bright, 255.0)
        axes = (int(rng.integers(4, 9)), int(rng.integers(2, 4)))
        cv2.ellipse(rgba, (int(x), int(y)), axes, rng.uniform(0, 180), 0, 360, colour, -1)
    return Texture(rgba, (1.6, 1.6))


def _wood(rng: np.random.Generator, boards: int, tile_m: tuple[float, float]) -> Texture:
    """Boards that run along the texture's x, with grain, joints and ends."""
    size = 1024
    y, x = np.mgrid[:size, :size]
    board = y * boards // size
    stretched = cv2.resize(
        rng.standard_normal((size, 24)).astype(np.float32),
        (size, size),
        interpolation=cv2.INTER_CUBIC,
    )
    fine = cv2.resize(
        rng.standard_normal((size, 96)).astype(np.float32),
        (size, size),
        interpolation=cv2.INTER_LINEAR,
    )
    rings = np.sin(y * boards / size * 30 + 2.2 * smooth_noise(size, 6, rng) + board * 2.1)
    light = 0.95 + 0.06 * stretched + 0.035 * fine + 0.05 * rings
    light += 0.09 * rng.standard_normal(boards)[board]
    ends = rng.integers(0, size, boards)[board]
    joint = ((y * boards) % size < 3 * boards) | (np.abs(x - ends) < 2)
    light[joint & (boards > 1)] *= 0.55
    for _ in range(boards):  # knots
        centre = (int(rng.integers(20, size - 20)), int(rng.integers(10, size - 10)))
        cv2.ellipse(light, centre, (11, 5), 0, 0, 360, 0.62, -1, cv2.LINE_AA)
        cv2.ellipse(light, centre, (16, 8), 0, 0, 360, 0.78, 2, cv2.LINE_AA)
    return Texture(coloured((238, 238, 238), light, tinted=1.0), tile_m)


def _cloth(rng: np.random.Generator) -> Texture:
    size = 256
    y, x = np.mgrid[:size, :size]
    weave = 0.05 * np.sin(x * np.pi / 2) * np.sin(y * np.pi / 2)
    light = 0.9 + weave + 0.06 * grain(size, rng) + 0.09 * fractal_noise(size, rng, 4)
    return Texture(coloured((245, 245, 245), light, tinted=1.0), (0.5, 0.5))


def _stripes(rng: np.random.Generator) -> Texture:
    cloth = _cloth(rng).rgba.copy()
    y = np.mgrid[:256, :256][0]
    pale = (y // 32) % 2 == 0
    cloth[pale] = coloured((226, 224, 216), 0.9 + 0.07 * grain(256, rng))[pale]
    return Texture(cloth, (0.4, 0.4))


def _plain(rng: np.random.Generator) -> Texture:
    light = 0.965 + 0.028 * grain(128, rng, 1.0) + 0.016 * fractal_noise(128, rng, 4)
    return Texture(coloured((245, 245, 245), light, tinted=1.0), (1.0, 1.0))


def _bark(rng: np.random.Generator) -> Texture:
    rough = cv2.resize(smooth_noise(256, 64, rng)[:64], (256, 256), interpolation=cv2.INTER_CUBIC)
    light = 0.9 + 0.2 * rough + 0.1 * grain(256, rng)
    return Texture(coloured((104, 84, 66), light), (0.7, 0.7))


def _paint(rng: np.random.Generator) -> Texture:
    worn = np.clip(1.15 - 0.6 * np.clip(fractal_noise(256, rng, 8, 0.9) - 0.9, 0, 1), 0.55, 1.02)
    return Texture(coloured((222, 221, 214), worn + 0.03 * grain(256, rng)), (2.0, 2.0))


def _concrete(rng: np.random.Generator) -> Texture:
    x = np.mgrid[:256, :256][1]
    light = 0.95 + 0.07 * grain(256, rng) + 0.06 * fractal_noise(256, rng)
    light[x < 4] *= 0.6
    return Texture(coloured((176, 172, 165), light), (1.0, 1.0))


def _grass(rng: np.random.Generator) -> Texture:
    light = 0.9 + 0.22 * grain(256, rng, 0.9) + 0.13 * fractal_noise(256, rng, 6)
    return Texture(coloured((88, 108, 58), light), (2.0, 2.0))


def _rug(rng: np.random.Generator) -> Texture:
    size = 512
    rgba = coloured((150, 46, 42), 0.93 + 0.09 * grain(size, rng))
    for inset, colour in ((14, (226, 204, 160)), (30, (44, 56, 92)), (60, (226, 204, 160))):
        cv2.rectangle(rgba, (inset, inset), (size - inset, size - inset), (*colour, 0), 6)
    for centre in np.stack(
        np.meshgrid(np.arange(104, 460, 76), np.arange(104, 460, 76)), -1
    ).reshape(-1, 2):
        diamond = (centre + np.array([(0, -30), (30, 0), (0, 30), (-30, 0)])).astype(np.int32)
        colour = ((226, 204, 160), (44, 56, 92), (196, 140, 60))[centre.sum() // 76 % 3]
        cv2.fillPoly(rgba, [diamond], (*colour, 0), cv2.LINE_AA)
        cv2.circle(rgba, tuple(int(c) for c in centre), 9, (120, 30, 34, 0), -1, cv2.LINE_AA)
    rgba = np.clip(rgba * (1 + 0.05 * grain(size, rng))[..., None], 0, 255).astype(np.uint8)
    rgba[..., 3] = 0
    return Texture(rgba, (2.4, 1.7))


def _wallpaper(rng: np.random.Generator) -> Texture:
    size = 512
    rgba = coloured((245, 245, 245), 0.95 + 0.03 * grain(size, rng, 1.0), tinted=1.0)
    for row in range(8):
        for column in range(4):
            x, y = column * 128 + (row % 2) * 64 + 32, row * 64 + 32
            for angle in range(0, 360, 72):
                cv2.ellipse(rgba, (x, y), (15, 5), angle, 0, 360, (214, 214, 214, 255), -1, 16)
            cv2.circle(rgba, (x, y), 4, (180, 180, 180, 255), -1, cv2.LINE_AA)
    cv2.GaussianBlur(rgba, (0, 0), 0.8, rgba)
    rgba = np.clip(rgba * (1 + 0.02 * grain(size, rng))[..., None], 0, 255).astype(np.uint8)
    rgba[..., 3] = 255
    return Texture(rgba, (1.0, 1.0))


def _sky(rng: np.random.Generator) -> Texture:
    """Blue above, pale at the horizon, with soft clouds; u runs once round, v down to it."""
    size = 512
    height = 1 - np.linspace(0, 1, size)[:, None]  # 1 in the zenith
    blend = np.clip(height * 1.6, 0, 1)[..., None] ** 0.8
    colour = np.array((212, 222, 230.0)) * (1 - blend) + np.array((104, 152, 208.0)) * blend
    colour = np.broadcast_to(colour, (size, 2048, 3))
    clouds = cv2.resize(
        fractal_noise(size, rng, 8, 0.62), (2048, size), interpolation=cv2.INTER_CUBIC
    )
    cover = np.clip((clouds - 0.2) / 1.3, 0, 1) * np.clip(height * 5, 0, 1)
    cloud = 246 - 26 * np.clip((clouds - 1.2) / 1.5, 0, 1)
    mixed = colour + cover[..., None] * (cloud[..., None] - colour)
    alpha = np.zeros((size, 2048, 1))
    return Texture(np.concatenate([mixed, alpha], -1).astype(np.uint8), (1.0, 1.0))


SURFACES: dict[str, Callable[[np.random.Generator], Texture]] = {
    "sky": _sky,
    "asphalt": _asphalt,
    "paving": _paving,
    "brick": _brick,
    "plaster": _plaster,
    "ashlar": _ashlar,
    "roof": _roof,
    "foliage": _foliage,
    "bark": _bark,
    "paint": _paint,
    "concrete": _concrete,
    "grass": _grass,
    "cloth": _cloth,
    "stripes": _stripes,
    "plain": _plain,
    "wood": lambda rng: _wood(rng, 1, (1.2, 0.5)),
    "floor_boards": lambda rng: _wood(rng, 8, (2.4, 1.2)),
    "rug": _rug,
    "wallpaper": _wallpaper,
}
