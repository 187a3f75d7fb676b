"""A drawing board in metres, for textures that show things: windows, shop fronts, cars, pictures.

Owns anti-aliased drawing (twice the size, then averaged) of RGB plus the share of tint.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from pipelines.datasets.simulated.textures import Texture, grain
from pipelines.types import Array, Image

_OVER = 2  # drawn this many times larger than the texture
_SHIFT = 4  # fractional bits of cv2's coordinates
PAINT = (255, 255, 255, 255)  # takes the tint wholly


def _rgba(colour: ArrayLike) -> tuple[float, ...]:
    values = tuple(float(c) for c in np.asarray(colour, float))
    return values if len(values) == 4 else (*values, 0.0)


class Canvas:
    """Board of `size_m` (width, height), origin top left, y down; colours RGB or RGB plus tint."""

    def __init__(self, size_px: tuple[int, int], size_m: tuple[float, float], colour: ArrayLike):
        self.size_px, self.size_m = size_px, size_m
        self._scale = np.array(size_px, float) * _OVER / np.array(size_m, float)
        self.pixels = np.empty((size_px[1] * _OVER, size_px[0] * _OVER, 4), np.uint8)
        self.pixels[:] = np.array(_rgba(colour), np.uint8)

    def _points(self, points_m: ArrayLike) -> np.ndarray:
        scaled = np.asarray(points_m, float) * self._scale * 2**_SHIFT
        return np.round(scaled).astype(np.int32)

    def polygon(self, points_m: ArrayLike, colour: ArrayLike) -> None:
        points = [self._points(points_m)]
        cv2.fillPoly(self.pixels, points, _rgba(colour), cv2.LINE_AA, _SHIFT)

    def rect(self, x0: float, y0: float, x1: float, y1: float, colour: ArrayLike) -> None:
        self.polygon([(x0, y0), (x1, y0), (x1, y1), (x0, y1)], colour)

    def line(self, points_m: ArrayLike, colour: ArrayLike, width_m: float = 0.02) -> None:
        width = max(1, round(width_m * self._scale.mean()))
        points = [self._points(points_m)]
        cv2.polylines(self.pixels, points, False, _rgba(colour), width, cv2.LINE_AA, _SHIFT)

    def ellipse(self, centre: ArrayLike, radii: ArrayLike, colour: ArrayLike) -> None:
        angle = np.linspace(0, 2 * np.pi, 40, endpoint=False)
        ring = np.stack([np.cos(angle), np.sin(angle)], 1) * np.asarray(radii, float)
        self.polygon(ring + np.asarray(centre, float), colour)

    def text(self, words: str, centre: ArrayLike, height_m: float, colour: ArrayLike) -> None:
        face, thick = cv2.FONT_HERSHEY_DUPLEX, 2
        (_, base_height), _ = cv2.getTextSize(words, face, 1.0, thick)
        scale = height_m * self._scale[1] / base_height
        thick = max(1, round(2.4 * scale))
        (w, h), _ = cv2.getTextSize(words, face, scale, thick)
        x, y = np.asarray(centre, float) * self._scale + (-w / 2, h / 2)
        place = (round(float(x)), round(float(y)))
        cv2.putText(self.pixels, words, place, face, scale, _rgba(colour), thick, cv2.LINE_AA)

    def fade(
        self, box_m: tuple[float, float, float, float], top: ArrayLike, bottom: ArrayLike
    ) -> None:
        """Fill x0, y0, x1, y1 with a vertical gradient."""
        (x0, y0), (x1, y1) = (np.array(box_m).reshape(2, 2) * self._scale).round().astype(int)
        t = np.linspace(0, 1, max(y1 - y0, 1))[:, None]
        ramp = np.array(_rgba(top)) * (1 - t) + np.array(_rgba(bottom)) * t
        self.pixels[y0:y1, x0:x1] = ramp[:, None].astype(np.uint8)

    def paste(self, rgba: Image, tile_m: tuple[float, float]) -> None:
        """Cover the whole board with copies of a tile."""
        w, h = np.maximum(1, np.round(np.array(tile_m) * self._scale)).astype(int)
        tile = cv2.resize(rgba, (int(w), int(h)), interpolation=cv2.INTER_AREA)
        H, W = self.pixels.shape[:2]
        repeats = (-(-H // tile.shape[0]), -(-W // tile.shape[1]), 1)
        self.pixels[:] = np.tile(tile, repeats)[:H, :W]

    def texture(self, rng: np.random.Generator, roughness: float = 0.02) -> Texture:
        """The finished drawing, with a little grain so that no surface is perfectly plain."""
        small: Array = cv2.resize(self.pixels, self.size_px, interpolation=cv2.INTER_AREA)
        light = 1 + roughness * grain(max(self.size_px), rng)[: self.size_px[1], : self.size_px[0]]
        out = small.astype(np.float32)
        out[..., :3] *= light[..., None]
        return Texture(np.clip(out + 0.5, 0, 255).astype(np.uint8), self.size_m)
