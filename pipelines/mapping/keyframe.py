"""Keyframes: the frames that the map remembers, and when a frame becomes one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.config import MappingConfig
from pipelines.types import Array, Features


@dataclass(frozen=True, slots=True)
class Tracks:
    """Map points seen in one image (parallel arrays of length N).

    point_ids: (N,) int64. uv_px: (N, 2) sub-pixel places. disparity_px: (N,), NaN where unknown
    or far. sigma_uv_px: (N,) standard deviations of the places.
    """

    point_ids: NDArray[np.int64]
    uv_px: Array
    disparity_px: Array
    sigma_uv_px: Array

    def __len__(self) -> int:
        return len(self.point_ids)

    def __getitem__(self, which: NDArray) -> Tracks:
        """The tracks chosen by a boolean mask or an index array."""
        return Tracks(
            self.point_ids[which],
            self.uv_px[which],
            self.disparity_px[which],
            self.sigma_uv_px[which],
        )

    @property
    def uvr_px(self) -> Array:
        """(N, 3) stereo pixels u_L, v, u_R."""
        return np.column_stack([self.uv_px, self.uv_px[:, 0] - self.disparity_px])

    @classmethod
    def empty(cls) -> Tracks:
        return cls(np.empty(0, np.int64), np.empty((0, 2)), np.empty(0), np.empty(0))

    @classmethod
    def concatenate(cls, *parts: Tracks) -> Tracks:
        return cls(
            np.concatenate([p.point_ids for p in parts]),
            np.concatenate([p.uv_px for p in parts]),
            np.concatenate([p.disparity_px for p in parts]),
            np.concatenate([p.sigma_uv_px for p in parts]),
        )


@dataclass(frozen=True, slots=True)
class Keyframe:
    """A remembered frame: its pose, the map points it sees, and its features that see none yet.

    T_world_camera: (4, 4) as it was when the frame was tracked. tracks: the map points seen.
    free_features: ORB features that observe no map point.
    """

    frame_index: int
    timestamp_s: float
    T_world_camera: Array
    tracks: Tracks
    free_features: Features


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
