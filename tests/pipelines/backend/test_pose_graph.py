"""The pose graph on a drive round a circle with known drift."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from pipelines.backend.loop_detection import LoopClosure
from pipelines.backend.pose_graph import PoseGraph, loop_correction, solve_pose_graph
from pipelines.geometry import exp_se3, invert_T, rotation_angle_deg
from pipelines.observations import Tracks

N = 40


def circle() -> np.ndarray:
    step = exp_se3(np.array([0.0, 2 * np.pi / N, 0.0, 0.0, 0.0, 1.0]))
    return np.stack([np.linalg.matrix_power(step, k) for k in range(N + 1)])


def drifted(Ts: np.ndarray) -> np.ndarray:
    """Each step a little too long and turned a little too far, as of a wrong calibration."""
    error = exp_se3(np.array([0.0, 0.001, 0.0, 0.0, 0.0, 0.01]))
    poses = [Ts[0]]
    for a, b in pairwise(Ts):
        poses.append(poses[-1] @ invert_T(a) @ b @ error)
    return np.stack(poses)


def end_error_m(Ts: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm((invert_T(truth[-1]) @ Ts[-1])[:3, 3]))


def test_a_loop_takes_most_of_the_drift_away() -> None:
    truth = circle()
    Ts = drifted(truth)
    i, j = np.arange(N), np.arange(1, N + 1)
    edges = invert_T(Ts[i]) @ Ts[j]
    loop = invert_T(truth[0]) @ truth[-1]
    graph = PoseGraph(Ts, np.append(i, 0), np.append(j, N), np.concatenate([edges, loop[None]]))
    solved = solve_pose_graph(graph)
    before, after = end_error_m(Ts, truth), end_error_m(solved, truth)
    assert before > 0.1
    assert 1e-6 < after < 0.1 * before
    middle = np.linalg.norm(solved[N // 2, :3, 3] - truth[N // 2, :3, 3])
    assert middle < np.linalg.norm(Ts[N // 2, :3, 3] - truth[N // 2, :3, 3])
    assert np.abs(solved[0] - Ts[0]).max() < 1e-6
    assert rotation_angle_deg(invert_T(truth[-1]) @ solved[-1]) < 0.3


def test_without_a_loop_nothing_moves() -> None:
    Ts = drifted(circle())
    i, j = np.arange(N), np.arange(1, N + 1)
    solved = solve_pose_graph(PoseGraph(Ts, i, j, invert_T(Ts[i]) @ Ts[j]))
    assert np.abs(solved - Ts).max() < 1e-6


def test_the_correction_names_every_keyframe_and_no_point() -> None:
    Ts = drifted(circle())
    graph = PoseGraph(Ts, np.array([0]), np.array([1]), (invert_T(Ts[0]) @ Ts[1])[None])
    moved = exp_se3(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])) @ Ts
    loop = LoopClosure(N, 0, Ts[0], Tracks.empty(), np.eye(4), 10.0)
    correction = loop_correction(graph, moved, loop)
    assert correction.sights == (N, loop.tracks)
    assert correction.keyframes.tolist() == list(range(N + 1))
    assert np.array_equal(correction.Ts_old, Ts) and np.array_equal(correction.Ts_new, moved)
    assert len(correction.point_ids) == 0
