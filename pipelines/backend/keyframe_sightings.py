"""What keyframes saw of the map's points, copied out of the map, and as tracks for an adjustment.

Owns how far each sighting is to be believed. Which keyframes take part is for others to say.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.batch_problem import choose_longest, weigh
from pipelines.backend.point_tracks import Index, PointTracks
from pipelines.frontend.disparity_offset import corrected
from pipelines.frontend.sensor import Sensor
from pipelines.mapping.sparse_map import SparseMap
from pipelines.types import Array, StereoCamera

_MIN_VIEWS = 2  # keyframes that must see a point for it to take part
_FIRST_SIGMA_PX = 0.05  # px, small: a point is by definition where it was first seen


@dataclass(frozen=True, slots=True)
class KeyframeSightings:
    """M sightings of points by K keyframes, in the order of these.

    keyframes: (K,) rows in the map, ascending. frame_index: (K,). Ts_world_camera: (K, 4, 4).
    view: (M,) rows of these. point_ids: (M,), of points that are alive. uv_px: (M, 2).
    disparity_px: (M,) with the offset as it is known by now, NaN where unknown. sigma_uv_px: (M,)
    of a step from the frame before. sigma_disparity_px: of all. sigma_found_px: (M,) of
    the place, where a point was not followed to it but found again.
    """

    camera: StereoCamera
    keyframes: Index
    frame_index: Index
    Ts_world_camera: Array
    view: Index
    point_ids: Index
    uv_px: Array
    disparity_px: Array
    sigma_uv_px: Array
    sigma_disparity_px: float
    sigma_found_px: Array

    def __len__(self) -> int:
        return len(self.view)


def copy_sightings(
    sparse_map: SparseMap, sensor: Sensor, keyframes: Index, wanted: NDArray[np.bool_]
) -> KeyframeSightings:
    """What some keyframes (ascending) saw of the points that are wanted, by their ids (N,)."""
    chosen = [sparse_map.keyframes[k] for k in keyframes.tolist()]
    offset_px, sigma_uv_px = sensor.offset.offset_px, sensor.noise.sigma_uv_px
    ids = np.concatenate([k.tracks.point_ids for k in chosen])
    keep = wanted[ids]
    disparity_px = [
        corrected(sparse_map.camera, k.tracks.disparity_px, offset_px - k.disparity_offset_px)
        for k in chosen
    ]
    return KeyframeSightings(
        sparse_map.camera,
        keyframes,
        np.array([k.frame_index for k in chosen], np.int64),
        np.stack([k.T_world_camera for k in chosen]),
        np.repeat(np.arange(len(chosen)), [len(k.tracks) for k in chosen])[keep],
        ids[keep],
        np.concatenate([k.tracks.uv_px for k in chosen])[keep],
        np.concatenate(disparity_px)[keep],
        np.concatenate([k.tracks.sigma_uv_px for k in chosen])[keep],
        sensor.noise.sigma_disparity_px,
        np.where(sparse_map.album.has(ids[keep]), sigma_uv_px["looks"], sigma_uv_px["orb"]),
    )


def to_tracks(seen: KeyframeSightings, most_per_keyframe: int = 0) -> tuple[PointTracks, Index]:
    """Tracks of the points that two keyframes or more see, and the ids of these points (P,).

    A point that the keyframe before has seen, too, was followed from there: errors of the frames
    between add up. Any other sighting but a point's first is one by descriptor. most_per_keyframe:
    sightings, the longest tracks first, evenly over the image; 0 = all.
    """
    many = np.bincount(seen.point_ids, minlength=1)[seen.point_ids] >= _MIN_VIEWS
    order = np.flatnonzero(many)
    order = order[np.lexsort((seen.view[order], seen.point_ids[order]))]
    point_ids, track = np.unique(seen.point_ids[order], return_inverse=True)
    track, view = track.ravel().astype(np.int64), seen.view[order]
    known = np.r_[False, np.diff(track) == 0][: len(track)]
    followed = known & np.r_[False, np.diff(seen.keyframes[view]) == 1][: len(track)]
    frames = np.maximum(np.diff(seen.frame_index[view], prepend=0), 1)
    sigma = seen.sigma_uv_px[order]
    sigma_uv_px = np.where(
        followed,
        sigma * np.sqrt(frames),
        np.where(known, np.hypot(sigma, seen.sigma_found_px[order]), _FIRST_SIGMA_PX),
    )
    tracks = PointTracks(
        view,
        track,
        followed.astype(np.float64),
        seen.uv_px[order],
        seen.disparity_px[order],
        sigma_uv_px,
        np.full(len(order), seen.sigma_disparity_px),
        len(point_ids),
        len(seen.keyframes),
    )
    if most_per_keyframe:
        keep = choose_longest(tracks, seen.camera, most_per_keyframe)
        tracks, point_ids = tracks.of_tracks(keep), point_ids[keep]
    return weigh(tracks), point_ids
