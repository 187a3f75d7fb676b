"""Corrections of the map: points and frames follow their keyframes, objects their cameras."""

from __future__ import annotations

from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest

from pipelines.config import MappingConfig
from pipelines.geometry import exp_se3, invert_T, transform_points
from pipelines.mapping.correction import FrameAnchors, MapCorrection, correct_map
from pipelines.mapping.keyframe import Keyframe
from pipelines.mapping.sparse_map import SparseMap
from pipelines.object_types import ObjectEstimates
from pipelines.observations import Tracks
from pipelines.types import Features, FrameResult, MotionHypothesis, StereoCamera, TrackingStatus

CAMERA = StereoCamera(640, 480, 500.0, 500.0, 320.0, 240.0, 50.0)
NOTHING, NO_SHIFTS = np.empty(0, np.int64), np.empty((0, 3))


def pose_at(k):
    return exp_se3(np.array([0.0, 0.02 * k, 0.0, 0.1 * k, 0.0, 1.0 * k]))


def add_points(sparse_map, n, seed):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, 3, 3))
    return sparse_map.add_points(
        rng.uniform(-5, 5, (n, 3)),
        A @ A.transpose(0, 2, 1),
        rng.normal(size=(n, 3)),
        np.zeros((n, 32), np.uint8),
        np.zeros((n, 3), np.uint8),
    )


def add_keyframe(sparse_map, ids, T, frame_index=0):
    n = len(ids)
    tracks = Tracks(ids, np.ones((n, 2)), np.full(n, 5.0), np.full(n, 0.3))
    sparse_map.add_keyframe(Keyframe(frame_index, 0.1, T, tracks, Features.empty()))


@pytest.fixture
def sparse_map():
    """Four keyframes with ten points each, and ten points that none has seen; ids in this order."""
    sparse_map = SparseMap(CAMERA, MappingConfig())
    for k in range(4):
        add_keyframe(sparse_map, add_points(sparse_map, 10, k), pose_at(k), k)
    add_points(sparse_map, 10, 9)
    return sparse_map


def correction_of(sparse_map, Cs, point_ids=NOTHING, shifts_m=NO_SHIFTS):
    """Cs: row of a keyframe -> its motion."""
    rows = np.array(list(Cs), np.int64)
    old = np.stack([sparse_map.keyframes[k].T_world_camera for k in rows])
    return MapCorrection(rows, old, np.stack(list(Cs.values())) @ old, point_ids, shifts_m)


def small_motion(seed):
    return exp_se3(0.02 * np.random.default_rng(seed).normal(size=6))


def test_points_follow_the_keyframe_that_first_saw_them(sparse_map) -> None:
    before = sparse_map.position_m[:50].copy()
    shape = sparse_map.covariance_m2[:50].copy()
    C1, C2 = small_motion(1), small_motion(2)
    C = correct_map(sparse_map, correction_of(sparse_map, {1: C1, 2: C2}))
    np.testing.assert_allclose(C, C2, atol=1e-12)
    by = [np.eye(4), C1, C2, C2, C2]  # the newest keyframe and young points go with the second
    for k in range(5):
        rows = slice(10 * k, 10 * k + 10)
        moved = transform_points(by[k], before[rows])
        np.testing.assert_allclose(sparse_map.position_m[rows], moved, atol=1e-12)
        R = by[k][:3, :3]
        np.testing.assert_allclose(sparse_map.covariance_m2[rows], R @ shape[rows] @ R.T, atol=1e-9)
    for k in range(4):
        T = sparse_map.keyframes[k].T_world_camera
        np.testing.assert_allclose(T, by[k] @ pose_at(k), atol=1e-12)
    np.testing.assert_array_equal(sparse_map.snapshot().keyframe_Ts_world_camera[3], T)


def test_named_points_move_by_their_own_shifts_from_where_they_are_now(sparse_map) -> None:
    ids, shifts = np.array([12, 25, 41]), np.array([[0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3]])
    correction = correction_of(sparse_map, {1: small_motion(1)}, ids, shifts)
    sparse_map.position_m[ids] += 0.01  # refined since the question
    sparse_map.remove_points(np.array([25]))  # and one forgotten
    before = sparse_map.position_m[:50].copy()
    correct_map(sparse_map, correction)
    np.testing.assert_allclose(sparse_map.position_m[[12, 41]], before[[12, 41]] + shifts[[0, 2]])
    np.testing.assert_array_equal(sparse_map.position_m[25], before[25])


