"""Covariances of final poses by what the residuals themselves say: a score bootstrap.

Owns what the marginals of the model cannot know: that errors of real flow and disparity last along
a track and are alike over a patch of the image, so that N sightings are fewer than N witnesses. The
pull of each group of tracks on all poses gets a random sign, again and again, and the spread of the
poses is their covariance: the bootstrap form of the cluster-robust sandwich H^-1 (sum g g') H^-1
(Liang and Zeger 1986; Kline and Santos 2012), whatever the weights were.

What errs over the whole of a body as if it had moved leaves no residual. It is told from the two
scales that do: by as much as patches make variances wider than single tracks, the whole body is
taken to make them wider than patches, which lie about half way between in scale. White noise shows
no such growth, and gets none. Measured as errors over standard deviations, by the model in
brackets: on eight degraded drives and rooms 0.9 (1.4) for steps of the camera, 1.1 (1.9) for its
poses, 1.0 (1.5) for motions of objects and 1.2 (2.6) for their poses; on four streets and crossings
0.8 (1.9), 0.9 (2.6), 1.3 (2.2) and 1.6 (3.3).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.batch_problem import BatchProblem
from pipelines.backend.batch_solver import adjoint, pose_system, to_values
from pipelines.backend.marginals import PoseCovariances
from pipelines.backend.object_graph import PoseFactors, camera_key, object_key
from pipelines.backend.point_elimination import Residuals, eliminate_points
from pipelines.backend.point_tracks import Index
from pipelines.geometry import invert_T
from pipelines.types import Array

_DRAWS = 200  # 5 % of a standard deviation
_WORLD_PATCHES, _OBJECT_PATCHES = 32, 4  # of the image, and of what is seen of an object
_POSE_NUMBERS, _GROUP_NUMBERS = 6.0, 2.0  # of a view, and of the mean error of a group in it
_MOST_LEVERAGE = 0.5
_SLIGHT_DAMPING = 1e-6  # of points: some are hardly held at all


def bootstrap_covariances(
    problem: BatchProblem, graph: PoseFactors, residuals: Residuals, seed: int = 0
) -> PoseCovariances:
    """Covariances of all poses, as `marginals.pose_covariances` has them, by the residuals.

    graph: the gtsam factors between poses, taken at their word. residuals: at the optimum.
    """
    from scipy.sparse.linalg import splu

    views = problem.views(problem.Ts_world_camera, problem.Ts_world_object)
    system = eliminate_points(
        problem.camera, problem.tracks, views, problem.points_m, residuals, _SLIGHT_DAMPING
    )
    first, second, blocks, _ = pose_system(problem, system, views)
    factors = _factors(problem, graph)
    n = problem.n_frames + len(problem.Ts_world_object)
    factor = splu(
        _matrix(first, second, blocks, factors, n),
        permc_spec="MMD_AT_PLUS_A",
        options={"SymmetricMode": True},
    )
    of_tracks, of_patches = (
        _of_samples(problem, _sample(problem, views, system.pull, groups, factors, factor, seed))
        for groups in (np.arange(problem.tracks.n_tracks), _patches(problem))
    )
    return _carried_on(of_tracks, of_patches)


def _factors(problem: BatchProblem, graph: PoseFactors) -> list[tuple[list[int], Array]]:
    """The linearised factors between poses: which poses, cameras first, and their information."""
    F, n_objects = problem.n_frames, len(problem.Ts_world_object)
    row = {camera_key(k): k for k in range(F)}
    row |= {object_key(o): F + o for o in range(n_objects)}
    linear = graph.linearize(to_values(problem))
    parts = [linear.at(i) for i in range(linear.size())]
    return [([row[k] for k in list(part.keys())], part.information()) for part in parts]


def _matrix(
    first: Index, second: Index, blocks: Array, factors: list[tuple[list[int], Array]], n: int
) -> Any:
    """The system of all poses, (6 n, 6 n) sparse, from blocks first <= second and factors."""
    from scipy.sparse import coo_matrix

    off = first != second
    rows, columns = [first, second[off]], [second, first[off]]
    parts = [blocks, blocks[off].transpose(0, 2, 1)]
    for keys, information in factors:
        m = len(keys)
        rows.append(np.repeat(keys, m))
        columns.append(np.tile(keys, m))
        parts.append(information.reshape(m, 6, m, 6).swapaxes(1, 2).reshape(-1, 6, 6))
    every = np.arange(n)  # a pose that nothing tells of must not make it singular
    rows, columns = [*rows, every], [*columns, every]
    parts.append(np.repeat(1e-9 * np.eye(6)[None], n, axis=0))
    row = 6 * np.concatenate(rows)[:, None, None] + np.arange(6)[:, None]
    column = 6 * np.concatenate(columns)[:, None, None] + np.arange(6)
    values = np.concatenate(parts)
    row, column = (np.broadcast_to(x, values.shape).ravel() for x in (row, column))
    return coo_matrix((values.ravel(), (row, column)), (6 * n, 6 * n)).tocsc()


def _patches(problem: BatchProblem) -> Index:
    """(P,) the patch of each track: of its body, by where its middle sighting lies in the image.

    An object's patches lie on what is seen of it, from the middle of its points in that view.
    """
    tracks = problem.tracks
    middle = tracks.starts + tracks.lengths // 2
    uv, view = tracks.uv_px[middle], tracks.view[middle]
    body = problem.body_of_view[view]
    area = float(problem.camera.width * problem.camera.height)
    side = np.full(len(uv), np.sqrt(area / _WORLD_PATCHES))
    of_object = body > 0
    counts = np.maximum(np.bincount(tracks.view, minlength=tracks.n_views), 1).astype(float)
    center = np.stack([np.bincount(tracks.view, x, tracks.n_views) for x in tracks.uv_px.T], -1)
    center = center / counts[:, None]
    away = (tracks.uv_px - center[tracks.view]) ** 2
    spread = np.stack([np.bincount(tracks.view, x, tracks.n_views) for x in away.T], -1)
    box_px = np.sqrt(12.0 * spread / counts[:, None])  # sides of an even box of that spread
    sides = np.maximum(np.sqrt(box_px.prod(axis=1) / _OBJECT_PATCHES), 1.0)
    side[of_object] = sides[view[of_object]]
    uv = np.where(of_object[:, None], uv - center[view], uv)
    cell = np.floor(uv / side[:, None]).astype(np.int64)
    return np.unique(np.column_stack([body, cell]), axis=0, return_inverse=True)[1].ravel()


def _sample(
    problem: BatchProblem,
    views: Array,
    pull: Array,
    groups: Index,
    factors: list[tuple[list[int], Array]],
    solver: Any,
    seed: int,
) -> Array:
    """(F + O, 6, draws) answers of all poses where groups of tracks pull with random signs."""
    rng = np.random.default_rng(seed)
    pulls = _draw_pulls(problem, views, pull, groups, rng)
    for keys, information in factors:
        values, vectors = np.linalg.eigh(information)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        draw = root @ rng.standard_normal((len(root), _DRAWS))
        pulls[keys] += draw.reshape(len(keys), 6, _DRAWS)
    return solver.solve(pulls.reshape(-1, _DRAWS)).reshape(pulls.shape)


def _draw_pulls(
    problem: BatchProblem, views: Array, pull: Array, groups: Index, rng: np.random.Generator
) -> Array:
    """(F + O, 6, draws) sums of the pulls (N, 6) on views, each group of tracks (P,) with its sign.

    The poses have fitted a part of each group's error away, by which its pulls are made larger: all
    alike, as those of a track add up to nothing on its body as a whole.
    """
    from scipy.sparse import coo_matrix

    tracks, F = problem.tracks, problem.n_frames
    n, of_track = F + len(problem.Ts_world_object), groups[tracks.track]
    n_groups = int(groups.max()) + 1
    seen = np.unique(tracks.view * n_groups + of_track) // n_groups
    n_seen = np.maximum(np.bincount(seen, minlength=tracks.n_views), 1)
    leverage = np.minimum(_POSE_NUMBERS / (_GROUP_NUMBERS * n_seen), _MOST_LEVERAGE)
    mean = np.bincount(of_track, leverage[tracks.view]) / np.bincount(of_track)
    pull = pull / (1.0 - mean[of_track])[:, None]
    signs = rng.choice([-1.0, 1.0], (n_groups, _DRAWS))
    sums = np.zeros((n, 6, _DRAWS))
    of_object = tracks.view >= F
    turned = -np.swapaxes(adjoint(invert_T(views)), -1, -2)
    on_objects = np.einsum("nij,nj->ni", turned[tracks.view[of_object]], pull[of_object])
    for rows, values, members in (
        (problem.camera_of_view[tracks.view], pull, of_track),
        (tracks.view[of_object], on_objects, of_track[of_object]),
    ):
        for i in range(6):
            by_group = coo_matrix((values[:, i], (rows, members)), (n, n_groups))
            sums[:, i] += by_group.tocsr() @ signs
    return sums


def _of_samples(problem: BatchProblem, samples: Array) -> PoseCovariances:
    """Covariances of right perturbations (F + O, 6, draws), and of their steps."""

    def spread(values: Array) -> Array:
        return values @ np.swapaxes(values, -1, -2) / values.shape[-1]

    F, Ts = problem.n_frames, problem.Ts_world_camera
    cameras, objects = samples[:F], samples[F:]
    camera_steps, steps = (np.full((len(x), 6, 6), np.nan) for x in (cameras, objects))
    back = adjoint(invert_T(Ts[1:]) @ Ts[:-1])
    camera_steps[1:] = spread(cameras[1:] - back @ cameras[:-1])
    inner: NDArray[np.bool_] = np.ones(len(objects), bool)
    inner[[s.first_pose for s in problem.stretches]] = False
    rows = np.flatnonzero(inner)
    steps[rows] = spread(objects[rows] - objects[rows - 1])
    return PoseCovariances(spread(cameras), camera_steps, spread(objects), steps)


def _carried_on(of_tracks: PoseCovariances, of_patches: PoseCovariances) -> PoseCovariances:
    """From tracks to patches to whole bodies: variances grow once more as they did between these.

    By one factor for all poses of a kind, as that of a single pose is uncertain itself. That of
    poses is at least that of their steps: what errs over many frames is drawn but a few times.
    """

    def growth(name: str) -> float:
        fine, coarse = (
            np.diagonal(getattr(of, name), axis1=1, axis2=2) for of in (of_tracks, of_patches)
        )
        known = (fine > 0.0) & (coarse > 0.0)
        return float(np.exp(np.log(coarse[known] / fine[known]).mean())) if known.any() else 1.0

    def carried_on(poses: str, steps: str) -> tuple[Array, Array]:
        of_poses, of_steps = max(growth(poses), 1.0), max(growth(steps), 1.0)
        return (
            max(of_poses, of_steps**2 / of_poses) * getattr(of_patches, poses),
            of_steps * getattr(of_patches, steps),
        )

    return PoseCovariances(*carried_on("cameras", "camera_steps"), *carried_on("objects", "steps"))
