"""Camera tracking: the pose of each frame from the points of the last one and of the local map.

Owns the order of the measurements and the state between frames (last view, velocity, noise). The
formulas are in the modules beside it; the map belongs to `mapping`.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.config import TrackingConfig
from pipelines.frontend.alignment import align_patches, fuse_measurements
from pipelines.frontend.hypotheses import (
    ConstantVelocity,
    choose_hypothesis,
    estimate_pnp,
    reprojection_inliers,
)
from pipelines.frontend.matching import match_all, match_in_radius
from pipelines.frontend.motion_only_ba import PoseEstimate, estimate_camera_pose
from pipelines.frontend.rgbd_odometry import estimate_rgbd_odometry
from pipelines.frontend.sampling import sample_bilinear
from pipelines.frontend.sensor import Sensor
from pipelines.frontend.view import View
from pipelines.geometry import invert_T, project_stereo, transform_points
from pipelines.mapping.keyframe import Tracks
from pipelines.mapping.sparse_map import SparseMap
from pipelines.types import Array, MotionHypothesis, TrackingStatus

_ALIGNMENT_TOLERANCE_PX = 10.0  # alignment may move a point this far from an ORB match
_RELOCALISED_SHARE = 0.5  # of descriptor matches that must agree with a pose found by them
_RELOCALISE_AGAINST = 5  # latest keyframes tried when lost
_NEIGHBOURS = 5  # matched points that predict the place of an unmatched one

Stage = Callable[[str], AbstractContextManager[None]]


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """The answer of tracking one view.

    pose: T_world_camera (4, 4), predicted if LOST. covariance: (6, 6), NaN if LOST.
    tracks: all points measured. inliers: (N,) bool of the tracks. rmse_px: of the inliers' pixels.
    visible_ids: points of the local map that were in view.
    """

    status: TrackingStatus
    hypothesis: MotionHypothesis
    T_world_camera: Array
    covariance: Array
    tracks: Tracks
    inliers: NDArray[np.bool_]
    rmse_px: float
    visible_ids: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class _Measurement:
    """Where the last frame's points are now, with each source's own say for learning its noise."""

    tracks: Tracks
    sources_px: dict[str, Array]  # name -> (N, 2), NaN where it had nothing to say


class Tracker:
    """Tracks a camera against a sparse map; step 4 of the design."""

    def __init__(self, sensor: Sensor, config: TrackingConfig) -> None:
        self.sensor, self.config = sensor, config
        self.camera, self.noise = sensor.camera, sensor.noise
        self.motion: ConstantVelocity | None = None
        self._last_view: View | None = None
        self._last_tracks = Tracks.empty()
        self._last_is_previous = False

    # ----------------------------------------------------------------- state

    def start(self, view: View, T_world_camera: Array) -> None:
        """Begin, or begin anew, with a known pose and no velocity."""
        self.motion = ConstantVelocity(T_world_camera, view.timestamp_s)

    def remember(self, view: View, tracks: Tracks) -> None:
        """Keep what the next frame will be tracked from."""
        self._last_view, self._last_tracks, self._last_is_previous = view, tracks, True

    def forget_flow(self) -> None:
        """Say that the next frame's flow does not start at the remembered view."""
        self._last_is_previous = False

    # -------------------------------------------------------------- tracking

    def track(self, view: View, sparse_map: SparseMap, stage: Stage | None = None) -> TrackedFrame:
        """Pose of a view: motion hypotheses, bundle adjustment, local map, again adjustment."""
        stage = stage or (lambda name: nullcontext())
        assert self.motion is not None and self._last_view is not None
        T_predicted = self.motion.predict(view.timestamp_s)
        with stage("track"):
            hypothesis, T, measured = self._initial_pose(view, sparse_map, T_predicted)
        seen = min(len(measured.tracks), len(view.features))  # flow alone is no sight: black frames
        if seen < self.config.min_inliers:
            return self._lost(T_predicted, measured.tracks)
        with stage("pose"):
            estimate = self._adjust(sparse_map, measured.tracks, T)
            self._learn_noise(sparse_map, measured, estimate)
        share = estimate.n_inliers / len(measured.tracks)
        if estimate.n_inliers < self.config.min_inliers or share < self.config.min_inlier_share:
            return self._lost(T_predicted, measured.tracks)
        with stage("local_map"):
            found, visible = self._search_local_map(view, sparse_map, measured.tracks, estimate)
            tracks = Tracks.concatenate(measured.tracks, found)
            if len(found):
                estimate = self._adjust(sparse_map, tracks, estimate.T_world_camera)
                self._learn_orb_noise(estimate, len(measured.tracks))
        pixels = estimate.residuals_px[estimate.inliers][:, :2]
        return TrackedFrame(
            TrackingStatus.OK,
            hypothesis,
            estimate.T_world_camera,
            estimate.covariance,
            tracks,
            estimate.inliers,
            float(np.sqrt((pixels**2).sum(1).mean())) if len(pixels) else np.nan,
            visible,
        )

    def _lost(self, T_predicted: Array, tracks: Tracks) -> TrackedFrame:
        return TrackedFrame(
            TrackingStatus.LOST,
            MotionHypothesis.NONE,
            T_predicted,
            np.full((6, 6), np.nan),
            tracks,
            np.zeros(len(tracks), bool),
            np.nan,
            np.empty(0, np.int64),
        )

    def _adjust(self, sparse_map: SparseMap, tracks: Tracks, T: Array) -> PoseEstimate:
        observations = sparse_map.observe(tracks, self.noise.sigma_disparity_px)
        return estimate_camera_pose(self.camera, T, observations)

    # ------------------------------------------------------------ hypotheses

    def _initial_pose(
        self, view: View, sparse_map: SparseMap, T_predicted: Array
    ) -> tuple[MotionHypothesis, Array, _Measurement]:
        """The best motion hypothesis, with the measurements that it was judged by.

        Constant velocity and PnP RANSAC compete always. Where the winner holds less than
        `weak_inlier_share` of the points, or too few in all, dense odometry and then a search
        among recent keyframes try as well, each with measurements around its own prediction.
        """
        measured = self._measure(view, sparse_map, T_predicted)
        best = self._compete(
            sparse_map, measured, {MotionHypothesis.CONSTANT_VELOCITY: T_predicted}
        )
        for attempt in (self._dense_hypothesis, self._relocalise):
            if not self._is_weak(best[2], len(measured.tracks)):
                break
            name, T_guess = attempt(view, sparse_map, T_predicted)
            if T_guess is None:
                continue
            again = self._measure(view, sparse_map, T_guess)
            rival = self._compete(sparse_map, again, {name: T_guess})
            if rival[2] > best[2]:
                best, measured = (name, rival[1], rival[2]), again
        return best[0], best[1], measured

    def _is_weak(self, n_inliers: int, n_tracks: int) -> bool:
        share = n_inliers / max(n_tracks, 1)
        return n_inliers < self.config.min_inliers or share < self.config.weak_inlier_share

    def _compete(
        self,
        sparse_map: SparseMap,
        measured: _Measurement,
        candidates: dict[MotionHypothesis, Array | None],
    ) -> tuple[MotionHypothesis, Array, int]:
        """The given hypotheses against PnP RANSAC on the same measurements."""
        points = sparse_map.position_m[measured.tracks.point_ids]
        uv = measured.tracks.uv_px
        limit, seed = self.config.inlier_px, self.config.seed
        pnp = estimate_pnp(self.camera, points, uv, limit, seed)
        every = {**candidates, MotionHypothesis.PNP_RANSAC: pnp}
        return choose_hypothesis(self.camera, every, points, uv, limit)

    def _dense_hypothesis(
        self, view: View, sparse_map: SparseMap, T_predicted: Array
    ) -> tuple[MotionHypothesis, Array | None]:
        """Open3D's RGB-D odometry from the last view, seeded with the prediction."""
        name, last = MotionHypothesis.RGBD_ODOMETRY, self._last_view
        if not self.config.use_rgbd_odometry or last is None or self.motion is None:
            return name, None
        T_prev_curr = estimate_rgbd_odometry(
            self.camera,
            (last.gray, last.depth_of_static_m(self.camera)),
            (view.gray, view.depth_of_static_m(self.camera)),
            invert_T(self.motion.T_world_camera) @ T_predicted,
            self.camera.bf / self.sensor.min_close_disparity_px,
        )
        return name, None if T_prev_curr is None else self.motion.T_world_camera @ T_prev_curr

    def _relocalise(
        self, view: View, sparse_map: SparseMap, T_predicted: Array
    ) -> tuple[MotionHypothesis, Array | None]:
        """Pose by descriptors alone, against the points of the latest keyframes."""
        name = MotionHypothesis.RELOCALISATION
        recent = sparse_map.keyframes[-_RELOCALISE_AGAINST:]
        if not recent:
            return name, None
        ids = np.unique(np.concatenate([k.tracks.point_ids for k in recent]))
        ids = ids[sparse_map.alive[ids]]
        points, features = match_all(
            sparse_map.descriptor[ids], view.features.descriptors, self.config.max_hamming, 0.8
        )
        if len(points) < self.config.min_inliers:
            return name, None
        world, uv = sparse_map.position_m[ids[points]], view.features.uv_px[features]
        T = estimate_pnp(self.camera, world, uv, 2.0 * self.config.inlier_px, self.config.seed)
        if T is None:
            return name, None
        n = reprojection_inliers(self.camera, T, world, uv, 2.0 * self.config.inlier_px).sum()
        enough = max(self.config.min_inliers, _RELOCALISED_SHARE * len(world))
        return name, T if n >= enough else None

    # ----------------------------------------------------------- measurement

    def _measure(self, view: View, sparse_map: SparseMap, T_predicted: Array) -> _Measurement:
        """Where the points of the last frame are in this view.

        The start is the given flow where there is one, else ORB matches around the places that
        `T_predicted` says. Patch alignment makes it sub-pixel, and is fused with the flow.
        """
        assert self._last_view is not None
        last = self._last_tracks
        flow_uv = self._flow_places(view, last)
        start = self._predicted_places(view, sparse_map, last, T_predicted, flow_uv)
        by_flow = np.asarray(np.isfinite(flow_uv).all(axis=1))
        tolerance = self.config.flow_tolerance_px if by_flow.any() else _ALIGNMENT_TOLERANCE_PX
        aligned, ok = align_patches(self._last_view.gray, view.gray, last.uv_px, start, tolerance)
        sigma = self.noise.sigma_uv_px
        uv, valid, sigma_px = fuse_measurements(
            flow_uv, by_flow, sigma["flow"], aligned, ok, sigma["alignment"]
        )
        aligned[~ok] = np.nan
        valid &= view.is_static(uv) & np.isfinite(uv).all(axis=1)
        uv, ids = uv[valid], last.point_ids[valid]
        tracks = Tracks(ids, uv, self.sensor.read_close_disparity(view, uv), sigma_px[valid])
        return _Measurement(tracks, {"flow": flow_uv[valid], "alignment": aligned[valid]})

    def _flow_places(self, view: View, last: Tracks) -> Array:
        if view.flow_prev_to_curr_px is None or not self._last_is_previous or len(last) == 0:
            return np.full((len(last), 2), np.nan)
        return last.uv_px + sample_bilinear(view.flow_prev_to_curr_px, last.uv_px)

    def _predicted_places(
        self,
        view: View,
        sparse_map: SparseMap,
        last: Tracks,
        T_predicted: Array,
        flow_uv: Array,
    ) -> Array:
        """Start (N, 2) of the alignment: flow, else ORB matches, else as matched neighbours go."""
        start = flow_uv.copy()
        missing = np.flatnonzero(~np.isfinite(flow_uv).all(axis=1))
        if len(missing) == 0:
            return start
        ids = last.point_ids[missing]
        points = transform_points(invert_T(T_predicted), sparse_map.position_m[ids])
        front = points[:, 2] > 0.1
        missing, ids, points = missing[front], ids[front], points[front]
        predicted = project_stereo(self.camera, points)[:, :2]
        start[missing] = predicted
        matched, features = match_in_radius(
            predicted,
            sparse_map.descriptor[ids],
            view.features.uv_px,
            view.features.descriptors,
            self.config.search_radius_px,
            self.config.max_hamming,
        )
        if len(matched) < 2 * _NEIGHBOURS:
            return start
        shift = view.features.uv_px[features] - predicted[matched]
        unmatched = np.setdiff1d(np.arange(len(missing)), matched)
        if len(unmatched):
            _, nearest = cKDTree(predicted[matched]).query(predicted[unmatched], k=_NEIGHBOURS)
            start[missing[unmatched]] += np.median(shift[nearest], axis=1)
        start[missing[matched]] += shift
        return start

    def _search_local_map(
        self, view: View, sparse_map: SparseMap, tracks: Tracks, estimate: PoseEstimate
    ) -> tuple[Tracks, NDArray[np.int64]]:
        """Points of the local map found again in this view, and all that were in view."""
        ids, predicted = sparse_map.local_points(estimate.T_world_camera, tracks.point_ids)
        on_static = view.is_static(predicted)
        ids, predicted = ids[on_static], predicted[on_static]
        features = view.features
        if len(ids) == 0 or len(features) == 0:
            return Tracks.empty(), ids
        taken = np.zeros(len(features), bool)
        if len(tracks):
            distance, _ = cKDTree(tracks.uv_px).query(features.uv_px, distance_upper_bound=3.0)
            taken = np.isfinite(distance)
        free = np.flatnonzero(~taken)
        matched, chosen = match_in_radius(
            predicted,
            sparse_map.descriptor[ids],
            features.uv_px[free],
            features.descriptors[free],
            self.config.map_radius_px,
            self.config.max_hamming,
        )
        uv = features.uv_px[free[chosen]]
        sigma = np.full(len(uv), self.noise.sigma_uv_px["orb"])
        return Tracks(ids[matched], uv, self.sensor.read_close_disparity(view, uv), sigma), ids

    # ----------------------------------------------------------------- noise

    def _learn_noise(
        self, sparse_map: SparseMap, measured: _Measurement, estimate: PoseEstimate
    ) -> None:
        points = transform_points(
            invert_T(estimate.T_world_camera), sparse_map.position_m[measured.tracks.point_ids]
        )
        good = estimate.inliers & (points[:, 2] > 0.1)
        predicted = project_stereo(self.camera, points[good])[:, :2]
        for source, uv in measured.sources_px.items():
            residual = uv[good] - predicted
            self.noise.learn_uv(source, residual[np.isfinite(residual).all(axis=1)])
        r = estimate.residuals_px[estimate.inliers]
        disparity = r[:, 0] - r[:, 2]
        self.noise.learn_disparity(disparity[np.isfinite(disparity)])

    def _learn_orb_noise(self, estimate: PoseEstimate, n_measured: int) -> None:
        r = estimate.residuals_px[n_measured:][estimate.inliers[n_measured:]]
        self.noise.learn_uv("orb", r[:, :2])
