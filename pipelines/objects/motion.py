"""Rigid motion of objects between two frames, all objects at once.

Owns eqs. (2) and (3) of the paper: motion hypotheses, their contest, and what the solution says of
a motion in the world, its speed and its uncertainty. Points are measured elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.frontend.hypotheses import estimate_pnp, reprojection_inliers
from pipelines.frontend.motion_only_ba import estimate_poses
from pipelines.geometry import (
    exp_se3,
    invert_T,
    make_T,
    reprojection_errors,
    rotation_of,
    rotation_vector,
    skew,
)
from pipelines.objects.points import ObjectPoints
from pipelines.observations import StereoObservations
from pipelines.types import Array, StereoCamera

_INLIER_PX = 2.0  # reprojection error of an inlier of a motion hypothesis
_GATE = 2.0  # inlier limits: observations farther from the chosen hypothesis join later
_MAX_STEPS = 5  # of Levenberg-Marquardt: the guesses are good to some pixels
_WEAK_SHARE = 0.7  # of inliers, below which PnP RANSAC competes
_MIN_PNP_POINTS = 8
GATE_6DOF = 16.8  # chi-square, 6 degrees of freedom, 99 %
# Errors of flow are alike over a patch, so that N points are not N witnesses: two of them count
# as one where they share a cell of this size. Measured by the errors of simulated drives.
_CORRELATION_PX = 20.0


@dataclass(frozen=True, slots=True)
class Motions:
    """Motions of J objects from the previous camera to the present one.

    object_id: (J,). Gs_curr_prev: (J, 4, 4), p_camera_curr = G @ p_camera_prev for their matter.
    covariances: (J, 6, 6) of the right perturbation [omega rad, v m] of inv(G), in the axes of the
    present camera; NaN where not solved. n_points, n_inliers: (J,). inliers: (N,) bool of all
    points in a row. residuals_px: (N, 3) of (u_L, v, u_R).
    """

    object_id: NDArray[np.int64]
    Gs_curr_prev: Array
    covariances: Array
    n_points: NDArray[np.int64]
    n_inliers: NDArray[np.int64]
    inliers: NDArray[np.bool_]
    residuals_px: Array


def estimate_motions(
    camera: StereoCamera,
    points: ObjectPoints,
    observations: StereoObservations,
    hypotheses: tuple[Array, ...],
    seed: int,
) -> Motions:
    """Motions of all objects that have points.

    points: as the previous camera saw them. observations: of the same points (N) in the present
    frame, `points_world_m` being their places in the previous camera. hypotheses: each (J, 4, 4),
    a guess of G for every object; the one with the most reprojection inliers wins, and PnP RANSAC
    competes where it holds less than 70 % of the points.
    Paper, section Object Motion Tracking. Deviation: PnP RANSAC competes always there, which costs
    as much as all the rest.
    """
    ids, sizes = points.groups()
    uv_px = observations.uvr_px[:, :2]
    guesses, share = _best_hypotheses(camera, points, uv_px, hypotheses, sizes)
    ends = np.cumsum(sizes)
    for j in np.flatnonzero((share < _WEAK_SHARE) & (sizes >= _MIN_PNP_POINTS)):
        rows = slice(int(ends[j] - sizes[j]), int(ends[j]))
        positions, uv = points.position_m[rows], uv_px[rows]
        T = estimate_pnp(camera, positions, uv, _INLIER_PX, seed)
        if T is None:
            continue
        if reprojection_inliers(camera, T, positions, uv, _INLIER_PX).mean() > share[j]:
            guesses[j] = invert_T(T)
    found = estimate_poses(
        camera,
        invert_T(guesses),
        observations,
        sizes,
        robust_rounds=1,
        gate_px=_GATE * _INLIER_PX,
        max_steps=_MAX_STEPS,
    )
    return Motions(
        ids,
        invert_T(found.Ts_body_camera),
        found.covariances * _redundancy(uv_px, sizes)[:, None, None],
        sizes,
        found.n_inliers,
        found.inliers,
        found.residuals_px,
    )


def _redundancy(uv_px: Array, sizes: NDArray[np.int64]) -> Array:
    """(J,) factor by which points in a row (N, 2) outnumber their witnesses, outliers included."""
    factor = np.ones(len(sizes))
    end = 0
    for j, n in enumerate(sizes):
        uv = uv_px[end : end + int(n)]
        end += int(n)
        cells = np.unique(np.floor(uv / _CORRELATION_PX) @ (1.0, 1e5))
        factor[j] = n / len(cells)
    return factor


def _best_hypotheses(
    camera: StereoCamera,
    points: ObjectPoints,
    uv_px: Array,
    hypotheses: tuple[Array, ...],
    sizes: NDArray[np.int64],
) -> tuple[Array, Array]:
    """For each object the hypothesis with the most inliers (J, 4, 4), and their share (J,)."""
    starts = np.cumsum(sizes) - sizes
    shares = np.stack(
        [
            np.add.reduceat(_inliers(camera, Gs, points.position_m, uv_px, sizes), starts) / sizes
            for Gs in hypotheses
        ]
    )
    best = shares.argmax(0)  # the first wins a tie
    J = np.arange(len(sizes))
    return np.stack(hypotheses)[best, J].copy(), shares[best, J]


def _inliers(
    camera: StereoCamera, Gs: Array, points_m: Array, uv_px: Array, sizes: NDArray[np.int64]
) -> Array:
    """(N,) 1.0 where a point, moved by its object's G, reprojects to where it was seen."""
    moved = move_points(Gs, points_m, sizes)
    error = reprojection_errors(camera, np.eye(4), moved, uv_px)
    return (error <= _INLIER_PX).astype(np.float64)


