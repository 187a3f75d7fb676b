"""The batch on a drive with known truth and noise: as good as it can be, and never worse."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from pipelines.backend import batch_solver, global_batch
from pipelines.backend.batch_outcome import corrections, objects_after, trajectory_after
from pipelines.backend.global_batch import run_global_batch
from pipelines.backend.guard import Verdict
from pipelines.backend.object_graph import camera_key
from pipelines.backend.partial_batch import run_partial_batch
from pipelines.backend.point_motion_batch import run_point_motion_batch
from pipelines.config import BatchConfig
from pipelines.frame_observations import FrameObservations
from pipelines.geometry import exp_se3, invert_T, rotation_vector
from pipelines.object_types import ObjectEstimates

CONFIG = BatchConfig(held_out_share=0.05, rounds=1, max_steps=10)


def perturbations(Ts, Ts_true):
    E = invert_T(Ts) @ Ts_true
    return np.concatenate([rotation_vector(E), E[:, :3, 3]], 1)


def test_errors_of_cameras_are_at_the_bound(make_drive, stereo):
    """Squared errors over the marginals' variances are about 1: the Cramer-Rao bound is met.

    The weights by redundancy widen the bound: points spread so thinly share few cells.
    """
    ratios = []
    for seed in range(6):
        drive = make_drive(seed)
        result = run_global_batch(stereo, drive.log, ObjectEstimates.empty(), CONFIG)
        e = perturbations(result.after.Ts_world_camera, drive.Ts_true)[1:]
        std = np.sqrt(np.diagonal(result.covariances.cameras, axis1=1, axis2=2))[1:]
        ratios.append((e / std) ** 2)
    ratio = np.sqrt(np.mean(ratios))
    assert 0.7 < ratio < 1.2


def test_objects_get_better_and_say_how_sure_they_are(make_drive, stereo):
    ratios = []
    for seed in range(4):
        drive = make_drive(seed)
        result = run_global_batch(stereo, drive.log, drive.objects, CONFIG)
        assert result.accepted and result.accepted_objects == {1}
        moved = corrections(drive.log, result)
        Ts = trajectory_after(drive.log, moved)
        assert np.abs(Ts - result.after.Ts_world_camera).max() < 1e-9
        rows, pose_std = objects_after(drive.objects, drive.log, moved, result)
        H_true = drive.Ls_true[1:] @ invert_T(drive.Ls_true[:-1])
        errors = []
        for objects in (drive.objects, rows):
            B_true = invert_T(drive.Ls_true[:-1]) @ drive.Ls_true[1:]
            H = objects.Hs_world_curr_prev[1:]
            B = invert_T(drive.Ls_true[:-1]) @ H @ drive.Ls_true[:-1]
            errors.append(np.sqrt(np.mean(perturbations(B, B_true)[:, 3:] ** 2)))
        assert errors[1] < 0.3 * errors[0]
        E = H_true @ invert_T(rows.Hs_world_curr_prev[1:])
        spin = rotation_vector(E)
        std = np.sqrt(np.diagonal(rows.motion_covariances[1:], axis1=1, axis2=2))
        ratios.append((spin / std[:, :3]) ** 2)
        assert np.isfinite(pose_std).all()
        assert np.isfinite(rows.speed_std_mps[1:]).all()
    assert 0.3 < np.sqrt(np.mean(ratios)) < 1.3  # smoothness may be truer than it says


@pytest.mark.parametrize("what", ["cameras", "objects"])
def test_what_gets_worse_is_refused(make_drive, stereo, monkeypatch, what):
    """Poses that are worse than at the start, whatever the reason, change nothing."""
    drive = make_drive(2, jitter=0.001)
    right = global_batch.solve

    def spoilt(*arguments, **keywords):
        solution = right(*arguments, **keywords)
        problem, rng = solution.problem, np.random.default_rng(0)
        X, L = problem.Ts_world_camera, problem.Ts_world_object
        wrong = exp_se3(rng.normal(size=(len(X), 6)) * np.repeat([0.005, 0.05], 3))
        X, L = (X @ wrong, L) if what == "cameras" else (X, L @ wrong)
        return replace(solution, problem=problem.at(X, L, problem.points_m))

    monkeypatch.setattr(global_batch, "solve", spoilt)
    result = run_global_batch(stereo, drive.log, drive.objects, CONFIG)
    assert result.accepted == (what == "objects")
    assert not result.accepted_objects
    unguarded = run_global_batch(stereo, drive.log, drive.objects, replace(CONFIG, guard=False))
    assert unguarded.accepted and unguarded.accepted_objects == {1}
    kept = result.before.Ts_world_object
    np.testing.assert_array_equal(result.after.Ts_world_object, kept)
    same = np.array_equal(result.after.Ts_world_camera, result.before.Ts_world_camera)
    assert same == (what == "cameras")
    rows, _ = objects_after(drive.objects, drive.log, corrections(drive.log, result), result)
    step = invert_T(result.before.Ts_world_camera[3]) @ drive.objects.Ts_world_object[3]
    now = invert_T(result.after.Ts_world_camera[3]) @ rows.Ts_world_object[3]
    np.testing.assert_allclose(now, step, atol=1e-9)  # as the front-end saw it


def test_a_step_that_cannot_be_taken_is_tried_shorter(make_drive, stereo, monkeypatch):
    """gtsam refuses a system in which some pose is hardly held; with more damping it is."""
    drive, right, dampings = make_drive(5), batch_solver.linear_graph, []

    def refuse_first(*arguments):
        dampings.append(arguments[-1])
        linear = right(*arguments)
        if len(dampings) == 1:  # a camera is worse than loose
            linear.add(gtsam.HessianFactor(camera_key(3), -1e12 * np.eye(6), np.zeros(6), 0.0))
        return linear

    good = run_global_batch(stereo, drive.log, drive.objects, CONFIG)
    monkeypatch.setattr(batch_solver, "linear_graph", refuse_first)
    result = run_global_batch(stereo, drive.log, drive.objects, CONFIG)
    assert dampings[1] == pytest.approx(10.0 * dampings[0])
    assert result.accepted and result.cost_after == pytest.approx(good.cost_after, rel=1e-3)


def motion_errors(H, drive):
    """(K - 1,) translations in m by which motions err in the true object's frame."""
    E = invert_T(drive.Ls_true[1:]) @ H @ drive.Ls_true[:-1]
    return np.linalg.norm(E[:, :3, 3], axis=1)


