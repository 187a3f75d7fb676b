"""Houses, trees and the furniture of a street, each in its own upright frame.

Owns their shapes. A house's frame: x along its front, y down, z into it; ground at y = 0.
"""

from __future__ import annotations

import numpy as np

from pipelines.datasets.simulated.facades import BAY_M, GROUND_M, STOREY_M
from pipelines.datasets.simulated.meshes import (
    WHITE,
    Mesh,
    box,
    cylinder,
    ellipsoid,
    merge,
    pose,
    quad,
    quads,
    surface,
)
from pipelines.types import Array

# wall texture for the sides, texture of the storeys, tints that suit them
_STYLES = (
    ("brick", "storeys_brick", ((176, 92, 70), (150, 84, 66), (188, 122, 84))),
    ("plaster", "storeys_plaster", ((238, 220, 178), (226, 190, 164), (206, 216, 206))),
    ("ashlar", "storeys_ashlar", ((216, 206, 184), (200, 194, 182))),
    ("plaster", "storeys_modern", ((226, 222, 212), (190, 202, 212), (220, 186, 150))),
)
_GROUND = ("shops_a", "homes", "shops_b", "homes", "shops_c")
_ROOFS = ((150, 78, 60), (92, 92, 98), (122, 74, 58))


def house(width_m: float, depth_m: float, rng: np.random.Generator, plain: bool = False) -> Mesh:
    """A terraced house of two to four storeys over a ground floor; `plain` leaves out the shops."""
    wall, storeys, tints = _STYLES[rng.integers(0, len(_STYLES))]
    tint = tints[rng.integers(0, len(tints))]
    levels = int(rng.integers(2, 5))
    eaves = -(GROUND_M + levels * STOREY_M)
    w, d = width_m, depth_m
    ground = "homes" if plain else _GROUND[rng.integers(0, len(_GROUND))]
    bays = max(1, round(w / BAY_M)) * BAY_M
    start = int(rng.integers(0, 4)) * BAY_M if ground == "homes" else 0.0
    front = [(0, -GROUND_M, 0), (w, -GROUND_M, 0), (w, 0, 0), (0, 0, 0)]
    parts = [quad(front, ground, WHITE, _uv(start, 0, bays, GROUND_M))]
    upper = [(0, eaves, 0), (w, eaves, 0), (w, -GROUND_M, 0), (0, -GROUND_M, 0)]
    first = int(rng.integers(0, 4))
    uv = _uv(first * BAY_M, (4 - levels) * STOREY_M, bays, levels * STOREY_M)
    parts.append(quad(upper, storeys, tint, uv))
    for x, z0, z1 in ((0.0, d, 0.0), (w, 0.0, d)):
        parts += _side_wall(x, (z0, z1), levels, (wall, storeys, tint))
    parts.append(box((w, 0.35, 0.5), "plain", (206, 200, 188), (w / 2, eaves - 0.1, -0.12)))
    parts.append(box((w, 0.2, 0.24), "plain", (196, 190, 178), (w / 2, -GROUND_M + 0.02, -0.06)))
    parts += _roof(w, d, eaves, wall, tint, rng)
    if ground != "homes" and rng.random() < 0.75:
        parts.append(_awning(0.3, min(4.0, w - 0.5), rng))
    if wall == "plaster" and levels > 2:
        parts += _balconies(w, levels, rng)
    return merge(parts)


def _side_wall(
    x: float, z: tuple[float, float], levels: int, style: tuple[str, str, tuple[int, ...]]
) -> list[Mesh]:
    """Wall without a shop; two window bays in its middle are seen where a side street opens."""
    wall, storeys, tint = style
    eaves, (z0, z1) = -(GROUND_M + levels * STOREY_M), z
    edges = np.interp([0, 0.15, 0.85, 1], [0, 1], [z0, z1])
    parts = []
    for k in range(3):
        a, b = edges[k], edges[k + 1]
        top = eaves if k != 1 else -GROUND_M
        parts.append(quad([(x, top, a), (x, top, b), (x, 0, b), (x, 0, a)], wall, tint))
    a, b = edges[1], edges[2]
    upper = [(x, eaves, a), (x, eaves, b), (x, -GROUND_M, b), (x, -GROUND_M, a)]
    uv = _uv(BAY_M, (4 - levels) * STOREY_M, 2 * BAY_M, levels * STOREY_M)
    parts.append(quad(upper, storeys, tint, uv))
    return parts


def _uv(u: float, v: float, width: float, height: float) -> list[tuple[float, float]]:
    return [(u, v), (u + width, v), (u + width, v + height), (u, v + height)]


