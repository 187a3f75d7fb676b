"""VDO-SLAM's formulation of the batch, as the comparison for ours: a point a sighting, H a motion.

Owns its graph and its solution by gtsam. Every sighting of an object is a point of its own in the
world, and a ternary factor p_k = H_k p_{k-1} ties it to the one before; the motions H_k of an
object are alike. Ours has one point a track, at rest in the object: a fraction of the variables.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from pipelines.backend.batch_problem import BatchProblem, build_problem
from pipelines.backend.global_batch import BatchResult, as_result, has_enough
from pipelines.backend.guard import judge
from pipelines.backend.held_out import hold_out
from pipelines.backend.object_graph import camera_key
from pipelines.backend.pixel_noise import PixelNoise
from pipelines.config import BatchConfig
from pipelines.frame_observations import FrameObservations
from pipelines.geometry import invert_T, orthonormalise, transform_points
from pipelines.object_types import ObjectEstimates
from pipelines.types import StereoCamera

if TYPE_CHECKING:
    import gtsam

_MOTION_M = 1e-3  # of p_k = H p_{k-1}, about what rigid matter keeps
_GAUGE = 1e-6  # rad and m, of the first camera


def run_point_motion_batch(
    camera: StereoCamera,
    log: Sequence[FrameObservations],
    objects: ObjectEstimates,
    config: BatchConfig,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> BatchResult | None:
    """Optimise a run in VDO-SLAM's formulation; as `run_global_batch`, without covariances.

    Deviation: stereo pixels with learned weights stand for its 3-D points with fixed ones, and each
    step from a frame to the next is measured by points alone, without odometry factors, which would
    count them twice. The first pose of a stretch stays with the camera that saw it.
    """
    import gtsam

    if not has_enough(log):
        return None
    with_objects = objects if config.with_objects else ObjectEstimates.empty()
    start = build_problem(camera, log, with_objects, config.max_static_per_frame)
    if len(start.tracks) == 0:
        return None
    tracks, rows, held = hold_out(start.tracks, start.sighting_rows, config.held_out_share)
    problem = start.with_tracks(tracks, rows)
    graph, values = _build(problem, config)
    costs = [graph.error(values)]
    params = gtsam.LevenbergMarquardtParams()
    params.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
    params.setOrderingType("METIS")
    optimizer = gtsam.LevenbergMarquardtOptimizer(graph, values, params)
    total = config.rounds * config.max_steps
    for step in range(total):
        optimizer.iterate()
        costs.append(optimizer.error())
        progress(step + 1, total)
        if costs[-2] - costs[-1] < 1e-4 * costs[-2]:
            break
    solved = _read(problem, optimizer.values())
    ends = np.array([costs[0], costs[-1]])
    verdicts = judge(problem, solved, held, config.guard)
    return as_result(problem, solved, verdicts, ends, 0)


def _point_key(row: int) -> int:
    """Of the point of a static track, or of one sighting of an object, by its row."""
    import gtsam

    return int(gtsam.symbol("p", row))


def _motion_key(o: int) -> int:
    """Of the motion that leads to object pose o."""
    import gtsam

    return int(gtsam.symbol("h", o))


def _build(
    problem: BatchProblem, config: BatchConfig
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    import gtsam

    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for k, T in enumerate(problem.Ts_world_camera):
        values.insert(camera_key(k), gtsam.Pose3(T))
    hold = gtsam.noiseModel.Isotropic.Sigma(6, _GAUGE)
    graph.add(gtsam.PriorFactorPose3(camera_key(0), gtsam.Pose3(problem.Ts_world_camera[0]), hold))
    _add_points(graph, values, problem)
    for stretch in problem.stretches:
        Ls = problem.Ts_world_object[stretch.poses]
        dts_s = np.diff(problem.timestamps_s[stretch.frames])
        for n in range(1, len(stretch)):
            o = stretch.first_pose + n
            values.insert(_motion_key(o), gtsam.Pose3(Ls[n] @ invert_T(Ls[n - 1])))
            if n == 1:
                continue
            sigmas = (
                np.repeat([config.turn_radps2, config.acceleration_mps2], 3) * dts_s[n - 1] ** 2
            )
            alike = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
            graph.add(
                gtsam.BetweenFactorPose3(_motion_key(o - 1), _motion_key(o), gtsam.Pose3(), alike)
            )
    return graph, values


def _add_points(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, problem: BatchProblem
) -> None:
    """Points with their sightings, and the motions that tie those of objects together."""
    import gtsam

    tracks, noise = problem.tracks, PixelNoise(problem.camera)
    is_static = tracks.view < problem.n_frames
    point = np.where(is_static, tracks.starts[tracks.track], np.arange(len(tracks)))
    Ts_world_body = np.concatenate(
        [np.tile(np.eye(4), (problem.n_frames, 1, 1)), problem.Ts_world_object]
    )[tracks.view]
    local = problem.points_m[tracks.track]
    world = np.einsum("nij,nj->ni", Ts_world_body[:, :3, :3], local) + Ts_world_body[:, :3, 3]
    camera_of = problem.camera_of_view[tracks.view]
    begins = np.flatnonzero(point == np.arange(len(tracks)))
    for row in begins.tolist():
        values.insert(_point_key(row), world[row])
    keys = zip(camera_of.tolist(), point.tolist(), strict=True)
    factors = noise.factors(
        tracks.uv_px, tracks.disparity_px, tracks.sigma_uv_px, tracks.sigma_disparity_px
    )
    for (k, p), make in zip(keys, factors, strict=True):
        graph.add(make(camera_key(k), _point_key(p)))
    rigid = gtsam.noiseModel.Isotropic.Sigma(3, _MOTION_M)
    next_one = np.flatnonzero(~is_static[1:] & (np.diff(tracks.track) == 0)) + 1
    next_one = next_one[tracks.view[next_one] == tracks.view[next_one - 1] + 1]
    for row in next_one.tolist():
        motion = _motion_key(int(tracks.view[row]) - problem.n_frames)
        graph.add(
            gtsam.ReferenceFrameFactorPoint3Pose3(
                _point_key(row - 1), motion, _point_key(row), rigid
            )
        )


def _read(problem: BatchProblem, values: gtsam.Values) -> BatchProblem:
    """The solution: object poses are the first one of a stretch, led on by the motions."""
    Ts = np.stack([values.atPose3(camera_key(k)).matrix() for k in range(problem.n_frames)])
    Ls = problem.Ts_world_object.copy()
    for stretch in problem.stretches:
        o, k = stretch.first_pose, int(stretch.frames[0])
        Ls[o] = Ts[k] @ invert_T(problem.Ts_world_camera[k]) @ Ls[o]
        for n in range(1, len(stretch)):
            Ls[o + n] = values.atPose3(_motion_key(o + n)).matrix() @ Ls[o + n - 1]
    tracks, points = problem.tracks, problem.points_m.copy()
    for track, row in enumerate(tracks.starts.tolist()):
        world = values.atPoint3(_point_key(row))
        view = int(tracks.view[row]) - problem.n_frames
        points[track] = world
        if view >= 0:
            points[track] = transform_points(invert_T(Ls[view]), world[None])[0]
    return problem.at(orthonormalise(Ts), orthonormalise(Ls), points)
