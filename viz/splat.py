"""Point clouds to pixels in numpy: round splats with a depth buffer, where no Vulkan is at hand.

Owns the software renderer of points. Lines and text come on top, in `viz.render`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.types import Array, Image
from viz.scene import View
from viz.style import Color

SUPERSAMPLING = 2  # drawn so many times larger each way and averaged down
RIM_SHADE = 0.72  # a splat's rim is this much darker, which keeps light points legible on white
RIMMED_FROM = 5  # radius in supersampled pixels; a smaller splat would be nothing but rim
MIN_RADIUS_PX, MAX_RADIUS_PX = 2.0, 7.0  # in a picture 1280 wide


def splat_points(
    view: View, points_m: Array, colors: NDArray[np.uint8], radius_m: float, background: Color
) -> Image:
    """Picture (H, W, 3) uint8 RGB of points (N, 3) as discs of `radius_m`, nearer ones in front."""
    import cv2

    s = SUPERSAMPLING
    W, H = view.size[0] * s, view.size[1] * s
    uv, depth = view.project(points_m)
    seen = depth > 1e-3
    uv, depth, rgb = uv[seen], depth[seen], colors[seen]
    radius = disc_radius_px(view, depth, radius_m) * s
    # The centre of the small pixel 0 is at (0, 0), so that of the large ones is half a step in.
    centre = np.round(uv * s + (s - 1) / 2.0)
    near = (np.abs(centre - [W / 2.0, H / 2.0]) < [W / 2.0 + 20, H / 2.0 + 20]).all(1)
    centre, depth, rgb, radius = centre[near], depth[near], rgb[near], np.round(radius[near])
    keys = np.full(W * H, np.iinfo(np.uint64).max, np.uint64)
    own = (depth.astype(np.float32).view(np.uint32).astype(np.uint64) << 32) | np.arange(
        len(depth), dtype=np.uint64
    )
    for r in np.unique(radius):  # a handful of sizes; all points of one at once
        group = np.flatnonzero(radius == r)
        pixels, which = _disc_pixels(centre[group].astype(np.int64), int(r), W, H)
        np.minimum.at(keys, pixels, own[group][which])
    hit = np.flatnonzero(keys != np.iinfo(np.uint64).max)
    index = (keys[hit] & np.uint64(0xFFFFFFFF)).astype(np.int64)
    canvas = np.tile(np.array(background, np.uint8), (W * H, 1))
    offset = np.stack([hit % W, hit // W], 1) - centre[index]
    rim = (np.hypot(*offset.T) > 0.85 * radius[index] - 1.0) & (radius[index] >= RIMMED_FROM)
    canvas[hit] = np.round(rgb[index] * np.where(rim, RIM_SHADE, 1.0)[:, None])
    return cv2.resize(canvas.reshape(H, W, 3), view.size, interpolation=cv2.INTER_AREA)


def disc_radius_px(view: View, depth_m: Array, radius_m: float) -> Array:
    """Radii on the screen (N,) of points at depths (N,): by perspective, within legible bounds."""
    scale = view.size[0] / 1280.0
    low, high = max(MIN_RADIUS_PX * scale, 1.0), max(MAX_RADIUS_PX * scale, 1.0)
    return np.clip(view.K[0, 0] * radius_m / depth_m, low, high)


def _disc_pixels(
    centres: NDArray[np.int64], radius: int, W: int, H: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Flat pixel indices of discs round `centres` (N, 2), and the disc each belongs to."""
    span = np.arange(-radius, radius + 1)
    du, dv = np.meshgrid(span, span)
    inside = du**2 + dv**2 <= (radius + 0.3) ** 2
    u = centres[:, :1] + du[inside]
    v = centres[:, 1:] + dv[inside]
    ok = (u >= 0) & (v >= 0) & (u < W) & (v < H)
    which = np.broadcast_to(np.arange(len(centres))[:, None], u.shape)[ok]
    return (v * W + u)[ok], which
