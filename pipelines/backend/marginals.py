"""Covariances of final poses: gtsam's marginals of the batch at its optimum.

Owns their axes. Points are integrated out before, as in the solver.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from pipelines.backend.batch_problem import BatchProblem, Stretch
from pipelines.backend.batch_solver import linear_graph, make_ordering, to_values
from pipelines.backend.object_graph import camera_key, object_key
from pipelines.backend.point_elimination import Residuals, eliminate_points
from pipelines.types import Array

if TYPE_CHECKING:
    import gtsam

_AT_A_TIME = 100  # poses of one call, each of which walks the whole tree


@dataclass(frozen=True, slots=True)
class PoseCovariances:
    """Covariances of right perturbations [omega rad, v m].

    cameras: (F, 6, 6). objects: (O, 6, 6), the first pose of a stretch being held. steps: (O, 6, 6)
    of the difference of an object's perturbation and that one frame before, which is the left
    perturbation of its motion H carried into the object's axes; NaN at the first of a stretch.
    """

    cameras: Array
    objects: Array
    steps: Array


def pose_covariances(
    problem: BatchProblem, graph: gtsam.NonlinearFactorGraph, residuals: Residuals
) -> PoseCovariances:
    """Marginals of all poses. graph: the gtsam factors between poses. residuals: at the optimum."""
    views = problem.views(problem.Ts_world_camera, problem.Ts_world_object)
    system = eliminate_points(
        problem.camera, problem.tracks, views, problem.points_m, residuals, damping=0.0
    )
    linear = linear_graph(problem, graph, to_values(problem), system, views, damping=0.0)
    tree = linear.eliminateMultifrontal(make_ordering(problem))
    cameras = np.empty((problem.n_frames, 6, 6))
    for begin in range(0, problem.n_frames, _AT_A_TIME):
        block = range(begin, min(begin + _AT_A_TIME, problem.n_frames))
        joint = tree.jointMarginalCovariance([camera_key(k) for k in block])
        for k in block:
            cameras[k] = joint.at(camera_key(k), camera_key(k))
    objects = np.full((len(problem.Ts_world_object), 6, 6), np.nan)
    steps = np.full_like(objects, np.nan)
    for blocks in _together(problem.stretches):
        joint = tree.jointMarginalCovariance([object_key(o) for block in blocks for o in block])
        for block in blocks:
            _fill(joint, block, objects, steps)
    return PoseCovariances(cameras, objects, steps)


def _together(stretches: Sequence[Stretch]) -> Iterator[list[range]]:
    """Poses of all stretches in groups for one call each; blocks of a stretch share a pose."""
    group: list[range] = []
    for stretch in stretches:
        first, end = stretch.poses.start, stretch.poses.stop
        for begin in range(first, end, _AT_A_TIME):
            block = range(max(begin - 1, first), min(begin + _AT_A_TIME, end))
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
