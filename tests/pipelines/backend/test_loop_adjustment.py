"""Full bundle adjustment after a loop, on a drive round a circle of which all is known."""

from __future__ import annotations

from concurrent.futures import Future
from dataclasses import dataclass, replace

import numpy as np
import pytest

from pipelines.backend.back_end import BackEnd
from pipelines.backend.loop_adjustment import (
    adjust_loop,
    join_points,
    loop_adjustment_correction,
    loop_question,
)
from pipelines.backend.loop_detection import LoopClosure
from pipelines.backend.seen_places import SeenPlaces
from pipelines.config import BackendConfig, DepthConfig, MappingConfig, PlacesConfig
from pipelines.frontend.sensor import Sensor
from pipelines.geometry import (
    backproject,
    exp_se3,
    inside_image,
    invert_T,
    project_stereo,
    transform_points,
)
from pipelines.mapping.correction import correct_map
from pipelines.mapping.keyframe import Keyframe
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.types import Features, StereoCamera

CAMERA = StereoCamera(640, 480, 500.0, 500.0, 320.0, 240.0, 100.0)
ROUND, N = 32, 38  # keyframes of a round, and in all
SIGMA_UV_PX, FIRST_UV_PX, SIGMA_DISPARITY_PX = 0.1, 0.05, 0.2
NOISY_BITS = 10  # of 256, in which two descriptors of one thing differ
CONFIG = BackendConfig(process=False)


@dataclass(frozen=True)
class Drive:
    """A map that the pose graph has closed, and what is true of it.

    truth: (K, 4, 4) poses. things_m: (T, 3). thing: (N,) which of these each point of the map is.
    """

    sparse_map: SparseMap
    sensor: Sensor
    truth: np.ndarray
    things_m: np.ndarray
    thing: np.ndarray
    loop: LoopClosure


def make_drive(seed: int = 0) -> Drive:
    """A round and some more; what is seen again is mapped again. Half-way the map is off most."""
    rng = np.random.default_rng(seed)
    step = exp_se3(np.array([0.0, 2 * np.pi / ROUND, 0.0, 0.0, 0.0, 1.5]))
    truth = np.stack([np.linalg.matrix_power(step, k) for k in range(N)])
    bend = np.sin(np.pi * np.arange(N) / ROUND)
    wrong = np.array([0.0, 0.004, 0.0, 0.05, 0.01, 0.15])
    Ts = truth @ exp_se3(
        bend[:, None] * wrong + rng.normal(size=(N, 6)) * [[1e-3] * 3 + [1e-2] * 3]
    )
    Ts[0] = truth[0]
    centre_m = truth[:ROUND, :3, 3].mean(axis=0)
    angle, radius = rng.uniform(0, 2 * np.pi, 2500), rng.uniform(2, 20, 2500)
    things = np.column_stack(
        [radius * np.sin(angle), rng.uniform(-3, 3, 2500), radius * np.cos(angle)]
    )
    things += centre_m
    looks = rng.integers(0, 256, (len(things), 32), np.uint8)
    sparse_map, sensor = SparseMap(CAMERA, MappingConfig()), Sensor(CAMERA, DepthConfig())
    sensor.noise.sigma_disparity_px = SIGMA_DISPARITY_PX
    ids, drift = np.full(len(things), -1), np.zeros((len(things), 2))
    thing: list[int] = []
    for k in range(N):
        local = transform_points(invert_T(truth[k]), things)
        uvr = project_stereo(CAMERA, np.where(local[:, 2:] > 1, local, [0.0, 0.0, 1.0]))
        seen = (local[:, 2] > 2) & (local[:, 2] < 15) & inside_image(CAMERA, uvr[:, :2])
        ids[~seen], drift[~seen] = -1, 0.0
        new = np.flatnonzero(seen & (ids < 0))
        sigma = np.where(seen & (ids < 0), FIRST_UV_PX, SIGMA_UV_PX)
        drift[seen] += rng.normal(size=(seen.sum(), 2)) * sigma[seen, None]
        uv = uvr[:, :2] + drift
        disparity = uvr[:, 0] - uvr[:, 2] + rng.normal(0, SIGMA_DISPARITY_PX, len(uvr))
        points = backproject(CAMERA, uv[new], CAMERA.bf / disparity[new])
        flipped = np.packbits(rng.random((len(new), 256)) < NOISY_BITS / 512, axis=1)
        ids[new] = sparse_map.add_points(
            transform_points(Ts[k], points),
            np.repeat(0.01 * np.eye(3)[None], len(new), axis=0),
            np.zeros((len(new), 3)),
            looks[new] ^ flipped,
            np.zeros((len(new), 3), np.uint8),
        )
        thing += new.tolist()
        rows = np.flatnonzero(seen)
        tracks = Tracks(ids[rows], uv[rows], disparity[rows], sigma[rows])
        sparse_map.add_keyframe(Keyframe(k, 0.1 * k, Ts[k], tracks, Features.empty()))
    loop = LoopClosure(ROUND + 2, 2, Ts[ROUND + 2], Tracks.empty(), np.eye(4), 10.0)
    return Drive(sparse_map, sensor, truth, things, np.array(thing), loop)


