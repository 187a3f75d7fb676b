"""The exact optical flow of rigid motion, and motion blur made from it.

Owns the step from depth, labels and true motion to flow. Knows no files and no rendering.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import find_objects

from pipelines.types import Array, Image, StereoCamera

Flow = NDArray[np.float32]


def rigid_flow(
    camera: StereoCamera,
    depth_m: NDArray[np.float32],
    labels: NDArray[np.integer],
    Ts_next_camera: Mapping[int, Array],
) -> Flow:
    """Flow (H, W, 2) in pixels of every pixel, from its depth and the motion of its label.

    Ts_next_camera: for each label, the motion (4, 4) that takes points from this camera's frame
    to the next one's, own motion included; label 0 is the still world. Where depth is NaN (the
    sky) the point is taken as infinitely far. NaN where a point comes to lie behind the camera.
    """
    inverse_depth = 1.0 / depth_m
    np.nan_to_num(inverse_depth, copy=False, nan=0.0)
    whole = (slice(0, depth_m.shape[0]), slice(0, depth_m.shape[1]))
    flow = _plane_flow(camera, inverse_depth, Ts_next_camera[0], whole)
    for label, window in enumerate(find_objects(labels), start=1):
        if window is None:
            continue
        part = _plane_flow(camera, inverse_depth[window], Ts_next_camera[label], window)
        np.copyto(flow[window], part, where=(labels[window] == label)[..., None])
    return flow


def _plane_flow(
    camera: StereoCamera, inverse_depth: Array, T: Array, window: tuple[slice, slice]
) -> Flow:
    """Flow of a window's pixels for one motion.

    With A = K R inv(K) and b = K t, pixel p = (u, v, 1) goes to (A p + b / z), dehomogenised by
    its last part w. Writing the difference to (u, v) out before dividing keeps float32 exact to
    1e-5 px: no large number is subtracted from another.
    """
    A = camera.K @ T[:3, :3] @ np.linalg.inv(camera.K)
    b = camera.K @ T[:3, 3]
    u = np.arange(window[1].start, window[1].stop, dtype=float)[None]
    v = np.arange(window[0].start, window[0].stop, dtype=float)[:, None]

    def f32(x: Array) -> NDArray[np.float32]:
        return np.asarray(x, np.float32)

    w = f32(A[2, 0] * u + A[2, 2]) + f32(A[2, 1] * v) + f32(b[2]) * inverse_depth
    behind = w <= 0
    w[behind] = np.nan
    du = f32(A[0, 2] + (A[0, 0] - A[2, 2]) * u - A[2, 0] * u**2) + f32(A[0, 1] * v)
    du -= f32(A[2, 1] * v) * f32(u)
    du += f32(b[0] - b[2] * u) * inverse_depth
    dv = f32(A[1, 2] + (A[1, 1] - A[2, 2]) * v - A[2, 1] * v**2) + f32(A[1, 0] * u)
    dv -= f32(A[2, 0] * u) * f32(v)
    dv += f32(b[1] - b[2] * v) * inverse_depth
    flow = np.empty((*w.shape, 2), np.float32)
    np.divide(du, w, out=flow[..., 0])
    np.divide(dv, w, out=flow[..., 1])
    return flow


def blur_along(image: Image, flow: Flow, share: float) -> Image:
    """`image` smeared along the flow of one frame interval, for an exposure of `share` of it.

    The exposure is centred on the frame's time, so blurred edges stay centred on true ones.
    """
    H, W = image.shape[:2]
    v, u = np.mgrid[:H, :W].astype(np.float32)
    motion = np.nan_to_num(flow)
    longest = share * float(np.quantile(np.abs(motion), 0.995))
    taps = int(np.clip(np.ceil(longest / 1.5), 5, 31))  # a tap every 1.5 px leaves no comb
    total = np.zeros(image.shape, np.float32)
    for moment in (np.arange(taps) + 0.5) / taps - 0.5:
        step = np.float32(moment * share)
        total += cv2.remap(
            image, u - step * motion[..., 0], v - step * motion[..., 1], cv2.INTER_LINEAR,
            borderMode=cv2.BORDER_REPLICATE,
        )  # fmt: skip
    return (total / taps + 0.5).astype(np.uint8)
