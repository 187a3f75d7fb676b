"""Point clouds to pixels in numpy: round, shaded splats, where no Vulkan is at hand.

Owns the software renderer of points, and how large and how pale a point is by its distance, which
the other renderer shares. Lines and text come on top, in `viz.render`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.types import Array, Image
from viz.scene import View
from viz.style import Color

SUPERSAMPLING = 2  # drawn so many times larger each way and averaged down
RIM_SHADE = 0.66  # a splat is so much darker at its rim, as a ball is: one stands out from the next
SHADED_FROM_PX = 2.5  # radius on the picture; a smaller splat would be nothing but rim
MIN_RADIUS_PX, MAX_RADIUS_PX = 2.0, 7.0  # in a picture 1280 wide


def splat_points(
    view: View, points_m: Array, colors: NDArray[np.uint8], radius_m: float, background: Color
) -> Image:
    """Picture (H, W, 3) uint8 RGB of points (N, 3) as balls of `radius_m`, nearer ones in front.

    They are painted from far to near. Radii only grow on that way, so that all points of one radius
    are painted at once and nothing need be compared.
    """
    import cv2

    s = SUPERSAMPLING
    uv, depth = view.project(points_m)
    largest = int(np.ceil(disc_radius_px(view, np.full(1, 1e-9), radius_m)[0] * s)) + 1
    edge = 2 * largest  # so that discs which reach into the picture are whole on the canvas
    W, H = view.size[0] * s + 2 * edge, view.size[1] * s + 2 * edge
    # The centre of the small pixel 0 is at (0, 0), so that of the large ones is half a step in.
    centre = uv * s + (s - 1) / 2.0 + edge
    with np.errstate(invalid="ignore"):
        inside = ((centre >= largest) & (centre < [W - largest - 1, H - largest - 1])).all(1)
    order = np.flatnonzero((depth > view.near_m) & inside)
    order = order[np.argsort(-depth[order], kind="stable")]
    column, row = np.floor(centre[order] + 0.5).astype(np.int32).T
    radius = np.round(disc_radius_px(view, depth[order], radius_m) * s)
    owner = np.full(W * H, -1, np.int32)
    shade = np.empty(W * H, np.uint8)
    for r in np.unique(radius).astype(int).tolist():  # a handful of sizes
        group = np.flatnonzero(radius == r).astype(np.int32)
        offsets, shades = _disc(r, W)
        pixels = (row[group] * W + column[group])[:, None] + offsets
        owner[pixels] = group[:, None]
        shade[pixels] = shades
    hit = np.flatnonzero(owner >= 0)
    rgb = faded(view, colors[order].astype(np.float32), depth[order], background)
    canvas = np.empty((W * H, 3), np.uint8)
    canvas[:] = background
    canvas[hit] = rgb[owner[hit]] * (shade[hit, None] * np.float32(1 / 255)) + np.float32(0.5)
    whole = canvas.reshape(H, W, 3)[edge:-edge, edge:-edge]
    return cv2.resize(whole, view.size, interpolation=cv2.INTER_AREA)


def disc_radius_px(view: View, depth_m: Array, radius_m: float) -> Array:
    """Radii on the screen (N,) of points at depths (N,): by perspective, within legible bounds."""
    scale = view.size[0] / 1280.0
    low, high = max(MIN_RADIUS_PX * scale, 1.0), max(MAX_RADIUS_PX * scale, 1.0)
    return np.clip(view.K[0, 0] * radius_m / depth_m, low, high)


def ball_shade(share: Array) -> Array:
    """Brightness of a ball seen from the front where (distance to its middle / radius)^2 is so."""
    return 1.0 - (1.0 - RIM_SHADE) * np.clip(share, 0.0, 1.0) ** 1.5


def faded(view: View, colors: Array, depth_m: Array, background: Color) -> Array:
    """Colours (N, 3) that turn to the ground's with distance, as the view's haze says."""
    if view.haze is None:
        return colors
    begin_m, end_m, most = view.haze
    share = most * np.clip((depth_m - begin_m) / max(end_m - begin_m, 1e-9), 0.0, 1.0)[:, None]
    return (colors * (1.0 - share) + np.array(background) * share).astype(np.float32)


def _disc(radius: int, W: int) -> tuple[NDArray[np.int32], NDArray[np.uint8]]:
    """Of a disc of that radius: offsets of its flat pixels in rows of W, and how bright each is."""
    span = np.arange(-radius, radius + 1)
    du, dv = np.meshgrid(span, span)
    share = (du**2 + dv**2) / max(radius, 1) ** 2
    inside = du**2 + dv**2 <= (radius + 0.3) ** 2
    is_shaded = radius >= SHADED_FROM_PX * SUPERSAMPLING
    bright = ball_shade(share[inside]) if is_shaded else np.ones(inside.sum())
    return (dv * W + du)[inside].astype(np.int32), np.round(255 * bright).astype(np.uint8)
