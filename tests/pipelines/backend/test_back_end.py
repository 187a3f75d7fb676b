"""The back-end beside tracking: when answers are applied, which are refused, and what may die."""

from __future__ import annotations

import logging
import os
import signal
from concurrent.futures import Future
from dataclasses import replace

import numpy as np
import pytest

from pipelines.backend.back_end import BackEnd
from pipelines.backend.bundle_adjustment import BundleSolution, adjust_bundle, load_solver
from pipelines.backend.local_window import local_window, to_correction
from pipelines.backend.questions import reason_to_refuse
from pipelines.backend.seen_places import SeenPlaces
from pipelines.backend.worker import WorkerDied
from pipelines.config import BackendConfig, PlacesConfig
from pipelines.dyob_slam import DyObSlam
from pipelines.geometry import exp_se3
from pipelines.io.config import load_config
from pipelines.io.result import load_result
from pipelines.runner import run
from pipelines.types import Features, TrackingStatus

# Many keyframes, so that much is adjusted in few frames
SETTINGS = ("backend.local_from_keyframe=0", "mapping.keyframe_max_interval=2")

ADJUSTING = BackendConfig(local_from_keyframe=0, loop_closing=False)
PLACES = SeenPlaces(PlacesConfig())  # of which nobody asks


class Slow:
    """A worker that answers when it is told to."""

    def __init__(self) -> None:
        self.questions: list[tuple[Future, tuple]] = []
        self.closed = False

    def submit(self, function, *arguments):
        future = Future()
        if function is load_solver:
            future.set_result(None)
        else:
            self.questions.append((future, (function, arguments)))
        return future

    def answer(self) -> None:
        future, (function, arguments) = self.questions[-1]
        future.set_result(function(*arguments))

    def close(self) -> None:
        self.closed = True


def run_street(street, *settings, after=lambda slam, k: None):
    """All frames of the street, and the system then; it is closed."""
    slam = DyObSlam(street.camera, load_config(None, [*SETTINGS, *settings]))
    results = []
    try:
        for k in range(len(street)):
            results.append(slam.process(street.read(k)))
            after(slam, k)
    finally:
        slam.close()
    return slam, results


@pytest.fixture(scope="module")
def inline(street):
    return run_street(street, "backend.process=false")


@pytest.fixture(scope="module")
def plain(street):
    """The same without any adjustment."""
    return run_street(street, "backend.local_adjustment=false")


def poses(results):
    return np.stack([r.T_world_camera for r in results])


# ----------------------------------------------------------------- whole runs


def test_runs_are_the_same_to_the_bit_inline_and_in_a_process(street, inline) -> None:
    slam, results = inline
    other, theirs = run_street(street)
    assert slam._backend.n_applied == other._backend.n_applied >= 3
    np.testing.assert_array_equal(poses(results), poses(theirs))
    np.testing.assert_array_equal(poses(slam.revise(results)), poses(other.revise(theirs)))
    np.testing.assert_array_equal(slam.static_map().points_m, other.static_map().points_m)
    for ours, others in zip(results, theirs, strict=True):
        np.testing.assert_array_equal(ours.objects.centers_m, others.objects.centers_m)


def test_corrections_move_the_map_and_tracking_goes_on_without_a_jump(street, inline, plain):
    (slam, results), (_, before) = inline, plain
    assert all(r.status is TrackingStatus.OK for r in results)
    assert np.abs(poses(results) - poses(before)).max() > 1e-7  # something was corrected
    truth = street.ground_truth().Ts_world_camera[:, :3, 3]
    for Ts in (poses(results), poses(slam.revise(results))):
        error_m = np.linalg.norm(Ts[:, :3, 3] - truth, axis=1)
        assert 1e-7 < error_m.max() < 0.02
        steps = np.diff(Ts[:, :3, 3], axis=0) - np.diff(truth, axis=0)
        assert np.abs(steps).max() < 0.01


def test_objects_keep_their_motion_through_corrections(inline, plain) -> None:
    (slam, results), (_, before) = inline, plain
    n_told = 0
    for now, then in zip(slam.revise(results), before, strict=True):
        assert now.objects.object_id.tolist() == then.objects.object_id.tolist()
        told = np.isfinite(then.objects.speed_mps)
        difference = now.objects.speed_mps[told] - then.objects.speed_mps[told]
        assert (np.abs(difference) < 0.1).all()
        n_told += told.sum()
    assert n_told > 20


def test_without_adjustment_results_are_left_as_they_are(plain) -> None:
    slam, results = plain
    revised = slam.revise(results)
    assert all(a is b for a, b in zip(revised, results, strict=True))
    assert slam._backend.n_applied == 0 and slam._backend.worker.pid is None


def test_a_killed_process_is_replaced_and_the_run_ends_whole(street, tmp_path, caplog) -> None:
    killed = []

    class Killer:
        """A sink: it sees each frame when it is done."""

        def start(self, sequence, n_frames, config, folder) -> None: ...

        def frame(self, frame, result) -> None:
            for pid in children() if frame.index in (6, 7, 13) else []:
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

        def finish(self) -> None: ...

    settings = [*SETTINGS, "batch.at_end=false", "batch.record=true"]
    with caplog.at_level(logging.INFO, logger="dyob"):
        run(street, load_config(None, settings), tmp_path / "r", sinks=[Killer()])
    assert len(set(killed)) >= 2
    assert len(load_result(tmp_path / "r").Ts_world_camera) == len(street)
    said = [r for r in caplog.records if "run goes on" in r.message]
    assert len(said) >= 1 and [r.levelno for r in said].count(logging.WARNING) == 1
    assert not children()


