"""Full bundle adjustment after a loop: all keyframes, and the points that tie them together.

Owns what is asked once the pose graph has closed a loop, the answer, and its way into the map.
Points that both sides of the loop mapped become one, which holds the loop closed while the rest
settles. All of the work is one function of arrays, for any process.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.bundle_adjustment import BundleProblem, BundleSolution, adjust_bundle
from pipelines.backend.duplicate_points import Pairs, find_duplicates
from pipelines.backend.keyframe_sightings import KeyframeSightings, copy_sightings, to_tracks
from pipelines.backend.point_tracks import Index
from pipelines.config import BackendConfig
from pipelines.frontend.sensor import Sensor
from pipelines.mapping.correction import MapCorrection
from pipelines.mapping.sparse_map import SparseMap
from pipelines.types import Array

_COVISIBLE = 15  # keyframes around each end of the loop whose points may be double
_NEIGHBOURS = 5  # of each of these


@dataclass(frozen=True, slots=True)
class LoopQuestion:
    """The map as it is: sightings of all keyframes, points by their ids, both sides of the loop.

    positions_m: (N, 3). descriptors: (N, 32). recent, place: rows of keyframes.
    """

    seen: KeyframeSightings
    positions_m: Array
    descriptors: NDArray[np.uint8]
    recent: Index
    place: Index


@dataclass(frozen=True, slots=True)
class LoopAnswer:
    """Points that are one (P, 2), the ids (N,) of those that took part, and how all came to lie."""

    duplicates: Pairs
    point_ids: Index
    problem: BundleProblem
    solution: BundleSolution


def loop_question(sparse_map: SparseMap, sensor: Sensor, keyframe: int, place: int) -> LoopQuestion:
    """All of the map, copied, in which a loop is closed. keyframe, place: rows of its two ends."""
    n = len(sparse_map.keyframes)
    middle = (place + keyframe) / 2
    old, recent = _around(sparse_map, place), _around(sparse_map, keyframe)
    recent = np.union1d(recent, np.arange(keyframe, n))
    columns = sparse_map.columns()
    return LoopQuestion(
        copy_sightings(sparse_map, sensor, np.arange(n), columns["alive"]),
        columns["position_m"].copy(),
        columns["descriptor"].copy(),
        recent[recent > middle],
        old[old <= middle],
    )


def _around(sparse_map: SparseMap, keyframe: int) -> Index:
    """A keyframe, those most covisible with it, and some that are with these."""
    near = np.append(sparse_map.covisible_keyframes(keyframe)[:_COVISIBLE], keyframe)
    further = [sparse_map.covisible_keyframes(int(k))[:_NEIGHBOURS] for k in near]
    return np.unique(np.concatenate([near, *further]))


def adjust_loop(question: LoopQuestion, config: BackendConfig) -> LoopAnswer:
    """Join what both sides of the loop mapped, and adjust all; the first keyframe is held."""
    seen = question.seen
    duplicates = find_duplicates(
        seen, question.positions_m, question.descriptors, question.recent, question.place
    )
    seen = join_points(seen, duplicates, len(question.positions_m))
    tracks, point_ids = to_tracks(seen, config.points_per_keyframe)
    problem = BundleProblem(
        seen.camera,
        seen.Ts_world_camera,
        np.arange(len(seen.keyframes)) == 0,
        question.positions_m[point_ids],
        tracks,
    )
    solution = adjust_bundle(problem, config.rounds, config.iterations)
    return LoopAnswer(duplicates, point_ids, problem, solution)


def join_points(seen: KeyframeSightings, pairs: Pairs, n_points: int) -> KeyframeSightings:
    """The sightings with each pair's second point as its first, which a keyframe sees only once."""
    name = np.arange(n_points)
    name[pairs[:, 1]] = pairs[:, 0]
    ids = name[seen.point_ids]
    order = np.lexsort((ids != seen.point_ids, ids, seen.view))  # a point's own sighting first
    double = np.zeros(len(ids), bool)
    double[order[1:]] = (np.diff(ids[order]) == 0) & (np.diff(seen.view[order]) == 0)
    rows = np.flatnonzero(~double)
    return replace(
        seen,
        view=seen.view[rows],
        point_ids=ids[rows],
        uv_px=seen.uv_px[rows],
        disparity_px=seen.disparity_px[rows],
        sigma_uv_px=seen.sigma_uv_px[rows],
        sigma_found_px=seen.sigma_found_px[rows],
    )


def loop_adjustment_correction(answer: LoopAnswer) -> MapCorrection:
    """The answer as a correction of the map; points that took no part go with their keyframes."""
    problem, solution = answer.problem, answer.solution
    borne_out = np.unique(problem.tracks.track[solution.inliers])
    return MapCorrection(
        np.arange(len(problem.held)),
        problem.Ts_world_camera,
        solution.Ts_world_camera,
        answer.point_ids[borne_out],
        solution.points_m[borne_out] - problem.points_m[borne_out],
        duplicates=answer.duplicates,
    )