def move_points(Gs: Array, points_m: Array, sizes: NDArray[np.int64]) -> Array:
    """Points (N, 3) of J objects in a row, moved by each one's motion (J, 4, 4); eq. (2)."""
    moved = np.empty_like(points_m)
    end = 0
    for G, n in zip(Gs, sizes, strict=True):
        rows = slice(end, end + int(n))
        moved[rows] = points_m[rows] @ G[:3, :3].T + G[:3, 3]
        end = rows.stop
    return moved


def motion_in_world(G_curr_prev: Array, T_world_curr: Array, T_world_prev: Array) -> Array:
    """H_world_curr_prev (..., 4, 4) of motions seen from a moving camera: X_k G inv(X_k-1)."""
    return T_world_curr @ G_curr_prev @ invert_T(T_world_prev)


def world_covariance(covariance: Array, T_world_curr: Array, center_m: Array) -> Array:
    """Covariances (..., 6, 6) of motions in the world, from those of `Motions` (..., 6, 6).

    The answer is of [omega rad, v m], the left perturbation of H about the object's centre (..., 3)
    in the world, after the motion: v is how far that centre is put wrong.
    """
    R = T_world_curr[:3, :3]
    lever = center_m - T_world_curr[:3, 3]
    # inv(G) exp(xi) means exp(-xi) before the camera: H <- X exp(-xi) inv(X) H
    A = np.zeros((*lever.shape[:-1], 6, 6))
    A[..., :3, :3] = -R
    A[..., 3:, 3:] = -R
    A[..., 3:, :3] = skew(lever) @ R
    return A @ covariance @ np.swapaxes(A, -1, -2)


def displacement(H_world_curr_prev: Array, center_m: Array) -> Array:
    """How far (..., 3) m motions take objects' centres: t - (I - R) c, eq. (6) of the paper."""
    R, t = H_world_curr_prev[..., :3, :3], H_world_curr_prev[..., :3, 3]
    return t - ((np.eye(3) - R) @ center_m[..., None])[..., 0]


def scale_about(H_world_curr_prev: Array, center_m: Array, share: float) -> Array:
    """A share of a motion (4, 4): of its turn about the object's centre (3,), and of its way."""
    if abs(share - 1.0) < 1e-9:
        return H_world_curr_prev
    R = rotation_of(share * rotation_vector(H_world_curr_prev))
    way = share * displacement(H_world_curr_prev, center_m)
    return make_T(R, center_m + way - R @ center_m)


@dataclass(frozen=True, slots=True)
class FusedMotion:
    """Motions (..., 4, 4) with their covariances (..., 6, 6), as of `world_covariance`.

    distance2: (...,) squared Mahalanobis distances of what was measured from what was expected.
    """

    H_world_curr_prev: Array
    covariance: Array
    distance2: Array


def fuse_motions(
    H_expected: Array,
    expected_covariance: Array,
    H_measured: Array,
    measured_covariance: Array,
    center_m: Array,
) -> FusedMotion:
    """The motions between expected (..., 4, 4) and measured ones (..., 4, 4), all at once.

    Covariances as of `world_covariance`. center_m: (..., 3) the objects' centres before the motion.
    One step of a Kalman filter: matter does not change its motion at once. A measurement outside
    its 99 % gate is answered as it is, and whether to believe it is left to who asked.
    Deviation: the paper keeps the measured motion. This changes it only where it is less certain
    than the expectation, as with few or far points.
    """
    P, R_expected = expected_covariance, H_expected[..., :3, :3]
    turn = rotation_vector(H_measured[..., :3, :3] @ np.swapaxes(R_expected, -1, -2))
    way_m = displacement(H_expected, center_m)
    innovation = np.concatenate([turn, displacement(H_measured, center_m) - way_m], -1)
    S = P + measured_covariance
    # [inv(S) P, inv(S) innovation], one solution for both
    solved = np.linalg.solve(S, np.concatenate([P, innovation[..., None]], -1))
    distance2 = (innovation * solved[..., 6]).sum(-1)
    gain = np.swapaxes(solved[..., :6], -1, -2)
    step = (gain @ innovation[..., None])[..., 0]
    fused = np.zeros_like(H_measured)
    turn_only = step * (1.0, 1.0, 1.0, 0.0, 0.0, 0.0)
    R = exp_se3(turn_only)[..., :3, :3] @ R_expected
    fused[..., :3, :3], fused[..., 3, 3] = R, 1.0
    fused[..., :3, 3] = center_m + way_m + step[..., 3:] - (R @ center_m[..., None])[..., 0]
    covariance = (np.eye(6) - gain) @ P
    covariance = 0.5 * (covariance + np.swapaxes(covariance, -1, -2))
    wild = np.asarray(distance2 > GATE_6DOF)[..., None, None]
    return FusedMotion(
        np.where(wild, H_measured, fused),
        np.where(wild, measured_covariance, covariance),
        distance2,
    )


def largest_std(covariance: Array) -> Array:
    """Standard deviations (...,) along the worst direction of covariances (..., 3, 3)."""
    return np.sqrt(np.maximum(np.linalg.eigvalsh(covariance)[..., -1], 0.0))
