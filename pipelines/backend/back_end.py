"""Bundle adjustment and loops beside tracking: when they are asked, when an answer moves the map.

Owns the one question that is under way and the judgement of its answer. What is adjusted is chosen
by `local_window` and solved by `bundle_adjustment`; loops are found by `loop_detection`, closed by
`pose_graph` and then settled by `loop_adjustment`; `mapping.correction` moves the map. A loop goes
before a local adjustment, but not before the full one of the loop that was found last. What sees
old places where they should be is settled as well, whenever the map has grown by a fifth.

An answer is applied a fixed number of frames after its question, however soon it is there: so the
same run moves the same map at the same frame, in a process or in this one.
"""

from __future__ import annotations

import logging
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol

import numpy as np

from pipelines.backend.bundle_adjustment import (
    BundleProblem,
    BundleSolution,
    adjust_bundle,
    load_solver,
)
from pipelines.backend.local_window import BundleWindow, local_window, to_correction
from pipelines.backend.loop_adjustment import (
    LoopAnswer,
    LoopQuestion,
    adjust_loop,
    loop_adjustment_correction,
    loop_question,
)
from pipelines.backend.loop_detection import FEWEST_KEYFRAMES, LoopClosure, LoopDetector
from pipelines.backend.pose_graph import (
    PoseGraph,
    build_pose_graph,
    loop_correction,
    solve_pose_graph,
)
from pipelines.backend.seen_places import SeenPlaces
from pipelines.backend.worker import InlineWorker, ProcessWorker, Worker
from pipelines.config import BackendConfig
from pipelines.frontend.sensor import Sensor
from pipelines.geometry import invert_T, rotation_angle_deg
from pipelines.mapping.correction import MapCorrection
from pipelines.mapping.sparse_map import SparseMap
from pipelines.types import Array, Features

_MIN_AGREEING = 0.5  # share of observations; where fewer agree, something else is wrong
_MAX_MOVE_M, _MAX_MOVE_SHARE = 0.05, 0.02  # of a keyframe, and of its way from the held ones
_MAX_TURN_DEG = 0.5  # of a keyframe
_OBSERVATIONS_PER_EDGE = 3  # what an edge of the pose graph costs, in observations
_GROWN = 1.2  # times the keyframes of the last full adjustment, which are worth another
_log = logging.getLogger("dyob.backend")


class _Question(Protocol):
    """Work to be done. what: for people. due: the count of frames at which its answer is applied.

    ask: hands it to a worker, which answers the same however often. judge: makes a correction of
    the answer, or says why it is refused. closes: the loop that it does, if it is the pose graph's.
    is_full: whether it is the full adjustment.
    """

    what: ClassVar[str]
    is_full: ClassVar[bool]

    @property
    def due(self) -> int: ...

    @property
    def closes(self) -> LoopClosure | None: ...

    def ask(self, worker: Worker) -> Future[Any]: ...

    def judge(self, answer: Any) -> MapCorrection | str: ...


@dataclass(frozen=True, slots=True)
class ClosingQuestion:
    """Where all keyframes go when a loop is closed by the pose graph."""

    what: ClassVar[str] = "loop closing"
    is_full: ClassVar[bool] = False
    due: int
    graph: PoseGraph
    closes: LoopClosure

    def ask(self, worker: Worker) -> Future[Any]:
        """As of `_Question`."""
        return worker.submit(solve_pose_graph, self.graph)

    def judge(self, answer: Array) -> MapCorrection:
        """As of `_Question`."""
        return loop_correction(self.graph, answer, self.closes)


@dataclass(frozen=True, slots=True)
class WindowQuestion:
    """Where the latest keyframes and their points go."""

    what: ClassVar[str] = "local bundle adjustment"
    is_full: ClassVar[bool] = False
    due: int
    window: BundleWindow
    rounds: int
    iterations: int
    closes: LoopClosure | None = None

    def ask(self, worker: Worker) -> Future[Any]:
        """As of `_Question`."""
        return worker.submit(adjust_bundle, self.window.problem, self.rounds, self.iterations)

    def judge(self, answer: BundleSolution) -> MapCorrection | str:
        """As of `_Question`."""
        return reason_to_refuse(self.window, answer) or to_correction(self.window, answer)


@dataclass(frozen=True, slots=True)
class SettlingQuestion:
    """Where all of a map goes in which a loop is closed."""

    what: ClassVar[str] = "full bundle adjustment"
    is_full: ClassVar[bool] = True
    due: int
    question: LoopQuestion
    config: BackendConfig
    closes: LoopClosure | None = None

    def ask(self, worker: Worker) -> Future[Any]:
        """As of `_Question`."""
        return worker.submit(adjust_loop, self.question, self.config)

    def judge(self, answer: LoopAnswer) -> MapCorrection | str:
        """As of `_Question`."""
        reason = reason_to_refuse_all(answer.problem, answer.solution)
        if reason is not None:
            return reason
        _log.info(
            "loop settled: %d keyframes and %d points, %d of them mapped twice",
            len(answer.problem.held),
            len(answer.point_ids),
            len(answer.duplicates),
        )
        return loop_adjustment_correction(answer)


