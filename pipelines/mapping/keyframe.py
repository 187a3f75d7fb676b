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

    True when fewer than `keyframe_min_overlap` of the tracked points were seen by the last
    keyframe, or after `keyframe_max_interval` frames.
    """
    if last is None or frame_index - last.frame_index >= config.keyframe_max_interval:
        return True
    shared = np.isin(tracks.point_ids, last.tracks.point_ids).sum()
    return bool(shared < config.keyframe_min_overlap * max(len(tracks), 1))
