"""Self-calibration of a stereo pair: a constant error of its disparities, learned while driving.

A tenth of a pixel of disparity error makes far points half a percent too far and every step of the
camera as much too long. Near and far points then disagree about the camera's motion, which makes
the error observable. Owns that estimate; the map keeps how each point depends on it.

A rig is calibrated on targets close by, where its focal length and baseline make up for such an
error. So the error is one of far disparities, and is gone at the targets' distance.

Deviation: the paper trusts the calibration.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipelines.frame_observations import FrameObservations
from pipelines.frontend.motion_only_ba import observation_covariance, whitening
from pipelines.geometry import (
    invert_T,
    pose_jacobian,
    project_stereo,
    projection_jacobian,
    skew,
    transform_points,
)
from pipelines.observations import StereoObservations
from pipelines.types import Array, StereoCamera

_TARGET_BASELINES = 10.0  # distance of calibration targets, in baselines
_PRIOR_SIGMA_PX = 0.25  # rectified pairs are off by about as much
_INDEPENDENT_SHARE = 0.05  # errors of the same points in consecutive frames are alike
_SIGNIFICANT_SIGMAS = 1.0  # a smaller offset is not told from none
_SIGNIFICANT_PX = 0.1  # nor is a smaller one told from the bias of computed flow
_FORGET = 0.99  # share of the evidence that each frame keeps


def offset_share(camera: StereoCamera, disparity_px: Array) -> Array:
    """How much of the offset each disparity has: all far away, none at calibration targets.

    disparity_px: of any shape, as is the answer.
    """
    return 1.0 - np.float32(_TARGET_BASELINES / camera.fx) * disparity_px


def corrected(camera: StereoCamera, disparity_px: NDArray, offset_px: float) -> NDArray:
    """Disparities of any shape with their share of an offset added; infinite ones stay so."""
    share = offset_share(camera, np.where(np.isinf(disparity_px), 0.0, disparity_px))
    return disparity_px + (offset_px * share).astype(disparity_px.dtype)


def with_last_offset(
    camera: StereoCamera, log: Sequence[FrameObservations]
) -> list[FrameObservations]:
    """The log of a run with all disparities as the offset was known at its end."""
    last = log[-1].disparity_offset_px if log else 0.0
    entries = []
    for entry in log:
        step = last - entry.disparity_offset_px
        disparity = entry.sightings.disparity_px
        sightings = replace(entry.sightings, disparity_px=corrected(camera, disparity, step))
        entries.append(replace(entry, sightings=sightings, disparity_offset_px=last))
    return entries


class DisparityOffset:
    """Running least-squares estimate of the offset b: true = measured + b * `offset_share`."""

    def __init__(self) -> None:
        self.offset_px = 0.0
        self._information = 0.0  # 1 / px^2
        self._gradient = 0.0  # 1 / px, of half the cost at the present offset

    @property
    def sigma_px(self) -> float:
        """Standard deviation of the offset in px."""
        return (self._information + _PRIOR_SIGMA_PX**-2) ** -0.5

    def learn(
        self,
        camera: StereoCamera,
        T_world_camera: Array,
        observations: StereoObservations,
        offset_slopes: Array,
    ) -> Array:
        """Take in the inliers of one frame, at the pose that fits them best.

        offset_slopes: (N, 3) d(point in the world) / d(offset), m / px. Returns how the camera's
        pose depends on the offset, (6,) d[omega, v] / d(offset), right perturbation.
        """
        R = T_world_camera[:3, :3]
        points = transform_points(invert_T(T_world_camera), observations.points_world_m)
        D = projection_jacobian(camera, points)
        W = whitening(observation_covariance(camera, T_world_camera, observations))
        residual = observations.uvr_px - project_stereo(camera, points)
        slope = -(D @ (offset_slopes @ R)[..., None])[..., 0]  # d residual / d offset
        slope[:, 2] -= offset_share(camera, camera.bf / points[:, 2])
        mono = np.isnan(residual[:, 2])
        residual[mono, 2] = 0.0
        W[mono, 2] = 0.0  # the first two rows do not know of the third
        J = (W @ pose_jacobian(D, points)).reshape(-1, 6)
        slope = (W @ slope[..., None]).ravel()
        residual = (W @ residual[..., None]).ravel()
        pose_slope = np.linalg.solve(J.T @ J + 1e-9 * np.eye(6), J.T @ slope)
        slope -= J @ pose_slope  # what is left once the pose has followed the offset
        self._information *= _FORGET
        self._gradient *= _FORGET
        self._information += _INDEPENDENT_SHARE * float(slope @ slope)
        self._gradient += _INDEPENDENT_SHARE * float(slope @ residual)
        return pose_slope

    def step(self) -> float:
        """Move the offset to its present optimum, or to none; returns by how much, in px."""
        prior = _PRIOR_SIGMA_PX**-2
        step = -(self._gradient + prior * self.offset_px) / (self._information + prior)
        best = self.offset_px + step
        if abs(best) < max(_SIGNIFICANT_SIGMAS * self.sigma_px, _SIGNIFICANT_PX):
            step = -self.offset_px
        self.offset_px += step
        self._gradient += self._information * step
        return step


def follow_camera(T_world_camera: Array, points_world_m: Array, pose_slope: Array) -> Array:
    """(N, 3) d(point in the world) / d(offset) due to the camera's own dependence `pose_slope`.

    points_world_m: (N, 3). pose_slope: (6,) d[omega, v] / d(offset), as `learn` answers. Added to
    the points' own slopes, it expresses them with the present camera held still.
    """
    points = transform_points(invert_T(T_world_camera), points_world_m)
    in_camera = np.einsum("nij,j->ni", skew(points), pose_slope[:3]) - pose_slope[3:]
    return in_camera @ T_world_camera[:3, :3].T