class BackEnd:
    """Improves the latest keyframes and their points while tracking goes on.

    worker: where the work is done; by default as the settings say.
    """

    def __init__(
        self,
        sensor: Sensor,
        config: BackendConfig,
        places: SeenPlaces,
        worker: Worker | None = None,
    ) -> None:
        self.sensor, self.config = sensor, config
        self.worker = worker or (ProcessWorker() if config.process else InlineWorker())
        self._question: _Question | None = None
        self._answer: Future[Any] | None = None
        self._closed: LoopClosure | None = None  # the latest that the map has closed, not settled
        self._must_settle = False  # at once, as the pose graph had to close it
        self._n_settled = 0  # keyframes in the last full adjustment
        self._loops = LoopDetector(sensor, places)
        self._n_frames = 0
        self._warned = self._is_started = False
        self.n_applied = self.n_refused = self.n_loops = self.n_full = 0

    def __getstate__(self) -> dict[str, Any]:
        """All but the answer that is awaited: its question is asked again."""
        return {**vars(self), "_answer": None, "_is_started": False}

    def take(self) -> MapCorrection | None:
        """The correction that is due, if one is; to be called once a frame, before tracking.

        Waits for an answer that is late, unless `wait` is false. Answers that would make the map
        worse, and those that never came, are dropped.
        """
        self._n_frames += 1
        question = self._question
        if question is None:
            return None
        answer = self._awaited(question)
        late = self._n_frames >= question.due
        if not (late if self.config.wait else answer.done()):
            return None
        return self._judge(question)

    def is_busy(self, sparse_map: SparseMap) -> bool:
        """Whether an answer is awaited, or a loop is not settled with all keyframes that there are.

        For the time after the end: while frames come, what is new waits for more of it.
        """
        return self._question is not None or self._loop_to_settle(sparse_map, 1.0) is not None

    def settle(self, sparse_map: SparseMap) -> MapCorrection | None:
        """The correction that is under way, at once; while `is_busy`, after the end."""
        loop = self._loop_to_settle(sparse_map, 1.0)
        if self._question is None and loop is not None:
            self._settle_loop(sparse_map, *loop)
        return None if self._question is None else self._judge(self._question)

    def _judge(self, question: _Question) -> MapCorrection | None:
        """The correction that the question has led to, once its answer is there."""
        answer = self._awaited(question)
        self._question = self._answer = None
        try:
            verdict = question.judge(answer.result())
        except Exception as error:  # of any kind: the run does not depend on it
            self._warn(question.what, error)
            return None
        if isinstance(verdict, str):
            self.n_refused += 1
            _log.info("%s refused: %s", question.what, verdict)
            return None
        self.n_applied += 1
        self.n_full += question.is_full
        if self.config.full_adjustment and question.closes is not None:
            self._closed, self._must_settle = question.closes, True
        return verdict

    def after_keyframe(self, sparse_map: SparseMap, features: Features) -> None:
        """Ask what the map's latest keyframe, with these ORB features, is good for.

        Is it a place seen before, but not where it should be, the pose graph is asked, and once
        that is applied the adjustment of all; else that of the keyframe and its neighbours, unless
        an answer is awaited. The map is copied, not changed.
        """
        n, config = len(sparse_map.keyframes), self.config
        # Once a loop was settled, full adjustments keep the map: windows would only stir it
        is_open = self._n_settled == 0 and n >= config.local_from_keyframe
        adjusts = config.local_adjustment and is_open
        if adjusts or (config.loop_closing and n >= FEWEST_KEYFRAMES):
            self._start_worker()
        if config.loop_closing and self._close_loop(sparse_map, features):
            return
        if self._question is not None:
            return
        loop = self._loop_to_settle(sparse_map, _GROWN)
        if loop is not None:
            self._settle_loop(sparse_map, *loop)
        elif adjusts:
            self._adjust(sparse_map)

    def _close_loop(self, sparse_map: SparseMap, features: Features) -> bool:
        """Ask for the pose graph where the latest keyframe closes a loop that is open."""
        loop = self._loops.take(sparse_map, features)
        if loop is None or (self._question is not None and self._question.is_full):
            return False
        if self._must_settle:
            return False  # what settles the loop before this one may close this one, too
        if not loop.is_open:
            if self.config.full_adjustment:
                self._closed = loop
            return False
        frames = [sparse_map.keyframes[k].frame_index for k in (loop.keyframe, loop.place)]
        _log.info("loop: frame %d sees the place of frame %d", *frames)
        graph = build_pose_graph(sparse_map, [loop])
        due = self._due(len(graph.i) * _OBSERVATIONS_PER_EDGE)
        self.n_loops += 1
        self._ask(ClosingQuestion(due, graph, loop))
        return True

    def _ask(self, question: _Question) -> None:
        self._question, self._answer = question, question.ask(self.worker)

    def _awaited(self, question: _Question) -> Future[Any]:
        """The answer to come; it is asked for again where a run was interrupted meanwhile."""
        if self._answer is None:
            self._answer = question.ask(self.worker)
        return self._answer

    def _start_worker(self) -> None:
        """Start the process before there is a question, so that no answer waits for that."""
        if not self._is_started:
            self._is_started = True
            self.worker.submit(load_solver)

    def _adjust(self, sparse_map: SparseMap) -> None:
        config = self.config
        window = local_window(sparse_map, self.sensor, config)
        if window is None:
            return
        due = self._due(len(window.problem.tracks))
        self._ask(WindowQuestion(due, window, config.rounds, config.iterations))

    def _loop_to_settle(self, sparse_map: SparseMap, growth: float) -> tuple[int, int] | None:
        """Rows of a keyframe and of an old one that sees the same, if all should be adjusted now.

        Of the loop just closed; else, in a map that has had one, of the latest keyframe, when there
        are so many times the keyframes of the last full adjustment.
        """
        n, closed = len(sparse_map.keyframes), self._closed
        has_grown = n > self._n_settled and n >= growth * self._n_settled
        if closed is not None and (self._must_settle or has_grown):
            return closed.keyframe, closed.place
        if self._n_settled == 0 or not has_grown:
            return None
        old = sparse_map.covisible_keyframes(n - 1)
        old = old[old < n - FEWEST_KEYFRAMES]
        return (n - 1, int(old[0])) if len(old) else None

    def _settle_loop(self, sparse_map: SparseMap, keyframe: int, place: int) -> None:
        """Ask for the full adjustment of a map in which a loop is closed."""
        self._closed, self._must_settle = None, False
        self._n_settled = len(sparse_map.keyframes)
        question = loop_question(sparse_map, self.sensor, keyframe, place)
        most = self.config.points_per_keyframe * len(sparse_map.keyframes)
        n = len(question.seen)
        due = self._due(min(n, most) if most else n)
        self._ask(SettlingQuestion(due, question, self.config))

    def _due(self, n_observations: int) -> int:
        """The count of frames at which the answer to a question of some size is applied."""
        config = self.config
        frames = config.latency_frames + n_observations // config.observations_per_frame
        return self._n_frames + frames

    def close(self) -> None:
        """End the process, if there is one; an answer that is under way never comes."""
        self._question = self._answer = self._closed = None
        self._must_settle = False
        self.worker.close()

    def _warn(self, what: str, error: Exception) -> None:
        """Once as a warning: what fails for good would fail at every keyframe."""
        level = logging.INFO if self._warned else logging.WARNING
        self._warned = True
        _log.log(level, "%s dropped, the run goes on: %s", what, error)


