"""Sightings that a batch is not shown, and how well an estimate predicts them.

Owns their choice and their errors: the honest measure of whether a batch made things better.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from pipelines.backend.point_elimination import camera_points
from pipelines.backend.point_tracks import Index, PointTracks
from pipelines.geometry import MIN_DEPTH_M
from pipelines.types import Array, StereoCamera

_MIN_OTHERS = 4  # sightings of a track without the one that is held out
_MOST = 9.0  # of a squared error in standard deviations; beyond, it counts as an outlier


@dataclass(frozen=True, slots=True)
class HeldOut:
    """H sightings that are left out.

    view, track: (H,) as in the tracks that are kept. uv_px, disparity_px: what was seen.
    sigma_to_px, sigma_from_px: (H,) of the steps to it and from it, carried_to, carried_from: (H,)
    as of these steps. sigma_disparity_px: (H,).
    row_before, row_after: (H,) rows of the kept tracks between which it lay.
    """

    view: Index
    track: Index
    uv_px: Array
    disparity_px: Array
    sigma_to_px: Array
    sigma_from_px: Array
    carried_to: Array
    carried_from: Array
    sigma_disparity_px: Array
    row_before: Index
    row_after: Index

    def __len__(self) -> int:
        return len(self.view)


def hold_out(
    tracks: PointTracks, rows_of_log: Index, share: float, seed: int = 0
) -> tuple[PointTracks, Index, HeldOut]:
    """The tracks without some sightings, their rows in the log, and these sightings.

    Only sightings with others before and after them are held out, about `share` of these; the
    next one then counts as followed from the one before.
    """
    followed = tracks.is_followed
    inner = followed & np.r_[followed[1:], False]
    inner &= tracks.lengths[tracks.track] > _MIN_OTHERS
    chosen = inner & (np.random.default_rng(seed).random(len(tracks)) < share)
    chosen[1:] &= ~chosen[:-1]
    # A whole run of sightings was thinned to every other one by that, which is what is wanted
    out = np.flatnonzero(chosen)
    place = np.cumsum(~chosen) - 1
    held = HeldOut(
        tracks.view[out],
        tracks.track[out],
        tracks.uv_px[out],
        tracks.disparity_px[out],
        tracks.sigma_uv_px[out],
        tracks.sigma_uv_px[out + 1],
        tracks.carried[out],
        tracks.carried[out + 1],
        tracks.sigma_disparity_px[out],
        place[out - 1],
        place[out + 1],
    )
    sigma, carried = tracks.sigma_uv_px.copy(), tracks.carried.copy()
    sigma[out + 1] = np.hypot(carried[out + 1] * sigma[out], sigma[out + 1])
    carried[out + 1] *= carried[out]
    wider = replace(tracks, sigma_uv_px=sigma, carried=carried)
    arrays = {f.name: getattr(wider, f.name)[~chosen] for f in fields(tracks)[:7]}
    kept = PointTracks(**arrays, n_tracks=tracks.n_tracks, n_views=tracks.n_views)
    return kept, rows_of_log[~chosen], held


def held_out_errors(
    camera: StereoCamera, kept: PointTracks, held: HeldOut, Ts_body_camera: Array, points_m: Array
) -> Array:
    """(H,) squared errors of the prediction in standard deviations, per number, outliers capped.

    A pixel is predicted from where the point projects and from how far its neighbours in time were
    off, as errors of followed pixels last; a disparity from the point alone.
    """
    R, t = Ts_body_camera[held.view, :3, :3], Ts_body_camera[held.view, :3, 3]
    p = np.einsum("nji,nj->ni", R, points_m[held.track] - t)
    weight_to, weight_from = held.sigma_to_px**-2.0, held.sigma_from_px**-2.0
    variance = 1.0 / (weight_to + held.carried_from**2 * weight_from)
    share_before = (variance * weight_to * held.carried_to)[:, None]
    share_after = (variance * weight_from * held.carried_from)[:, None]
    miss = misses_px(camera, kept.uv_px, camera_points(kept, Ts_body_camera, points_m))
    expected = share_before * miss[held.row_before] + share_after * miss[held.row_after]
    uv = (misses_px(camera, held.uv_px, p) - expected) / np.sqrt(variance)[:, None]
    z = np.maximum(p[:, 2], MIN_DEPTH_M)
    disparity = (held.disparity_px - camera.bf / z) / held.sigma_disparity_px
    squares = np.minimum(np.column_stack([uv, disparity]) ** 2, _MOST)
    return np.nanmean(squares, axis=1)


def misses_px(camera: StereoCamera, uv_px: Array, points: Array) -> Array:
    """(N, 2) pixels seen less projected; points near the camera's plane are far off."""
    z = np.maximum(points[:, 2:], MIN_DEPTH_M)
    return uv_px - (points[:, :2] / z * (camera.fx, camera.fy) + (camera.cx, camera.cy))
