"""The partial batch: cameras and static points of a window of frames, window after window.

Owns the windows and how they join. A window's first frames are those that the one before has
solved already; they are held, and all later frames follow the last one rigidly, so that no joint
shows (VDO-SLAM's windows jump there).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields

import numpy as np

from pipelines.backend.batch_problem import BatchProblem, build_problem
from pipelines.backend.batch_solver import solve
from pipelines.backend.carried_errors import learn_carried
from pipelines.backend.global_batch import BatchResult, as_result, has_enough, inliers
from pipelines.backend.guard import judge
from pipelines.backend.held_out import hold_out
from pipelines.backend.object_graph import pose_graph
from pipelines.backend.point_elimination import settle_points
from pipelines.backend.point_tracks import Index, PointTracks
from pipelines.config import BatchConfig
from pipelines.frame_observations import FrameObservations
from pipelines.geometry import invert_T, orthonormalise
from pipelines.object_types import ObjectEstimates
from pipelines.types import StereoCamera


def run_partial_batch(
    camera: StereoCamera,
    log: Sequence[FrameObservations],
    config: BatchConfig,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> BatchResult | None:
    """Optimise the cameras of a run in windows (paper: 20 frames, 4 of them shared).

    Returns None where there is too little to optimise. The result has no covariances: each window
    knows its own frames alone.
    """
    if not has_enough(log):
        return None
    start = build_problem(camera, log, ObjectEstimates.empty(), config.max_static_per_frame)
    if len(start.tracks) == 0:
        return None
    start = learn_carried(start)
    tracks, rows, held = hold_out(start.tracks, start.sighting_rows, config.held_out_share)
    before = start.with_tracks(tracks, rows)
    problem, n_outliers, costs = before, 0, np.zeros(2)
    windows = list(_windows(before.n_frames, config.partial_window, config.partial_overlap))
    for number, (first, end) in enumerate(windows):
        n_held = 1 if number == 0 else min(config.partial_overlap, end - first - 1)
        problem, cost, left_out = _solve_window(problem, first, end, n_held, config)
        costs += cost
        n_outliers += left_out
        progress(number + 1, len(windows))
    verdicts = judge(before, problem, held, config.guard)
    return as_result(before, problem, verdicts, costs, n_outliers)


def _windows(n_frames: int, size: int, overlap: int) -> list[tuple[int, int]]:
    """First and end of windows that cover all frames; the last may be longer than `size`."""
    step = max(size - overlap, 1)
    starts = list(range(0, max(n_frames - overlap, 1), step))
    return [(first, min(first + size, n_frames)) for first in starts]


def _solve_window(
    problem: BatchProblem, first: int, end: int, n_held: int, config: BatchConfig
) -> tuple[BatchProblem, tuple[float, float], int]:
    """The problem with the frames of one window solved, and those after it led on."""
    part, points = window_of(problem, first, end)
    if len(part.tracks) == 0:
        return problem, (0.0, 0.0), 0
    views = part.views(part.Ts_world_camera, part.Ts_world_object)
    part = part.at(
        part.Ts_world_camera,
        part.Ts_world_object,
        settle_points(part.camera, part.tracks, views, part.points_m),
    )
    graph = pose_graph(part, config, n_held)
    keep_uv = keep_disparity = np.ones(len(part.tracks), bool)
    solution = solve(part, graph, keep_uv, keep_disparity, config.max_steps)
    for _ in range(config.rounds - 1):
        keep_uv, keep_disparity = inliers(solution.residuals)
        solution = solve(solution.problem, graph, keep_uv, keep_disparity, config.max_steps)
    Ts, points_m = problem.Ts_world_camera.copy(), problem.points_m.copy()
    new = solution.problem.Ts_world_camera
    leads_on = new[-1] @ invert_T(Ts[end - 1])
    Ts[end:] = orthonormalise(leads_on @ Ts[end:])
    Ts[first:end] = new
    points_m[points] = solution.problem.points_m
    left_out = int((~keep_uv).sum() + (~keep_disparity).sum())
    return (
        problem.at(Ts, problem.Ts_world_object, points_m),
        (solution.cost_before, solution.cost),
        left_out,
    )


def window_of(problem: BatchProblem, first: int, end: int) -> tuple[BatchProblem, Index]:
    """The static part of a problem in frames `first` to `end`, and which points (Q,) it has.

    Tracks of at least two sightings there; the first of them counts as a place, not as a step.
    """
    tracks = problem.tracks
    inside = (tracks.view >= first) & (tracks.view < end)
    count = np.bincount(tracks.track[inside], minlength=tracks.n_tracks)
    inside &= count[tracks.track] >= 2
    points, track = np.unique(tracks.track[inside], return_inverse=True)
    arrays = {f.name: getattr(tracks, f.name)[inside] for f in fields(tracks)[:7]}
    arrays["view"] = arrays["view"] - first
    arrays["track"] = track.ravel()
    begins = np.r_[True, np.diff(arrays["track"]) != 0][: len(track)]
    arrays["carried"] = np.where(begins, 0.0, arrays["carried"])
    own = slice(first, end)
    part = BatchProblem(
        problem.camera,
        problem.frame_index[own],
        problem.timestamps_s[own],
        problem.Ts_world_camera[own],
        (),
        np.empty((0, 4, 4)),
        problem.points_m[points],
        PointTracks(**arrays, n_tracks=len(points), n_views=end - first),
        problem.sighting_rows[inside],
    )
    return part, points
