"""Stereo residuals of all points, and their elimination from the least-squares problem.

Owns the model of what was seen, its robust weights, and the Schur complement: what the points say
of the views, once each point has been chosen best. Knows neither bodies nor graphs.

The model: where a point was followed from one frame to the next, the *step* of its pixel was
measured, and errors of steps add up along the track; disparities err anew in each frame. Measured
on degraded sequences: the error of a followed pixel grows with the square root of the frames since,
that of its disparity does not grow.
Deviation: the usual graph has one stereo factor a sighting, with independent errors.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.point_tracks import Index, PointTracks
from pipelines.geometry import MIN_DEPTH_M, pose_jacobian, projection_jacobian
from pipelines.types import Array, StereoCamera

HUBER_UV, HUBER_DISPARITY = 2.45, 1.96  # standard deviations: 95 % in two dimensions and in one
_DENSE_BYTES = 1 << 23  # of one block of tracks that is eliminated at a time
_LENGTH_BINS = (4, 8, 16, 32, 64)  # tracks of like length are eliminated together
_SETTLE_DAMPING = 1e-4
_SIGHTINGS_A_PART = 200_000
_MAX_BAND = 128  # views that a track may span to be eliminated by dense blocks

Blocks = tuple[Index, Index, Array]  # pairs of views (M,), first <= second, and (M, 6, 6)


@dataclass(frozen=True, slots=True)
class Residuals:
    """N sightings at some estimate.

    uv, disparity: (N, 2) and (N,) whitened; disparity is 0 where unknown. weight_uv,
    weight_disparity: (N,) Huber's, 0 where the point lies behind the camera, where the sighting is
    left out or nothing is known. cost: half the robust sum.
    """

    uv: Array
    disparity: Array
    weight_uv: Array
    weight_disparity: Array
    cost: float


@dataclass(frozen=True, slots=True)
class ViewSystem:
    """What all points say of small changes of the V views, right perturbations [omega rad, v m].

    The system H x = g. first, second: (M,) views with first <= second. blocks: (M, 6, 6) of H.
    gradient: (V, 6). pull: (N, 6) what each sighting adds to it. `step_points` gives the points'
    own best answer to a change of the views.
    """

    first: Index
    second: Index
    blocks: Array
    gradient: Array
    pull: Array
    _H_inverse: Array
    _g: Array
    _C: Array
    _tracks: PointTracks

    def step_points(self, views: Array) -> Array:
        """(P, 3) steps of the points in their bodies, in m, for steps (V, 6) of the views."""
        tracks = self._tracks
        pull = np.einsum("nij,nj->ni", self._C, views[tracks.view])
        rest = self._g - sum_by_track(pull, tracks)
        return np.einsum("pij,pj->pi", self._H_inverse, rest)


def camera_points(tracks: PointTracks, Ts_body_camera: Array, points_m: Array) -> Array:
    """(N, 3) each sighting's point in its camera. Ts_body_camera: (V, 4, 4). points_m: (P, 3)."""
    R, t = Ts_body_camera[:, :3, :3], Ts_body_camera[:, :3, 3]
    q = points_m[tracks.track] - t[tracks.view]
    return np.einsum("nji,nj->ni", R[tracks.view], q)


def sum_by_track(values: Array, tracks: PointTracks) -> Array:
    """(P, ...) sums of values (N, ...) over each track."""
    return np.add.reduceat(values, tracks.starts, axis=0) if len(values) else values[:0]


