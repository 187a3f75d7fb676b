"""Never worse: what of a batch is believed, by sightings that it was not shown.

Owns the verdict on the cameras, on each object and on each single motion of one. Writes and logs
nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.batch_problem import BatchProblem, witnesses
from pipelines.backend.held_out import HeldOut, held_out_errors
from pipelines.backend.misfit import object_misfits
from pipelines.backend.point_elimination import settle_points
from pipelines.geometry import invert_T, orthonormalise
from pipelines.object_types import ObjectEstimates
from pipelines.objects.motion import displacement, fuse_motions
from pipelines.types import Array

# Five times chi-square, 6 degrees of freedom, 99.9 %: real errors are not white. Of a thousand
# motions of simulated sequences, none that the batch made better comes near both
_RULED_OUT = 5.0 * 22.5
_WILD_MPS = 1.0  # apart in speed, it is ruled out by the front-end's covariance alone
_TOLERANCE = 1.002  # of an error, up to which it is as good as before
_SIGNIFICANT = 1.0  # standard deviations of the growth, below which it may be chance
_LONE = 2  # poses of a stretch that is a single motion
MIN_HELD_OUT = 5  # sightings, fewer of which say nothing of an object
CAMERA = 0  # body of the static world


@dataclass(frozen=True, slots=True)
class Verdict:
    """Held-out errors of one body, in standard deviations (RMS), before and after the batch.

    object_id: 0 for the static world, by which the cameras are judged. n_held_out: sightings behind
    it. Where they are few, nothing objects to the cameras, and nothing speaks for an object.
    worse_by: mean growth of their squared errors, in that mean's own standard deviations.
    is_binding: whether the batch is refused by it. handicap: share of `before` by which it is too
    small, as the front-end was shown them.
    """

    object_id: int
    n_held_out: int
    before: float
    after: float
    worse_by: float
    is_binding: bool = True
    handicap: float = 0.0

    @property
    def accepted(self) -> bool:
        """Whether the batch made it no worse, or nobody minds."""
        if not self.is_binding:
            return True
        if self.n_held_out < MIN_HELD_OUT:
            return self.object_id == CAMERA
        allowed = _TOLERANCE * (1.0 + self.handicap) * self.before
        return self.after <= allowed or self.worse_by < _SIGNIFICANT


def judge(
    before: BatchProblem, after: BatchProblem, held: HeldOut, is_binding: bool = True
) -> tuple[Verdict, ...]:
    """Verdicts on the static world and on each object, all its stretches together.

    before, after: the same problem at the front-end's answer and at the batch's. Points settle for
    each, as the front-end's own are those that its filter had at the end of their tracks. Its poses
    were fitted to the held-out sightings, too: the six numbers of a pose fit some of the noise.
    """
    errors = [_errors(problem, held) for problem in (before, after)]
    owner_of_view = np.array([CAMERA, *(s.object_id for s in before.stretches)])[
        before.body_of_view
    ]
    verdicts = []
    for object_id in np.unique(owner_of_view):
        own = owner_of_view[held.view] == object_id
        n = int(own.sum())
        if n == 0:
            verdicts.append(Verdict(int(object_id), 0, np.nan, np.nan, np.nan, is_binding))
            continue
        sizes = [float(np.sqrt(e[own].mean())) for e in errors]
        n_poses = int((owner_of_view == object_id).sum())
        handicap = 6.0 * n_poses / _n_numbers(before, held, owner_of_view == object_id)
        growth = errors[1][own] - (1.0 + handicap) ** 2 * errors[0][own]
        chance = float(growth.std() / np.sqrt(n))
        worse_by = float(growth.mean()) / max(chance, 1e-12)
        verdicts.append(
            Verdict(int(object_id), n, sizes[0], sizes[1], worse_by, is_binding, handicap)
        )
    return tuple(verdicts)


def _n_numbers(problem: BatchProblem, held: HeldOut, views: NDArray[np.bool_]) -> int:
    """How many numbers the front-end has measured in some views (V,), those held out among them.

    Pixels of one patch err alike, and count as one: a pose fits so much more of their errors.
    """
    seen = (problem.tracks, held)
    view = np.concatenate([s.view for s in seen])
    uv_px, disparity_px = (
        np.concatenate([getattr(s, name) for s in seen]) for name in ("uv_px", "disparity_px")
    )
    own = views[view]
    n_patches = len(witnesses(view[own], uv_px[own]))
    return 2 * n_patches + int(np.isfinite(disparity_px[own]).sum())


def misfit_motions(
    before: BatchProblem, after: BatchProblem, objects: ObjectEstimates
) -> NDArray[np.bool_]:
    """(O,) motions to object poses that all there is of them speaks against.

    objects: the front-end's rows. The held-out sightings judge an object as a whole, as a single
    motion has too few of them. Here what the two frames saw of the object, outliers of the batch
    and all, misfits the batch's motion by far more than six numbers fit by chance beside the
    front-end's (a likelihood-ratio test), and the front-end's own covariance rules it out. Where
    the speeds are far apart that alone will do, unless what was seen speaks for the batch as
    clearly: few points fit anything.
    """
    n, growth = len(before.Ts_world_object), np.zeros(len(before.Ts_world_object))
    view = before.tracks.view - before.n_frames
    on_object = view >= 0
    for problem, sign in ((before, -1.0), (after, 1.0)):
        growth += sign * np.bincount(view[on_object], object_misfits(problem), n)
    found: NDArray[np.bool_] = np.zeros(n, bool)
    told = _front_end_motions(before, after)
    for stretch in before.stretches:
        rows, steps = stretch.rows[1:], np.arange(stretch.first_pose + 1, stretch.poses.stop)
        poses = after.Ts_world_object[stretch.poses]
        centers = np.einsum(
            "nij,nj->ni", invert_T(told[steps]), np.pad(objects.centers_m[rows], ((0, 0), (0, 1)),
            constant_values=1.0),
        )[:, :3]  # fmt: skip
        Hs = poses[1:] @ invert_T(poses[:-1])
        none = np.zeros((len(rows), 6, 6))
        covariances = objects.motion_covariances[rows]
        surprise = fuse_motions(told[steps], covariances, Hs, none, centers).distance2
        apart_m = displacement(Hs, centers) - displacement(told[steps], centers)
        dts_s = np.diff(before.timestamps_s[stretch.frames])
        wild = np.linalg.norm(apart_m, axis=1) > _WILD_MPS * dts_s
        wild &= growth[steps] > -_RULED_OUT  # else what was seen proves it
        found[steps] = ((growth[steps] > _RULED_OUT) | wild) & ~(surprise <= _RULED_OUT)
    return found


def lone_motions(problem: BatchProblem) -> NDArray[np.bool_]:
    """(O,) motions to object poses that have no other before or after them in their stretch.

    Nothing is held out of them, and nothing makes them smoother: the front-end, which fused them
    with what it expected, knows more.
    """
    lone: NDArray[np.bool_] = np.zeros(len(problem.Ts_world_object), bool)
    for stretch in problem.stretches:
        lone[stretch.poses] = len(stretch) <= _LONE
    return lone


def _front_end_motions(before: BatchProblem, after: BatchProblem) -> Array:
    """(O, 4, 4) motions to object poses by the front-end, as seen from the batch's cameras."""
    C = after.Ts_world_camera @ invert_T(before.Ts_world_camera)
    Hs = np.full_like(before.Ts_world_object, np.nan)
    for stretch in before.stretches:
        L, moved = before.Ts_world_object[stretch.poses], C[stretch.frames]
        steps = L[1:] @ invert_T(L[:-1])
        Hs[stretch.first_pose + 1 : stretch.poses.stop] = moved[1:] @ steps @ invert_T(moved[:-1])
    return Hs


def keep_motions(
    before: BatchProblem, after: BatchProblem, kept: NDArray[np.bool_]
) -> BatchProblem:
    """The batch's answer, but with the front-end's motions, as seen from its cameras, where kept.

    kept: (O,) motions to these poses. What follows in a stretch goes on from there.
    """
    told, poses = _front_end_motions(before, after), after.Ts_world_object.copy()
    for stretch in before.stretches:
        for o in range(stretch.first_pose + 1, stretch.poses.stop):
            new = after.Ts_world_object[o] @ invert_T(after.Ts_world_object[o - 1])
            poses[o] = (told[o] if kept[o] else new) @ poses[o - 1]
    return after.at(after.Ts_world_camera, orthonormalise(poses), after.points_m)


def _errors(problem: BatchProblem, held: HeldOut) -> Array:
    views = problem.views(problem.Ts_world_camera, problem.Ts_world_object)
    points = settle_points(problem.camera, problem.tracks, views, problem.points_m)
    return held_out_errors(problem.camera, problem.tracks, held, views, points)
