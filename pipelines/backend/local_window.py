"""Which keyframes and points are adjusted together, and how the answer returns to the map.

Owns the choice of the local window, as a problem for `bundle_adjustment`.
Changes nothing: what it returns are copies.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.bundle_adjustment import BundleProblem, BundleSolution
from pipelines.config import BackendConfig
from pipelines.frontend.sensor import Sensor
from pipelines.mapping.correction import MapCorrection
from pipelines.mapping.sparse_map import SparseMap

Ids = NDArray[np.int64]
_MIN_VIEWS = 2  # keyframes that must see a point for it to take part


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
    offset_px = sensor.offset.offset_px
    views = [sparse_map.keyframes[k] for k in keyframes]
    keep = [wanted[view.tracks.point_ids] for view in views]
    ids = np.concatenate([v.tracks.point_ids[g] for v, g in zip(views, keep, strict=True)])
    row = np.repeat(np.arange(len(views)), [int(g.sum()) for g in keep])
    uv = np.concatenate([v.tracks.uv_px[g] for v, g in zip(views, keep, strict=True)])
    sigma = np.concatenate([v.tracks.sigma_uv_px[g] for v, g in zip(views, keep, strict=True)])
    disparity = np.concatenate(
        [
            v.tracks.disparity_px[g] + (offset_px - v.disparity_offset_px)
            for v, g in zip(views, keep, strict=True)
        ]
    )
    often = np.bincount(ids, minlength=len(wanted))[ids] >= _MIN_VIEWS
    point_ids, point = np.unique(ids[often], return_inverse=True)
    problem = BundleProblem(
        sparse_map.camera,
        np.stack([view.T_world_camera for view in views]),
        np.isin(keyframes, held),
        sparse_map.position_m[point_ids],
        row[often],
        point.astype(np.int64),
        uv[often],
        disparity[often],
        sigma[often],
        np.full(int(often.sum()), sensor.noise.sigma_disparity_px),
    )
    return BundleWindow(keyframes, point_ids, problem)


def to_correction(window: BundleWindow, solution: BundleSolution) -> MapCorrection:
    """The solution as a correction of the map; points that no observation bears out go along."""
    problem = window.problem
    borne_out = np.unique(problem.point[solution.inliers])
    return MapCorrection(
        window.keyframes,
        problem.Ts_world_camera,
        solution.Ts_world_camera,
        window.point_ids[borne_out],
        solution.points_m[borne_out] - problem.points_m[borne_out],
    )
