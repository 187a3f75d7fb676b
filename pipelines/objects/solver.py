"""From points in two frames to believed motions of objects, and to points refined by them.

Owns the noise that objects' own residuals teach, the test of what is believed, and the second try
by descriptors. Keeps nothing from frame to frame; tracks and identities are not its matter.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.config import ObjectsConfig
from pipelines.frontend.hypotheses import estimate_pnp, reprojection_inliers
from pipelines.frontend.sampling import sample_disparity
from pipelines.frontend.sensor import Sensor
from pipelines.geometry import backproject, invert_T
from pipelines.mapping.point_filter import refine_points
from pipelines.objects.following import Followed, learn_edges
from pipelines.objects.instances import middle_of
from pipelines.objects.motion import Motions, estimate_motions, move_points
from pipelines.objects.points import ObjectPoints, create_points
from pipelines.observations import StereoObservations
from pipelines.types import Array, StereoCamera

_SEARCH_INLIER_PX = 3.0  # of descriptor matches: corners lie on coarse levels too, unaligned
_SPREAD, _RELATIVE_SPREAD = 5.0, 0.15  # of the disparities on one object
_MIN_SEARCH_SHARE = 0.3  # of the matches that must agree with a motion found by them


@dataclass(frozen=True, slots=True)
class Solution:
    """Motions of J objects with what they were measured from (N points in a row).

    accepted: (J,) bool, whether enough points agree.
    """

    points: ObjectPoints
    observations: StereoObservations
    motions: Motions
    accepted: NDArray[np.bool_]

    @property
    def agrees(self) -> NDArray[np.bool_]:
        """(N,) which points agree with an accepted motion."""
        return self.motions.inliers & np.repeat(self.accepted, self.motions.n_points)

    def rows_of(self, j: int) -> NDArray[np.int64]:
        """Rows of the points of object `j`."""
        end = int(self.motions.n_points[: j + 1].sum())
        return np.arange(end - int(self.motions.n_points[j]), end)


class MotionSolver:
    """Solves eq. (3) for all objects of a frame; step 8."""

    def __init__(self, sensor: Sensor, config: ObjectsConfig, seed: int) -> None:
        self.sensor, self.config, self.camera, self._seed = sensor, config, sensor.camera, seed
        self._next_track_id = 0

    def create_points(
        self, disparity_px: NDArray[np.float32], object_id: NDArray[np.int64], uv_px: Array
    ) -> ObjectPoints:
        """Points at pixels (N, 2) of objects (N,) with their disparities (H, W), by object."""
        order = np.argsort(object_id, kind="stable")
        sigma = self.sensor.noise.sigma_disparity_px
        points = create_points(
            self.camera,
            disparity_px,
            object_id[order],
            uv_px[order],
            sigma,
            self.sensor.min_disparity_px,
            self._next_track_id,
        )
        self._next_track_id += len(points)
        return points[on_one_surface(self.camera, points, sigma)]

    def solve(
        self,
        disparity_px: NDArray[np.float32],
        points: ObjectPoints,
        followed: Followed,
        hypotheses: tuple[Array, ...],
    ) -> Solution:
        """Motions of all objects that have points. disparity_px: (H, W) of the present frame.

        hypotheses: each (J, 4, 4), see `estimate_motions`.
        """
        sigma = self.sensor.noise.sigma_disparity_px
        disparity = sample_disparity(disparity_px, followed.uv_px, sigma)
        disparity = np.where(disparity >= self.sensor.min_disparity_px, disparity, np.nan)
        observations = StereoObservations(
            points.position_m,
            points.covariance_m2,
            np.column_stack([followed.uv_px, followed.uv_px[:, 0] - disparity]),
            followed.sigma_px,
            np.full(len(points), sigma),
        )
        motions = estimate_motions(self.camera, points, observations, hypotheses, self._seed)
        enough = np.maximum(self.config.min_points, self.config.min_inlier_share * motions.n_points)
        accepted = motions.n_inliers >= enough
        accepted &= np.isfinite(motions.covariances).all(axis=(1, 2))
        solution = Solution(points, observations, motions, accepted)
        self._learn_noise(followed, solution)
        return solution

    def _learn_noise(self, followed: Followed, solution: Solution) -> None:
        """Each source's own residuals at the inliers teach its noise."""
        motions = solution.motions
        good = solution.agrees
        predicted = followed.uv_px - motions.residuals_px[:, :2]
        residual = motions.residuals_px[good, :2]
        learn_edges(residual, followed.across[good], self.sensor.noise)
        sources = {"object_flow": followed.flow_px, "object_alignment": followed.aligned_px}
        for source, uv in sources.items():
            residual = (uv - predicted)[good]
            self.sensor.noise.learn_uv(source, residual[np.isfinite(residual).all(axis=1)])

    def refine(self, solution: Solution) -> ObjectPoints:
        """The agreeing points in the present camera, each refined by what was seen of it."""
        points, motions, good = solution.points, solution.motions, solution.agrees
        if not good.any():
            return ObjectPoints.empty()
        moved = move_points(motions.Gs_curr_prev, points.position_m, motions.n_points)
        R = np.repeat(motions.Gs_curr_prev[:, :3, :3], motions.n_points, axis=0)[good]
        seen = replace(
            solution.observations[good],
            points_world_m=moved[good],
            point_covariances_m2=R @ points.covariance_m2[good] @ R.transpose(0, 2, 1),
        )
        pose = np.repeat(motions.covariances, motions.n_points, axis=0)[good]
        positions, covariances, _ = refine_points(
            self.camera, np.eye(4), pose, seen, np.zeros((len(seen), 3))
        )
        uv = seen.uvr_px[:, :2]
        return ObjectPoints(
            points.object_id[good], positions, covariances, uv, points.track_id[good]
        )

    def guess_by_matches(
        self, disparity_prev_px: NDArray[np.float32], uv_prev_px: Array, uv_px: Array
    ) -> Array | None:
        """G (4, 4) of one object by PnP RANSAC on pixels (N, 2) matched by descriptors, or None."""
        sigma = self.sensor.noise.sigma_disparity_px
        disparity = sample_disparity(disparity_prev_px, uv_prev_px, sigma)
        good = disparity >= self.sensor.min_disparity_px
        if good.sum() < self.config.min_points:
            return None
        points = backproject(self.camera, uv_prev_px[good], self.camera.bf / disparity[good])
        T = estimate_pnp(self.camera, points, uv_px[good], _SEARCH_INLIER_PX, self._seed)
        if T is None:
            return None
        agree = reprojection_inliers(self.camera, T, points, uv_px[good], _SEARCH_INLIER_PX)
        return invert_T(T) if agree.mean() >= _MIN_SEARCH_SHARE else None


def on_one_surface(
    camera: StereoCamera, points: ObjectPoints, sigma_disparity_px: float
) -> NDArray[np.bool_]:
    """(N,) which points are about as far as most of their object's: a worn mask holds others too.

    Their disparity is within five median deviations, or 15 %, of the object's median, or so near
    as its noise allows beyond that.
    """
    disparity = camera.bf / points.position_m[:, 2]
    near = np.zeros(len(points), bool)
    end = 0
    for n in points.groups()[1]:
        rows = slice(end, end + int(n))
        end = rows.stop
        middle = middle_of(disparity[rows])
        away = np.abs(disparity[rows] - middle)
        limit = max(_SPREAD * middle_of(away), _RELATIVE_SPREAD * middle) + 3.0 * sigma_disparity_px
        near[rows] = away <= limit
    return near
