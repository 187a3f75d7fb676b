"""gtsam factors between poses: what holds the gauge, and what objects may do between frames.

Owns the smoothness of consecutive object motions, the planar option and the keys of poses. Points
are not its matter.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.batch_problem import BatchProblem, Stretch
from pipelines.config import BatchConfig
from pipelines.types import Array

if TYPE_CHECKING:
    import gtsam

_GAUGE_RAD, _GAUGE_M = 1e-6, 1e-6  # of the poses that hold the gauge
_CAUCHY = 3.5  # standard deviations: a jolt of the truth (a kerb, a collision) must stay one
ROAD_VEHICLES = ("car", "truck", "bus", "motorcycle", "bicycle", "van", "tram")


def camera_key(k: int) -> int:
    """Of camera k."""
    import gtsam

    return int(gtsam.symbol("x", k))


def object_key(o: int) -> int:
    """Of object pose o."""
    import gtsam

    return int(gtsam.symbol("l", o))


class PoseFactors:
    """Factors between poses in parts, each seen with its own poses alone.

    gtsam hands every custom factor a copy of all values: with those of a whole run its cost would
    grow with the square of the run's length.
    """

    def __init__(self) -> None:
        self._parts: list[tuple[gtsam.NonlinearFactorGraph, list[int]]] = []

    def add_part(self, graph: gtsam.NonlinearFactorGraph, keys: list[int]) -> None:
        """Factors between these poses."""
        self._parts.append((graph, keys))

    def error(self, values: gtsam.Values) -> float:
        """Of all parts, as gtsam's graph says it."""
        return float(sum(graph.error(_chosen(values, keys)) for graph, keys in self._parts))

    def linearize(self, values: gtsam.Values) -> gtsam.GaussianFactorGraph:
        """All parts, as gtsam's graph does it."""
        import gtsam

        linear = gtsam.GaussianFactorGraph()
        for graph, keys in self._parts:
            linear.push_back(graph.linearize(_chosen(values, keys)))
        return linear


def _chosen(values: gtsam.Values, keys: list[int]) -> gtsam.Values:
    import gtsam

    chosen = gtsam.Values()
    for key in keys:
        chosen.insert(key, values.atPose3(key))
    return chosen


def pose_graph(problem: BatchProblem, config: BatchConfig, n_held: int = 1) -> PoseFactors:
    """Priors on the first cameras and on the first pose of each stretch, and smoothness.

    n_held: how many cameras are held where they are.
    """
    import gtsam

    factors = gauge_graph(problem, n_held)
    for stretch in problem.stretches:
        graph, o = gtsam.NonlinearFactorGraph(), stretch.first_pose
        times = problem.timestamps_s[stretch.frames]
        for n in range(2, len(stretch)):
            graph.add(_smoothness(o + n, np.diff(times[n - 2 : n + 1]), config))
        if config.planar_sigma > 0.0 and stretch.class_name in ROAD_VEHICLES:
            _add_planar(graph, problem, stretch, config.planar_sigma)
        factors.add_part(graph, [object_key(o + n) for n in range(len(stretch))])
    return factors


def gauge_graph(problem: BatchProblem, n_held: int = 1) -> PoseFactors:
    """The priors alone, without which the poses could all move together."""
    import gtsam

    graph, keys = gtsam.NonlinearFactorGraph(), []
    gauge = gtsam.noiseModel.Diagonal.Sigmas(np.repeat([_GAUGE_RAD, _GAUGE_M], 3))
    held = [(camera_key(k), T) for k, T in enumerate(problem.Ts_world_camera[:n_held])]
    firsts = [stretch.first_pose for stretch in problem.stretches]
    for key, T in held + [(object_key(o), problem.Ts_world_object[o]) for o in firsts]:
        graph.add(gtsam.PriorFactorPose3(key, gtsam.Pose3(T), gauge))
        keys.append(key)
    factors = PoseFactors()
    factors.add_part(graph, keys)
    return factors


def _smoothness(o: int, dts_s: Array, config: BatchConfig) -> gtsam.CustomFactor:
    """The velocities of the steps to poses o - 1 and o, in the object's axes, are alike.

    r = Log(inv(B) C) / dt2 - Log(inv(A) B) / dt1 for poses A, B, C; for equal dt this is, to first
    order, constant velocity. It divides by true times, so that frames may lack.
    """
    import gtsam

    sigmas = np.repeat([config.turn_radps2, config.acceleration_mps2], 3) * float(dts_s.mean())
    loss = gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY)
    noise = gtsam.noiseModel.Robust.Create(loss, gtsam.noiseModel.Diagonal.Sigmas(sigmas))
    dt1, dt2 = (float(dt) for dt in dts_s)
    Pose3 = gtsam.Pose3
    keys = [object_key(o - 2), object_key(o - 1), object_key(o)]

    def error(factor: Any, values: gtsam.Values, jacobians: Any) -> NDArray[np.float64]:
        A, B, C = (values.atPose3(key) for key in keys)
        d1, d2 = A.between(B), B.between(C)
        if jacobians is not None:
            J1, J2 = Pose3.LogmapDerivative(d1) / dt1, Pose3.LogmapDerivative(d2) / dt2
            jacobians[0] = J1 @ d1.inverse().AdjointMap()
            jacobians[1] = -J2 @ d2.inverse().AdjointMap() - J1
            jacobians[2] = J2
        return Pose3.Logmap(d2) / dt2 - Pose3.Logmap(d1) / dt1

    return gtsam.CustomFactor(noise, keys, error)


def _add_planar(
    graph: gtsam.NonlinearFactorGraph, problem: BatchProblem, stretch: Stretch, sigma: float
) -> None:
    """A road vehicle turns about its upright axis alone, and moves at right angles to it.

    Its poses begin upright: y is the world's. Loose in the other four directions.
    """
    import gtsam

    poses = problem.Ts_world_object[stretch.poses]
    ways = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    for n, way_m in enumerate(ways):
        tight = sigma * max(float(way_m), 0.05)
        sigmas = np.array([sigma, 1e3, sigma, 1e3, tight, 1e3])
        noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
        o = stretch.first_pose + n
        step = gtsam.Pose3(_upright_part(np.linalg.inv(poses[n]) @ poses[n + 1]))
        graph.add(gtsam.BetweenFactorPose3(object_key(o), object_key(o + 1), step, noise))


def _upright_part(T: Array) -> Array:
    """The planar motion (4, 4) nearest to T: a turn about y, and no way along it."""
    angle = np.arctan2(T[0, 2] - T[2, 0], T[0, 0] + T[2, 2])
    c, s = np.cos(angle), np.sin(angle)
    planar = np.eye(4)
    planar[:3, :3] = [[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]]
    planar[:3, 3] = T[0, 3], 0.0, T[2, 3]
    return planar
