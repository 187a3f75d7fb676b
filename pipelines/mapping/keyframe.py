"""Keyframes: the frames that the map remembers, and when a frame becomes one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.config import MappingConfig
from pipelines.observations import Tracks
from pipelines.types import Array, Features


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A remembered frame: its pose, the map points it sees, and its features that see none yet.

    T_world_camera: (4, 4) as it was when the frame was tracked. tracks: the map points seen.
    free_features: ORB features that observe no map point. disparity_offset_px: what its disparities
    were corrected by when they were read.
    """

    frame_index: int
    timestamp_s: float
    T_world_camera: Array
    tracks: Tracks
    free_features: Features
    disparity_offset_px: float = 0.0


def needs_keyframe(
    config: MappingConfig, tracks: Tracks, last: Keyframe | None, frame_index: int
) -> bool:
    """Whether a tracked frame shows enough that the last keyframe does not.

    tracks: points of earlier frames that this one has found again. True when fewer than
    `keyframe_min_overlap` of them were seen by the last keyframe, or after `keyframe_max_interval`
    frames; but never while the camera stands, so that keyframes are bounded by its way and turns.
    """
    if last is None:
        return True
    shared = np.isin(tracks.point_ids, last.tracks.point_ids)
    if shared.sum() < config.min_shared_points:
        return True
    is_due = frame_index - last.frame_index >= config.keyframe_max_interval
    is_due |= bool(shared.sum() < config.keyframe_min_overlap * len(tracks))
    return is_due and _image_motion_px(tracks, last.tracks) >= config.keyframe_min_motion_px


def _image_motion_px(tracks: Tracks, before: Tracks) -> float:
    """Median way in the image of the points that both see; they see some."""
    _, now, then = np.intersect1d(tracks.point_ids, before.point_ids, return_indices=True)
    return float(np.median(np.linalg.norm(tracks.uv_px[now] - before.uv_px[then], axis=1)))