def test_a_single_motion_that_gets_worse_stays_the_front_ends(make_drive, stereo, monkeypatch):
    """One pose a metre off hardly shows in the held-out sightings of the whole object."""
    drive = make_drive(3)
    right = global_batch.solve

    def spoilt(*arguments, **keywords):
        solution = right(*arguments, **keywords)
        L = solution.problem.Ts_world_object.copy()
        L[6, 0, 3] += 1.0
        problem = solution.problem
        return replace(solution, problem=problem.at(problem.Ts_world_camera, L, problem.points_m))

    good = run_global_batch(stereo, drive.log, drive.objects, CONFIG)
    assert good.accepted_objects == {1} and not good.kept_motions.any()
    monkeypatch.setattr(global_batch, "solve", spoilt)
    verdicts = [Verdict(i, 100, 1.0, 1.0, 0.0) for i in (0, 1)]  # in hundreds of frames it may pass
    monkeypatch.setattr(global_batch, "judge", lambda *arguments: tuple(verdicts))
    result = run_global_batch(stereo, drive.log, drive.objects, CONFIG)
    assert set(np.flatnonzero(result.kept_motions)) == {6, 7}  # to it and away from it
    moved = corrections(drive.log, result)
    rows, pose_std = objects_after(drive.objects, drive.log, moved, result)
    spoilt_m, before_m, best_m = (
        motion_errors(objects.Hs_world_curr_prev[1:], drive)
        for objects in (
            rows,
            drive.objects,
            objects_after(drive.objects, drive.log, corrections(drive.log, good), good)[0],
        )
    )
    np.testing.assert_allclose(spoilt_m[5:7], before_m[5:7], rtol=0.4)  # cameras moved
    np.testing.assert_allclose(np.delete(spoilt_m, [5, 6]), np.delete(best_m, [5, 6]), rtol=1e-6)
    kept = drive.objects.motion_covariances[6:8]
    np.testing.assert_array_equal(rows.motion_covariances[6:8], kept)
    assert np.isfinite(pose_std[:6]).all() and np.isnan(pose_std[6:]).all()


