"""What the back-end may ask beside tracking: how the work is done, and which answers are believed.

Owns the three questions and the judgement of their answers; `back_end` says when each is asked.
What is adjusted is chosen by `local_window` and solved by `bundle_adjustment`; loops are closed by
`pose_graph` and then settled by `loop_adjustment`.
"""

from __future__ import annotations

import logging
from abc import ABC, abstractmethod
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from pipelines.backend.bundle_adjustment import BundleProblem, BundleSolution, adjust_bundle
from pipelines.backend.local_window import BundleWindow, to_correction
from pipelines.backend.loop_adjustment import (
    LoopAnswer,
    LoopQuestion,
    adjust_loop,
    loop_adjustment_correction,
)
from pipelines.backend.loop_detection import LoopClosure
from pipelines.backend.pose_graph import PoseGraph, loop_correction, solve_pose_graph
from pipelines.backend.worker import Worker
from pipelines.config import BackendConfig
from pipelines.geometry import invert_T, rotation_angle_deg
from pipelines.mapping.correction import MapCorrection
from pipelines.types import Array

_MIN_AGREEING = 0.5  # share of observations; where fewer agree, something else is wrong
_MAX_MOVE_M, _MAX_MOVE_SHARE = 0.05, 0.02  # of a keyframe, and of its way from the held ones
_MAX_TURN_DEG = 0.5  # of a keyframe
_log = logging.getLogger("dyob.backend")


@dataclass(frozen=True, slots=True)
class Question(ABC):
    """Work to be done. what: for people. due: the count of frames at which its answer is applied.

    closes: the loop that it does, if it is the pose graph's. is_full: whether it is the full
    adjustment.
    """

    what: ClassVar[str]
    is_full: ClassVar[bool] = False
    due: int
    closes: LoopClosure | None = field(default=None, kw_only=True)

    @abstractmethod
    def ask(self, worker: Worker) -> Future[Any]:
        """Hand it to a worker, which answers the same however often."""

    @abstractmethod
    def judge(self, answer: Any) -> MapCorrection | str:
        """A correction by the answer, or why that is refused."""


@dataclass(frozen=True, slots=True)
class ClosingQuestion(Question):
    """Where all keyframes go when a loop is closed by the pose graph."""

    what = "loop closing"
    graph: PoseGraph
    closes: LoopClosure = field(kw_only=True)

    def ask(self, worker: Worker) -> Future[Any]:
        return worker.submit(solve_pose_graph, self.graph)

    def judge(self, answer: Array) -> MapCorrection:
        return loop_correction(self.graph, answer, self.closes)


@dataclass(frozen=True, slots=True)
class WindowQuestion(Question):
    """Where the latest keyframes and their points go."""

    what = "local bundle adjustment"
    window: BundleWindow
    rounds: int
    iterations: int

    def ask(self, worker: Worker) -> Future[Any]:
        return worker.submit(adjust_bundle, self.window.problem, self.rounds, self.iterations)

    def judge(self, answer: BundleSolution) -> MapCorrection | str:
        return reason_to_refuse(self.window, answer) or to_correction(self.window, answer)


@dataclass(frozen=True, slots=True)
class SettlingQuestion(Question):
    """Where all of a map goes in which a loop is closed."""

    what = "full bundle adjustment"
    is_full = True
    question: LoopQuestion
    config: BackendConfig

    def ask(self, worker: Worker) -> Future[Any]:
        return worker.submit(adjust_loop, self.question, self.config)

    def judge(self, answer: LoopAnswer) -> MapCorrection | str:
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
