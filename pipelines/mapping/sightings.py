"""What a frame saw of the static world, as the observation log keeps it."""

from __future__ import annotations

import numpy as np

from pipelines.frame_observations import STATIC, Sightings
from pipelines.geometry import invert_T, transform_points
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.types import Array


def static_sightings(
    sparse_map: SparseMap,
    tracks: Tracks,
    frame_index: int,
    T_world_camera: Array,
    sigma_disparity_px: float,
) -> Sightings:
    """The tracks of one frame under the lasting numbers of their points, which the map holds."""
    n, ids = len(tracks), tracks.point_ids
    return Sightings(
        np.full(n, frame_index, np.int64),
        np.full(n, STATIC, np.int64),
        sparse_map.serial[ids],
        tracks.uv_px,
        tracks.disparity_px,
        tracks.sigma_uv_px,
        np.full(n, sigma_disparity_px),
        transform_points(invert_T(T_world_camera), sparse_map.position_m[ids]),
    )
