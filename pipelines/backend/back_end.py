"""Bundle adjustment and loops beside tracking: when they are asked, when an answer moves the map.

Owns which question is under way; what each asks and when its answer is believed is in `questions`.
Loops are found by `loop_detection`; `mapping.correction` moves the map. A loop goes before a local
adjustment, but not before the full one of the loop that was found last. What sees old places where
they should be is settled as well, whenever the map has grown by a fifth.

An answer is applied a fixed number of frames after its question, however soon it is there: so the
same run moves the same map at the same frame, in a process or in this one.
"""

from __future__ import annotations

import logging
from concurrent.futures import Future
from typing import Any

from pipelines.backend.bundle_adjustment import load_solver
from pipelines.backend.local_window import local_window
from pipelines.backend.loop_adjustment import loop_question
from pipelines.backend.loop_detection import FEWEST_KEYFRAMES, LoopClosure, LoopDetector
from pipelines.backend.pose_graph import build_pose_graph
from pipelines.backend.questions import (
    ClosingQuestion,
    Question,
    SettlingQuestion,
    WindowQuestion,
)
from pipelines.backend.seen_places import SeenPlaces
from pipelines.backend.worker import InlineWorker, ProcessWorker, Worker
from pipelines.config import BackendConfig
from pipelines.frontend.sensor import Sensor
from pipelines.mapping.correction import MapCorrection
from pipelines.mapping.sparse_map import SparseMap
from pipelines.types import Features

_OBSERVATIONS_PER_EDGE = 3  # what an edge of the pose graph costs, in observations
_GROWN = 1.2  # times the keyframes of the last full adjustment, which are worth another
_log = logging.getLogger("dyob.backend")


class BackEnd:
    """Improves the map while tracking goes on: its latest part, and all of it where a loop closes.

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
        self._question: Question | None = None
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

    def _judge(self, question: Question) -> MapCorrection | None:
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
        self._ask(ClosingQuestion(due, graph, closes=loop))
        return True

    def _ask(self, question: Question) -> None:
        self._question, self._answer = question, question.ask(self.worker)

    def _awaited(self, question: Question) -> Future[Any]:
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
