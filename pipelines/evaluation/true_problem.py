"""The sightings of a run, set at the truth and weighed by the noise that their inputs really have.

Owns the step from known noise of dense inputs to that of a sighting, and which true object each
estimated one is. What follows from it is in `bound`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.batch_problem import BatchProblem, build_problem
from pipelines.backend.point_elimination import Residuals, camera_points, settle_points
from pipelines.backend.point_tracks import PointTracks
from pipelines.evaluation.object_matching import match_objects
from pipelines.evaluation.object_truth import ObjectLimits, RunFrames, true_steps
from pipelines.frame_observations import FrameObservations, Sightings
from pipelines.geometry import MIN_DEPTH_M
from pipelines.object_types import ObjectEstimates
from pipelines.types import Array, KnownNoise, ObjectTruth, StereoCamera

_BIRTH_SHARE = 0.1  # of the flow's noise: a point is by definition where it was first seen
_PLANE_PIXELS, _PLANE_SQUARES = 25.0, 50.0  # of the 5 x 5 window of a disparity: n, and sum of du^2


@dataclass(frozen=True, slots=True)
class TrueObjects:
    """Which true object each estimated row is, for M rows.

    Ts_before, Ts_now: (M, 4, 4) true poses in the processed frame before and in the row's own, NaN
    where the row shows no object, or another one than most rows of its id do.
    """

    Ts_before: Array
    Ts_now: Array


def find_true_objects(
    objects: ObjectEstimates, truth: ObjectTruth, frames: RunFrames, limits: ObjectLimits
) -> TrueObjects:
    """The true objects of all rows, matched as every figure on objects has it."""
    truth = truth[np.isin(truth.frame_index, frames.index)]
    steps = true_steps(truth, frames, limits)
    row = match_objects(
        objects, truth, steps.is_judged, limits.min_overlap, limits.min_pixels
    ).truth_row
    matched = row >= 0
    matched[matched] &= steps.previous_row[row[matched]] >= 0
    for own_id in np.unique(objects.object_id[matched]):
        own = np.flatnonzero(matched & (objects.object_id == own_id))
        ids, counts = np.unique(truth.object_id[row[own]], return_counts=True)
        matched[own[truth.object_id[row[own]] != ids[counts.argmax()]]] = False
    Ts_before, Ts_now = (np.full((len(objects), 4, 4), np.nan) for _ in range(2))
    Ts_now[matched] = truth.Ts_world_object[row[matched]]
    Ts_before[matched] = truth.Ts_world_object[steps.previous_row[row[matched]]]
    return TrueObjects(Ts_before, Ts_now)


def build_true_problem(
    camera: StereoCamera,
    log: Sequence[FrameObservations],
    objects: ObjectEstimates,
    true_objects: TrueObjects,
    frames: RunFrames,
    noise: KnownNoise,
) -> BatchProblem:
    """The batch's problem with true poses, sigmas as known, and points where these put them.

    objects: the front-end's rows. A stretch has the frame of its true object.
    """
    pose_at = dict(zip(frames.index.tolist(), frames.Ts_world_camera, strict=True))
    nowhere = np.full((4, 4), np.nan)
    at_truth = []
    for entry in log:
        T = pose_at.get(entry.frame_index, nowhere)
        is_known = entry.is_tracked and bool(np.isfinite(T).all())
        at_truth.append(replace(entry, T_world_camera=T, is_tracked=is_known))
    known = np.isfinite(true_objects.Ts_now).all((1, 2))
    Hs = objects.Hs_world_curr_prev.copy()
    Hs[~known] = np.nan
    problem = build_problem(camera, at_truth, replace(objects, Hs_world_curr_prev=Hs))
    Ls = problem.Ts_world_object.copy()
    for stretch in problem.stretches:
        own = Ls[stretch.poses]
        own[1:] = true_objects.Ts_now[stretch.rows[1:]]
        own[0] = true_objects.Ts_before[stretch.rows[1]]
    problem = problem.at(problem.Ts_world_camera, Ls, problem.points_m)
    seen = Sightings.concatenate(*(entry.sightings for entry in log))[problem.sighting_rows]
    problem = replace(problem, tracks=known_sigmas(problem.tracks, seen.sigma_uv_px, noise))
    views = problem.views(problem.Ts_world_camera, Ls)
    # The rows' own places are the front-end's: the points begin where its cameras saw them
    start = np.einsum("nij,nj->ni", views[problem.tracks.view][:, :3, :3], seen.position_m)
    start += views[problem.tracks.view][:, :3, 3]
    last = problem.tracks.starts + problem.tracks.lengths - 1
    points_m = settle_points(camera, problem.tracks, views, start[last])
    return problem.at(problem.Ts_world_camera, Ls, points_m)


def known_sigmas(tracks: PointTracks, recorded_uv_px: Array, noise: KnownNoise) -> PointTracks:
    """The tracks with the standard deviations that known noise gives their sightings.

    A followed pixel is read from the flow between four pixels, a disparity from a plane through 25.
    Only a place found again by its descriptor, which is hardly worth anything beside these, has the
    standard deviation that was recorded, (N,).
    """
    uv = tracks.uv_px
    part = np.roll(uv - np.floor(uv), 1, axis=0)  # of a pixel, where the flow was read
    step = noise.flow_px * np.sqrt((part**2 + (1.0 - part) ** 2).prod(axis=1))
    is_first = np.zeros(len(tracks), bool)
    is_first[tracks.starts] = True
    sigma_uv = np.where(tracks.is_followed, step, recorded_uv_px)
    sigma_uv[is_first] = _BIRTH_SHARE * noise.flow_px
    off = ((uv - np.rint(uv)) ** 2).sum(axis=1)
    gain = np.sqrt(1.0 / _PLANE_PIXELS + off / _PLANE_SQUARES)
    return tracks.with_sigmas(sigma_uv, noise.disparity_px * gain)


def full_weights(problem: BatchProblem) -> Residuals:
    """Residuals of no size with full weight wherever something was seen: those of the truth."""
    tracks = problem.tracks
    views = problem.views(problem.Ts_world_camera, problem.Ts_world_object)
    front = camera_points(tracks, views, problem.points_m)[:, 2] > MIN_DEPTH_M
    known: NDArray[np.bool_] = np.isfinite(tracks.disparity_px) & front
    N = len(tracks)
    return Residuals(np.zeros((N, 2)), np.zeros(N), front.astype(float), known.astype(float), 0.0)
