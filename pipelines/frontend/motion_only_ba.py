"""Motion-only bundle adjustment: one camera pose from stereo pixels of known points.

Owns eq. (1) of the paper, its weights and its robust minimisation. Knows no images and no map.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import (
    MIN_DEPTH_M,
    exp_se3,
    invert_T,
    pose_jacobian,
    projection_jacobian,
    transform_points,
)
from pipelines.types import Array, StereoCamera

CHI2_95_2DOF = 5.991  # chi-square, 95 %, of a pixel (u_L, v)
CHI2_95_3DOF = 7.815  # chi-square, 95 %, of a stereo pixel (u_L, v, u_R)
_ROUNDS = 3  # solve, reject by chi-square, solve again
_MAX_ITERATIONS = 10  # Levenberg-Marquardt steps per round
_CONVERGED_STEP = 1e-7  # rad and m


@dataclass(frozen=True, slots=True)
class StereoObservations:
    """Points of the map and where an image sees them (parallel arrays of length N).

    points_world_m: (N, 3). point_covariances_m2: (N, 3, 3), in the world, zero if exact.
    uvr_px: (N, 3) stereo pixels u_L, v, u_R; u_R is NaN where the depth is not known or far.
    sigma_uv_px, sigma_disparity_px: (N,) standard deviations of the pixel and of u_L - u_R.
    """

    points_world_m: Array
    point_covariances_m2: Array
    uvr_px: Array
    sigma_uv_px: Array
    sigma_disparity_px: Array

    def __len__(self) -> int:
        return len(self.uvr_px)

    def __getitem__(self, which: NDArray) -> StereoObservations:
        """The observations chosen by a boolean mask or an index array."""
        return StereoObservations(
            self.points_world_m[which],
            self.point_covariances_m2[which],
            self.uvr_px[which],
            self.sigma_uv_px[which],
            self.sigma_disparity_px[which],
        )


@dataclass(frozen=True, slots=True)
class PoseEstimate:
    """A camera pose with what it was measured from.

    T_world_camera: (4, 4). covariance: (6, 6) of the right perturbation [omega rad, v m].
    inliers: (N,) bool. chi2: (N,) squared Mahalanobis distances, inf behind the camera.
    residuals_px: (N, 3) of (u_L, v, u_R), measured minus predicted; NaN where not measured.
    """

    T_world_camera: Array
    covariance: Array
    inliers: NDArray[np.bool_]
    chi2: Array
    residuals_px: Array

    @property
    def n_inliers(self) -> int:
        return int(self.inliers.sum())


def estimate_camera_pose(
    camera: StereoCamera, T_world_camera: Array, observations: StereoObservations
) -> PoseEstimate:
    """Camera pose that minimises the reprojection error, eq. (1), from an initial guess.

    Huber's kernel on Mahalanobis distances, then chi-square rejection between rounds (95 %). The
    weight of an observation is the inverse of its pixel noise plus its point's uncertainty seen in
    the image, which eliminates the points exactly to first order.
    """
    chi2_limit = np.where(np.isnan(observations.uvr_px[:, 2]), CHI2_95_2DOF, CHI2_95_3DOF)
    used = np.ones(len(observations), bool)
    T = T_world_camera
    for round_index in range(_ROUNDS):
        information = observation_information(camera, T, observations)
        robust = round_index < _ROUNDS - 1
        T = _minimise(camera, T, observations, information, chi2_limit, used, robust)
        _, chi2 = _residuals(camera, T, observations, information)
        used = chi2 <= chi2_limit
        if used.sum() < 6:
            break
    residuals, chi2 = _residuals(camera, T, observations, information)
    _, H, _ = _normal_equations(camera, T, observations, information, chi2_limit, used, False)
    covariance = np.linalg.pinv(H, hermitian=True) if used.sum() >= 6 else np.full((6, 6), np.nan)
    residuals[np.isnan(observations.uvr_px)] = np.nan
    return PoseEstimate(T, covariance, used, chi2, residuals)


def observation_information(
    camera: StereoCamera, T_world_camera: Array, observations: StereoObservations
) -> Array:
    """Inverse covariances (N, 3, 3) of the residuals of eq. (1), in (u_L, v, u_R).

    Pixel noise plus the point's covariance seen through the projection. The disparity is measured
    on its own, so u_R = u_L - d shares the noise of u_L. Rows of unknown u_R are zero.
    """
    points = transform_points(invert_T(T_world_camera), observations.points_world_m)
    J = projection_jacobian(camera, points) @ T_world_camera[:3, :3].T
    S = J @ observations.point_covariances_m2 @ J.transpose(0, 2, 1)
    variance = observations.sigma_uv_px**2
    S[:, 0, 0] += variance
    S[:, 1, 1] += variance
    S[:, 0, 2] += variance
    S[:, 2, 0] += variance
    S[:, 2, 2] += variance + observations.sigma_disparity_px**2
    mono = np.isnan(observations.uvr_px[:, 2])
    S[mono, 2, :] = 0.0
    S[mono, :, 2] = 0.0
    S[mono, 2, 2] = 1.0
    information = np.linalg.inv(S)
    information[mono, 2, 2] = 0.0
    return information


def _predict(
    camera: StereoCamera, T: Array, observations: StereoObservations
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Points in the camera (N, 3), residuals (N, 3) with 0 where unmeasured, and visibility."""
    points = transform_points(invert_T(T), observations.points_world_m)
    visible = points[:, 2] > MIN_DEPTH_M
    z = np.where(visible, points[:, 2], 1.0)
    u = camera.fx * points[:, 0] / z + camera.cx
    v = camera.fy * points[:, 1] / z + camera.cy
    predicted = np.stack([u, v, u - camera.bf / z], -1)
    residuals = np.nan_to_num(observations.uvr_px - predicted, nan=0.0)  # eq. (1)
    return points, residuals, visible