def children() -> list[int]:
    """Back-end processes of this one that are not dead yet."""
    import subprocess

    listed = subprocess.run(
        ["ps", "-o", "pid=,stat=,args=", "--ppid", str(os.getpid())],
        capture_output=True, text=True, check=True,
    ).stdout  # fmt: skip
    rows = [line.split(None, 2) for line in listed.splitlines()]
    return [int(pid) for pid, stat, args in rows if "backend.worker" in args and stat[0] != "Z"]


# ----------------------------------------------------------------- one answer


@pytest.fixture(scope="module")
def mapped(plain):
    """A map with many keyframes, and its sensor."""
    slam, _ = plain
    return slam.map, slam.sensor


def test_an_answer_is_applied_at_its_frame_however_soon_it_is_there(mapped) -> None:
    sparse_map, sensor = mapped
    for quick in (True, False):
        worker = Slow()
        back_end = BackEnd(sensor, ADJUSTING, PLACES, worker)
        assert back_end.take() is None
        back_end.after_keyframe(sparse_map, Features.empty())
        back_end.after_keyframe(sparse_map, Features.empty())  # one at a time
        assert len(worker.questions) == 1
        n = len(worker.questions[0][1][1][0].tracks)
        if quick:
            worker.answer()
        for _ in range(1 + n // 1500):
            assert back_end.take() is None
        if not quick:
            worker.answer()
        assert back_end.take() is not None
        assert back_end.take() is None
        back_end.close()
        assert worker.closed


def test_without_waiting_an_answer_is_taken_when_it_comes(mapped) -> None:
    sparse_map, sensor = mapped
    worker = Slow()
    config = BackendConfig(local_from_keyframe=0, loop_closing=False, wait=False)
    back_end = BackEnd(sensor, config, PLACES, worker)
    back_end.after_keyframe(sparse_map, Features.empty())
    for _ in range(30):
        assert back_end.take() is None
    worker.answer()
    assert back_end.take() is not None


@pytest.mark.parametrize("error", [WorkerDied("gone"), RuntimeError("indeterminate system")])
def test_an_answer_that_never_comes_is_dropped_with_one_warning(mapped, caplog, error) -> None:
    sparse_map, sensor = mapped
    worker = Slow()
    back_end = BackEnd(sensor, ADJUSTING, PLACES, worker)
    with caplog.at_level(logging.WARNING, logger="dyob.backend"):
        for n in range(2):
            back_end.after_keyframe(sparse_map, Features.empty())
            worker.questions[-1][0].set_exception(error)
            assert [back_end.take() for _ in range(10)] == [None] * 10
            assert len(worker.questions) == n + 1
    assert len(caplog.records) == 1 and str(error) in caplog.text


def test_the_window_is_copied_and_holds_the_first_keyframe(mapped) -> None:
    sparse_map, sensor = mapped
    for window in (
        local_window(sparse_map, sensor, BackendConfig(local_keyframes=3)),
        local_window(sparse_map, sensor, BackendConfig(local_keyframes=99)),
    ):
        problem = window.problem
        assert not problem.held[-1] and problem.held.any()
        assert problem.held[window.keyframes == 0].all()
        assert (problem.tracks.lengths >= 2).all()
        assert not np.shares_memory(problem.points_m, sparse_map.position_m)
        K = len(window.keyframes)
        np.testing.assert_array_equal(np.unique(problem.tracks.view), np.arange(K))
        correction = to_correction(window, adjust_bundle(problem))
        assert sparse_map.alive[correction.point_ids].all()
    assert (
        ~local_window(sparse_map, sensor, BackendConfig(local_keyframes=3)).problem.held
    ).sum() == 3


# ------------------------------------------------------------------- judgement


@pytest.fixture(scope="module")
def solved(mapped):
    window = local_window(*mapped, BackendConfig())
    return window, adjust_bundle(window.problem)


def test_a_good_solution_is_believed(solved) -> None:
    assert reason_to_refuse(*solved) is None


def moved(solution: BundleSolution, xi) -> np.ndarray:
    Ts = solution.Ts_world_camera.copy()
    Ts[-1] = Ts[-1] @ exp_se3(np.array(xi, float))
    return Ts


def test_bad_solutions_are_refused_with_their_reason(solved) -> None:
    window, good = solved
    nan = np.full_like(good.Ts_world_camera, np.nan)
    cases = {
        "error": replace(good, error_after=good.error_before),
        "not finite": replace(good, Ts_world_camera=nan),
        "agree": replace(good, inliers=np.zeros_like(good.inliers)),
        "move by": replace(good, Ts_world_camera=moved(good, [0, 0, 0, 0.5, 0, 0])),
        "turn by": replace(good, Ts_world_camera=moved(good, [0, 0.02, 0, 0, 0, 0])),
    }
    for reason, solution in cases.items():
        assert reason in (reason_to_refuse(window, solution) or ""), reason


def test_a_refused_answer_leaves_the_map_alone(mapped, solved, caplog) -> None:
    _, good = solved
    worker = Slow()
    back_end = BackEnd(mapped[1], ADJUSTING, PLACES, worker)
    back_end.after_keyframe(mapped[0], Features.empty())
    worker.questions[-1][0].set_result(replace(good, error_after=good.error_before))
    with caplog.at_level(logging.INFO, logger="dyob.backend"):
        assert [back_end.take() for _ in range(10)] == [None] * 10
    assert (back_end.n_refused, back_end.n_applied) == (1, 0)
    assert "refused: error" in caplog.text
