"""How much of a sighting's error goes on in the next one, learned from the sightings of a batch.

Owns the one parameter of that noise. What follows from it is in `point_elimination`.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pipelines.backend.batch_problem import BatchProblem
from pipelines.backend.held_out import misses_px
from pipelines.backend.point_elimination import camera_points, settle_points
from pipelines.geometry import MIN_DEPTH_M, exp_se3, pose_jacobian, projection_jacobian
from pipelines.types import Array

_FAR = 8  # frames, over which the growth of errors is measured
_MIN_SAMPLES = 200  # fewer pairs of sightings so far apart say nothing of it
_MOST_SIGHTINGS = 60_000  # more tell it no better
_SETTLING_ROUNDS = 3
_LEAST_CARRIED = 0.05  # nothing at all would count as not followed


def learn_carried(problem: BatchProblem) -> BatchProblem:
    """The same problem with the share of a static sighting's error that goes on in the next one.

    Where points are aligned to their first sight, errors are partly new in every frame; where flow
    or worn patches lead from frame to frame they walk. How much farther errors come apart over some
    frames than over one tells: both are a first-order Markov process. Each pose is moved to where
    it fits its own frame first, or errors of poses would be taken for those of pixels.
    """
    long = _long_tracks(problem)
    far = np.arange(_FAR, len(long.tracks))
    run = np.cumsum(~long.tracks.is_followed)
    far = far[run[far] == run[far - _FAR]]
    if len(far) < _MIN_SAMPLES:
        return problem
    off = _off_at_best_poses(long)
    apart_px = [float(np.median(np.abs(off[far] - off[far - lag]))) for lag in (1, _FAR)]
    if apart_px[0] == 0.0:
        return problem  # nothing ever moves, nor errs
    growth = apart_px[1] / apart_px[0]
    shares = np.linspace(_LEAST_CARRIED, 1.0, 200, endpoint=False)
    expected = np.sqrt((1.0 - shares**_FAR) / (1.0 - shares))
    carried = float(np.interp(growth, expected, shares, right=1.0))
    tracks = problem.tracks
    static = tracks.is_followed & (tracks.view < problem.n_frames)
    # What is told of a step is of the difference of two errors
    sigma = tracks.sigma_uv_px * np.where(static, np.sqrt(0.5 * (1.0 + carried)), 1.0)
    learned = replace(tracks, carried=np.where(static, carried, tracks.carried), sigma_uv_px=sigma)
    return problem.with_tracks(learned, problem.sighting_rows)


def _long_tracks(problem: BatchProblem) -> BatchProblem:
    """The same problem with no more than some of the long static tracks."""
    tracks = problem.tracks
    long = (tracks.lengths > _FAR) & (tracks.view[tracks.starts] < problem.n_frames)
    every = -(-int(tracks.lengths[long].sum()) // _MOST_SIGHTINGS)
    chosen = np.flatnonzero(long)[:: max(every, 1)]
    keep = np.zeros(tracks.n_tracks, bool)
    keep[chosen] = True
    kept = replace(problem, points_m=problem.points_m[keep])
    return kept.with_tracks(tracks.of_tracks(keep), problem.sighting_rows[keep[tracks.track]])


def _off_at_best_poses(problem: BatchProblem) -> Array:
    """(N, 2) pixels by which sightings miss, each for itself, where points and poses have settled.

    In turn: the points for all views, then each view alone for its points.
    """
    camera, tracks = problem.camera, replace(problem.tracks, carried=np.zeros(len(problem.tracks)))
    views = problem.views(problem.Ts_world_camera, problem.Ts_world_object)
    points = problem.points_m
    for _ in range(_SETTLING_ROUNDS):
        points = settle_points(camera, tracks, views, points, steps=2)
        seen = camera_points(tracks, views, points)
        views = views @ exp_se3(_best_pose_steps(problem, seen))
    points = settle_points(camera, tracks, views, points, steps=2)
    return misses_px(camera, tracks.uv_px, camera_points(tracks, views, points))


def _best_pose_steps(problem: BatchProblem, seen: Array) -> Array:
    """(V, 6) right perturbations by which the views best fit their pixels, the points being held.

    seen: (N, 3) the points in the cameras. A miss of more than the usual size counts less.
    """
    tracks = problem.tracks
    off = misses_px(problem.camera, tracks.uv_px, seen)
    J = pose_jacobian(projection_jacobian(problem.camera, seen), seen)[:, :2]
    size = np.linalg.norm(off, axis=1)
    weight = np.minimum(1.0, float(np.median(size)) / np.maximum(size, 1e-12))
    weight[seen[:, 2] < MIN_DEPTH_M] = 0.0
    H, g = np.empty((tracks.n_views, 6, 6)), np.empty((tracks.n_views, 6))
    for i in range(6):
        pull = weight[:, None] * J[:, :, i]
        g[:, i] = np.bincount(tracks.view, (pull * off).sum(1), tracks.n_views)
        for j in range(i + 1):
            products = (pull * J[:, :, j]).sum(1)
            H[:, i, j] = H[:, j, i] = np.bincount(tracks.view, products, tracks.n_views)
    return (np.linalg.pinv(H, hermitian=True) @ g[:, :, None])[:, :, 0]
