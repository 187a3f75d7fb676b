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

_TOLERANCE = 1.002  # of an error, to be as good as before: exact inputs leave noise alone
CAMERA = 0  # body of the static world


@dataclass(frozen=True, slots=True)
class Verdict:
    """Held-out errors of one body, in standard deviations (RMS), before and after the batch.

    object_id: 0 for the static world, by which the cameras are judged. n_held_out: numbers of
    sightings behind it; without any there is nothing to object to.
    """

    object_id: int
    n_held_out: int
    before: float
    after: float

    @property
    def accepted(self) -> bool:
        """Whether the batch made it no worse."""
        return self.n_held_out == 0 or self.after <= _TOLERANCE * self.before


def judge(before: BatchProblem, after: BatchProblem, held: HeldOut) -> tuple[Verdict, ...]:
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
        sizes = [float(np.sqrt(e[own].mean())) if own.any() else np.nan for e in errors]
        verdicts.append(Verdict(int(object_id), int(own.sum()), sizes[0], sizes[1]))
    return tuple(verdicts)


def _errors(problem: BatchProblem, held: HeldOut) -> Array:
    views = problem.views(problem.Ts_world_camera, problem.Ts_world_object)
    points = settle_points(problem.camera, problem.tracks, views, problem.points_m)
    return held_out_errors(problem.camera, problem.tracks, held, views, points)
