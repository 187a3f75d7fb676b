"""Lorries, trams and cyclists, and any vehicle made as wide, high and long as a label says.

Owns their shapes and artwork. Origin at the centre of the box, x right, y down, z forward; cars
are in `vehicles.py`, walkers in `people.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from pipelines.datasets.simulated.canvas import PAINT, Canvas
from pipelines.datasets.simulated.meshes import (
    WHITE,
    Mesh,
    box,
    cylinder,
    ellipsoid,
    limb,
    merge,
    quad,
    surface,
)
from pipelines.datasets.simulated.people import Clothes
from pipelines.datasets.simulated.textures import Texture
from pipelines.types import Array

_DARK, _STEEL = (38, 38, 40), (120, 122, 126)
_PANEL_M = (8.0, 3.0)  # what one drawing of a side covers


def fitted(mesh: Mesh, size_m: Array) -> Mesh:
    """The mesh stretched so that its box is `size_m` (width, height, length), around the origin."""
    low, high = mesh.bounds()
    scale = np.asarray(size_m, float) / (high - low)
    normals = mesh.normals / scale
    return replace(
        mesh,
        vertices=(mesh.vertices - (low + high) / 2) * scale,
        normals=normals / np.linalg.norm(normals, axis=-1, keepdims=True),
    )


def lorry_mesh() -> Mesh:
    """A lorry of 2.4 x 3.3 x 8 m with a lettered box behind its cab."""
    cargo = _shell((2.4, 2.45, 5.7), (0, -2.075, -1.15), ("lorry_side", "lorry_doors", "lorry_top"))
    cab = _shell((2.3, 2.2, 2.0), (0, -1.65, 3.0), ("cab_side", "cab_front", "lorry_top"))
    frame = box((1.6, 0.35, 7.6), "plain", _DARK, (0, -0.75, -0.1))
    guard = box((2.3, 0.3, 2.6), "plain", _STEEL, (0, -0.65, 0.2))
    wheels = [_wheel(side * 1.2, z, 0.48) for z in (-3.0, -1.9, 2.9) for side in (-1, 1)]
    return _centred(merge([cargo, cab, frame, guard, *wheels]))


def tram_mesh() -> Mesh:
    """A tram of 2.4 x 3.4 x 16 m: windows and doors along both sides."""
    body = _shell((2.4, 3.0, 16.0), (0, -1.75, 0), ("tram_side", "tram_front", "lorry_top"))
    skirt = box((2.2, 0.3, 14.5), "plain", _DARK, (0, -0.15, 0))
    roof = [box((1.7, 0.25, 3.0), "plain", _STEEL, (0, -3.3, z)) for z in (-4.5, 4.0)]
    return _centred(merge([body, skirt, *roof]))


def cyclist_mesh(clothes: Clothes) -> Mesh:
    """A bicycle and its rider, 0.6 x 1.75 x 1.75 m."""
    top, skin, frame = clothes.top_texture, clothes.skin, clothes.top
    parts = [ring for z in (-0.53, 0.53) for ring in _spoked_wheel(z, 0.335)]
    rear, front = (0, -0.335, -0.53), (0, -0.335, 0.53)
    crank, seat, head = (0, -0.3, -0.06), (0, -0.88, -0.22), (0, -0.86, 0.4)
    for a, b in ((rear, crank), (rear, seat), (crank, seat), (crank, head), (seat, head),
                 (front, head), (head, (0, -1.0, 0.38))):  # fmt: skip
        parts.append(cylinder(a, b, (0.02, 0.02), "plain", frame, 8, False))
    parts.append(cylinder((-0.28, -1.0, 0.38), (0.28, -1.0, 0.38), (0.015,) * 2, "plain", _DARK, 8))
    parts.append(box((0.13, 0.05, 0.25), "plain", _DARK, (0, -0.92, -0.22)))
    hips, chest = (0, -1.0, -0.2), (0, -1.4, 0.06)
    parts.append(limb([hips, chest], (0.15, 0.17), top, clothes.top, 12))
    parts.append(limb([chest, (0, -1.5, 0.1)], (0.08, 0.06), "plain", skin))
    parts.append(ellipsoid((0.082, 0.115, 0.1), "plain", skin, (0, -1.62, 0.13), 10, 14))
    parts.append(ellipsoid((0.09, 0.08, 0.105), "plain", clothes.hair, (0, -1.67, 0.1), 8, 14))
    for side, pedal in ((-1, (-0.12, -0.17)), (1, (-0.1, 0.05))):
        x, y = side * 0.1, -0.3 + pedal[1]
        knee, ankle = (x, -0.72 + pedal[1] / 2, 0.2 + pedal[1] / 3), (x, y, pedal[0])
        joints = [(x, -0.97, -0.18), knee, ankle]
        parts.append(limb(joints, (0.095, 0.07, 0.05), "cloth", clothes.legs, 10))
        shoe = (x, y + 0.03, pedal[0] + 0.06)
        parts.append(ellipsoid((0.05, 0.045, 0.13), "plain", clothes.shoes, shoe, 6, 10))
        arm = [(side * 0.2, -1.38, 0.05), (side * 0.27, -1.15, 0.2), (side * 0.25, -1.02, 0.38)]
        parts.append(limb(arm, (0.06, 0.048, 0.036), top, clothes.top, 8))
    if clothes.bag:
        parts.append(ellipsoid((0.14, 0.2, 0.1), "cloth", clothes.bag, (0, -1.3, -0.17), 8, 12))
    return _centred(merge(parts))


def _centred(mesh: Mesh) -> Mesh:
    low, high = mesh.bounds()
    return replace(mesh, vertices=mesh.vertices - (low + high) / 2)


def _shell(size: tuple[float, float, float], centre: tuple[float, float, float],
           art: tuple[str, str, str]) -> Mesh:  # fmt: skip
    """Box whose painted sides, ends and top show drawings; ends and sides are fitted to theirs."""
    side, end, top = art
    (w, h, d), (W, H) = size, _PANEL_M
    x, y, z = w / 2, h / 2, d / 2
    whole_side, whole_end = [(0, 0), (W, 0), (W, H), (0, H)], [(0, 0), (3, 0), (3, 3), (0, 3)]
    back = [whole_end[i] for i in (1, 0, 3, 2)]
    parts = [
        quad([(x, -y, -z), (x, -y, z), (x, y, z), (x, y, -z)], side, WHITE, whole_side),
        # The other side shows it in a mirror, so that its front is in front there too.
        quad([(-x, -y, z), (-x, -y, -z), (-x, y, -z), (-x, y, z)], side, WHITE,
             [whole_side[i] for i in (1, 0, 3, 2)]),
        quad([(x, -y, z), (-x, -y, z), (-x, y, z), (x, y, z)], end, WHITE, whole_end),
        quad([(-x, -y, -z), (x, -y, -z), (x, y, -z), (-x, y, -z)], end, WHITE, back),
        quad([(-x, -y, z), (x, -y, z), (x, -y, -z), (-x, -y, -z)], top, WHITE),
        quad([(-x, y, z), (x, y, z), (x, y, -z), (-x, y, -z)], "plain", _DARK),
    ]  # fmt: skip
    mesh = merge(parts)
    painted = mesh.texture != "plain"
    return replace(mesh, vertices=mesh.vertices + np.array(centre), painted=painted)


def _wheel(x: float, z: float, r: float) -> Mesh:
    inner = x - np.sign(x) * 0.3
    tyre = cylinder((inner, -r, z), (x, -r, z), (r, r), "plain", (44, 44, 46), 18)
    angle = np.linspace(0, 2 * np.pi, 19)
    rim = np.stack([0 * angle + x, -r + r * np.sin(angle), z + r * np.cos(angle)], 1)
    rim[:, 0] += np.sign(x) * 0.004
    points = np.stack([np.broadcast_to((rim[0, 0], -r, z), rim.shape), rim])
    uv = (points[..., [2, 1]] - (z, -r)) / (2 * r) + 0.5
    return merge([tyre, surface(points, "wheel", uv=uv)])


def _spoked_wheel(z: float, r: float) -> list[Mesh]:
    """Tyre and spokes, which one can see through."""
    angle, around = np.meshgrid(
        np.linspace(0, 2 * np.pi, 25), np.linspace(0, 2 * np.pi, 7), indexing="ij"
    )
    radius = r - 0.022 + 0.022 * np.cos(around)
    points = np.stack(
        [0.022 * np.sin(around), -r + radius * np.sin(angle), z + radius * np.cos(angle)], -1
    )
    parts = [surface(points, "plain", _DARK, smooth=True)]
    for a in np.arange(5) * np.pi / 5:
        tip = 0.95 * r * np.array([0, np.sin(a), np.cos(a)])
        hub = np.array([0, -r, z])
        parts.append(cylinder(hub - tip, hub + tip, (0.006,) * 2, "plain", _STEEL, 5, False))
    return parts


def _lorry_side(rng: np.random.Generator) -> Texture:
    canvas = Canvas((512, 256), _PANEL_M, PAINT)
    canvas.rect(0, 2.55, 8, 3, (70, 72, 76))
    canvas.rect(0, 0, 8, 0.15, (150, 152, 156))
    canvas.polygon([(0.6, 2.5), (2.2, 2.5), (4.4, 0.2), (2.8, 0.2)], (236, 234, 226))
    canvas.polygon([(2.5, 2.5), (2.9, 2.5), (5.1, 0.2), (4.7, 0.2)], (206, 160, 62))
    canvas.rect(3.0, 0.9, 7.4, 1.7, (236, 234, 226))
    canvas.text("NORDEXPRESS", (5.2, 1.3), 0.5, (30, 36, 52))
    canvas.text("0800 " + str(rng.integers(1000, 9999)), (6.3, 2.15), 0.25, (40, 42, 46))
    for x in np.arange(0.0, 8.01, 0.8):
        canvas.line([(x, 0.1), (x, 2.6)], (96, 98, 102, 90), 0.03)
    return canvas.texture(rng, 0.03)


def _lorry_doors(rng: np.random.Generator) -> Texture:
    canvas = Canvas((256, 256), (3.0, 3.0), PAINT)
    canvas.rect(1.48, 0, 1.52, 2.7, (40, 42, 46))
    for x in (0.4, 1.2, 1.8, 2.6):
        canvas.rect(x, 0.1, x + 0.05, 2.6, (160, 162, 166))
    canvas.rect(0, 2.66, 3, 3, (52, 54, 58))
    for x in (0.08, 2.42):
        canvas.rect(x, 2.7, x + 0.5, 2.92, (206, 34, 36))
    canvas.rect(1.0, 2.72, 2.0, 2.92, (238, 238, 234))
    canvas.text("LK " + str(rng.integers(100, 999)), (1.5, 2.82), 0.12, (20, 22, 30))
    return canvas.texture(rng, 0.03)


def _lorry_top(rng: np.random.Generator) -> Texture:
    canvas = Canvas((128, 128), (2.0, 2.0), PAINT)
    for x in np.arange(0.0, 2.0, 0.4):
        canvas.rect(x, 0, x + 0.05, 2, (150, 152, 156, 160))
    return canvas.texture(rng, 0.04)


def _cab_side(rng: np.random.Generator) -> Texture:
    canvas = Canvas((256, 128), _PANEL_M, PAINT)
    canvas.rect(3.2, 0.35, 7.2, 1.45, (58, 70, 82))
    canvas.polygon([(3.4, 1.4), (4.6, 0.4), (5.6, 0.4), (4.4, 1.4)], (138, 160, 178))
    canvas.line([(3.0, 0.2), (3.0, 2.7), (7.4, 2.7), (7.4, 0.2)], (70, 70, 74, 120), 0.06)
    canvas.rect(3.4, 1.6, 4.4, 1.72, _DARK)
    canvas.rect(0, 2.7, 8, 3, (60, 62, 66))
    return canvas.texture(rng, 0.03)


def _cab_front(rng: np.random.Generator) -> Texture:
    canvas = Canvas((256, 256), (3.0, 3.0), PAINT)
    canvas.rect(0.15, 0.4, 2.85, 1.45, _DARK)
    canvas.fade((0.22, 0.47, 2.78, 1.38), (138, 160, 178), (40, 50, 60))
    for y in (1.7, 1.85, 2.0, 2.15):
        canvas.rect(0.7, y, 2.3, y + 0.07, (52, 54, 58))
    canvas.rect(0, 2.4, 3, 3, (70, 72, 76))
    for x in (0.4, 2.6):
        canvas.ellipse((x, 2.62), (0.26, 0.15), (232, 238, 242))
    canvas.rect(1.1, 2.6, 1.9, 2.8, (238, 238, 234))
    return canvas.texture(rng, 0.02)


def _tram_side(rng: np.random.Generator) -> Texture:
    canvas = Canvas((512, 256), _PANEL_M, PAINT)
    canvas.rect(0, 0, 8, 0.35, (206, 208, 206))
    canvas.rect(0, 2.0, 8, 2.25, (238, 236, 228))
    for k, x in enumerate(np.arange(0.15, 7.6, 0.77)):
        door = k % 4 == 2
        low = 2.8 if door else 1.75
        canvas.rect(x, 0.5, x + 0.67, low, _DARK)
        canvas.fade((x + 0.04, 0.55, x + 0.62, low - 0.05), (150, 168, 182), (44, 54, 64))
        if door:
            canvas.rect(x + 0.32, 0.5, x + 0.35, low, _DARK)
        elif rng.random() < 0.6:
            canvas.ellipse((x + 0.33, 1.5), (0.12, 0.2), (92, 76, 66))
    canvas.rect(0, 2.9, 8, 3, (60, 62, 66))
    return canvas.texture(rng, 0.02)


def _tram_front(rng: np.random.Generator) -> Texture:
    canvas = Canvas((256, 256), (3.0, 3.0), PAINT)
    canvas.rect(0.3, 0.6, 2.7, 1.75, _DARK)
    canvas.fade((0.37, 0.67, 2.63, 1.68), (150, 168, 182), (44, 54, 64))
    canvas.rect(0.7, 0.12, 2.3, 0.48, (24, 24, 26))
    canvas.text("4  DEPOT", (1.5, 0.3), 0.2, (240, 190, 70))
    for x in (0.5, 2.5):
        canvas.ellipse((x, 2.3), (0.2, 0.2), (232, 238, 242))
    return canvas.texture(rng, 0.02)


ROAD_USER_ART: dict[str, Callable[[np.random.Generator], Texture]] = {
    "lorry_side": _lorry_side,
    "lorry_doors": _lorry_doors,
    "lorry_top": _lorry_top,
    "cab_side": _cab_side,
    "cab_front": _cab_front,
    "tram_side": _tram_side,
    "tram_front": _tram_front,
}
