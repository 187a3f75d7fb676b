"""Levenberg-Marquardt on a batch: gtsam's graph of poses, with all points eliminated beforehand.

Owns the loop, its stop and how what the points say of the views enters gtsam's graph. The loop is
driven from Python, as gtsam's own calls each custom factor at a cost that grows with the values.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.batch_problem import BatchProblem
from pipelines.backend.object_graph import PoseFactors, camera_key, object_key
from pipelines.backend.point_elimination import (
    Residuals,
    ViewSystem,
    eliminate_points,
    evaluate,
    sum_blocks,
)
from pipelines.backend.point_tracks import Index
from pipelines.geometry import invert_T, skew
from pipelines.types import Array

if TYPE_CHECKING:
    import gtsam

_LAMBDA, _LEAST_LAMBDA, _MOST_LAMBDA = 1e-4, 1e-6, 1e6
_RELATIVE_STOP, _ABSOLUTE_STOP = 1e-4, 1e-3  # of the cost's fall in one step
_ROUGH_STOP = 0.05  # of the same, where outliers are all that is asked
_ZERO = np.zeros((6, 6)), np.zeros(6)

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class Solution:
    """Where a batch has come to. residuals: there, of the problem's tracks. steps: taken."""

    problem: BatchProblem
    residuals: Residuals
    cost_before: float
    cost: float
    steps: int


def solve(
    problem: BatchProblem,
    graph: gtsam.NonlinearFactorGraph | PoseFactors,
    keep_uv: NDArray[np.bool_],
    keep_disparity: NDArray[np.bool_],
    max_steps: int,
    after_step: Callable[[], None] = lambda: None,
    *,
    is_rough: bool = False,
) -> Solution:
    """The problem at its optimum. graph: factors between poses. keep_*: (N,) as of `evaluate`.

    is_rough: near enough to it to tell outliers.
    """
    least_fall = _ROUGH_STOP if is_rough else _RELATIVE_STOP
    values = to_values(problem)
    ordering = make_ordering(problem)

    def cost_at(at: BatchProblem, values: gtsam.Values) -> tuple[Residuals, float]:
        views = at.views(at.Ts_world_camera, at.Ts_world_object)
        residuals = evaluate(at.camera, at.tracks, views, at.points_m, keep_uv, keep_disparity)
        return residuals, residuals.cost + graph.error(values)

    residuals, cost = cost_at(problem, values)
    before, damping, steps = cost, _LAMBDA, 0
    for _ in range(max_steps):
        views = problem.views(problem.Ts_world_camera, problem.Ts_world_object)
        system = eliminate_points(
            problem.camera, problem.tracks, views, problem.points_m, residuals, damping
        )
        linear = linear_graph(problem, graph, values, system, views, damping)
        try:
            delta = linear.optimize(ordering)
        except RuntimeError:  # gtsam finds a pose that hardly anything holds: a shorter step
            steps, damping = steps + 1, damping * 10.0
            after_step()
            if damping > _MOST_LAMBDA:
                break
            continue
        moved, moved_values = _moved(problem, values, delta, system, views)
        residuals_new, cost_new = cost_at(moved, moved_values)
        steps += 1
        after_step()
        if cost_new > cost:
            damping *= 10.0
            if damping > _MOST_LAMBDA:
                break
            continue
        fall, damping = cost - cost_new, max(damping / 10.0, _LEAST_LAMBDA)
        problem, values, residuals, cost = moved, moved_values, residuals_new, cost_new
        if fall < max(least_fall * cost, _ABSOLUTE_STOP):
            break
    return Solution(problem, residuals, before, cost, steps)


def to_values(problem: BatchProblem) -> gtsam.Values:
    """All poses as gtsam holds them."""
    import gtsam

    values = gtsam.Values()
    for k, T in enumerate(problem.Ts_world_camera):
        values.insert(camera_key(k), gtsam.Pose3(T))
    for o, T in enumerate(problem.Ts_world_object):
        values.insert(object_key(o), gtsam.Pose3(T))
    return values


def make_ordering(problem: BatchProblem) -> gtsam.Ordering:
    """Objects first, each along its time, then cameras along theirs.

    Better than METIS here: an object is tied to the cameras of its time alone, which the static
    points have tied to each other already.
    """
    import gtsam

    ordering = gtsam.Ordering()
    for o in range(len(problem.Ts_world_object)):
        ordering.push_back(object_key(o))
    for k in range(problem.n_frames):
        ordering.push_back(camera_key(k))
    return ordering