def question_of(drive: Drive):
    return loop_question(drive.sparse_map, drive.sensor, drive.loop.keyframe, drive.loop.place)


def far_off_m(Ts, truth):
    """(K,) how far each camera is from where it was."""
    return np.linalg.norm(Ts[:, :3, 3] - truth[:, :3, 3], axis=1)


@pytest.fixture(scope="module")
def asked():
    drive = make_drive()
    question = question_of(drive)
    return drive, question, adjust_loop(question, CONFIG)


def test_what_was_mapped_twice_is_found_and_nothing_else(asked) -> None:
    drive, question, answer = asked
    pairs = answer.duplicates
    assert (drive.thing[pairs[:, 0]] == drive.thing[pairs[:, 1]]).mean() > 0.98
    recent = np.unique(question.seen.point_ids[np.isin(question.seen.view, question.recent)])
    place = np.unique(question.seen.point_ids[np.isin(question.seen.view, question.place)])
    both = np.intersect1d(drive.thing[recent], drive.thing[place])
    assert 0.7 * len(both) < len(pairs) <= len(both)
    assert len(np.unique(pairs)) == pairs.size


def test_all_keyframes_come_near_the_truth_as_noise_allows(asked) -> None:
    drive, question, answer = asked
    before = far_off_m(question.seen.Ts_world_camera, drive.truth)
    after = far_off_m(answer.solution.Ts_world_camera, drive.truth)
    assert before.max() > 0.14
    assert 0.001 < after.max() < 0.05
    np.testing.assert_array_equal(answer.solution.Ts_world_camera[0], drive.truth[0])


def test_it_is_the_points_mapped_twice_that_hold_the_loop_closed(asked) -> None:
    drive, question, answer = asked
    apart = adjust_loop(replace(question, place=question.place[:0]), CONFIG)
    assert len(apart.duplicates) == 0
    ends = [far_off_m(a.solution.Ts_world_camera, drive.truth)[-1] for a in (apart, answer)]
    assert 1e-4 < ends[1] < 0.5 * ends[0]


def test_few_points_do_nearly_as_well(asked) -> None:
    drive, question, answer = asked
    few = adjust_loop(question, replace(CONFIG, points_per_keyframe=30))
    assert len(few.point_ids) < 0.7 * len(answer.point_ids)
    assert 0.001 < far_off_m(few.solution.Ts_world_camera, drive.truth).max() < 0.08


def test_one_keyframe_sees_a_point_that_was_two_only_once(asked) -> None:
    _, question, answer = asked
    joined = join_points(question.seen, answer.duplicates, len(question.positions_m))
    key = joined.view * len(question.positions_m) + joined.point_ids
    assert len(np.unique(key)) == len(key) <= len(question.seen)
    assert not np.isin(joined.point_ids, answer.duplicates[:, 1]).any()


def test_the_map_follows_the_answer_with_what_came_since() -> None:
    drive = make_drive(1)
    sparse_map = drive.sparse_map
    answer = adjust_loop(question_of(drive), CONFIG)
    positions_m = sparse_map.position_m.copy()
    last = sparse_map.keyframes[-1]
    later = replace(
        last, frame_index=N, T_world_camera=last.T_world_camera @ exp_se3(np.ones(6) / 50)
    )
    sparse_map.add_keyframe(later)
    C = correct_map(sparse_map, loop_adjustment_correction(answer))
    Ts = np.stack([k.T_world_camera for k in sparse_map.keyframes])
    np.testing.assert_allclose(Ts[:N], answer.solution.Ts_world_camera, atol=1e-9)
    np.testing.assert_allclose(Ts[N], C @ later.T_world_camera, atol=1e-9)
    kept, gone = answer.duplicates.T
    assert sparse_map.alive[kept].all() and not sparse_map.alive[gone].any()
    assert not np.isin(sparse_map.keyframes[N].tracks.point_ids, gone).any()
    assert (sparse_map.covisible_keyframes(ROUND + 2) < 10).any()
    true_m = drive.things_m[drive.thing]
    before, after = (
        np.median(np.linalg.norm(p[answer.point_ids] - true_m[answer.point_ids], axis=1))
        for p in (positions_m, sparse_map.position_m)
    )
    assert 0.005 < after < 0.6 * before


