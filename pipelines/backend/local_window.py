"""Which keyframes and points are adjusted together, and how the answer returns to the map.

Owns the choice of the local window, as a problem for `bundle_adjustment`.
Changes nothing: what it returns are copies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.bundle_adjustment import BundleProblem, BundleSolution
from pipelines.backend.keyframe_sightings import copy_sightings, to_tracks
from pipelines.config import BackendConfig
from pipelines.frontend.sensor import Sensor
from pipelines.mapping.correction import MapCorrection
from pipelines.mapping.sparse_map import SparseMap

Ids = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class BundleWindow:
    """A problem, and what its rows are in the map: keyframes (K,) and point_ids (N,)."""

    keyframes: Ids
    point_ids: Ids
    problem: BundleProblem


def local_window(
    sparse_map: SparseMap, sensor: Sensor, config: BackendConfig
) -> BundleWindow | None:
    """The latest keyframe, its neighbours by covisibility, their points, and others who see these.

    The others are held. None while there are too few keyframes.
    """
    last = len(sparse_map.keyframes) - 1
    if last < 1:
        return None
    neighbours = sparse_map.covisible_keyframes(last)[: config.local_keyframes - 1]
    free = np.sort(np.append(neighbours, last))
    free = free[free > 0]  # the first keyframe is where the world is
    seen = np.zeros(len(sparse_map.alive), bool)
    for k in free:
        seen[sparse_map.keyframes[k].tracks.point_ids] = True
    others = np.setdiff1d(_covisible_with(sparse_map, free), free)
    shared = [int(seen[sparse_map.keyframes[k].tracks.point_ids].sum()) for k in others]
    order = np.argsort(-np.array(shared, np.int64), kind="stable")[: config.held_keyframes]
    held = others[order]
    if len(held) == 0:
        held, free = free[:1], free[1:]
    if len(free) == 0:
        return None
    return _window(sparse_map, sensor, held, free, seen & sparse_map.alive)


def _covisible_with(sparse_map: SparseMap, keyframes: Ids) -> Ids:
    """All keyframes covisible with some of these; earlier ones know nothing of later ones."""
    found = [sparse_map.covisible_keyframes(int(k)) for k in keyframes]
    return np.unique(np.concatenate(found)) if found else np.empty(0, np.int64)


def _window(
    sparse_map: SparseMap, sensor: Sensor, held: Ids, free: Ids, wanted: NDArray[np.bool_]
) -> BundleWindow:
    keyframes = np.sort(np.concatenate([held, free]))
    seen = copy_sightings(sparse_map, sensor, keyframes, wanted)
    tracks, point_ids = to_tracks(seen)
    problem = BundleProblem(
        sparse_map.camera,
        seen.Ts_world_camera,
        np.isin(keyframes, held),
        sparse_map.position_m[point_ids],
        tracks,
    )
    return BundleWindow(keyframes, point_ids, problem)


def to_correction(window: BundleWindow, solution: BundleSolution) -> MapCorrection:
    """The solution as a correction of the map; points that no observation bears out go along."""
    problem = window.problem
    borne_out = np.unique(problem.tracks.track[solution.inliers])
    return MapCorrection(
        window.keyframes,
        problem.Ts_world_camera,
        solution.Ts_world_camera,
        window.point_ids[borne_out],
        solution.points_m[borne_out] - problem.points_m[borne_out],
    )
