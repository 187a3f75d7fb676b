"""The nouns of the observation log: which point was seen where, in each frame of a run.

Owns what the batch needs to know of a frame long after it. Imports numpy alone.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.shapes import check_shape

Array = NDArray[np.floating[Any]]
STATIC = 0  # object id of points of the static world


@dataclass(frozen=True, slots=True)
class Sightings:
    """Points and where frames saw them (parallel arrays of length N).

    frame_index: (N,) int64. object_id: (N,) int64, 0 for the static world. track_id: (N,) int64,
    the point's lasting number, never used twice; static points and those of objects are numbered
    apart. uv_px: (N, 2). disparity_px: (N,) corrected by the learned offset, NaN where unknown or
    far. sigma_uv_px, sigma_disparity_px: (N,) standard deviations. position_m: (N, 3) the point in
    the camera of that frame, by the front-end's filter.
    """

    frame_index: NDArray[np.int64]
    object_id: NDArray[np.int64]
    track_id: NDArray[np.int64]
    uv_px: Array
    disparity_px: Array
    sigma_uv_px: Array
    sigma_disparity_px: Array
    position_m: Array

    def __post_init__(self) -> None:
        N = len(self.frame_index)
        for field in fields(self):
            inner = {"uv_px": (2,), "position_m": (3,)}.get(field.name, ())
            check_shape("Sightings", field.name, getattr(self, field.name), (N, *inner))

    def __len__(self) -> int:
        return len(self.frame_index)

    def __getitem__(self, which: NDArray) -> Sightings:
        """The sightings chosen by a boolean mask or an index array."""
        return Sightings(*(getattr(self, f.name)[which] for f in fields(self)))

    @classmethod
    def empty(cls) -> Sightings:
        """None at all."""
        whole, none = np.empty(0, np.int64), np.empty(0)
        two, three = np.empty((0, 2)), np.empty((0, 3))
        return cls(whole, whole, whole, two, none, none, none, three)

    @classmethod
    def concatenate(cls, *parts: Sightings) -> Sightings:
        """All of them, in their order."""
        if not parts:
            return cls.empty()
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


@dataclass(frozen=True, slots=True)
class FrameObservations:
    """What the front-end saw in one frame, and where it believed the camera to be.

    is_tracked: whether the pose was measured. T_world_camera: (4, 4). sightings: those that agreed
    with the front-end's motions, of the static world and of objects; some may be of the frame
    before, where a point was only found back once this one was there. disparity_offset_px: by which
    its disparities are corrected, see `frontend.disparity_offset`.
    """

    frame_index: int
    timestamp_s: float
    is_tracked: bool
    T_world_camera: Array
    sightings: Sightings
    disparity_offset_px: float = 0.0

    def __post_init__(self) -> None:
        check_shape("FrameObservations", "T_world_camera", self.T_world_camera, (4, 4))
