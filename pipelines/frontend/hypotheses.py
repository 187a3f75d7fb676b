"""Where a camera may be, before refinement: the competing motion hypotheses of a frame.

Owns constant velocity, PnP RANSAC, and the count of inliers that decides between hypotheses.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import (
    T_from_q_xyzw,
    invert_T,
    make_T,
    q_xyzw_from_T,
    reprojection_errors,
)
from pipelines.types import Array, MotionHypothesis, StereoCamera

_RANSAC_ITERATIONS = 200
_RANSAC_CONFIDENCE = 0.999
_MIN_POINTS = 6  # AP3P takes four, but their agreement alone proves nothing


@dataclass(slots=True)
class ConstantVelocity:
    """The camera's last motion, as a rate, so that uneven time stamps and dropped frames count.

    T_world_camera: (4, 4) last measured, at `timestamp_s`. The paper's "previous camera motion".
    """

    T_world_camera: Array
    timestamp_s: float
    _step: Array | None = None
    _step_s: float = 0.0

    def predict(self, timestamp_s: float) -> Array:
        """T_world_camera (4, 4) at a time, if the camera keeps its velocity."""
        if self._step is None or self._step_s <= 0.0:
            return self.T_world_camera
        return self.T_world_camera @ scale_motion(
            self._step, (timestamp_s - self.timestamp_s) / self._step_s
        )

    def update(self, T_world_camera: Array, timestamp_s: float, continuous: bool = True) -> None:
        """Take in a measured pose; after a jump (not `continuous`) the old velocity is dropped."""
        self._step_s = timestamp_s - self.timestamp_s
        self._step = invert_T(self.T_world_camera) @ T_world_camera if continuous else None
        self.T_world_camera, self.timestamp_s = T_world_camera, timestamp_s


def scale_motion(T: Array, share: float) -> Array:
    """A share of the small motion `T` (4, 4): its rotation angle and translation scaled."""
    q = q_xyzw_from_T(T)
    half = np.arctan2(np.linalg.norm(q[:3]), q[3])
    axis = q[:3] / max(float(np.linalg.norm(q[:3])), 1e-12)
    scaled = np.r_[axis * np.sin(half * share), np.cos(half * share)]
    return T_from_q_xyzw(T[:3, 3] * share, scaled)


def estimate_pnp(
    camera: StereoCamera, points_world_m: Array, uv_px: Array, inlier_px: float, seed: int
) -> Array | None:
    """T_world_camera (4, 4) by PnP RANSAC (AP3P) from points (N, 3) and pixels (N, 2), or None."""
    if len(points_world_m) < _MIN_POINTS:
        return None
    order = np.random.default_rng(seed).permutation(len(points_world_m))  # OpenCV never reseeds
    found, rotation, translation, _ = cv2.solvePnPRansac(
        points_world_m[order],
        uv_px[order],
        camera.K,
        None,
        iterationsCount=_RANSAC_ITERATIONS,
        reprojectionError=inlier_px,
        confidence=_RANSAC_CONFIDENCE,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or not np.isfinite(translation).all():
        return None
    return invert_T(make_T(cv2.Rodrigues(rotation)[0], translation))


def reprojection_inliers(
    camera: StereoCamera,
    T_world_camera: Array,
    points_world_m: Array,
    uv_px: Array,
    limit_px: float,
) -> NDArray[np.bool_]:
    """Which points (N, 3) reproject within `limit_px` of their pixels (N, 2)."""
    return reprojection_errors(camera, T_world_camera, points_world_m, uv_px) <= limit_px


def choose_hypothesis(
    camera: StereoCamera,
    candidates: dict[MotionHypothesis, Array | None],
    points_world_m: Array,
    uv_px: Array,
    limit_px: float,
) -> tuple[MotionHypothesis, Array, int]:
    """The candidate pose with the most reprojection inliers, its name and their number.

    Paper, section Camera Pose Estimation, which compares constant velocity with PnP RANSAC.
    Deviation: any number of candidates will do here. The earliest wins a tie, and at least one
    must be a pose. points_world_m: (N, 3). uv_px: (N, 2). limit_px: error of an inlier.
    """
    scored = [
        (int(reprojection_inliers(camera, T, points_world_m, uv_px, limit_px).sum()), name, T)
        for name, T in candidates.items()
        if T is not None
    ]
    count, name, T = max(scored, key=lambda entry: entry[0])
    return name, T, count