def _roof(
    w: float, d: float, eaves: float, wall: str, tint: tuple[int, ...], rng: np.random.Generator
) -> list[Mesh]:
    colour = _ROOFS[rng.integers(0, len(_ROOFS))]
    ridge = eaves - rng.uniform(2.0, 3.2)
    out = 0.35
    slopes = [
        [(0, ridge, d / 2), (w, ridge, d / 2), (w, eaves, -out), (0, eaves, -out)],
        [(w, ridge, d / 2), (0, ridge, d / 2), (0, eaves, d + out), (w, eaves, d + out)],
    ]
    parts = [quad(slope, "roof", colour) for slope in slopes]
    for x in (0.0, w):
        gable = [(x, eaves, 0), (x, ridge, d / 2), (x, ridge, d / 2), (x, eaves, d)]
        parts.append(quad(gable, wall, tint))
    height = 1.5
    at = (rng.uniform(0.15, 0.85) * w, ridge - 0.2, d / 2 - 0.8)
    parts.append(box((1.1, height, 0.6), "brick", (150, 84, 66), at))
    for k in (-0.3, 0.3):
        pot = (at[0] + k, at[1] - height / 2, at[2])
        parts.append(
            cylinder(pot, (pot[0], pot[1] - 0.35, pot[2]), (0.13, 0.1), "plain", (176, 104, 76), 8)
        )
    return parts


def _awning(x: float, width: float, rng: np.random.Generator) -> Mesh:
    colours = ((186, 54, 48), (58, 96, 72), (54, 78, 132), (206, 150, 60))
    colour = colours[rng.integers(0, 4)]
    y0, y1, out = -2.9, -2.45, -1.25
    cloth = [(x, y0, 0), (x + width, y0, 0), (x + width, y1, out), (x, y1, out)]
    hem = [(x, y1, out), (x + width, y1, out), (x + width, y1 + 0.22, out), (x, y1 + 0.22, out)]
    return merge([quad(cloth, "awning", colour), quad(hem, "awning", colour)])


