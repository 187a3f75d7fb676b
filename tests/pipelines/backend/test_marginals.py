"""Elimination and marginals against one dense least-squares problem with numeric derivatives."""

from itertools import pairwise

import numpy as np

from pipelines.backend.batch_problem import build_problem
from pipelines.backend.batch_solver import solve
from pipelines.backend.marginals import pose_covariances
from pipelines.backend.object_graph import pose_graph
from pipelines.backend.point_elimination import evaluate
from pipelines.config import BatchConfig
from pipelines.geometry import exp_se3


def dense_covariance(problem, graph_sigmas):
    """Covariance of all poses (cameras, then objects) by the inverse of J'J, points included."""
    F, n_objects = problem.n_frames, len(problem.Ts_world_object)
    n_poses, n_points = F + n_objects, problem.tracks.n_tracks
    keep = np.ones(len(problem.tracks), bool)

    def residuals(x):
        poses, points = x[: 6 * n_poses].reshape(-1, 6), x[6 * n_poses :].reshape(-1, 3)
        X = problem.Ts_world_camera @ exp_se3(poses[:F])
        L = problem.Ts_world_object @ exp_se3(poses[F:])
        r = evaluate(
            problem.camera, problem.tracks, problem.views(X, L), problem.points_m + points,
            keep, keep,
        )  # fmt: skip
        gauge = np.concatenate([poses[0], poses[F]]) / 1e-6
        velocity = np.diff([_log(np.linalg.inv(a) @ b) for a, b in pairwise(L)], axis=0)
        return np.concatenate([r.uv.ravel(), r.disparity, gauge, (velocity / graph_sigmas).ravel()])

    size = 6 * n_poses + 3 * n_points
    J = np.empty((len(residuals(np.zeros(size))), size))
    for i in range(size):
        step = np.zeros(size)
        step[i] = 1e-6
        J[:, i] = (residuals(step) - residuals(-step)) / 2e-6
    return np.linalg.inv(J.T @ J)[: 6 * n_poses, : 6 * n_poses]


def _log(T):
    import gtsam

    return gtsam.Pose3.Logmap(gtsam.Pose3(T))


def test_marginals_are_those_of_the_dense_inverse(make_drive, stereo):
    drive = make_drive(0, n_frames=4, n_points=14, n_object=10, jitter=0.0)
    # Exact sightings: all weights are 1, and no kernel bends the problem
    problem = build_problem(stereo, drive.log, drive.objects)
    config = BatchConfig(acceleration_mps2=50.0, turn_radps2=20.0)
    graph = pose_graph(problem, config)
    keep = np.ones(len(problem.tracks), bool)
    solution = solve(problem, graph, keep, keep, 15)
    weights = solution.residuals
    loose = problem.tracks.with_sigmas(
        problem.tracks.sigma_uv_px * 20.0, problem.tracks.sigma_disparity_px * 20.0
    )
    at = solution.problem.with_tracks(loose, solution.problem.sighting_rows)
    views = at.views(at.Ts_world_camera, at.Ts_world_object)
    weights = evaluate(at.camera, at.tracks, views, at.points_m, keep, keep)
    assert weights.weight_uv.min() == weights.weight_disparity.min() == 1.0
    graph = pose_graph(at, BatchConfig(acceleration_mps2=1e3, turn_radps2=1e3))
    found = pose_covariances(at, graph, weights)
    dense = dense_covariance(at, 1e3 * 0.1 * 0.1)
    F = at.n_frames
    std = np.sqrt(np.diag(dense)).reshape(-1, 6)
    ours = np.sqrt(np.diagonal(np.concatenate([found.cameras, found.objects]), axis1=1, axis2=2))
    np.testing.assert_allclose(ours[1:F], std[1:F], rtol=2e-3)
    np.testing.assert_allclose(ours[F + 1 :], std[F + 1 :], rtol=2e-3)
    o = 6 * (F + 1)
    difference = np.hstack([-np.eye(6), np.eye(6)])
    joint = difference @ dense[o : o + 12, o : o + 12] @ difference.T
    np.testing.assert_allclose(np.diag(found.steps[2]), np.diag(joint), rtol=5e-3)