@pytest.mark.parametrize("n_poses", [2, 3])
def test_a_motion_without_neighbours_stays_the_front_ends(make_drive, stereo, monkeypatch, n_poses):
    """There nothing makes it smoother, and nothing is held out to judge it by."""
    drive = make_drive(3)
    objects = drive.objects[np.arange(len(drive.objects)) < n_poses]
    verdicts = tuple(Verdict(i, 100, 1.0, 1.0, 0.0) for i in (0, 1))
    monkeypatch.setattr(global_batch, "judge", lambda *arguments: verdicts)
    result = run_global_batch(stereo, drive.log, objects, CONFIG)
    assert result.kept_motions.any() == (n_poses == 2)
    rows, _ = objects_after(objects, drive.log, corrections(drive.log, result), result)
    seen_before, seen = (
        invert_T(T[1]) @ o.Hs_world_curr_prev[1] @ T[0]
        for T, o in (
            (result.before.Ts_world_camera, objects),
            (result.after.Ts_world_camera, rows),
        )
    )
    same = np.abs(seen - seen_before).max() < 1e-9
    assert same == (n_poses == 2)


def test_the_partial_batch_improves_and_joins_its_windows(make_drive, stereo):
    drive = make_drive(3, n_frames=24)
    config = replace(CONFIG, partial_window=8, partial_overlap=3)
    result = run_partial_batch(stereo, drive.log, config)
    before, after = (
        perturbations(p.Ts_world_camera, drive.Ts_true)[:, 3:]
        for p in (result.before, result.after)
    )
    assert result.accepted
    rms = [float(np.sqrt(np.mean(e**2))) for e in (before, after)]
    assert 0.01 * rms[0] < rms[1] < 0.5 * rms[0]
    steps = np.linalg.norm(np.diff(after, axis=0), axis=1)
    joints = [i for i in range(len(steps)) if (i - 7) % 5 == 0 and i >= 7]
    others = np.delete(steps, joints)
    assert steps[joints].max() < 3.0 * others.max()


def test_a_point_a_sighting_and_a_motion_a_frame_come_to_nearly_the_same(make_drive, stereo):
    """VDO-SLAM's formulation against ours: both far better than the start, neither than truth."""
    drive = make_drive(1)
    config = replace(CONFIG, max_steps=15)
    B_true = invert_T(drive.Ls_true[:-1]) @ drive.Ls_true[1:]
    rms_m = {}
    for run in (run_point_motion_batch, run_global_batch):
        result = run(stereo, drive.log, drive.objects, config)
        assert result.accepted and result.accepted_objects == {1}
        for name, problem in (("before", result.before), (run.__name__, result.after)):
            Ls = problem.Ts_world_object
            H = Ls[1:] @ invert_T(Ls[:-1])
            B = invert_T(drive.Ls_true[:-1]) @ H @ drive.Ls_true[:-1]
            off = perturbations(problem.Ts_world_camera, drive.Ts_true), perturbations(B, B_true)
            rms_m[name] = [float(np.sqrt(np.mean(e[:, 3:] ** 2))) for e in off]
    theirs, ours = rms_m["run_point_motion_batch"], rms_m["run_global_batch"]
    for k in range(2):
        assert 0.0 < theirs[k] < 0.1 * rms_m["before"][k]
        assert 0.5 * ours[k] < theirs[k] < 2.0 * ours[k]


def test_lost_frames_follow_and_too_little_is_left_alone(make_drive, stereo):
    drive = make_drive(4)
    log = list(drive.log)
    lost = log[5]
    log[5] = FrameObservations(5, lost.timestamp_s, False, lost.T_world_camera, lost.sightings[:0])
    result = run_global_batch(stereo, log, ObjectEstimates.empty(), CONFIG)
    Ts = trajectory_after(log, corrections(log, result))
    assert len(Ts) == len(log) and np.isfinite(Ts).all()
    step = invert_T(log[4].T_world_camera) @ lost.T_world_camera
    np.testing.assert_allclose(invert_T(Ts[4]) @ Ts[5], step, atol=1e-9)
    assert run_global_batch(stereo, log[:2], ObjectEstimates.empty(), CONFIG) is None


def test_a_rough_first_round_leads_to_the_same_optimum(make_drive, stereo, monkeypatch):
    drive, right, rough = make_drive(3), global_batch.solve, []

    def thorough(*args, is_rough=False):
        rough.append(is_rough)
        return right(*args)

    config = BatchConfig(held_out_share=0.05, max_steps=20)
    found = run_global_batch(stereo, drive.log, drive.objects, config)
    monkeypatch.setattr(global_batch, "solve", thorough)
    best = run_global_batch(stereo, drive.log, drive.objects, config)
    assert rough == [True, False]
    apart = invert_T(found.after.Ts_world_camera) @ best.after.Ts_world_camera
    error = invert_T(best.after.Ts_world_camera) @ drive.Ts_true
    far, off = (np.linalg.norm(T[:, :3, 3], axis=1) for T in (apart, error))
    assert far.max() < 0.05 * off.max()
