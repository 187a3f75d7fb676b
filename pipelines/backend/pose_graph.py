"""The pose graph: keyframes tied to their neighbours and, by loops, to places seen before.

Owns its edges and their solution by gtsam. What is left of the drift is spread over the loop; full
bundle adjustment follows.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.loop_detection import LoopClosure
from pipelines.geometry import invert_T
from pipelines.mapping.correction import MapCorrection
from pipelines.mapping.sparse_map import SparseMap
from pipelines.types import Array

_STRONG = 3  # covisible keyframes that each is tied to, besides the one before it
# Of one step between neighbours; only their ratio counts, and it is about that of real drift
_SIGMA_ROTATION_RAD, _SIGMA_TRANSLATION_M = 0.001, 0.01
_HELD = 1e-6  # rad and m, of the first pose
_ITERATIONS = 50


@dataclass(frozen=True, slots=True)
class PoseGraph:
    """K poses (K, 4, 4) and E edges: T_i_j (E, 4, 4), p_i = T @ p_j, between rows i and j (E,)."""

    Ts_world_camera: Array
    i: NDArray[np.int64]
    j: NDArray[np.int64]
    Ts_i_j: Array


def build_pose_graph(sparse_map: SparseMap, loops: list[LoopClosure]) -> PoseGraph:
    """All keyframes, tied as they lie to the ones before and the most covisible; and the loops."""
    Ts = np.stack([keyframe.T_world_camera for keyframe in sparse_map.keyframes])
    pairs = {(k - 1, k) for k in range(1, len(Ts))}
    for k in range(len(Ts)):
        pairs.update((int(n), k) for n in sparse_map.covisible_keyframes(k)[:_STRONG] if n < k)
    edges = [(i, j, invert_T(Ts[i]) @ Ts[j]) for i, j in sorted(pairs)]
    edges += [
        (loop.place, loop.keyframe, invert_T(Ts[loop.place]) @ loop.T_world_camera)
        for loop in loops
    ]
    return PoseGraph(
        Ts,
        np.array([i for i, _, _ in edges], np.int64),
        np.array([j for _, j, _ in edges], np.int64),
        np.stack([T for _, _, T in edges]),
    )


def solve_pose_graph(graph: PoseGraph) -> Array:
    """Poses (K, 4, 4) that fit all edges best; the first is held."""
    import gtsam
    from gtsam.symbol_shorthand import X

    sigmas = np.repeat([_SIGMA_ROTATION_RAD, _SIGMA_TRANSLATION_M], 3)
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, T in enumerate(graph.Ts_world_camera):
        values.insert(X(k), gtsam.Pose3(T))
    held = gtsam.noiseModel.Isotropic.Sigma(6, _HELD)
    factors.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(graph.Ts_world_camera[0]), held))
    for i, j, T in zip(graph.i.tolist(), graph.j.tolist(), graph.Ts_i_j, strict=True):
        factors.add(gtsam.BetweenFactorPose3(X(i), X(j), gtsam.Pose3(T), noise))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setMaxIterations(_ITERATIONS)
    found = gtsam.LevenbergMarquardtOptimizer(factors, values, parameters).optimize()
    return np.stack([found.atPose3(X(k)).matrix() for k in range(len(graph.Ts_world_camera))])


def loop_correction(graph: PoseGraph, Ts_new: Array, loop: LoopClosure) -> MapCorrection:
    """The solution as a correction of the map: points go with their first keyframes.

    The loop's keyframe then sees the points of the place, too.
    """
    rows = np.arange(len(Ts_new))
    return MapCorrection(
        rows,
        graph.Ts_world_camera,
        Ts_new,
        np.empty(0, np.int64),
        np.empty((0, 3)),
        (loop.keyframe, loop.tracks),
    )