def _residuals(
    camera: StereoCamera, T: Array, observations: StereoObservations, information: Array
) -> tuple[Array, Array]:
    _, residuals, visible = _predict(camera, T, observations)
    chi2 = np.einsum("ni,nij,nj->n", residuals, information, residuals)
    return residuals, np.where(visible, chi2, np.inf)


def _robust_cost(chi2: Array, limit: Array, used: NDArray[np.bool_], robust: bool) -> float:
    """Half the Huber cost over the used observations; one behind the camera costs a large sum."""
    chi2 = np.where(np.isfinite(chi2), chi2, 1e3 * limit)
    if robust:
        chi2 = np.where(chi2 <= limit, chi2, 2.0 * np.sqrt(limit * chi2) - limit)
    return 0.5 * float(chi2[used].sum())


def _normal_equations(
    camera: StereoCamera,
    T: Array,
    observations: StereoObservations,
    information: Array,
    limit: Array,
    used: NDArray[np.bool_],
    robust: bool,
) -> tuple[float, Array, Array]:
    """Cost, J^T W J (6, 6) and J^T W r (6,) at `T`, for the right perturbation [omega, v]."""
    points, residuals, visible = _predict(camera, T, observations)
    J = pose_jacobian(projection_jacobian(camera, points), points)
    chi2 = np.einsum("ni,nij,nj->n", residuals, information, residuals)
    cost = _robust_cost(np.where(visible, chi2, np.inf), limit, used, robust)
    weight = (used & visible).astype(float)
    if robust:
        weight *= np.minimum(1.0, np.sqrt(limit / np.maximum(chi2, 1e-12)))
    WJ = (information * weight[:, None, None]) @ J
    flat = J.reshape(-1, 6)
    WJ_flat = WJ.reshape(-1, 6)
    return cost, flat.T @ WJ_flat, WJ_flat.T @ residuals.ravel()


def _minimise(
    camera: StereoCamera,
    T: Array,
    observations: StereoObservations,
    information: Array,
    limit: Array,
    used: NDArray[np.bool_],
    robust: bool,
) -> Array:
    """Levenberg-Marquardt from `T` with fixed weights and a fixed set of observations."""
    damping = 1e-6
    cost, H, g = _normal_equations(camera, T, observations, information, limit, used, robust)
    for _ in range(_MAX_ITERATIONS):
        step = np.linalg.solve(H + np.diag(damping * np.diag(H) + 1e-9), g)
        T_new = T @ exp_se3(step)
        trial = _normal_equations(camera, T_new, observations, information, limit, used, robust)
        if trial[0] <= cost:
            T, (cost, H, g), damping = T_new, trial, max(damping * 0.1, 1e-9)
            if np.abs(step).max() < _CONVERGED_STEP:
                break
        else:
            damping *= 100.0
            if damping > 1e6:
                break
    return T
