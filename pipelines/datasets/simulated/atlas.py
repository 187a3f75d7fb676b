"""All textures of a scene in one picture with their reductions, so that a look-up is one gather.

Owns the placing of mip levels and anti-aliased look-ups. Knows no geometry.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.simulated.textures import Texture
from pipelines.types import Image

_WIDTH = 4096
_PAD = 2  # texels repeated around each level, so that bilinear look-ups wrap
_SHIFTS = tuple(np.float32((k + 0.5) / 4 - 0.5) for k in range(4))
_ROW = 2048  # cv2.remap takes no side above 32767: look-ups go in rows of this many


Floats = NDArray[np.float32]


class Atlas:
    """Textures by index, each with all its halved levels down to one texel."""

    def __init__(self, textures: list[Texture]) -> None:
        self._levels = [_reductions(t.rgba) for t in textures]
        self.tile_m = np.array([t.tile_m for t in textures], np.float32)
        self.size_px = np.array([t.rgba.shape[1::-1] for t in textures], np.float32).T.copy()
        deepest = max(len(levels) for levels in self._levels)
        n = len(textures)
        self._count = np.array([len(levels) for levels in self._levels], np.int32)
        self._x0 = np.zeros(n * deepest, np.float32)
        self._y0 = np.zeros(n * deepest, np.float32)
        self._w = np.ones(n * deepest, np.float32)
        self._h = np.ones(n * deepest, np.float32)
        self._deepest = deepest
        self._picture = self._place()

    def _place(self) -> Image:
        """Shelf packing, highest first."""
        slots = [(i, j) for i, levels in enumerate(self._levels) for j in range(len(levels))]
        slots.sort(key=lambda s: -self._levels[s[0]][s[1]].shape[0])
        x = y = shelf = 0
        for i, j in slots:
            h, w = self._levels[i][j].shape[:2]
            if x + w + 2 * _PAD > _WIDTH:
                x, y, shelf = 0, y + shelf, 0
            shelf = max(shelf, h + 2 * _PAD)
            k = i * self._deepest + j
            self._x0[k], self._y0[k], self._w[k], self._h[k] = x + _PAD - 0.5, y + _PAD - 0.5, w, h
            x += w + 2 * _PAD
        picture = np.zeros((y + shelf, _WIDTH, 4), np.uint8)
        for i, j in slots:
            level = np.pad(self._levels[i][j], ((_PAD, _PAD), (_PAD, _PAD), (0, 0)), mode="wrap")
            k = i * self._deepest + j
            top, left = int(self._y0[k] + 0.5) - _PAD, int(self._x0[k] + 0.5) - _PAD
            picture[top : top + level.shape[0], left : left + level.shape[1]] = level
        return picture

    def look_up(
        self,
        index: NDArray[np.int32],
        tiles: tuple[Floats, Floats],
        step2_px: Floats,
        along: tuple[Floats, Floats] | None = None,
    ) -> Floats:
        """RGBA planes (4, N) of textures `index` (N,) at `tiles` (u, v), whole numbers repeating.

        step2_px: (N,) squared distance in texels (of the full level) between neighbouring pixels.
        along: step (u, v) over which four look-ups are spread and averaged.
        """
        # log2 of a square is twice log2; 0.35 leans to the sharper side of the rounding.
        level = np.float32(0.5) * np.log2(np.maximum(step2_px, 1.0)) + np.float32(0.35)
        level = np.minimum(level.astype(np.int32), self._count[index] - 1)
        slot = index * self._deepest + level
        frames = [(self._w[slot], self._x0[slot]), (self._h[slot], self._y0[slot])]
        N = len(slot)
        maps = np.zeros((2, -(-N // _ROW) * _ROW), np.float32)
        total: NDArray[np.uint16] | Image | None = None
        for shift in _SHIFTS if along is not None else (0.0,):
            for axis, (length, start) in enumerate(frames):
                place = tiles[axis] if along is None else tiles[axis] + shift * along[axis]
                place = place - np.floor(place)
                place *= length
                np.add(place, start, out=maps[axis, :N])
            found = cv2.remap(
                self._picture,
                maps[0].reshape(-1, _ROW),
                maps[1].reshape(-1, _ROW),
                cv2.INTER_LINEAR,
            )
            total = found if total is None else cv2.add(total, found, dtype=cv2.CV_16U)
        planes = np.stack(cv2.split(total)).reshape(4, -1)[:, :N].astype(np.float32)
        return planes if along is None else planes * np.float32(1 / len(_SHIFTS))


def _reductions(rgba: Image) -> list[Image]:
    """`rgba` and its averages over 2x2, 4x4, ... pixels."""
    levels = [rgba]
    while max(levels[-1].shape[:2]) > 1:
        h, w = levels[-1].shape[:2]
        half = (max(w // 2, 1), max(h // 2, 1))
        levels.append(cv2.resize(levels[-1], half, interpolation=cv2.INTER_AREA))
    return levels
