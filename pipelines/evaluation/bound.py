"""The Cramer-Rao bound: how far from the best possible a run is, where its noise is known.

Owns the covariances that no unbiased estimator beats on the sightings of a run, and the ratios of
real errors to them. A ratio near 1 is efficient; one well below 1 means that the bound is wrong, or
that the estimator knew more than the sightings say, as a batch does that takes motions as smooth.

The bound of the front-end is causal: a step is known at best as well as all sightings up to its
frame say, with all points and earlier poses unknown too. To take the map's points as known would
give a bound that nothing attains, as they come from the same noisy sightings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from pipelines.backend.batch_problem import BatchProblem, Stretch
from pipelines.backend.batch_solver import adjoint
from pipelines.backend.marginals import PoseCovariances, pose_covariances, step_covariance
from pipelines.backend.object_graph import gauge_graph
from pipelines.backend.point_elimination import Residuals, eliminate_points
from pipelines.backend.point_tracks import Index, PointTracks
from pipelines.evaluation.true_problem import full_weights
from pipelines.geometry import invert_T, rotation_vector
from pipelines.object_types import ObjectEstimates
from pipelines.types import Array

_I6 = np.eye(6)


@dataclass(frozen=True, slots=True)
class CausalBounds:
    """Covariances of steps, given all sightings up to each frame; NaN where there is no step.

    camera_steps: (F, 6, 6) of the right perturbation of inv(X_k-1) X_k. objects: (O, 6, 6) of that
    of inv(L_k-1) H L_k-1, with true poses L: the error of motions in the evaluation.
    """

    camera_steps: Array
    objects: Array


def evaluate_bound(
    problem: BatchProblem,
    Ts_front_end: Array,
    of_front_end: ObjectEstimates,
    Ts_final: Array | None,
    final: ObjectEstimates,
) -> dict[str, Any]:
    """The blocks of all stages. problem: at the truth. Ts_: (F, 4, 4) cameras of its frames.

    Ts_final: after the batch, with its objects; None where there was none.
    """
    causal = causal_bounds(problem)
    errors = camera_step_errors(Ts_front_end, problem)
    blocks = {
        "motion_only_ba": compare(errors, causal.camera_steps),
        "object_motion": compare(object_step_errors(of_front_end, problem), causal.objects),
    }
    if Ts_final is None:
        return blocks
    joint = joint_bounds(problem)
    return blocks | {
        "batch_camera_step": compare(camera_step_errors(Ts_final, problem), joint.camera_steps),
        "batch_camera": compare(camera_pose_errors(Ts_final, problem), joint.cameras),
        "batch_object_motion": compare(object_step_errors(final, problem), joint.steps),
        "batch_object_pose": compare(object_pose_errors(final, problem), joint.objects),
    }


def joint_bounds(problem: BatchProblem) -> PoseCovariances:
    """Covariances of all poses given all sightings. problem: at the truth."""
    return pose_covariances(problem, gauge_graph(problem), full_weights(problem))


def causal_bounds(problem: BatchProblem) -> CausalBounds:
    """Covariances of the steps of cameras and objects. problem: at the truth."""
    views = problem.views(problem.Ts_world_camera, problem.Ts_world_object)
    weights, F = full_weights(problem), problem.n_frames
    pairs = _pair_covariances(problem, slice(0, F), views, weights)
    cameras = np.full((F, 6, 6), np.nan)
    for k in range(1, F):
        cameras[k] = step_covariance(views[k - 1], views[k], pairs[k])
    objects = np.full((len(problem.Ts_world_object), 6, 6), np.nan)
    for stretch in problem.stretches:
        first = F + stretch.first_pose
        of_views = _pair_covariances(problem, slice(first, first + len(stretch)), views, weights)
        for n in range(1, len(stretch)):
            P_prev, P = views[first + n - 1], views[first + n]
            # H = X_k inv(S) inv(X_k-1) with the step S of the view: cameras err too
            J = np.hstack([adjoint(invert_T(P) @ P_prev), -_I6])
            covariance = J @ pairs[stretch.frames[n]] @ J.T + step_covariance(
                P_prev, P, of_views[n]
            )
            A = adjoint(P)
            objects[stretch.first_pose + n] = A @ covariance @ A.T
    return CausalBounds(cameras, objects)


def _pair_covariances(problem: BatchProblem, own: slice, views: Array, weights: Residuals) -> Array:
    """(n, 12, 12) of the poses of views k - 1 and k of one body, given what was seen up to k.

    own: its views, of which the first is held; its entry is NaN.
    """
    tracks = problem.tracks
    inside = (tracks.view >= own.start) & (tracks.view < own.stop)
    rows = np.flatnonzero(inside)
    n = own.stop - own.start
    view, track = tracks.view[rows] - own.start, tracks.track[rows]
    first, last = (np.full(tracks.n_tracks, fill) for fill in (n, -1))
    np.minimum.at(first, track, view)
    np.maximum.at(last, track, view)
    ended = np.zeros((6 * n, 6 * n))  # what is known by tracks that will not be seen again
    pairs = np.full((n, 12, 12), np.nan)
    for k in range(1, n):
        open_ = (first[track] < k) & (last[track] >= k) & (view <= k)
        closing = open_ & (last[track] == k)
        finished = _information(problem, rows[closing], own, views, weights)
        H = ended + finished + _information(problem, rows[open_ & ~closing], own, views, weights)
        ended += finished
        pairs[k] = 0.0
        known = H[6 : 6 * (k + 1), 6 : 6 * (k + 1)]
        last_two = np.eye(len(known))[:, -12:]
        size = last_two.shape[1]
        pairs[k, -size:, -size:] = np.linalg.lstsq(known, last_two, rcond=None)[0][-size:]
    return pairs


def _information(
    problem: BatchProblem, rows: Index, own: slice, views: Array, weights: Residuals
) -> Array:
    """(6 n, 6 n) what some sightings say of the views `own`, their points being unknown."""
    n = own.stop - own.start
    H = np.zeros((n, 6, n, 6))
    if len(rows) == 0:
        return H.reshape(6 * n, 6 * n)
    tracks = problem.tracks
    points, track = np.unique(tracks.track[rows], return_inverse=True)
    arrays = {f.name: getattr(tracks, f.name)[rows] for f in fields(tracks)[:7]}
    arrays["view"], arrays["track"] = arrays["view"] - own.start, track.ravel()
    part = PointTracks(**arrays, n_tracks=len(points), n_views=n)
    residuals = Residuals(
        weights.uv[rows],
        weights.disparity[rows],
        weights.weight_uv[rows],
        weights.weight_disparity[rows],
        0.0,
    )
    system = eliminate_points(
        problem.camera, part, views[own], problem.points_m[points], residuals, damping=0.0
    )
    off = system.first != system.second
    H[system.first, :, system.second, :] = system.blocks
    H[system.second[off], :, system.first[off], :] = system.blocks[off].transpose(0, 2, 1)
    return H.reshape(6 * n, 6 * n)


def compare(errors: Array, covariances: Array) -> dict[str, Any]:
    """Errors (N, 4, 4) beside their bounds (N, 6, 6): RMSE, root mean square bound, and ratio.

    The ratio is the root mean square of each error over its own bound: so what hardly anything is
    known of does not outweigh the rest. Where either is not known, neither counts.
    """
    known = np.isfinite(errors).all((1, 2)) & np.isfinite(covariances).all((1, 2))
    E, variance = errors[known], np.diagonal(covariances[known], axis1=1, axis2=2)
    block: dict[str, Any] = {"n": int(known.sum())}
    turns, ways = np.degrees(rotation_vector(E)), E[:, :3, 3]
    sizes = (
        ("trans", "m", ways, variance[:, 3:]),
        ("rot", "deg", turns, np.degrees(1.0) ** 2 * variance[:, :3]),
    )
    for name, unit, values, squares in sizes:
        errors2, bounds2 = (values**2).sum(1), squares.sum(1)
        columns = {f"rmse_{unit}": errors2, f"bound_{unit}": bounds2, "ratio": errors2 / bounds2}
        for key, column in columns.items():
            block[f"{name}_{key}"] = float(np.sqrt(column.mean())) if len(E) else None
    return block


def camera_step_errors(Ts_est: Array, problem: BatchProblem) -> Array:
    """(F, 4, 4) inv(step of the estimate) @ true step, NaN at the first. Ts_est: (F, 4, 4)."""
    Ts = problem.Ts_world_camera
    errors = np.full_like(Ts, np.nan)
    errors[1:] = invert_T(invert_T(Ts_est[:-1]) @ Ts_est[1:]) @ (invert_T(Ts[:-1]) @ Ts[1:])
    return errors


def camera_pose_errors(Ts_est: Array, problem: BatchProblem) -> Array:
    """(F, 4, 4) of poses with the first held, which has no error. Ts_est: (F, 4, 4)."""
    Ts = problem.Ts_world_camera
    held = Ts[0] @ invert_T(Ts_est[0])
    errors = invert_T(Ts) @ held @ Ts_est
    errors[0] = np.nan
    return errors


def object_step_errors(objects: ObjectEstimates, problem: BatchProblem) -> Array:
    """(O, 4, 4) of motions H in the true object's frame, NaN at the first of each stretch."""
    errors = np.full_like(problem.Ts_world_object, np.nan)
    for stretch, L_prev, L, out in _steps(problem, errors):
        B = invert_T(L_prev) @ objects.Hs_world_curr_prev[stretch.rows[1:]] @ L_prev
        out[1:] = invert_T(B) @ (invert_T(L_prev) @ L)
    return errors


def object_pose_errors(objects: ObjectEstimates, problem: BatchProblem) -> Array:
    """(O, 4, 4) of poses L in the true object's frame, the first of each stretch being held."""
    errors = np.full_like(problem.Ts_world_object, np.nan)
    for stretch, L_prev, L, out in _steps(problem, errors):
        L_est = objects.Ts_world_object[stretch.rows[1:]]
        begin = invert_T(objects.Hs_world_curr_prev[stretch.rows[1]]) @ L_est[0]
        out[1:] = invert_T(L) @ L_est @ invert_T(begin) @ L_prev[0]
    return errors


def _steps(problem: BatchProblem, errors: Array) -> Sequence[tuple[Stretch, Array, Array, Array]]:
    """Each stretch with its true poses before and after its steps, and its part of `errors`."""
    parts = []
    for stretch in problem.stretches:
        poses = problem.Ts_world_object[stretch.poses]
        parts.append((stretch, poses[:-1], poses[1:], errors[stretch.poses]))
    return parts
