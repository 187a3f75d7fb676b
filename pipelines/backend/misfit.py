"""How badly sightings fit a problem's poses, and what that says of their noise.

Owns the squared errors of objects that verdicts and weights are made of. Solves nothing.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.batch_problem import BatchProblem
from pipelines.backend.point_elimination import evaluate, settle_points
from pipelines.types import Array

_BEHIND = 100.0  # squared standard deviations that a point behind the camera counts as
_NOISY = 2.0  # times the median misfit of all objects, from which on a view of one is noisy
_MAX_NOISE_FACTOR = 4.0  # of its standard deviations then


def object_misfits(problem: BatchProblem) -> Array:
    """(M,) squared whitened residuals under Huber's kernel of all sightings of objects, in order.

    With points settled for the poses.
    """
    on_object = problem.tracks.view[problem.tracks.starts] >= problem.n_frames
    tracks = problem.tracks.of_tracks(on_object)
    views = problem.views(problem.Ts_world_camera, problem.Ts_world_object)
    points = settle_points(problem.camera, tracks, views, problem.points_m[on_object])
    every = np.ones(len(tracks), bool)
    seen = evaluate(problem.camera, tracks, views, points, every, every)
    w_uv, w_disparity = seen.weight_uv, seen.weight_disparity
    squares = (seen.uv**2).sum(1) * w_uv * (2.0 - w_uv)
    squares += seen.disparity**2 * w_disparity * (2.0 - w_disparity)
    return np.where(w_uv > 0.0, squares, _BEHIND)


def allow_for_noisy_views(problem: BatchProblem) -> BatchProblem:
    """The same problem with less weight on views of objects whose sightings fit badly as a whole.

    An object that is being covered, or lies in the shade, drags all its points along, and no robust
    kernel sees that by each of them alone. The median of its misfits says by how much: against that
    of all objects, at the front-end's motions.
    """
    view = problem.tracks.view - problem.n_frames
    on_object = view >= 0
    if not on_object.any():
        return problem
    squares = object_misfits(problem)
    share = _medians(squares, view[on_object], len(problem.Ts_world_object))
    share /= max(float(np.median(squares)), 1e-12)
    factor = np.where(share > _NOISY, np.minimum(np.sqrt(share), _MAX_NOISE_FACTOR), 1.0)
    by_sighting = np.ones(len(problem.tracks))
    by_sighting[on_object] = factor[view[on_object]]
    tracks = problem.tracks
    sigmas_px = (tracks.sigma_uv_px * by_sighting, tracks.sigma_disparity_px * by_sighting)
    return problem.with_tracks(tracks.with_sigmas(*sigmas_px), problem.sighting_rows)


def _medians(values: Array, group: NDArray[np.int64], n: int) -> Array:
    """(n,) medians of the values (N,) of each group; 0 where there are none."""
    order = np.lexsort((values, group))
    sizes = np.bincount(group, minlength=n)
    starts = np.cumsum(sizes) - sizes
    found = sizes > 0
    medians = np.zeros(n)
    medians[found] = values[order][(starts + sizes // 2)[found]]
    return medians
