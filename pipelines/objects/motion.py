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
    """H_world_curr_prev (4, 4) of a motion seen from a moving camera: X_k G inv(X_k-1)."""
    return T_world_curr @ G_curr_prev @ invert_T(T_world_prev)


def world_covariance(covariance: Array, T_world_curr: Array, center_m: Array) -> Array:
    """Covariance (6, 6) of a motion in the world, from that of `Motions` (6, 6).

    The answer is of [omega rad, v m], the left perturbation of H about the object's centre (3,) in
    the world, after the motion: v is how far that centre is put wrong.
    """
    R = T_world_curr[:3, :3]
    lever = center_m - T_world_curr[:3, 3]
    # inv(G) exp(xi) means exp(-xi) before the camera: H <- X exp(-xi) inv(X) H
    A = np.zeros((6, 6))
    A[:3, :3] = -R
    A[3:, 3:] = -R
    A[3:, :3] = skew(lever) @ R
    return A @ covariance @ A.T


def displacement(H_world_curr_prev: Array, center_m: Array) -> Array:
    """How far (3,) m a motion takes an object's centre: t - (I - R) c, eq. (6) of the paper."""
    R, t = H_world_curr_prev[:3, :3], H_world_curr_prev[:3, 3]
    return t - (np.eye(3) - R) @ center_m


def scale_about(H_world_curr_prev: Array, center_m: Array, share: float) -> Array:
    """A share of a motion (4, 4): of its turn about the object's centre (3,), and of its way."""
    if abs(share - 1.0) < 1e-9:
        return H_world_curr_prev
    R = rotation_of(share * rotation_vector(H_world_curr_prev))
    way = share * displacement(H_world_curr_prev, center_m)
    return make_T(R, center_m + way - R @ center_m)


@dataclass(frozen=True, slots=True)
class FusedMotion:
    """A motion (4, 4) with its covariance (6, 6), as of `world_covariance`.

    distance2: squared Mahalanobis distance of what was measured from what was expected.
    """

    H_world_curr_prev: Array
    covariance: Array
    distance2: float


def fuse_motions(
    H_expected: Array,
    expected_covariance: Array,
    H_measured: Array,
    measured_covariance: Array,
    center_m: Array,
) -> FusedMotion:
    """The motion between an expected (4, 4) and a measured one (4, 4).

    Covariances as of `world_covariance`. center_m: (3,) the object's centre before the motion. One
    step of a Kalman filter: matter does not change its motion at once. A measurement outside its
    99 % gate is answered as it is, and whether to believe it is left to who asked.
    Deviation: the paper keeps the measured motion. This changes it only where it is less certain
    than the expectation, as with few or far points.
    """
    turn = rotation_vector(H_measured[:3, :3] @ H_expected[:3, :3].T)
    way_m = displacement(H_expected, center_m)
    innovation = np.r_[turn, displacement(H_measured, center_m) - way_m]
    S = expected_covariance + measured_covariance
    distance2 = float(innovation @ np.linalg.solve(S, innovation))
    if distance2 > GATE_6DOF:
        return FusedMotion(H_measured, measured_covariance, distance2)
    gain = np.linalg.solve(S, expected_covariance).T
    step = gain @ innovation
    R = rotation_of(step[:3]) @ H_expected[:3, :3]
    covariance = (np.eye(6) - gain) @ expected_covariance
    return FusedMotion(
        make_T(R, center_m + way_m + step[3:] - R @ center_m),
        0.5 * (covariance + covariance.T),
        distance2,
    )


def points_std(covariance: Array, spread_m: float) -> float:
    """How far, in m, a motion with a covariance (6, 6) may put an object's points wrong.

    spread_m: root mean square distance of the points from the object's centre. Along the worst
    direction, of the centre and of what a wrong turn adds.
    """
    way, turn = largest_std(covariance[3:, 3:]), largest_std(covariance[:3, :3])
    return float(np.hypot(way, turn * spread_m))


def largest_std(covariance: Array) -> float:
    """Standard deviation along the worst direction of a covariance (3, 3)."""
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))