def _balconies(w: float, levels: int, rng: np.random.Generator) -> list[Mesh]:
    parts = []
    for level in range(1, levels):
        y = -(GROUND_M + level * STOREY_M) + 0.25
        for bay in range(int(w // BAY_M)):
            if rng.random() < 0.45:
                x = (bay + 0.5) * w / max(1, round(w / BAY_M))
                parts.append(box((2.2, 0.14, 0.9), "concrete", WHITE, (x, y, -0.45)))
                parts.append(box((2.2, 0.06, 0.05), "plain", (58, 62, 66), (x, y - 0.95, -0.87)))
                for k in np.linspace(-1.05, 1.05, 13):
                    bar = (x + k, y - 0.5, -0.87)
                    parts.append(box((0.035, 0.9, 0.035), "plain", (58, 62, 66), bar))
    return parts


def tree(rng: np.random.Generator, height_m: float = 6.5) -> Mesh:
    """A street tree: trunk, a few branches, a dark core of leaves and many loose sprays."""
    top = -height_m
    parts = [cylinder((0, 0, 0), (0, top * 0.55, 0), (0.16, 0.1), "bark", sides=9, caps=False)]
    centres = [np.array([0, top * 0.74, 0])]
    for k in range(5):
        angle = k * 2 * np.pi / 5 + rng.uniform(-0.3, 0.3)
        reach = rng.uniform(0.7, 1.15)
        tip = np.array([reach * np.cos(angle), top * rng.uniform(0.6, 0.84), reach * np.sin(angle)])
        parts.append(cylinder((0, top * 0.42, 0), tip, (0.07, 0.03), "bark", sides=6, caps=False))
        centres.append(tip)
    green = np.array((255, 255, 255)) * rng.uniform(0.82, 1.0) * (1.0, rng.uniform(0.92, 1), 0.95)
    for centre in centres:
        radius = rng.uniform(0.85, 1.15)
        core = (radius * 0.85, radius * 0.72, radius * 0.85)
        parts.append(ellipsoid(core, "foliage", green * 0.72, centre, 5, 8))
        parts.append(_sprays(centre, radius, green, rng))
    return merge(parts)


def _sprays(centre: Array, radius: float, tint: Array, rng: np.random.Generator) -> Mesh:
    """Small leafy patches scattered on a ball, lit as if they were the ball."""
    n = 46
    out = rng.standard_normal((n, 3))
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    out[:, 1] *= 0.85
    middle = centre + out * radius * rng.uniform(0.8, 1.12, (n, 1))
    a = rng.standard_normal((n, 3))
    b = np.cross(out, a)
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    b /= np.linalg.norm(b, axis=1, keepdims=True)
    half = rng.uniform(0.14, 0.3, (n, 1))
    p, q = a * half, b * half
    corners = np.stack([middle - p, middle - q, middle + p, middle + q], 1)
    around = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    uv = rng.uniform(0, 1.6, (n, 1, 2)) + half[:, None] * around
    return quads(corners, "foliage", tint, uv, normals=out)


def lamp_post() -> Mesh:
    """Street lamp, 6 m, arm towards -z."""
    steel = (84, 92, 92)
    return merge([
        cylinder((0, 0, 0), (0, -6, 0), (0.09, 0.06), "plain", steel, 8, False),
        cylinder((0, 0, 0), (0, -0.9, 0), (0.14, 0.12), "plain", steel, 8, False),
        cylinder((0, -5.9, 0), (0, -6.2, -1.3), (0.05, 0.04), "plain", steel, 6, False),
        box((0.26, 0.12, 0.6), "plain", (206, 206, 198), (0, -6.2, -1.45)),
    ])  # fmt: skip


def road_sign(kind: str) -> Mesh:
    """Sign on a post, 2.4 m, its face towards -z: `limit`, `parking` or `crossing`."""
    post = cylinder(
        (0, 0, 0.03), (0, -2.6, 0.03), (0.035, 0.035), "plain", (150, 152, 154), 8, False
    )
    if kind == "limit":
        angle = np.linspace(0, 2 * np.pi, 25)
        rim = np.stack([0.34 * np.cos(angle), -2.4 + 0.34 * np.sin(angle), 0 * angle], 1)
        points = np.stack([np.broadcast_to((0, -2.4, 0), rim.shape), rim])
        uv = points[..., :2] - (0, -2.4) + 0.35
        back = surface(points + np.array([0, 0, 0.012]), "plain", (150, 152, 154))
        return merge([post, surface(points, "sign_limit", uv=uv), back])
    face = [(-0.33, -2.73, 0), (0.33, -2.73, 0), (0.33, -2.07, 0), (-0.33, -2.07, 0)]
    corners = [(0.01, 0.01), (0.69, 0.01), (0.69, 0.69), (0.01, 0.69)]
    back = quad(np.array(face) + np.array([0, 0, 0.012]), "plain", (150, 152, 154))
    return merge([post, quad(face, f"sign_{kind}", WHITE, corners), back])


def traffic_light() -> Mesh:
    """Signal on a post, its face towards -z."""
    post = cylinder((0, 0, 0.12), (0, -3.3, 0.12), (0.06, 0.05), "plain", (70, 76, 76), 8, False)
    case = box((0.38, 1.0, 0.2), "plain", (34, 36, 36), (0, -2.9, 0))
    face = [(-0.2, -3.4, -0.102), (0.2, -3.4, -0.102), (0.2, -2.4, -0.102), (-0.2, -2.4, -0.102)]
    uv = [(0, 0.004), (0.4, 0.004), (0.4, 0.99), (0, 0.99)]
    return merge([post, case, quad(face, "signal", WHITE, uv)])


def bench() -> Mesh:
    """Wooden bench along x, 1.7 m, its back towards +z."""
    slats = [
        box((1.7, 0.04, 0.1), "wood", (172, 116, 72), (0, -0.45, z)) for z in (-0.2, -0.06, 0.08)
    ]
    slats += [box((1.7, 0.1, 0.04), "wood", (172, 116, 72), (0, y, 0.2)) for y in (-0.62, -0.8)]
    legs = [box((0.07, 0.85, 0.45), "plain", (52, 54, 56), (x, -0.42, 0.02)) for x in (-0.7, 0.7)]
    return merge([*slats, *legs])


def litter_bin() -> Mesh:
    body = cylinder((0, 0, 0), (0, -0.85, 0), (0.22, 0.25), "plain", (58, 88, 66), 12)
    return merge(
        [body, cylinder((0, -0.85, 0), (0, -0.9, 0), (0.27, 0.27), "plain", (44, 52, 48), 12)]
    )


def planter(rng: np.random.Generator) -> Mesh:
    """Concrete box with a bush in it."""
    parts = [box((1.2, 0.55, 0.6), "concrete", WHITE, (0, -0.275, 0))]
    for x in (-0.35, 0.0, 0.35):
        centre = np.array([x, -0.75, 0])
        parts.append(ellipsoid((0.3, 0.26, 0.28), "foliage", (200, 200, 190), centre, 5, 8))
        parts.append(_sprays(centre, 0.32, np.array((255, 255, 235)), rng))
    return merge(parts).placed(pose(0, 0, 0))