# ------------------------------------------------------------------ its turn


class Slow:
    """A worker that keeps its questions until it is told to answer the last one."""

    def __init__(self) -> None:
        self.questions: list[tuple[Future, tuple]] = []

    def submit(self, function, *arguments):
        future: Future = Future()
        self.questions.append((future, (function, arguments)))
        if function.__name__ == "load_solver":
            future.set_result(None)
        return future

    def answer(self) -> str:
        future, (function, arguments) = self.questions[-1]
        future.set_result(function(*arguments))
        return function.__name__

    def close(self) -> None: ...


def looping_back_end(drive, monkeypatch, **settings):
    worker = Slow()
    config = replace(CONFIG, **settings)
    back_end = BackEnd(drive.sensor, config, SeenPlaces(PlacesConfig()), worker)
    off = exp_se3(np.array([0.0, 0.0, 0.0, 0.5, 0.0, 0.0]))
    loop = replace(drive.loop, off=off)
    monkeypatch.setattr(back_end._loops, "take", lambda sparse_map, features: loop)
    return back_end, worker


def test_the_full_adjustment_follows_the_pose_graph_and_later_loops_wait(monkeypatch) -> None:
    drive = make_drive(2)
    back_end, worker = looping_back_end(drive, monkeypatch, local_from_keyframe=0)
    back_end.after_keyframe(drive.sparse_map, Features.empty())
    assert worker.answer() == "solve_pose_graph"
    due = [back_end.take() for _ in range(10)]
    assert sum(c is not None for c in due) == 1
    correct_map(drive.sparse_map, next(c for c in due if c is not None))
    for _ in range(3):
        back_end.after_keyframe(drive.sparse_map, Features.empty())
    assert worker.answer() == "adjust_loop"
    assert back_end.n_loops == 1
    due = [back_end.take() for _ in range(30)]
    assert sum(c is not None for c in due) == 1 and due[2] is None
    assert back_end.n_full == 1 and not back_end.is_busy(drive.sparse_map)


def test_after_the_end_all_that_is_under_way_is_settled(monkeypatch) -> None:
    drive = make_drive(2)
    back_end, worker = looping_back_end(drive, monkeypatch)
    back_end.after_keyframe(drive.sparse_map, Features.empty())
    told = []
    while back_end.is_busy(drive.sparse_map) and len(told) < 5:
        if back_end._question is None:
            monkeypatch.setattr(worker, "submit", lambda f, *a: _done(f(*a)))
        else:
            told.append(worker.answer())
        correct_map(drive.sparse_map, back_end.settle(drive.sparse_map))
    assert told == ["solve_pose_graph"] and back_end.n_full == 1


def test_a_settled_map_is_settled_again_when_it_has_grown(monkeypatch) -> None:
    drive = make_drive(2)
    sparse_map = drive.sparse_map
    back_end, worker = looping_back_end(drive, monkeypatch, local_adjustment=False)
    monkeypatch.setattr(worker, "submit", lambda f, *a: _done(f(*a)))
    back_end.after_keyframe(sparse_map, Features.empty())
    while back_end.is_busy(sparse_map):
        correct_map(sparse_map, back_end.settle(sparse_map))
    monkeypatch.setattr(back_end._loops, "take", lambda sparse_map, features: None)
    asked_at = []
    for n in range(N + 1, N + 11):
        last = sparse_map.keyframes[-1]
        sparse_map.add_keyframe(replace(last, frame_index=last.frame_index + 1))
        assert back_end.is_busy(sparse_map)  # after the end nothing would be left out
        back_end.after_keyframe(sparse_map, Features.empty())
        if back_end._question is not None:
            asked_at.append(n)
            break
    assert asked_at == [int(np.ceil(1.2 * N))]


def _done(result) -> Future:
    future: Future = Future()
    future.set_result(result)
    return future


def test_without_full_adjustment_the_pose_graph_is_all(monkeypatch) -> None:
    drive = make_drive(2)
    back_end, worker = looping_back_end(drive, monkeypatch, full_adjustment=False)
    back_end.after_keyframe(drive.sparse_map, Features.empty())
    worker.answer()
    assert sum(back_end.take() is not None for _ in range(10)) == 1
    assert not back_end.is_busy(drive.sparse_map)
