"""What a frame saw of the points of objects, as the observation log keeps it.

Owns the choice of what is worth keeping: observations that agreed with a motion, and births.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.frame_observations import Sightings
from pipelines.objects.points import ObjectPoints
from pipelines.objects.solver import Solution
from pipelines.types import Array, StereoCamera

_SIGMA_BIRTH_PX = 0.05  # px, a point is by definition where it was first seen


def collect_sightings(
    camera: StereoCamera,
    frames: tuple[int, int],
    solutions: list[Solution],
    moved: list[ObjectPoints],
    before: ObjectPoints,
    after: ObjectPoints,
    sigma_disparity_px: float,
) -> Sightings:
    """Sightings of one frame.

    frames: index of the frame before and of this one. moved: the agreeing points of each solution,
    refined, in this camera. before, after: all points that the two frames end with. Points that
    `before` lacks were found back in the frame before; what only `after` has is born now.
    """
    parts = []
    for solution, refined in zip(solutions, moved, strict=True):
        if len(refined) == 0:
            continue
        good = solution.agrees
        seen, old = solution.observations[good], solution.points[good]
        disparity = seen.uvr_px[:, 0] - seen.uvr_px[:, 2]
        sigmas = seen.sigma_uv_px, seen.sigma_disparity_px
        parts.append(_sightings(frames[1], refined, disparity, *sigmas))
        found_back = old[~np.isin(old.track_id, before.track_id)]
        parts.append(_births(camera, frames[0], found_back, sigma_disparity_px))
    known = np.concatenate([np.empty(0, np.int64), *(m.track_id for m in moved)])
    born = after[~np.isin(after.track_id, known)]
    parts.append(_births(camera, frames[1], born, sigma_disparity_px))
    return Sightings.concatenate(*parts)


def _births(
    camera: StereoCamera, frame_index: int, points: ObjectPoints, sigma_disparity_px: float
) -> Sightings:
    n = len(points)
    disparity = camera.bf / points.position_m[:, 2]
    sigmas = np.full(n, _SIGMA_BIRTH_PX), np.full(n, sigma_disparity_px)
    return _sightings(frame_index, points, disparity, *sigmas)


def _sightings(
    frame_index: int,
    points: ObjectPoints,
    disparity_px: Array,
    sigma_uv_px: Array,
    sigma_disparity_px: Array,
) -> Sightings:
    index: NDArray[np.int64] = np.full(len(points), frame_index, np.int64)
    return Sightings(
        index, points.object_id, points.track_id, points.uv_px, disparity_px,
        sigma_uv_px, sigma_disparity_px, points.position_m,
    )  # fmt: skip
