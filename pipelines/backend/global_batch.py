"""The global batch: all cameras, static points, object poses and object points of a run at once.

Owns the order of it: hold out, solve, leave out outliers, solve, judge, covariances. What a step
does is in the modules beside this one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.batch_problem import BatchProblem, build_problem
from pipelines.backend.batch_solver import solve
from pipelines.backend.carried_errors import learn_carried
from pipelines.backend.guard import (
    CAMERA,
    Verdict,
    judge,
    keep_motions,
    lone_motions,
    misfit_motions,
)
from pipelines.backend.held_out import hold_out
from pipelines.backend.marginals import PoseCovariances
from pipelines.backend.misfit import allow_for_noisy_views
from pipelines.backend.object_graph import pose_graph
from pipelines.backend.point_elimination import Residuals
from pipelines.backend.score_bootstrap import bootstrap_covariances
from pipelines.config import BatchConfig
from pipelines.frame_observations import FrameObservations
from pipelines.object_types import ObjectEstimates
from pipelines.types import Array, StereoCamera

_MIN_FRAMES = 3
_GATE_UV, _GATE_DISPARITY = 9.21**0.5, 6.63**0.5  # chi-square 99 %, 2 and 1 degrees of freedom

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class BatchResult:
    """What a batch came to.

    before, after: the problem at the front-end's answer and at the batch's; what was refused is in
    `after` as it was in `before`. verdicts: of the cameras first. kept_motions: (O,) bool, motions
    to these object poses that stayed the front-end's though their object was believed.
    covariances: at the batch's optimum, None where they were not wanted. cost_before, cost_after:
    robust costs. n_outliers: pixels and disparities left out.
    """

    before: BatchProblem
    after: BatchProblem
    verdicts: tuple[Verdict, ...]
    kept_motions: NDArray[np.bool_]
    covariances: PoseCovariances | None
    cost_before: float
    cost_after: float
    n_outliers: int

    @property
    def accepted(self) -> bool:
        """Whether the cameras were believed; without them nothing is."""
        return self.verdicts[0].accepted

    @property
    def accepted_objects(self) -> frozenset[int]:
        """Ids of objects whose new poses were believed."""
        if not self.accepted:
            return frozenset()
        return frozenset(v.object_id for v in self.verdicts[1:] if v.accepted)


def run_global_batch(
    camera: StereoCamera,
    log: Sequence[FrameObservations],
    objects: ObjectEstimates,
    config: BatchConfig,
    progress: Progress = lambda done, total: None,
) -> BatchResult | None:
    """Optimise a run. log: all its frames. objects: the front-end's rows, all frames.

    Returns None where there is too little to optimise. Two rounds: chi-square outliers of the
    first are left out of the second. progress: called with (done, total) as it goes.
    """
    if not has_enough(log):
        return None
    start = build_problem(
        camera,
        log,
        objects if config.with_objects else ObjectEstimates.empty(),
        config.max_static_per_frame,
    )
    if len(start.tracks) == 0:
        return None
    start = allow_for_noisy_views(learn_carried(start))
    tracks, rows, held = hold_out(start.tracks, start.sighting_rows, config.held_out_share)
    problem = start.with_tracks(tracks, rows)
    graph = pose_graph(problem, config)
    total, done = config.rounds * config.max_steps + 2, 0

    def step() -> None:
        nonlocal done
        done += 1
        progress(done, total)

    keep_uv = keep_disparity = np.ones(len(tracks), bool)
    solution, cost_before = None, 0.0
    for number in range(config.rounds):
        at = problem if solution is None else solution.problem
        is_last = number + 1 == config.rounds
        solution = solve(
            at, graph, keep_uv, keep_disparity, config.max_steps, step, is_rough=not is_last
        )
        if number == 0:
            cost_before = solution.cost_before
        if not is_last:
            keep_uv, keep_disparity = inliers(solution.residuals)
        done = (number + 1) * config.max_steps
    assert solution is not None
    verdicts = judge(problem, solution.problem, held, config.guard)
    step()
    covariances = None
    if config.covariances and verdicts[CAMERA].accepted:
        covariances = bootstrap_covariances(solution.problem, graph, solution.residuals)
    step()
    n_outliers = int((~keep_uv).sum() + (~keep_disparity).sum())
    costs = np.array([cost_before, solution.cost])
    result = as_result(problem, solution.problem, verdicts, costs, n_outliers)
    kept = result.kept_motions
    if config.guard:
        kept = misfit_motions(problem, solution.problem, objects) | lone_motions(problem)
    return with_motions(result, kept, covariances)


def has_enough(log: Sequence[FrameObservations]) -> bool:
    """Whether there are frames enough to optimise."""
    return sum(entry.is_tracked for entry in log) >= _MIN_FRAMES


def inliers(residuals: Residuals) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which pixels and disparities (N,) each pass the chi-square test, and lie before the camera.

    What was left out of the residuals is 0 there and passes: it is tried again.
    """
    size = np.linalg.norm(residuals.uv, axis=1)
    return size <= _GATE_UV, np.abs(residuals.disparity) <= _GATE_DISPARITY


def as_result(
    before: BatchProblem,
    solved: BatchProblem,
    verdicts: tuple[Verdict, ...],
    costs: Array,
    n_outliers: int,
) -> BatchResult:
    """What is left of a solution by its verdicts. costs: (2,) before and after."""
    after = _accept(before, solved, verdicts)
    none = np.zeros(len(before.Ts_world_object), bool)
    return BatchResult(
        before, after, verdicts, none, None, float(costs[0]), float(costs[1]), n_outliers
    )


def with_motions(
    result: BatchResult, kept: NDArray[np.bool_], covariances: PoseCovariances | None
) -> BatchResult:
    """The result with single motions left as they were, in objects that were not refused anyway.

    kept: (O,) motions to these poses. covariances: of the solution.
    """
    kept = kept & result.accepted
    for stretch in result.before.stretches:
        kept[stretch.poses] &= stretch.object_id in result.accepted_objects
    after = keep_motions(result.before, result.after, kept) if kept.any() else result.after
    return replace(result, after=after, kept_motions=kept, covariances=covariances)


def _accept(
    before: BatchProblem, after: BatchProblem, verdicts: tuple[Verdict, ...]
) -> BatchProblem:
    """The solution, but for objects that got worse; nothing of it where the cameras did."""
    if not verdicts[CAMERA].accepted:
        return before
    poses = after.Ts_world_object.copy()
    refused = {v.object_id for v in verdicts[1:] if not v.accepted}
    for stretch in before.stretches:
        if stretch.object_id in refused:
            poses[stretch.poses] = before.Ts_world_object[stretch.poses]
    return after.at(after.Ts_world_camera, poses, after.points_m)
