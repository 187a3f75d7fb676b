"""Covariances of final poses: gtsam's marginals of the batch at its optimum.

Owns their axes. Points are integrated out before, as in the solver.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipelines.backend.batch_problem import BatchProblem, Stretch
from pipelines.backend.batch_solver import adjoint, linear_graph, make_ordering, to_values
from pipelines.backend.object_graph import PoseFactors, camera_key, object_key
from pipelines.backend.point_elimination import Residuals, eliminate_points
from pipelines.geometry import invert_T
from pipelines.types import Array

if TYPE_CHECKING:
    import gtsam

_AT_A_TIME = 100  # poses of one call, each of which walks the whole tree


@dataclass(frozen=True, slots=True)
class PoseCovariances:
    """Covariances of right perturbations [omega rad, v m].

    cameras: (F, 6, 6). camera_steps: (F, 6, 6) of inv(X_k-1) X_k, NaN at the first. objects:
    (O, 6, 6), the first pose of a stretch being held. steps: (O, 6, 6) of the difference of an
    object's perturbation and that one frame before, which is the left perturbation of its motion H
    carried into the object's axes; NaN at the first of a stretch.
    """

    cameras: Array
    camera_steps: Array
    objects: Array
    steps: Array


def pose_covariances(
    problem: BatchProblem, graph: PoseFactors, residuals: Residuals
) -> PoseCovariances:
    """Marginals of all poses. graph: the gtsam factors between poses. residuals: at the optimum."""
    views = problem.views(problem.Ts_world_camera, problem.Ts_world_object)
    system = eliminate_points(
        problem.camera, problem.tracks, views, problem.points_m, residuals, damping=0.0
    )
    linear = linear_graph(problem, graph, to_values(problem), system, views, damping=0.0)
    tree = linear.eliminateMultifrontal(make_ordering(problem))
    cameras, camera_steps = (np.full((problem.n_frames, 6, 6), np.nan) for _ in range(2))
    for block in _blocks(0, problem.n_frames):
        joint = tree.jointMarginalCovariance([camera_key(k) for k in block])
        for k in block:
            cameras[k] = joint.at(camera_key(k), camera_key(k))
        for k in block[1:]:
            cross = joint.at(camera_key(k - 1), camera_key(k))
            pair = np.block([[cameras[k - 1], cross], [cross.T, cameras[k]]])
            T_prev, T = problem.Ts_world_camera[k - 1 : k + 1]
            camera_steps[k] = step_covariance(T_prev, T, pair)
    objects = np.full((len(problem.Ts_world_object), 6, 6), np.nan)
    steps = np.full_like(objects, np.nan)
    for blocks in _together(problem.stretches):
        joint = tree.jointMarginalCovariance([object_key(o) for block in blocks for o in block])
        for block in blocks:
            _fill(joint, block, objects, steps)
    return PoseCovariances(cameras, camera_steps, objects, steps)


def step_covariance(T_prev: Array, T: Array, pair: Array) -> Array:
    """(6, 6) of the right perturbation of inv(T_prev) T, by the joint (12, 12) of both poses'."""
    J = np.hstack([-adjoint(invert_T(T) @ T_prev), np.eye(6)])
    return J @ pair @ J.T


def _blocks(first: int, end: int) -> Iterator[range]:
    """Poses from `first` to `end` in blocks for one call each, which share a pose."""
    for begin in range(first, end, _AT_A_TIME):
        yield range(max(begin - 1, first), min(begin + _AT_A_TIME, end))


def _together(stretches: Sequence[Stretch]) -> Iterator[list[range]]:
    """Poses of all stretches in groups for one call each."""
    group: list[range] = []
    for stretch in stretches:
        for block in _blocks(stretch.poses.start, stretch.poses.stop):
            if group and sum(map(len, group)) + len(block) > _AT_A_TIME:
                yield group
                group = []
            group.append(block)
    if group:
        yield group


def _fill(joint: gtsam.JointMarginal, block: range, objects: Array, steps: Array) -> None:
    """Marginals of the poses of one block of a stretch into the arrays (O, 6, 6)."""
    for o in block:
        key = object_key(o)
        objects[o] = joint.at(key, key)
        if o > block[0]:
            before = object_key(o - 1)
            cross = joint.at(before, key)
            steps[o] = objects[o] + joint.at(before, before) - cross - cross.T
