"""What one image says of map points: the nouns that front-end and map hand to each other.

Owns tracks (which point is seen where) and observations (the same with what their weights need).
Lies below both, so that the map's storage need not know the front-end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.types import Array


@dataclass(frozen=True, slots=True)
class Tracks:
    """Map points seen in one image (parallel arrays of length N).

    point_ids: (N,) int64, rows of the map. uv_px: (N, 2) sub-pixel places. disparity_px: (N,), NaN
    where unknown or far. sigma_uv_px: (N,) standard deviations of the places, per axis.
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
        """(N, 3) stereo pixels u_L, v, u_R; u_R is NaN where the disparity is."""
        return np.column_stack([self.uv_px, self.uv_px[:, 0] - self.disparity_px])

    @classmethod
    def empty(cls) -> Tracks:
        """No tracks at all."""
        return cls(np.empty(0, np.int64), np.empty((0, 2)), np.empty(0), np.empty(0))

    @classmethod
    def concatenate(cls, *parts: Tracks) -> Tracks:
        """All parts, in their order."""
        return cls(
            np.concatenate([p.point_ids for p in parts]),
            np.concatenate([p.uv_px for p in parts]),
            np.concatenate([p.disparity_px for p in parts]),
            np.concatenate([p.sigma_uv_px for p in parts]),
        )


@dataclass(frozen=True, slots=True)
class StereoObservations:
    """Points of the map and where an image sees them (parallel arrays of length N).

    In eq. (1) of the paper, points_world_m is P_{k-1} and uvr_px is C_k.
    points_world_m: (N, 3). point_covariances_m2: (N, 3, 3), in the world, zero if exact.
    uvr_px: (N, 3) stereo pixels u_L, v, u_R; u_R is NaN where the depth is not known or far.
    sigma_uv_px, sigma_disparity_px: (N,) standard deviations of the pixel and of u_L - u_R.
    """

    points_world_m: Array
    point_covariances_m2: Array
    uvr_px: Array
    sigma_uv_px: Array
    sigma_disparity_px: Array

    def __len__(self) -> int:
        return len(self.uvr_px)

    def __getitem__(self, which: NDArray) -> StereoObservations:
        """The observations chosen by a boolean mask or an index array."""
        return StereoObservations(
            self.points_world_m[which],
            self.point_covariances_m2[which],
            self.uvr_px[which],
            self.sigma_uv_px[which],
            self.sigma_disparity_px[which],
        )