def reason_to_refuse_all(problem: BundleProblem, solution: BundleSolution) -> str | None:
    """Why a solution is not believed, however far it moves what: None where it is.

    It must lower the error of the observations that agree in the end, and most must agree.
    """
    if not np.isfinite(solution.Ts_world_camera).all():
        return "its poses are not finite"
    if not solution.error_after < solution.error_before:
        return f"error {solution.error_before:.1f} before, {solution.error_after:.1f} after"
    share = float(solution.inliers.mean())
    if share < _MIN_AGREEING:
        return f"only {share:.0%} of the observations agree with it"
    return None


def reason_to_refuse(window: BundleWindow, solution: BundleSolution) -> str | None:
    """Why a solution of neighbours is not believed, None where it is.

    Besides all else no keyframe may jump: beyond 5 cm and 2 % of its way from the nearest held one,
    or by half a degree, which is far more than tracking errs by among neighbours.
    """
    problem = window.problem
    reason = reason_to_refuse_all(problem, solution)
    if reason is not None:
        return reason
    Ts_old, Ts_new = problem.Ts_world_camera, solution.Ts_world_camera
    moved_m = np.linalg.norm(Ts_new[:, :3, 3] - Ts_old[:, :3, 3], axis=1)
    centers_m = Ts_old[:, :3, 3]
    way_m = np.linalg.norm(centers_m[:, None] - centers_m[problem.held], axis=2).min(axis=1)
    if (moved_m > _MAX_MOVE_M + _MAX_MOVE_SHARE * way_m).any():
        return f"a keyframe would move by {moved_m.max():.3f} m"
    turned_deg = rotation_angle_deg(invert_T(Ts_old) @ Ts_new)
    if (turned_deg > _MAX_TURN_DEG).any():
        return f"a keyframe would turn by {turned_deg.max():.2f} deg"
    return None
