"""Bundle adjustment of keyframes and static points; step 11.

Owns the problem, its solution and what is dropped on the way, as arrays that any process can take.
Which keyframes and points go in is decided by `local_window` and `loop_adjustment`; the solver is
that of the batches.

Deviation: stereo factors, as gtsam has them, err independently. Errors of pixels that are
followed from image to image add up, as in the batches; gtsam holds and solves the graph of poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.batch_problem import BatchProblem
from pipelines.backend.batch_solver import solve
from pipelines.backend.global_batch import inliers
from pipelines.backend.object_graph import camera_key
from pipelines.backend.point_elimination import evaluate
from pipelines.backend.point_tracks import PointTracks
from pipelines.shapes import check_shape
from pipelines.types import Array, StereoCamera

if TYPE_CHECKING:
    import gtsam

_FIXED_SIGMA = 1e-6  # rad and m, of the poses that are held


@dataclass(frozen=True, slots=True)
class BundleProblem:
    """K keyframes, N static points and M sightings of them.

    Ts_world_camera: (K, 4, 4). held: (K,) bool, poses that do not move. points_m: (N, 3) in the
    world. tracks: a view is a keyframe, a track is a point.
    """

    camera: StereoCamera
    Ts_world_camera: Array
    held: NDArray[np.bool_]
    points_m: Array
    tracks: PointTracks

    def __post_init__(self) -> None:
        K, N = self.tracks.n_views, self.tracks.n_tracks
        check_shape("BundleProblem", "Ts_world_camera", self.Ts_world_camera, (K, 4, 4))
        check_shape("BundleProblem", "held", self.held, (K,))
        check_shape("BundleProblem", "points_m", self.points_m, (N, 3))


@dataclass(frozen=True, slots=True)
class BundleSolution:
    """Adjusted poses (K, 4, 4) and points (N, 3), and which sightings (M,) agree with them.

    error_before, error_after: robust costs of the sightings that agree in the end.
    """

    Ts_world_camera: Array
    points_m: Array
    inliers: NDArray[np.bool_]
    error_before: float
    error_after: float


def load_solver() -> None:
    """Import gtsam, which takes the best part of a second where it was not yet."""
    import gtsam  # noqa: F401


def adjust_bundle(problem: BundleProblem, rounds: int = 2, iterations: int = 10) -> BundleSolution:
    """Minimise the stereo reprojection errors of all sightings over poses and points.

    Between rounds, and after the last, what is beyond the 99 % quantile of chi-square is dropped.
    Levenberg-Marquardt with Huber's loss. Deterministic.
    """
    tracks, n = problem.tracks, problem.tracks.n_views
    at = BatchProblem(
        problem.camera,
        np.arange(n),
        np.zeros(n),
        problem.Ts_world_camera,
        (),
        np.empty((0, 4, 4)),
        problem.points_m,
        tracks,
        np.arange(len(tracks)),
    )
    graph = _held_poses(problem)
    keep_uv = keep_disparity = np.ones(len(tracks), bool)
    for _ in range(rounds):
        solution = solve(at, graph, keep_uv, keep_disparity, iterations)
        at = solution.problem
        every = np.ones(len(tracks), bool)
        residuals = evaluate(problem.camera, tracks, at.Ts_world_camera, at.points_m, every, every)
        keep_uv, keep_disparity = inliers(residuals)
        keep_uv &= residuals.weight_uv > 0
    costs = [
        evaluate(problem.camera, tracks, p.Ts_world_camera, p.points_m, keep_uv, keep_disparity)
        for p in (problem, at)
    ]
    Ts = at.Ts_world_camera.copy()
    Ts[problem.held] = problem.Ts_world_camera[problem.held]
    return BundleSolution(Ts, at.points_m, keep_uv & keep_disparity, costs[0].cost, costs[1].cost)


def _held_poses(problem: BundleProblem) -> gtsam.NonlinearFactorGraph:
    import gtsam

    graph = gtsam.NonlinearFactorGraph()
    hold = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED_SIGMA)
    for k in np.flatnonzero(problem.held).tolist():
        pose = gtsam.Pose3(problem.Ts_world_camera[k])
        graph.add(gtsam.PriorFactorPose3(camera_key(k), pose, hold))
    return graph