def linear_graph(
    problem: BatchProblem,
    graph: gtsam.NonlinearFactorGraph | PoseFactors,
    values: gtsam.Values,
    system: ViewSystem,
    views: Array,
    damping: float,
) -> gtsam.GaussianFactorGraph:
    """The linearised graph of all poses: factors between them, and what the points say of them."""
    import gtsam

    linear = graph.linearize(values)
    F, n_poses = problem.n_frames, len(problem.Ts_world_object)
    keys = [camera_key(k) for k in range(F)] + [object_key(o) for o in range(n_poses)]
    first, second, blocks, gradient = pose_system(problem, system, views)
    diagonal = first == second
    own = np.zeros((F + n_poses, 6, 6))
    own[first[diagonal]] = blocks[diagonal]
    corner = np.arange(6)
    own[:, corner, corner] += damping * own[:, corner, corner] + 1e-9
    for key, G, g in zip(keys, own, gradient, strict=True):
        linear.add(gtsam.HessianFactor(key, G, g, 0.0))
    zero, none = _ZERO
    for a, b, G in zip(first[~diagonal], second[~diagonal], blocks[~diagonal], strict=True):
        linear.add(gtsam.HessianFactor(keys[a], keys[b], zero, G, none, zero, none, 0.0))
    return linear


def pose_system(
    problem: BatchProblem, system: ViewSystem, views: Array
) -> tuple[Index, Index, Array, Array]:
    """The system of the views as one of the poses, cameras before object poses.

    As P = inv(L) X, a view moves with its camera and against its object: dP = dX - Ad(inv(P)) dL.
    Returns pairs first <= second, their blocks (M, 6, 6), and gradient (F + O, 6).
    P could be a variable of its own, tied to X and L by a stiff factor; to substitute it is exact,
    and leaves half as many poses.
    """
    F, n = problem.n_frames, len(views)
    cameras, A = problem.camera_of_view, -adjoint(invert_T(views))
    A_t = A.transpose(0, 2, 1)
    gradient = np.zeros((n, 6))
    np.add.at(gradient, cameras, system.gradient)
    gradient[F:] = np.einsum("vij,vj->vi", A_t[F:], system.gradient[F:])
    a, b, S = system.first, system.second, system.blocks
    moving = a >= F  # both views are of the same body
    p, q, S_pq = a[moving], b[moving], S[moving]
    off = p != q
    back = (A_t[p] @ S_pq).transpose(0, 2, 1)  # of (camera q, object p), the other way round
    rows = [
        (a[~moving], b[~moving], S[~moving]),
        (cameras[p], cameras[q], S_pq),
        (p, q, A_t[p] @ S_pq @ A[q]),
        (cameras[p], q, S_pq @ A[q]),
        (cameras[q][off], p[off], back[off]),
    ]
    first, second, blocks = (np.concatenate(arrays) for arrays in zip(*rows, strict=True))
    return *sum_blocks(first, second, blocks, n), gradient


def adjoint(Ts: Array) -> Array:
    """Ad (..., 6, 6) of motions (..., 4, 4), order [omega, v]: T exp(x) = exp(Ad x) T."""
    R = Ts[..., :3, :3]
    Ad = np.zeros((*Ts.shape[:-2], 6, 6))
    Ad[..., :3, :3] = Ad[..., 3:, 3:] = R
    Ad[..., 3:, :3] = skew(Ts[..., :3, 3]) @ R
    return Ad


def _moved(
    problem: BatchProblem,
    values: gtsam.Values,
    delta: gtsam.VectorValues,
    system: ViewSystem,
    views: Array,
) -> tuple[BatchProblem, gtsam.Values]:
    """All poses and points after a step, and the poses once more as gtsam holds them."""
    F, n_poses = problem.n_frames, len(problem.Ts_world_object)
    steps = np.array(
        [delta.at(camera_key(k)) for k in range(F)]
        + [delta.at(object_key(o)) for o in range(n_poses)]
    )
    moved = values.retract(delta)
    of_views = steps[problem.camera_of_view]
    A = adjoint(invert_T(views[F:]))
    of_views[F:] -= np.einsum("oij,oj->oi", A, steps[F:])
    Xs = np.array([moved.atPose3(camera_key(k)).matrix() for k in range(F)])
    Ls = np.array([moved.atPose3(object_key(o)).matrix() for o in range(n_poses)]).reshape(-1, 4, 4)
    return problem.at(Xs, Ls, problem.points_m + system.step_points(of_views)), moved
