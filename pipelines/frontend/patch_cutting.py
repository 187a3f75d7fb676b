"""Cutting patches of tracked points from the images that see them, while no older one will do.

A place that is aligned to the last frame carries that frame's error on, so that tracks drift as a
random walk does; one that is aligned to its first sight does not. Knows no map.

Deviation: in the paper points are matched from frame to frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.frontend.sampling import disparity_slopes
from pipelines.frontend.view import View
from pipelines.observations import Tracks
from pipelines.patches import SIDE_PX, Patches
from pipelines.types import Array, StereoCamera

_HALF = SIDE_PX // 2


@dataclass(frozen=True, slots=True)
class Shot:
    """A view that patches are cut from, with its T_world_camera (4, 4).

    sigma_disparity_px: noise of its disparities.
    """

    camera: StereoCamera
    view: View
    T_world_camera: Array
    sigma_disparity_px: float


def renew_patches(old: Patches, shot: Shot, tracks: Tracks, depth_m: Array) -> Patches:
    """Patches of the points that are tracked on: the old ones while they fit, else new ones.

    tracks: N points as the shot sees them, depth_m (N,) away from its camera.
    """
    order = np.argsort(tracks.point_ids, kind="stable")
    tracks, depth_m = tracks[order], depth_m[order]
    rows = old.rows(tracks.point_ids)
    fits = rows >= 0
    Hs = old.homographies(shot.camera, rows[fits], shot.T_world_camera)
    fits[fits] = old.are_like(rows[fits], Hs)
    return Patches.concatenate(old[rows[fits]], _cut_patches(shot, tracks[~fits], depth_m[~fits]))


def _cut_patches(shot: Shot, tracks: Tracks, depth_m: Array) -> Patches:
    view, bf, uv_px = shot.view, shot.camera.bf, tracks.uv_px
    H, W = view.gray.shape
    corner = np.floor(uv_px).astype(np.int64) - _HALF
    x = np.clip(corner[:, :1] + np.arange(SIDE_PX), 0, W - 1)
    y = np.clip(corner[:, 1:] + np.arange(SIDE_PX), 0, H - 1)
    slopes = disparity_slopes(view.disparity_px, uv_px, shot.sigma_disparity_px)
    at_origin = bf / depth_m - (slopes * uv_px).sum(axis=1)
    return Patches(
        tracks.point_ids,
        view.gray[y[:, :, None], x[:, None, :]],
        corner,
        uv_px,
        np.column_stack([slopes, at_origin]) / bf,
        np.tile(shot.T_world_camera, (len(uv_px), 1, 1)),
    )