def evaluate(
    camera: StereoCamera,
    tracks: PointTracks,
    Ts_body_camera: Array,
    points_m: Array,
    keep_uv: NDArray[np.bool_],
    keep_disparity: NDArray[np.bool_],
) -> Residuals:
    """Residuals of all sightings. keep_uv, keep_disparity: (N,) False where one is an outlier."""
    p = camera_points(tracks, Ts_body_camera, points_m)
    front = p[:, 2] > MIN_DEPTH_M
    z = np.where(front, p[:, 2], 1.0)
    K = np.array([camera.fx, camera.fy])
    miss = tracks.uv_px - (p[:, :2] / z[:, None] * K + (camera.cx, camera.cy))
    before = tracks.carried[:, None] * np.roll(miss, 1, axis=0)
    uv = (miss - before) / tracks.sigma_uv_px[:, None]
    disparity = (tracks.disparity_px - camera.bf / z) / tracks.sigma_disparity_px
    known = np.isfinite(disparity) & front & keep_disparity
    front_before = np.where(tracks.is_followed, np.roll(front, 1), True)
    ok = front & front_before & keep_uv
    uv = np.where(ok[:, None], uv, 0.0)
    disparity = np.where(known, disparity, 0.0)
    size_uv, size_d = np.linalg.norm(uv, axis=1), np.abs(disparity)
    weight_uv, cost_uv = _huber(size_uv, HUBER_UV)
    weight_d, cost_d = _huber(size_d, HUBER_DISPARITY)
    return Residuals(
        uv, disparity, weight_uv * ok, weight_d * known, float(cost_uv.sum() + cost_d.sum())
    )


def _huber(size: Array, limit: float) -> tuple[Array, Array]:
    """Weights and costs of residuals of a size (N,)."""
    weight = np.minimum(1.0, limit / np.maximum(size, 1e-12))
    cost = np.where(size <= limit, 0.5 * size**2, limit * (size - 0.5 * limit))
    return weight, cost


@dataclass(frozen=True, slots=True)
class _Rows:
    """The whitened problem at an estimate: a step of the pixel (2) and a disparity (1) a sighting.

    rows: (N, 3). A: (N, 3, 3) by the point. w: (N,) of the pixel, and w_before of the one before.
    """

    rows: Array
    A: Array
    w: Array
    w_before: Array
    w_disparity: Array
    projection: Array
    in_camera: Array


def _whiten(
    camera: StereoCamera,
    tracks: PointTracks,
    Ts_body_camera: Array,
    points_m: Array,
    residuals: Residuals,
) -> _Rows:
    p = camera_points(tracks, Ts_body_camera, points_m)
    D = projection_jacobian(camera, p)
    Jm = D @ Ts_body_camera[tracks.view][:, :3, :3].transpose(0, 2, 1)
    root_uv, root_d = np.sqrt(residuals.weight_uv), np.sqrt(residuals.weight_disparity)
    w = root_uv / tracks.sigma_uv_px
    w_before = tracks.carried * w
    w_d = root_d / tracks.sigma_disparity_px
    A = np.empty((len(tracks), 3, 3))
    A[:, :2] = w[:, None, None] * Jm[:, :2]
    A[:, :2] -= w_before[:, None, None] * np.roll(Jm[:, :2], 1, axis=0)
    A[:, 2] = w_d[:, None] * (Jm[:, 0] - Jm[:, 2])
    rows = np.column_stack([root_uv[:, None] * residuals.uv, root_d * residuals.disparity])
    return _Rows(rows, A, w, w_before, w_d, D, p)


def _point_system(seen: _Rows, tracks: PointTracks, damping: float) -> tuple[Array, Array]:
    """Roots (P, 3, 3) of the inverses of the points' own normal matrices, and their right sides.

    With H = L L' the root is inv(L'): inv(H) itself, of a far point that is hardly known along its
    ray, would be rounded so coarsely that what is left of the views were no longer definite.
    """
    H = sum_by_track(seen.A.transpose(0, 2, 1) @ seen.A, tracks)
    g = sum_by_track(np.einsum("nij,ni->nj", seen.A, seen.rows), tracks)
    scale = np.trace(H, axis1=1, axis2=2)[:, None]
    corner = np.arange(3)
    H[:, corner, corner] += damping * H[:, corner, corner] + 1e-9 * scale + 1e-12
    return np.linalg.inv(np.linalg.cholesky(H)).transpose(0, 2, 1), g


