"""Refinement of map points by each new observation: one small Kalman update per point.

Owns the structure-only update in inverse-depth form, which is close to linear even for points
whose depth is hardly known. Poses are not changed here.
"""

from __future__ import annotations

import numpy as np

from pipelines.frontend.disparity_offset import offset_share
from pipelines.frontend.motion_only_ba import add_pixel_noise, whitening
from pipelines.geometry import (
    backproject,
    invert_T,
    pose_jacobian,
    project_stereo,
    projection_jacobian,
    transform_points,
)
from pipelines.observations import StereoObservations
from pipelines.types import Array, StereoCamera

_MAX_DEPTH_FACTOR = 3.0  # one update may change a depth at most by this factor


def backprojection_covariance(
    camera: StereoCamera, points_camera: Array, sigma_uv_px: Array, sigma_disparity_px: Array
) -> Array:
    """Covariances (N, 3, 3) in the camera, in m^2, of points (N, 3) from a pixel and a disparity.

    sigma_uv_px, sigma_disparity_px: (N,) standard deviations of these.
    """
    z = points_camera[:, 2]
    J = np.zeros((len(z), 3, 3))
    J[:, 0, 0], J[:, 1, 1] = z / camera.fx, z / camera.fy
    J[:, :, 2] = -points_camera * (z / camera.bf)[:, None]
    variance = np.stack([sigma_uv_px**2, sigma_uv_px**2, sigma_disparity_px**2], -1)
    return (J * variance[:, None, :]) @ J.transpose(0, 2, 1)


def make_points(
    camera: StereoCamera,
    T_world_camera: Array,
    uv_px: Array,
    disparity_px: Array,
    sigma_uv_px: float,
    sigma_disparity_px: Array,
) -> tuple[Array, Array]:
    """World points (N, 3) and covariances (N, 3, 3) from pixels (N, 2) and disparities (N,).

    sigma_uv_px: of all pixels, sigma_disparity_px: (N,). The pose is taken as exact.
    """
    points = backproject(camera, uv_px, camera.bf / disparity_px)
    sigma_uv = np.full(len(points), sigma_uv_px)
    covariance = backprojection_covariance(camera, points, sigma_uv, sigma_disparity_px)
    R = T_world_camera[:3, :3]
    return transform_points(T_world_camera, points), R @ covariance @ R.T


def refine_points(
    camera: StereoCamera,
    T_world_camera: Array,
    pose_covariance: Array,
    observations: StereoObservations,
    offset_slopes: Array,
) -> tuple[Array, Array, Array]:
    """World points (N, 3), covariances (N, 3, 3) and offset slopes (N, 3) after one image.

    The pose's covariance (6, 6) counts as observation noise, so that a poor pose moves no point.
    All points must lie in front of the camera. offset_slopes: (N, 3) d(point in the world) /
    d(disparity offset), m / px, which follow the points through the update.

    Deviation: the paper does not say how points come by their places after triangulation.
    """
    R = T_world_camera[:3, :3]
    points = transform_points(invert_T(T_world_camera), observations.points_world_m)
    D = projection_jacobian(camera, points)
    J_pose = pose_jacobian(D, points)
    J_point = _each_times(D, R.T)
    residual = observations.uvr_px - project_stereo(camera, points)
    mono = np.isnan(residual[:, 2])
    slope = -np.einsum("nij,nj->ni", J_point, offset_slopes)  # d residual / d offset
    slope[:, 2] -= offset_share(camera, camera.bf / points[:, 2])
    residual[mono, 2] = slope[mono, 2] = 0.0
    if pose_covariance.ndim == 2:
        J_covariance = _each_times(J_pose, pose_covariance)
    else:
        J_covariance = J_pose @ pose_covariance
    S = add_pixel_noise(J_covariance @ _transposed(J_pose), observations)
    P = observations.point_covariances_m2
    J_point[mono, 2, :] = 0.0
    S[mono, 2, :] = 0.0
    S[mono, :, 2] = 0.0
    S[mono, 2, 2] = 1.0
    JP = J_point @ P
    W = whitening(JP @ _transposed(J_point) + S)
    B = W @ JP  # the gain is B^T W
    step = np.einsum("nji,nj->ni", B, np.einsum("nij,nj->ni", W, residual)) @ R
    moved, M = _step_in_inverse_depth(points, step)
    M = _each_times(_transposed(_each_times(_transposed(M), R.T)), R.T)
    P_new = M @ (P - _transposed(B) @ B) @ _transposed(M)
    P_new = 0.5 * (P_new + P_new.transpose(0, 2, 1))
    slope_new = offset_slopes + np.einsum("nji,nj->ni", B, np.einsum("nij,nj->ni", W, slope))
    slope_new = np.einsum("nij,nj->ni", M, slope_new)
    return transform_points(T_world_camera, moved), P_new, slope_new


def _each_times(matrices: Array, right: Array) -> Array:
    """Matrices (N, I, K), each times one and the same (K, K): a single product, not N of them."""
    return (matrices.reshape(-1, len(right)) @ right).reshape(matrices.shape)


def _transposed(matrices: Array) -> Array:
    """Matrices (N, I, K) as (N, K, I), copied: products of rows in a row take half the time."""
    return np.ascontiguousarray(matrices.transpose(0, 2, 1))


def _step_in_inverse_depth(points: Array, step: Array) -> tuple[Array, Array]:
    """Points (N, 3) moved by `step` (N, 3), taken as a step in (x/z, y/z, 1/z); and its Jacobian.

    The same step in metres would overshoot for points of uncertain depth, even through z = 0.
    """
    z = points[:, 2]
    ray = points[:, :2] / z[:, None]
    ray_new = ray + (step[:, :2] - ray * step[:, 2:]) / z[:, None]
    inverse_z = 1.0 / z - step[:, 2] / z**2
    z_new = 1.0 / np.clip(inverse_z, 1.0 / (_MAX_DEPTH_FACTOR * z), _MAX_DEPTH_FACTOR / z)
    moved = np.concatenate([ray_new, np.ones((len(z), 1))], 1) * z_new[:, None]
    # d(x, y, z) / d(x/z, y/z, 1/z) at the new place, times its inverse at the old one
    ratio = z_new / z
    M = np.zeros((len(z), 3, 3))
    M[:, 0, 0] = M[:, 1, 1] = ratio
    M[:, :2, 2] = (ray_new * ratio[:, None] - ray) * ratio[:, None]
    M[:, 2, 2] = ratio**2
    return moved, M
