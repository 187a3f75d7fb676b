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
    W, H = view.size[0] * s, view.size[1] * s
    uv, depth = view.project(points_m)
    # The centre of the small pixel 0 is at (0, 0), so that of the large ones is half a step in.
    centre = uv * s + (s - 1) / 2.0
    with np.errstate(invalid="ignore"):
        near = np.abs(centre - [W / 2.0, H / 2.0]) < [W / 2.0 + 40, H / 2.0 + 40]
    order = np.flatnonzero((depth > view.near_m) & near.all(1))
    order = order[np.argsort(-depth[order], kind="stable")]
    centre, depth = np.round(centre[order]).astype(np.int64), depth[order]
    radius = np.round(disc_radius_px(view, depth, radius_m) * s)
    owner = np.full(W * H, -1, np.int32)
    for r in np.unique(radius):  # a handful of sizes
        pixels, which = _disc_pixels(centre, np.flatnonzero(radius == r), int(r), (W, H))
        owner[pixels] = which
    hit = np.flatnonzero(owner >= 0)
    index = owner[hit]
    rgb = faded(view, colors[order].astype(np.float32), depth, background)
    offset = np.stack([hit % W, hit // W], 1) - centre[index]
    shade = ball_shade((offset**2).sum(1) / radius[index] ** 2)
    shade[radius[index] < SHADED_FROM_PX * s] = 1.0
    canvas = np.empty((W * H, 3), np.uint8)
    canvas[:] = background
    canvas[hit] = np.round(rgb[index] * shade[:, None])
    return cv2.resize(canvas.reshape(H, W, 3), view.size, interpolation=cv2.INTER_AREA)


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


def _disc_pixels(
    centres: NDArray[np.int64], group: NDArray[np.int64], radius: int, size: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.int32]]:
    """Flat pixels of the discs round `centres[group]`, in that order, and whose each pixel is."""
    W, H = size
    span = np.arange(-radius, radius + 1)
    du, dv = np.meshgrid(span, span)
    inside = du**2 + dv**2 <= (radius + 0.3) ** 2
    u = centres[group, :1] + du[inside]
    v = centres[group, 1:] + dv[inside]
    ok = (u >= 0) & (v >= 0) & (u < W) & (v < H)
    which = np.broadcast_to(group[:, None].astype(np.int32), u.shape)[ok]
    return (v * W + u)[ok], which