def eliminate_points(
    camera: StereoCamera,
    tracks: PointTracks,
    Ts_body_camera: Array,
    points_m: Array,
    residuals: Residuals,
    damping: float,
) -> ViewSystem:
    """The system of the views at an estimate. damping: of the points, Levenberg's share."""
    V = tracks.n_views
    gradient = np.zeros((V, 6))
    H_inverse, g = np.empty((tracks.n_tracks, 3, 3)), np.empty((tracks.n_tracks, 3))
    pull = np.empty((len(tracks), 6))
    C = np.empty((len(tracks), 3, 6), np.float32)  # the largest array: twice as long runs fit
    parts: list[Blocks] = [(np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, 6, 6)))]
    for own, rows, part in tracks.parts(_SIGHTINGS_A_PART):
        few = Residuals(
            residuals.uv[rows],
            residuals.disparity[rows],
            residuals.weight_uv[rows],
            residuals.weight_disparity[rows],
            0.0,
        )
        seen = _whiten(camera, part, Ts_body_camera, points_m[own], few)
        root, g[own] = _point_system(seen, part, damping)
        H_inverse[own] = root @ root.transpose(0, 2, 1)
        blocks, pull[rows], C[rows] = _eliminate_part(part, seen, root, g[own])
        gradient += np.stack([np.bincount(part.view, column, V) for column in pull[rows].T], -1)
        parts.append(_sum_all(blocks, V))
        if sum(len(first) for first, _, _ in parts[1:]) > len(parts[0][0]):  # else not worth it yet
            parts = [_sum_all(parts, V)]
    return ViewSystem(*_sum_all(parts, V), gradient, pull, H_inverse, g, C, tracks)


def _eliminate_part(
    tracks: PointTracks, seen: _Rows, root: Array, g: Array
) -> tuple[list[Blocks], Array, Array]:
    """Blocks of the views' system, pull (N, 6) on the view of each sighting, and C (N, 3, 6)."""
    rows, view, V = seen.rows, tracks.view, tracks.n_views
    Jp = pose_jacobian(seen.projection, seen.in_camera)  # d prediction / d view
    B = np.empty((len(tracks), 3, 6))
    B[:, :2] = seen.w[:, None, None] * Jp[:, :2]
    B[:, 2] = seen.w_disparity[:, None] * (Jp[:, 0] - Jp[:, 2])
    # A step also depends on the view before: that is a part of the next row, in this view's place
    before = -seen.w_before[:, None, None] * np.roll(Jp[:, :2], 1, axis=0)
    after = np.roll(before, -1, axis=0)
    C = seen.A.transpose(0, 2, 1) @ B
    C += np.roll(seen.A[:, :2], -1, axis=0).transpose(0, 2, 1) @ after
    pull = np.einsum("nij,ni->nj", B, rows)
    pull += np.einsum("nij,ni->nj", after, np.roll(rows[:, :2], -1, axis=0))
    best = np.einsum("pij,pj->pi", root, np.einsum("pji,pj->pi", root, g))
    pull -= np.einsum("nij,ni->nj", C, best[tracks.track])
    now = np.flatnonzero(tracks.is_followed)
    cross = before[now].transpose(0, 2, 1) @ B[now, :2]
    own = B.transpose(0, 2, 1) @ B + after.transpose(0, 2, 1) @ after
    blocks = [
        sum_blocks(view, view, own, V),
        sum_blocks(view[now - 1], view[now], cross, V),
        *_eliminated(tracks, C, root),
    ]
    return blocks, pull, C


def settle_points(
    camera: StereoCamera,
    tracks: PointTracks,
    Ts_body_camera: Array,
    points_m: Array,
    steps: int = 4,
) -> Array:
    """The points (P, 3) that fit best while the views stay as they are."""
    every = np.ones(len(tracks), bool)
    for _ in range(steps):
        residuals = evaluate(camera, tracks, Ts_body_camera, points_m, every, every)
        seen = _whiten(camera, tracks, Ts_body_camera, points_m, residuals)
        root, g = _point_system(seen, tracks, _SETTLE_DAMPING)
        points_m = points_m + np.einsum("pij,pkj,pk->pi", root, root, g, optimize=True)
    return points_m


