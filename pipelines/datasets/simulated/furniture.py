"""Furniture and toys, each in its own frame: x right, y down, z towards the wall behind it.

Owns their shapes. Furniture stands on y = 0; toys have their origin in the middle.
"""

from __future__ import annotations

from collections.abc import Sequence as Rows

import numpy as np

from pipelines.datasets.simulated.interiors import BOOKS_M
from pipelines.datasets.simulated.meshes import (
    WHITE,
    Mesh,
    box,
    cylinder,
    ellipsoid,
    merge,
    quad,
    quads,
)

_OAK, _WALNUT, _PINE = (206, 156, 100), (134, 90, 60), (226, 186, 130)


def table() -> Mesh:
    """Dining table, 1.5 x 0.9 m, with a vase, plates and a book."""
    parts = [box((1.5, 0.05, 0.9), "wood", _OAK, (0, -0.74, 0))]
    parts.append(box((1.34, 0.09, 0.74), "wood", (186, 136, 86), (0, -0.67, 0)))
    for x in (-0.66, 0.66):
        for z in (-0.36, 0.36):
            parts.append(box((0.08, 0.72, 0.08), "wood", _OAK, (x, -0.36, z)))
    vase = cylinder(
        (0.1, -0.76, 0.05), (0.1, -1.0, 0.05), (0.08, 0.05), "plain", (70, 108, 150), 14
    )
    parts.append(vase)
    for k in range(9):
        angle = k * 2.4
        tip = (0.1 + 0.13 * np.cos(angle), -1.2 - 0.04 * (k % 3), 0.05 + 0.13 * np.sin(angle))
        parts.append(
            cylinder((0.1, -0.98, 0.05), tip, (0.008, 0.006), "plain", (70, 104, 60), 5, False)
        )
        colour = ((214, 70, 74), (238, 200, 80), (226, 130, 170))[k % 3]
        parts.append(ellipsoid((0.05, 0.035, 0.05), "cloth", colour, tip, 5, 8))
    for x, z in ((-0.45, -0.2), (0.5, 0.15)):
        rim = (x, -0.785, z)
        parts.append(cylinder((x, -0.766, z), rim, (0.09, 0.13), "plain", (232, 232, 226), 18))
        parts.append(ellipsoid((0.045, 0.042, 0.045), "plain", (186, 60, 46), (x, -0.82, z), 6, 10))
    parts.append(box((0.24, 0.04, 0.17), "cloth", (150, 50, 46), (-0.15, -0.785, -0.25)))
    return merge(parts)


def chair(seat: tuple[int, int, int] = (176, 62, 54)) -> Mesh:
    """Wooden chair with a cushion, its back towards +z."""
    parts = [box((0.44, 0.04, 0.44), "wood", _WALNUT, (0, -0.45, 0))]
    parts.append(box((0.4, 0.05, 0.4), "cloth", seat, (0, -0.495, 0)))
    for x in (-0.19, 0.19):
        parts.append(box((0.045, 0.45, 0.045), "wood", _WALNUT, (x, -0.225, -0.19)))
        parts.append(box((0.045, 0.95, 0.045), "wood", _WALNUT, (x, -0.475, 0.2)))
    for y in (-0.62, -0.76, -0.9):
        parts.append(box((0.38, 0.075, 0.03), "wood", _WALNUT, (0, y, 0.2)))
    return merge(parts)


def sofa() -> Mesh:
    """Sofa of 1.9 m with cushions, its back towards +z."""
    blue = (92, 122, 150)
    parts = [box((1.9, 0.3, 0.85), "cloth", (78, 106, 134), (0, -0.25, 0))]
    parts.append(box((1.9, 0.5, 0.2), "cloth", (78, 106, 134), (0, -0.62, 0.34)))
    for x in (-0.87, 0.87):
        parts.append(box((0.18, 0.52, 0.85), "cloth", (84, 112, 140), (x, -0.36, 0)))
    for x in (-0.39, 0.39):
        parts.append(ellipsoid((0.4, 0.1, 0.36), "cloth", blue, (x, -0.43, -0.06), 8, 14))
        parts.append(box((0.74, 0.12, 0.62), "cloth", blue, (x, -0.42, -0.06)))
        parts.append(ellipsoid((0.38, 0.24, 0.13), "cloth", blue, (x, -0.7, 0.22), 8, 14))
    for x, colour in ((-0.62, (220, 170, 70)), (0.56, (196, 84, 62))):
        parts.append(ellipsoid((0.2, 0.2, 0.09), "stripes", colour, (x, -0.66, 0.06), 8, 12))
    for x in (-0.8, 0.8):
        for z in (-0.34, 0.34):
            parts.append(cylinder((x, 0, z), (x, -0.11, z), (0.03, 0.04), "wood", _WALNUT, 8))
    return merge(parts)


