"""Never worse: what of a batch is believed, by sightings that it was not shown.

Owns the verdict on the cameras and on each object. Writes and logs nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.backend.batch_problem import BatchProblem
from pipelines.backend.held_out import HeldOut, held_out_errors
from pipelines.backend.point_elimination import settle_points
from pipelines.types import Array

_TOLERANCE = 1.002  # of an error, up to which it is as good as before
_SIGNIFICANT = 1.0  # standard deviations of the growth, below which it may be chance
CAMERA = 0  # body of the static world


@dataclass(frozen=True, slots=True)
class Verdict:
    """Held-out errors of one body, in standard deviations (RMS), before and after the batch.

    object_id: 0 for the static world, by which the cameras are judged. n_held_out: sightings behind
    it; without any there is nothing to object to. worse_by: mean growth of their squared errors,
    in that mean's own standard deviations. is_binding: whether the batch is refused by it.
    """

    object_id: int
    n_held_out: int
    before: float
    after: float
    worse_by: float
    is_binding: bool = True

    @property
    def accepted(self) -> bool:
        """Whether the batch made it no worse, or nobody minds."""
        return (
            not self.is_binding
            or self.n_held_out == 0
            or (self.after <= _TOLERANCE * self.before or self.worse_by < _SIGNIFICANT)
        )


def judge(
    before: BatchProblem, after: BatchProblem, held: HeldOut, is_binding: bool = True
) -> tuple[Verdict, ...]:
    """Verdicts on the static world and on each object, all its stretches together.

    before, after: the same problem at the front-end's answer and at the batch's. Points settle for
    each, as the front-end's own are those that its filter had at the end of their tracks.
    """
    errors = [_errors(problem, held) for problem in (before, after)]
    body = before.body_of_view[held.view]
    owner = np.array([CAMERA, *(s.object_id for s in before.stretches)])[body]
    verdicts = []
    for object_id in np.unique([CAMERA, *(s.object_id for s in before.stretches)]):
        own = owner == object_id
        n = int(own.sum())
        if n == 0:
            verdicts.append(Verdict(int(object_id), 0, np.nan, np.nan, np.nan, is_binding))
            continue
        sizes = [float(np.sqrt(e[own].mean())) for e in errors]
        growth = errors[1][own] - errors[0][own]
        chance = float(growth.std() / np.sqrt(n))
        worse_by = float(growth.mean()) / max(chance, 1e-12)
        verdicts.append(Verdict(int(object_id), n, sizes[0], sizes[1], worse_by, is_binding))
    return tuple(verdicts)


def _errors(problem: BatchProblem, held: HeldOut) -> Array:
    views = problem.views(problem.Ts_world_camera, problem.Ts_world_object)
    points = settle_points(problem.camera, problem.tracks, views, problem.points_m)
    return held_out_errors(problem.camera, problem.tracks, held, views, points)
