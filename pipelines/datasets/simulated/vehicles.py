"""Cars: four lofted bodies, each painted from the side, above, front and rear, with four wheels.

Owns the shapes and their artwork. A car's origin is the centre of its box, x right, y down,
z forward; heights `h` in this file are above the road, lengths `z` from the middle, forward.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np

from pipelines.datasets.simulated.canvas import PAINT, Canvas
from pipelines.datasets.simulated.meshes import Mesh, box, cylinder, merge, surface
from pipelines.datasets.simulated.textures import Texture
from pipelines.types import Array

_LONG, _TALL = 5.12, 2.56  # metres that one drawing covers
_GLASS_TOP, _GLASS_LOW = (138, 160, 178), (40, 50, 60)
_BLACK = (30, 30, 32)
_CLEARANCE_M = 0.2


@dataclass(frozen=True, slots=True)
class CarShape:
    """Outline of a car. size_m: (width, height, length). top: (S, 2) rows of z and height.

    belt_m: height where the windows begin. glass_z: rear edge, pillars and front edge of the side
    windows, from rear to front. axles_z: rear and front. wheel_m: radius.
    """

    size_m: tuple[float, float, float]
    top: tuple[tuple[float, float], ...]
    belt_m: float
    glass_z: tuple[float, ...]
    axles_z: tuple[float, float]
    wheel_m: float = 0.32


SHAPES: dict[str, CarShape] = {
    "saloon": CarShape(
        (1.82, 1.46, 4.6),
        (
            (-2.3, 0.62), (-2.26, 0.86), (-2.1, 0.99), (-1.55, 1.04), (-0.95, 1.37), (-0.55, 1.45),
            (0.0, 1.46), (0.35, 1.42), (0.62, 1.3), (1.2, 1.0), (1.75, 0.9), (2.1, 0.79),
            (2.26, 0.66), (2.3, 0.52),
        ),
        0.94, (-1.35, -0.92, 0.02, 0.98), (-1.38, 1.4),
    ),
    "hatchback": CarShape(
        (1.74, 1.5, 3.95),
        (
            (-1.97, 0.62), (-1.94, 0.9), (-1.82, 1.1), (-1.58, 1.37), (-1.2, 1.47), (-0.4, 1.5),
            (0.12, 1.47), (0.45, 1.35), (1.08, 1.03), (1.5, 0.93), (1.8, 0.82), (1.93, 0.68),
            (1.975, 0.52),
        ),
        0.95, (-1.55, -0.95, -0.02, 0.9), (-1.22, 1.24), 0.31,
    ),
    "estate": CarShape(
        (1.9, 1.68, 4.65),
        (
            (-2.32, 0.66), (-2.29, 0.98), (-2.2, 1.2), (-1.98, 1.55), (-1.65, 1.65), (-0.6, 1.68),
            (0.1, 1.66), (0.5, 1.54), (1.12, 1.16), (1.7, 1.06), (2.08, 0.94), (2.27, 0.78),
            (2.325, 0.58),
        ),
        1.06, (-1.98, -1.2, -0.95, 0.0, 0.98), (-1.42, 1.42), 0.36,
    ),
    "van": CarShape(
        (1.92, 1.98, 4.8),
        (
            (-2.4, 0.7), (-2.39, 1.1), (-2.34, 1.7), (-2.2, 1.92), (-1.8, 1.97), (0.0, 1.98),
            (0.8, 1.95), (1.1, 1.83), (1.72, 1.24), (2.05, 1.12), (2.3, 0.95), (2.38, 0.76),
            (2.4, 0.55),
        ),
        1.12, (0.05, 0.12, 1.45), (-1.5, 1.52), 0.34,
    ),
}  # fmt: skip


def _top(shape: CarShape, z: Array) -> Array:
    outline = np.array(shape.top)
    return np.interp(z, outline[:, 0], outline[:, 1])


def _stations(shape: CarShape) -> Array:
    """Rings (S, R, 3) of the body as (x, height, z), from rear to front, closed around."""
    width, _, _ = shape.size_m
    outline = np.array(shape.top)
    z = np.unique(np.concatenate([outline[:, 0], np.linspace(outline[0, 0], outline[-1, 0], 15)]))
    z = z[np.append(True, np.diff(z) > 0.03)]
    z[-1] = outline[-1, 0]
    top = _top(shape, z)
    ends = np.abs(z) / outline[-1, 0]
    half = width / 2 * (1 - 0.16 * np.clip((ends - 0.72) / 0.28, 0, 1) ** 2)
    low = _CLEARANCE_M + 0.16 * np.clip((ends - 0.86) / 0.14, 0, 1)
    belt = np.minimum(shape.belt_m, top - 0.05)
    cabin = np.clip((top - shape.belt_m) / 0.42, 0, 1)  # 0 over bonnet and boot, 1 under the roof
    roof = half * (0.95 - 0.19 * cabin)
    middle = np.minimum(0.62, (low + belt) / 2 + 0.1)
    x = np.stack([0 * z, 0.86 * half, 0.97 * half, half, 0.985 * half, roof, roof - 0.1, 0 * z], 1)
    edge = top - 0.03 - 0.03 * cabin
    h = np.stack([low, low, low + 0.12, middle, belt, edge, top, top + 0.015], 1)
    right = np.stack([x, h, np.repeat(z[:, None], x.shape[1], 1)], -1)
    left = right[:, -2::-1] * (-1, 1, 1)
    return np.concatenate([right, left], 1)


def _view(points: Array, view: str) -> Array:
    """Texture coordinates (..., 2) of body points (x, height, z) in one of the four drawings."""
    x, h, z = np.moveaxis(points, -1, 0)
    if view == "side":
        return np.stack([z + _LONG / 2, _TALL - h], -1)
    if view == "above":
        return np.stack([z + _LONG / 2, x + _TALL / 2], -1)
    return np.stack([x + _TALL / 2, _TALL - h], -1)


def car_mesh(kind: str) -> Mesh:
    """Car of a kind in `SHAPES`, white until `painted_as`; origin at the centre of its box."""
    shape = SHAPES[kind]
    rings = _stations(shape)
    S = len(rings)
    parts = []

    def piece(rows: slice, columns: slice, view: str) -> None:
        points = rings[rows, columns]
        parts.append(
            surface(points, f"{kind}_{view}", uv=_view(points, view), smooth=True, painted=True)
        )

    steep = np.abs(np.diff(_top(shape, rings[:, 0, 2])) / np.diff(rings[:, 0, 2])) > 1.7
    first = int(np.argmin(steep))  # stations before this belong to the rear face
    last = S - 1 - int(np.argmin(steep[::-1]))
    whole = slice(0, S)
    for columns in (slice(1, 6), slice(9, 14)):
        piece(whole, columns, "side")
    for rows, view in (
        (slice(0, first + 1), "rear"),
        (slice(first, last + 1), "above"),
        (slice(last, S), "front"),
    ):
        if rows.stop - rows.start > 1:
            piece(rows, slice(5, 10), view)
    for index, view in ((0, "rear"), (S - 1, "front")):  # bumpers close the ends
        ring = rings[index]
        centre = ring.mean(0) * (0, 1, 1)
        points = np.stack([ring, centre + (ring - centre) * 0.02])
        uv = _view(points, view)
        parts.append(surface(points, f"{kind}_{view}", uv=uv, smooth=True, painted=True))
    bottom = rings[:, [13, 14, 1]]
    parts.append(surface(bottom, "plain", _BLACK))
    body = merge(parts)
    height = shape.size_m[1]
    body.vertices[:, 1] = height / 2 - body.vertices[:, 1]
    body.normals[..., 1] *= -1
    return merge([body, *_wheels(shape), *_mirrors(shape)])


def _wheels(shape: CarShape) -> list[Mesh]:
    width, height, _ = shape.size_m
    r, y = shape.wheel_m, height / 2 - shape.wheel_m
    parts = []
    for z in shape.axles_z:
        for side in (-1, 1):
            inner, outer = side * (width / 2 - 0.22), side * (width / 2 - 0.005)
            parts.append(
                cylinder((inner, y, z), (outer, y, z), (r, r), "plain", (44, 44, 46), 18, False)
            )
            angle = np.linspace(0, 2 * np.pi, 19)
            rim = np.stack([0 * angle + outer, y + r * np.sin(angle), z + r * np.cos(angle)], 1)
            points = np.stack([np.broadcast_to((outer, y, z), rim.shape), rim])
            uv = (points[..., [2, 1]] - (z, y)) / (2 * r) + 0.5
            parts.append(surface(points, "wheel", uv=uv))
    return parts


def _mirrors(shape: CarShape) -> list[Mesh]:
    width, height, _ = shape.size_m
    z, y = shape.glass_z[-1] - 0.22, height / 2 - shape.belt_m - 0.06
    centres = [(side * (width / 2 - 0.02), y, z) for side in (-1, 1)]
    return [box((0.16, 0.13, 0.1), "plain", (46, 46, 50), centre) for centre in centres]


def _side_art(rng: np.random.Generator, shape: CarShape) -> Texture:
    canvas = Canvas((512, 256), (_LONG, _TALL), PAINT)

    def at(z: float, h: float) -> tuple[float, float]:
        return z + _LONG / 2, _TALL - h

    length = shape.size_m[2]
    canvas.rect(0, _TALL - 0.34, _LONG, _TALL, _BLACK)
    canvas.rect(0, _TALL - 0.37, _LONG, _TALL - 0.34, (120, 120, 124))
    canvas.line([at(-length / 2, 0.72), at(length / 2, 0.66)], (190, 190, 190, 255), 0.025)
    edges = shape.glass_z
    low = shape.belt_m + 0.03
    canvas.polygon(_pane(shape, edges[0] - 0.04, edges[-1] + 0.05, low - 0.03, 0.05), _BLACK)
    for rear, front in pairwise(edges):
        if front - rear < 0.2:
            continue
        pane = np.array(_pane(shape, rear + 0.04, front - 0.04, low, 0.1))
        canvas.polygon(pane, _GLASS_LOW)
        upper = pane.copy()
        upper[:, 1] = np.minimum(upper[:, 1], _TALL - low - 0.17)
        canvas.polygon(upper, _GLASS_TOP)
        canvas.line(
            [at(rear + 0.2, low + 0.05), at(rear + 0.42, low + 0.4)], (150, 168, 182), 0.012
        )
    for z in edges[1:]:  # doors
        if z < edges[-1] - 0.01 and z - edges[0] > 0.05:
            canvas.line([at(z, low), at(z, 0.36)], (70, 70, 74, 120), 0.018)
            canvas.rect(
                z + _LONG / 2 + 0.07, _TALL - 0.86, z + _LONG / 2 + 0.25, _TALL - 0.82, _BLACK
            )
    front_door = edges[-1] - 0.02
    canvas.line([at(front_door, low), at(front_door + 0.06, 0.36)], (70, 70, 74, 120), 0.018)
    for z in shape.axles_z:
        canvas.ellipse(at(z, shape.wheel_m), (shape.wheel_m + 0.09,) * 2, (200, 200, 200, 255))
        canvas.ellipse(at(z, shape.wheel_m), (shape.wheel_m + 0.06,) * 2, (16, 16, 18))
    canvas.polygon(
        [at(length / 2, 0.62), at(length / 2, 0.78), at(length / 2 - 0.42, 0.79),
         at(length / 2 - 0.3, 0.66)], (224, 230, 234),
    )  # fmt: skip
    canvas.polygon(
        [at(-length / 2, 0.68), at(-length / 2, 0.96), at(-length / 2 + 0.24, 0.93),
         at(-length / 2 + 0.2, 0.7)], (168, 22, 26),
    )  # fmt: skip
    return canvas.texture(rng, 0.015)


def _pane(
    shape: CarShape, rear: float, front: float, low: float, below_roof: float
) -> list[tuple[float, float]]:
    """Side window between two lengths, its upper edge following the roof."""
    z = np.linspace(rear, front, 14)
    top = np.maximum(_top(shape, z) - below_roof, low)
    upper = [(a + _LONG / 2, _TALL - b) for a, b in zip(z, top, strict=True)]
    return [*upper, (front + _LONG / 2, _TALL - low), (rear + _LONG / 2, _TALL - low)]


def _above_art(rng: np.random.Generator, shape: CarShape) -> Texture:
    canvas = Canvas((512, 256), (_LONG, _TALL), PAINT)
    half = shape.size_m[0] / 2
    middle = _TALL / 2
    outline = np.array(shape.top)
    roof = outline[outline[:, 1] > shape.size_m[1] - 0.13, 0]
    hood = outline[(outline[:, 1] < shape.belt_m + 0.13) & (outline[:, 0] > 0), 0].min()
    boot = outline[(outline[:, 1] < shape.belt_m + 0.2) & (outline[:, 0] < 0), 0].max()
    for near, far in ((hood - 0.04, roof.max() + 0.03), (boot + 0.05, roof.min() - 0.03)):
        if abs(near - far) < 0.1:
            continue
        x0, x1 = near + _LONG / 2, far + _LONG / 2
        a, b = half * 0.84, half * 0.68
        frame = [(x0, middle - a), (x0, middle + a), (x1, middle + b), (x1, middle - b)]
        canvas.polygon(frame, _BLACK)
        k = 0.06 * np.sign(x1 - x0)
        inner = [(x0 + k, middle - a + 0.06), (x0 + k, middle + a - 0.06),
                 (x1 - k, middle + b - 0.05), (x1 - k, middle - b + 0.05)]  # fmt: skip
        canvas.polygon(inner, (92, 110, 126))
        m = (x0 + x1) / 2
        canvas.polygon([inner[2], inner[3], (m, middle - 0.5), (m, middle + 0.5)], (122, 142, 158))
    for side in (-1, 1):  # folds of the bonnet, roof rails
        y = middle + side * half * 0.62
        canvas.line(
            [(hood + _LONG / 2, y), (shape.size_m[2] / 2 + _LONG / 2, y * 0.98)],
            (205, 205, 205, 255),
            0.02,
        )
        y = middle + side * half * 0.68
        canvas.line(
            [(roof.min() + _LONG / 2, y), (roof.max() + _LONG / 2, y)], (150, 150, 150, 255), 0.03
        )
    return canvas.texture(rng, 0.015)


def _end_art(rng: np.random.Generator, shape: CarShape, front: bool) -> Texture:
    canvas = Canvas((256, 256), (_TALL, _TALL), PAINT)
    half, middle = shape.size_m[0] / 2, _TALL / 2

    def rect(x0: float, h0: float, x1: float, h1: float, colour: tuple[int, ...]) -> None:
        canvas.rect(middle + x0, _TALL - h1, middle + x1, _TALL - h0, colour)

    rect(-1.2, 0, 1.2, 0.42, _BLACK)
    plate = (238, 238, 232) if front else (240, 214, 90)
    if front:
        rect(-0.5 * half, 0.5, 0.5 * half, 0.68, (20, 20, 22))
        for h in (0.54, 0.6, 0.66):
            rect(-0.48 * half, h - 0.012, 0.48 * half, h, (150, 152, 156))
        for side in (-1, 1):
            x = side * half * 0.68
            canvas.ellipse((middle + x, _TALL - 0.68), (0.2, 0.09), (40, 42, 46))
            canvas.ellipse((middle + x, _TALL - 0.68), (0.17, 0.07), (232, 238, 242))
            canvas.ellipse((middle + x, _TALL - 0.44), (0.08, 0.05), (200, 206, 210))
        rect(-0.26, 0.44, 0.26, 0.55, plate)
    else:
        for side in (-1, 1):
            x0, x1 = sorted((side * half * 0.58, side * half * 0.98))
            rect(x0, 0.72, x1, 0.93, (96, 12, 16))
            rect(x0 + 0.03, 0.75, x1 - 0.03, 0.85, (206, 34, 36))
            rect(x0 + 0.03, 0.87, x1 - 0.03, 0.91, (236, 168, 90))
        rect(-0.27, 0.6, 0.27, 0.72, plate)
        rect(-0.8 * half, 0.985, 0.8 * half, 1.0, (60, 60, 64))
        if shape.size_m[1] > 1.9:  # rear doors of a van
            rect(-0.82 * half, 1.24, -0.05, 1.78, _GLASS_LOW)
            rect(0.05, 1.24, 0.82 * half, 1.78, _GLASS_LOW)
            rect(-0.01, 0.45, 0.01, 1.9, (60, 60, 64))
    letters = "".join(rng.choice(list("ABDEFHKLMNPRSTXZ"), 3)) + str(rng.integers(100, 999))
    canvas.text(letters, (middle, _TALL - (0.495 if front else 0.66)), 0.075, (20, 22, 30))
    return canvas.texture(rng, 0.015)


def _wheel_art(rng: np.random.Generator) -> Texture:
    canvas = Canvas((128, 128), (1.0, 1.0), (38, 38, 40))
    centre = (0.5, 0.5)
    canvas.ellipse(centre, (0.36, 0.36), (178, 180, 184))
    canvas.ellipse(centre, (0.32, 0.32), (52, 54, 58))
    for angle in np.arange(5) * 2 * np.pi / 5:
        tip = (0.5 + 0.33 * np.sin(angle), 0.5 - 0.33 * np.cos(angle))
        canvas.line([centre, tip], (186, 188, 192), 0.075)
    canvas.ellipse(centre, (0.09, 0.09), (150, 152, 156))
    return canvas.texture(rng, 0.03)


VEHICLE_ART: dict[str, Callable[[np.random.Generator], Texture]] = {"wheel": _wheel_art}
for _kind, _shape in SHAPES.items():
    VEHICLE_ART[f"{_kind}_side"] = partial(_side_art, shape=_shape)
    VEHICLE_ART[f"{_kind}_above"] = partial(_above_art, shape=_shape)
    VEHICLE_ART[f"{_kind}_rear"] = partial(_end_art, shape=_shape, front=False)
    VEHICLE_ART[f"{_kind}_front"] = partial(_end_art, shape=_shape, front=True)