def bookshelf(rng: np.random.Generator) -> Mesh:
    """Open shelf, 1.3 x 2 m, filled with books and a few ornaments; its back is at z = 0.3."""
    parts = [box((0.04, 2.0, 0.3), "wood", _PINE, (x, -1.0, 0.15)) for x in (-0.65, 0.0, 0.65)]
    parts.append(box((1.3, 2.0, 0.02), "wood", (190, 150, 104), (0, -1.0, 0.29)))
    levels = np.linspace(0.06, 1.98, 6)
    parts += [box((1.34, 0.035, 0.3), "wood", _PINE, (0, -h, 0.15)) for h in levels]
    for h in levels[:-1]:
        for x0 in (-0.63, 0.02):
            width = rng.uniform(0.34, 0.61)
            y0, y1 = -h - 0.0175 - BOOKS_M[1], -h - 0.0175
            u = rng.uniform(0, 1)
            front = [(x0, y0, 0.06), (x0 + width, y0, 0.06), (x0 + width, y1, 0.06), (x0, y1, 0.06)]
            uv = [(u, 0.005), (u + width, 0.005), (u + width, 0.295), (u, 0.295)]
            parts.append(quad(front, "books", WHITE, uv))
            if width < 0.48:
                x = x0 + width + 0.07
                colour = ((206, 90, 60), (72, 128, 120), (220, 190, 110))[rng.integers(0, 3)]
                parts.append(
                    ellipsoid((0.06, 0.09, 0.06), "plain", colour, (x, y1 - 0.09, 0.13), 8, 12)
                )
    return merge(parts)


def floor_lamp() -> Mesh:
    shade = cylinder((0, -1.35, 0), (0, -1.7, 0), (0.24, 0.15), "cloth", (255, 236, 190), 18, False)
    pole = cylinder((0, 0, 0), (0, -1.5, 0), (0.015, 0.015), "plain", (60, 58, 56), 8, False)
    foot = cylinder((0, 0, 0), (0, -0.03, 0), (0.16, 0.15), "plain", (60, 58, 56), 18)
    return merge([shade, pole, foot])


def plant(rng: np.random.Generator) -> Mesh:
    """Potted plant with arching leaves, about 1.2 m."""
    pot = cylinder((0, 0, 0), (0, -0.34, 0), (0.15, 0.2), "plain", (188, 104, 74), 16)
    corners = []
    for k in range(26):
        angle, reach = k * 2.4, rng.uniform(0.25, 0.5)
        out = np.array([np.cos(angle), 0, np.sin(angle)])
        side = np.array([-np.sin(angle), 0, np.cos(angle)]) * 0.045
        base = np.array([0, -0.33, 0])
        middle = base + out * reach * 0.5 + (0, -rng.uniform(0.5, 0.8), 0)
        tip = base + out * reach + (0, -rng.uniform(0.35, 0.75), 0)
        corners.append([base - side * 0.3, middle - side, middle + side, base + side * 0.3])
        corners.append([middle - side, tip, tip, middle + side])
    return merge([pot, quads(corners, "foliage", (240, 255, 230))])


def picture(name: str, width: float, height: float) -> Mesh:
    """Framed picture in the plane z = 0, facing -z; its texture fills it."""
    x, y = width / 2, height / 2
    uv = [(0.002, 0.002), (width - 0.002, 0.002), (width - 0.002, height - 0.002), (0.002, height)]
    face = [(-x, -y, -0.03), (x, -y, -0.03), (x, y, -0.03), (-x, y, -0.03)]
    rim = box((width + 0.03, height + 0.03, 0.026), "wood", _WALNUT, (0, 0, -0.013))
    return merge([rim, quad(face, name, WHITE, uv)])


def carton(size: Rows[float], texture: str = "cardboard", tile_m: float = 0.5) -> Mesh:
    """Box whose six faces each show one whole tile of `texture`; origin in the middle."""
    plain = box(size, texture)
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)]) * tile_m
    plain.uv_m[:] = corners[np.array([(0, 1, 2), (0, 2, 3)] * 6)]
    return plain


def toy_block(side: float = 0.36) -> Mesh:
    """Wooden letter cube, another letter on each face; origin in the middle."""
    cube = carton((side,) * 3, "toy_block", 0.36)
    for face in range(6):
        cube.uv_m[2 * face : 2 * face + 2] += (0.36 * (face % 4), 0.36 * (face // 4))
    return cube


def ball(radius: float = 0.22) -> Mesh:
    """Beach ball; origin in the middle."""
    mesh = ellipsoid((radius,) * 3, "ball", WHITE, (0, 0, 0), 14, 24)
    mesh.uv_m[:] *= (1 / (2 * np.pi * radius), 0.5 / (np.pi * radius))
    return mesh