def sum_blocks(first: Index, second: Index, blocks: Array, n_views: int) -> Blocks:
    """The same pairs of views (M,) with their blocks (M, 6, 6), each pair once."""
    key = first * n_views + second
    pairs, where = np.unique(key, return_inverse=True)
    order = np.argsort(where, kind="stable")
    begins = np.searchsorted(where[order], np.arange(len(pairs)))
    summed = np.add.reduceat(blocks[order], begins, axis=0) if len(pairs) else blocks[:0]
    return pairs // n_views, pairs % n_views, summed


def _sum_all(parts: list[Blocks], n_views: int) -> Blocks:
    first, second, blocks = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
    return sum_blocks(first, second, blocks, n_views)


def _eliminated(tracks: PointTracks, C: Array, root: Array) -> list[Blocks]:
    """Minus what the points (P) would have explained. C: (N, 3, 6). root: (P, 3, 3) of inv(H)."""
    E = np.einsum("nji,njk->nik", root[tracks.track], C)  # inv(H) = root root'
    starts, lengths = tracks.starts, tracks.lengths
    low, high = tracks.view[starts], tracks.view[starts + lengths - 1]
    span = high - low + 1
    band = int(span[span <= _MAX_BAND].max(initial=1))
    lowest = int(low.min())
    store = np.zeros((int(high.max()) + 1 - lowest, band, 6, 6))
    kind = np.where(span <= _MAX_BAND, np.searchsorted(_LENGTH_BINS, span), -1)
    for one in np.unique(kind[kind >= 0]):
        own = np.flatnonzero(kind == one)
        own = own[np.argsort(low[own], kind="stable")]
        width = 2 * int(span[own].max())
        most = max(1, _DENSE_BYTES // (8 * 18 * width))
        while len(own):
            fits = high[own[:most]] < low[own[0]] + width
            n = len(fits) if fits.all() else int(np.argmin(fits))
            _eliminate_dense(tracks, E, own[:n], starts, lengths, lowest, store)
            own = own[n:]
    parts = []
    used = np.abs(store).max(axis=(2, 3)) > 0.0
    first, offset = np.nonzero(used)
    parts.append((lowest + first, lowest + first + offset, -store[used]))
    for t in np.flatnonzero(kind < 0):
        rows = np.arange(starts[t], starts[t] + lengths[t])
        i, j = np.triu_indices(len(rows))
        blocks = -E[rows[i]].transpose(0, 2, 1) @ E[rows[j]]
        parts.append((tracks.view[rows[i]], tracks.view[rows[j]], blocks))
    return parts


def _eliminate_dense(
    tracks: PointTracks,
    E: Array,
    chunk: Index,
    starts: Index,
    lengths: Index,
    lowest: int,
    store: Array,
) -> None:
    """Add E' E of tracks of like views to the band `store` (views from `lowest`, band, 6, 6)."""
    n_rows = lengths[chunk]
    rows = np.repeat(starts[chunk] - np.cumsum(n_rows) + n_rows, n_rows) + np.arange(n_rows.sum())
    v0 = int(tracks.view[rows].min())
    views = tracks.view[rows] - v0
    width = int(views.max()) + 1
    dense = np.zeros((len(chunk), 3, width, 6))
    dense[np.repeat(np.arange(len(chunk)), n_rows), :, views] = E[rows]
    flat = dense.reshape(3 * len(chunk), 6 * width)
    product = (flat.T @ flat).reshape(width, 6, width, 6).transpose(0, 2, 1, 3)
    band = store.shape[1]
    for a in range(width):
        n = min(width - a, band)
        store[v0 - lowest + a, :n] += product[a, a : a + n]
