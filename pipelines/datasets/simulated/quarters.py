"""Quarters of a town: fronts drawn anew for each, and pillars with posters that no other has.

Owns what tells one place from another. Shapes of houses are in `buildings.py`, the drawings that
are varied here in `facades.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np

from pipelines.datasets.simulated.canvas import Canvas
from pipelines.datasets.simulated.facades import FACADES
from pipelines.datasets.simulated.meshes import Mesh, cylinder, merge, surface
from pipelines.datasets.simulated.textures import SURFACES, Texture

Drawing = Callable[[np.random.Generator], Texture]
_STYLES = 3  # of windows
_VARIED = {
    name: drawing
    for name, drawing in FACADES.items()
    if name.startswith(("storeys_", "shops_")) or name == "homes"
}
_PILLAR_M, _POSTERS_M = (0.55, 3.1), (3.6, 2.4)  # radius and height; what one drawing covers
_WORDS = (
    "OPERA", "CIRCUS", "MARKET", "JAZZ", "EXPO", "CINEMA", "RALLY", "BALLET", "REGATTA", "CHESS",
    "MUSEUM", "SUMMER", "DERBY", "GALA", "FLEA FAIR", "CONCERT", "MARATHON", "THEATRE",
)  # fmt: skip
_INKS = (
    (186, 42, 46), (36, 72, 140), (238, 196, 60), (40, 110, 74), (232, 228, 214), (30, 32, 38),
    (214, 120, 48), (112, 58, 126), (70, 150, 168), (222, 150, 170),
)  # fmt: skip


def in_quarter(mesh: Mesh, quarter: int) -> Mesh:
    """The mesh with the drawings of a quarter on its fronts."""
    names, which = np.unique(mesh.texture, return_inverse=True)
    own = np.array([f"{name}_{quarter}" if name in _VARIED else str(name) for name in names])
    return replace(mesh, texture=own[which.reshape(-1)])


def poster_pillar(drawing: int) -> Mesh:
    """Advertising pillar of 3.1 m, its foot in the origin, with posters of a drawing all round."""
    radius, height = _PILLAR_M
    angle = np.linspace(0, 2 * np.pi, 17)
    low, high = -0.45, -0.45 - _POSTERS_M[1]
    x, z = radius * np.cos(angle), radius * np.sin(angle)
    points = np.stack([np.stack([x, 0 * x + y, z], 1) for y in (high, low)])
    along = np.broadcast_to(angle / (2 * np.pi) * (_POSTERS_M[0] - 0.01) + 0.005, (2, 17))
    down = np.broadcast_to(np.array([[0.005], [_POSTERS_M[1] - 0.005]]), (2, 17))
    wall = surface(points, f"posters_{drawing}", uv=np.stack([along, down], -1), smooth=True)
    base = cylinder((0, 0, 0), (0, low, 0), (radius + 0.05,) * 2, "concrete", (150, 150, 146), 16)
    cap = cylinder((0, high, 0), (0, -height, 0), (radius + 0.12, 0.15), "plain", (66, 84, 76), 16)
    return merge([base, wall, cap])


def quarter_textures(quarters: int, pillars: int) -> dict[str, Drawing]:
    """All textures of a town with that many quarters and drawings of posters, by their names."""
    varied: dict[str, Drawing] = {}
    for quarter in range(quarters):
        for name, drawing in _VARIED.items():
            varied[f"{name}_{quarter}"] = _variant(name, drawing, quarter)
    posters: dict[str, Drawing] = {f"posters_{k}": _posters for k in range(pillars)}
    return SURFACES | FACADES | varied | posters


def _variant(name: str, drawing: Drawing, quarter: int) -> Drawing:
    """The drawing with the windows or the shops of a quarter; curtains and goods differ anyway."""
    if not isinstance(drawing, partial):
        return drawing
    told = dict(drawing.keywords)
    if name.startswith("storeys_"):
        told["style"] = (told["style"] + quarter) % _STYLES
    else:
        told["first"] = told["first"] + 2 * quarter
    return partial(drawing.func, *drawing.args, **told)


def _posters(rng: np.random.Generator) -> Texture:
    """Two rows of posters, each with its own colours, figures and words."""
    canvas = Canvas((512, 256), _POSTERS_M, (206, 200, 186))
    for row in range(2):
        x = 0.03
        while x < _POSTERS_M[0] - 0.45:
            width = min(float(rng.uniform(0.6, 1.2)), _POSTERS_M[0] - 0.03 - x)
            y = 0.03 + row * _POSTERS_M[1] / 2
            _poster(canvas, (x, y, x + width - 0.04, y + _POSTERS_M[1] / 2 - 0.06), rng)
            x += width
    return canvas.texture(rng, 0.03)


def _poster(
    canvas: Canvas, box: tuple[float, float, float, float], rng: np.random.Generator
) -> None:
    x0, y0, x1, y1 = box
    w, h = x1 - x0, y1 - y0
    ground, ink, other = (_INKS[k] for k in rng.choice(len(_INKS), 3, replace=False))
    canvas.rect(x0, y0, x1, y1, ground)
    for _ in range(int(rng.integers(3, 7))):
        at = (x0 + w * rng.uniform(0.15, 0.85), y0 + h * rng.uniform(0.3, 0.75))
        size = w * rng.uniform(0.06, 0.16)
        colour = (ink, other)[int(rng.integers(0, 2))]
        if rng.random() < 0.5:
            canvas.ellipse(at, (size, size * rng.uniform(0.5, 1.3)), colour)
        else:
            turn = rng.uniform(0, 2) + np.arange(3) * 2.1
            canvas.polygon([(at[0] + size * np.cos(a), at[1] + size * np.sin(a)) for a in turn],
                           colour)  # fmt: skip
    word = _WORDS[int(rng.integers(0, len(_WORDS)))]
    middle = (x0 + x1) / 2
    canvas.text(word, (middle, y0 + 0.14 * h), min(0.16, 1.15 * w / len(word)), ink)
    canvas.text(str(rng.integers(1, 32)) + "." + str(rng.integers(1, 13)), (middle, y0 + 0.88 * h),
                0.11, other)  # fmt: skip