def test_a_correction_and_its_opposite_leave_the_map_as_it_was(sparse_map) -> None:
    before = sparse_map.position_m[:50].copy()
    shift = np.full((1, 3), 0.2)
    Cs = {1: small_motion(1), 3: small_motion(2)}
    C = correct_map(sparse_map, correction_of(sparse_map, Cs, np.array([14]), shift))
    back = {k: invert_T(T) for k, T in Cs.items()}
    C_back = correct_map(sparse_map, correction_of(sparse_map, back, np.array([14]), -shift))
    np.testing.assert_allclose(C_back @ C, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(sparse_map.position_m[:50], before, atol=1e-12)


# --------------------------------------------------------------------- frames


def drive(n_frames=9, every=3):
    """A map with a keyframe every third frame, and the anchors of all frames."""
    sparse_map, anchors = SparseMap(CAMERA, MappingConfig()), FrameAnchors()
    for n in range(n_frames):
        if n % every == 0:
            add_keyframe(sparse_map, add_points(sparse_map, 5, n), pose_at(n), n)
        anchors.add(sparse_map, 10 * n, pose_at(n))
    return sparse_map, anchors


def test_frames_stay_where_no_keyframe_moved() -> None:
    sparse_map, anchors = drive()
    truth = np.stack([pose_at(n) for n in range(9)])
    np.testing.assert_allclose(anchors.trajectory(sparse_map), truth, atol=1e-12)


def test_what_a_keyframe_moves_by_is_spread_over_the_frames_before_it() -> None:
    sparse_map, anchors = drive()
    shift = np.eye(4)
    shift[2, 3] = 0.3
    correct_map(sparse_map, correction_of(sparse_map, {1: shift}))
    moved = anchors.trajectory(sparse_map)[:, :3, 3] - [pose_at(n)[:3, 3] for n in range(9)]
    expected = np.array([0, 0.1, 0.2, 0.3, 0.3, 0.3, 0.3, 0.3, 0.3])
    np.testing.assert_allclose(moved[:, 2], expected, atol=1e-3)
    np.testing.assert_allclose(moved[:, :2], 0.0, atol=1e-3)


def test_frames_before_the_first_keyframe_stay_in_the_world() -> None:
    sparse_map, anchors = SparseMap(CAMERA, MappingConfig()), FrameAnchors()
    anchors.add(sparse_map, 0, pose_at(0))
    add_keyframe(sparse_map, add_points(sparse_map, 5, 0), pose_at(1))
    anchors.add(sparse_map, 1, pose_at(1))
    correct_map(sparse_map, correction_of(sparse_map, {0: small_motion(1)}))
    Ts = anchors.trajectory(sparse_map)
    np.testing.assert_array_equal(Ts[0], pose_at(0))
    np.testing.assert_allclose(Ts[1], small_motion(1) @ pose_at(1), atol=1e-12)


def result_of(n, L, H):
    """A frame's answer with one object at pose L that moved by H."""
    none = ObjectEstimates.empty()
    blank = {
        f.name: np.zeros((1, *getattr(none, f.name).shape[1:]), getattr(none, f.name).dtype)
        for f in fields(none)
    }
    objects = ObjectEstimates(
        **{**blank, "Ts_world_object": L[None], "Hs_world_curr_prev": H[None]}
        | {"centers_m": L[None, :3, 3], "velocities_mps": 10.0 * (H - np.eye(4))[None, :3, 3]}
    )
    return FrameResult(
        10 * n, 0.1 * n, TrackingStatus.OK, pose_at(n), np.eye(6), MotionHypothesis.PNP_RANSAC,
        False, np.empty((0, 2)), NOTHING, np.empty(0, bool), np.nan, objects,
    )  # fmt: skip


def test_objects_follow_the_cameras_that_saw_them() -> None:
    """Seen from its camera, an object is where it was; its motion leads from pose to pose."""
    sparse_map, anchors = drive()
    Ls = [exp_se3(np.array([0.0, 0.1 * n, 0.0, 2.0, 0.0, 5.0 + 1.5 * n])) for n in range(9)]
    Hs = [np.eye(4)] + [b @ invert_T(a) for a, b in pairwise(Ls)]
    results = [result_of(n, L, H) for n, (L, H) in enumerate(zip(Ls, Hs, strict=True))]
    Cs = {1: small_motion(3), 2: small_motion(4)}
    correct_map(sparse_map, correction_of(sparse_map, Cs))
    revised = anchors.revise(sparse_map, results)
    assert np.abs(revised[5].T_world_camera - pose_at(5)).max() > 1e-3
    for n, (old, new) in enumerate(zip(results, revised, strict=True)):
        L, H = new.objects.Ts_world_object[0], new.objects.Hs_world_curr_prev[0]
        C = new.T_world_camera @ invert_T(old.T_world_camera)
        seen = invert_T(pose_at(n)) @ Ls[n]
        np.testing.assert_allclose(invert_T(new.T_world_camera) @ L, seen, atol=1e-12)
        np.testing.assert_allclose(new.objects.centers_m[0], L[:3, 3], atol=1e-12)
        np.testing.assert_allclose(
            new.objects.velocities_mps[0], C[:3, :3] @ old.objects.velocities_mps[0], atol=1e-12
        )
        if n:
            before = revised[n - 1].objects.Ts_world_object[0]
            np.testing.assert_allclose(H @ before, L, atol=1e-9)
    np.testing.assert_array_equal(results[5].T_world_camera, pose_at(5))  # copies, not changes


def test_results_of_unknown_frames_stay() -> None:
    sparse_map, anchors = drive()
    stranger = replace(result_of(4, np.eye(4), np.eye(4)), frame_index=7)
    correct_map(sparse_map, correction_of(sparse_map, {1: small_motion(3)}))
    assert len(anchors.revise(sparse_map, [stranger])) == 1
    np.testing.assert_array_equal(
        anchors.revise(sparse_map, [stranger])[0].T_world_camera, stranger.T_world_camera
    )
