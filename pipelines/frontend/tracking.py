"""Camera tracking: the pose of each frame from the points of the last one and of the local map.

Owns the contest of motion hypotheses and the state between frames (last view, velocity). Points
are found by `measurement`, poses by `motion_only_ba`; the map belongs to `mapping`.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.config import TrackingConfig
from pipelines.frontend.hypotheses import (
    ConstantVelocity,
    choose_hypothesis,
    estimate_pnp,
    reprojection_inliers,
)
from pipelines.frontend.matching import match_all
from pipelines.frontend.measurement import (
    LastFrame,
    Measurement,
    measure_points,
    search_local_map,
)
from pipelines.frontend.motion_only_ba import PoseEstimate, estimate_camera_pose
from pipelines.frontend.rgbd_odometry import estimate_rgbd_odometry
from pipelines.frontend.sensor import Sensor
from pipelines.frontend.view import View
from pipelines.geometry import invert_T, project_stereo, transform_points
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.types import Array, MotionHypothesis, TrackingStatus

_GATE = 2.0  # inlier limits: observations farther from the chosen hypothesis adjust it later
_REGAINED_NEAR = 0.5  # of the way predicted since the last good frame, to be about there
_RELOCALISED_SHARE = 0.5  # of descriptor matches that must agree with a pose found by them
_RELOCALISE_AGAINST = 5  # latest keyframes tried when lost
_RELOCALISE_RATIO = 0.8  # of the best to the second best distance (Lowe)
_RELOCALISE_SLACK = 2.0  # times `inlier_px`: features lie on coarse levels too, unaligned

Stage = Callable[[str], AbstractContextManager[None]]


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """The answer of tracking one view.

    T_world_camera: (4, 4), predicted if LOST. covariance: (6, 6) of the right perturbation
    [omega rad, v m], NaN if LOST. tracks: all points measured. inliers: (N,) bool of the tracks.
    rmse_px: of the inliers' pixels (u_L, v). visible_ids: (M,) points of the local map in view,
    whether found or not.
    """

    status: TrackingStatus
    hypothesis: MotionHypothesis
    T_world_camera: Array
    covariance: Array
    tracks: Tracks
    inliers: NDArray[np.bool_]
    rmse_px: float
    visible_ids: NDArray[np.int64]


class Tracker:
    """Tracks a camera against a sparse map; step 4 of the design."""

    def __init__(self, sensor: Sensor, config: TrackingConfig) -> None:
        self.sensor, self.config = sensor, config
        self.camera, self.noise = sensor.camera, sensor.noise
        self.motion: ConstantVelocity | None = None
        self._last: LastFrame | None = None

    # ----------------------------------------------------------------- state

    def start(self, view: View, T_world_camera: Array) -> None:
        """Begin, or begin anew, with a known pose and no velocity."""
        self.motion = ConstantVelocity(T_world_camera, view.timestamp_s)

    def remember(self, view: View, tracks: Tracks) -> None:
        """Keep what the next frame will be tracked from."""
        self._last = LastFrame(view, tracks)

    def forget_flow(self) -> None:
        """Say that the next frame's flow does not start at the remembered view."""
        if self._last is not None:
            self._last = replace(self._last, flow_starts_here=False)

    def move_world(self, C: Array) -> None:
        """Let what is remembered follow a correction of the map: p_new = C (4, 4) @ p_old."""
        if self.motion is not None:
            self.motion.T_world_camera = C @ self.motion.T_world_camera

    # -------------------------------------------------------------- tracking

    def track(self, view: View, sparse_map: SparseMap, stage: Stage | None = None) -> TrackedFrame:
        """Pose of a view: motion hypotheses, bundle adjustment, local map, again adjustment.

        The map is read, not changed. stage: times the parts by name. Losing track is an answer.
        """
        stage = stage or (lambda _: nullcontext())
        assert self.motion is not None
        T_predicted = self.motion.predict(view.timestamp_s)
        with stage("track"):
            hypothesis, T, measured = self._initial_pose(view, sparse_map, T_predicted)
        seen = min(len(measured.tracks), len(view.features))  # flow alone is no sight: black frames
        if seen < self.config.min_inliers:
            return self._lost(T_predicted, measured.tracks)
        with stage("pose"):
            estimate = self._adjust(sparse_map, measured.tracks, T)
        if not self._is_trusted(estimate, T_predicted):
            return self._lost(T_predicted, measured.tracks)
        first = not self.noise.is_learned
        self._learn_noise(sparse_map, measured, estimate)
        if first:  # the weights were guesses: once more with what they taught
            measured = self._measure(view, sparse_map, estimate.T_world_camera)
            estimate = self._adjust(sparse_map, measured.tracks, estimate.T_world_camera)
        with stage("local_map"):
            T, tracks = estimate.T_world_camera, measured.tracks
            found, visible = search_local_map(view, sparse_map, tracks, T, self.sensor, self.config)
            if len(found):
                tracks = Tracks.concatenate(tracks, found)
                estimate = self._adjust(sparse_map, tracks, T, robust_rounds=1)
                if not self._is_trusted(estimate, T_predicted):
                    return self._lost(T_predicted, tracks)
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

    def _is_trusted(self, estimate: PoseEstimate, T_predicted: Array) -> bool:
        """Whether enough points agree with a pose.

        After a lost frame any place may be in sight, and places look alike: more must agree then,
        unless the pose is about where the motion led.
        """
        assert self._last is not None and self.motion is not None
        share = self.config.min_inlier_share
        if not self._last.flow_starts_here:
            led_m = T_predicted[:3, 3] - self.motion.T_world_camera[:3, 3]
            off_m = T_predicted[:3, 3] - estimate.T_world_camera[:3, 3]
            if np.linalg.norm(off_m) > _REGAINED_NEAR * np.linalg.norm(led_m):
                share = self.config.min_regained_share
        return estimate.n_inliers >= max(self.config.min_inliers, share * len(estimate.inliers))

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

    def _adjust(
        self, sparse_map: SparseMap, tracks: Tracks, T: Array, robust_rounds: int = 2
    ) -> PoseEstimate:
        observations = sparse_map.observe(tracks, self.noise.sigma_disparity_px)
        gate_px = _GATE * self.config.inlier_px
        return estimate_camera_pose(self.camera, T, observations, robust_rounds, gate_px)

    # ------------------------------------------------------------ hypotheses

    def _initial_pose(
        self, view: View, sparse_map: SparseMap, T_predicted: Array
    ) -> tuple[MotionHypothesis, Array, Measurement]:
        """The best motion hypothesis, with the measurements that it was judged by.

        Constant velocity and PnP RANSAC compete always, as in the paper. Where the winner holds
        less than `weak_inlier_share` of the points, or too few in all, dense odometry and then a
        search among recent keyframes try as well, each with measurements around its own guess.
        Deviation: dense odometry costs too much to compete in every frame, as designed at first.
        """
        measured = self._measure(view, sparse_map, T_predicted)
        constant_velocity = MotionHypothesis.CONSTANT_VELOCITY
        name, T, n_inliers = self._compete(sparse_map, measured, constant_velocity, T_predicted)
        fallbacks: tuple[tuple[MotionHypothesis, Callable[[], Array | None]], ...] = (
            (MotionHypothesis.RGBD_ODOMETRY, lambda: self._dense_odometry(view, T_predicted)),
            (MotionHypothesis.RELOCALISATION, lambda: self._relocalise(view, sparse_map)),
        )
        for rival, estimate in fallbacks:
            if not self._is_weak(n_inliers, len(measured.tracks)):
                break
            T_guess = estimate()
            if T_guess is None:
                continue
            again = self._measure(view, sparse_map, T_guess)
            _, T_again, n_again = self._compete(sparse_map, again, rival, T_guess)
            if n_again > n_inliers:  # whoever won: it did on measurements that the rival led to
                name, T, n_inliers, measured = rival, T_again, n_again, again
        return name, T, measured

    def _measure(self, view: View, sparse_map: SparseMap, T: Array) -> Measurement:
        assert self._last is not None
        return measure_points(self._last, view, sparse_map, T, self.sensor, self.config)

    def _is_weak(self, n_inliers: int, n_tracks: int) -> bool:
        share = n_inliers / max(n_tracks, 1)
        return n_inliers < self.config.min_inliers or share < self.config.weak_inlier_share

    def _compete(
        self,
        sparse_map: SparseMap,
        measured: Measurement,
        name: MotionHypothesis,
        T_world_camera: Array,
    ) -> tuple[MotionHypothesis, Array, int]:
        """A hypothesis against PnP RANSAC on the same measurements: the winner and its inliers."""
        points = sparse_map.position_m[measured.tracks.point_ids]
        uv = measured.tracks.uv_px
        limit, seed = self.config.inlier_px, self.config.seed
        pnp = estimate_pnp(self.camera, points, uv, limit, seed)
        candidates = {name: T_world_camera, MotionHypothesis.PNP_RANSAC: pnp}
        return choose_hypothesis(self.camera, candidates, points, uv, limit)

    def _dense_odometry(self, view: View, T_predicted: Array) -> Array | None:
        """T_world_camera (4, 4) by RGB-D odometry from the last view, seeded by prediction."""
        if not self.config.use_rgbd_odometry:
            return None
        assert self._last is not None
        assert self.motion is not None
        last = self._last.view
        T_prev_curr = estimate_rgbd_odometry(
            self.camera,
            (last.gray, last.depth_of_static_m(self.camera)),
            (view.gray, view.depth_of_static_m(self.camera)),
            invert_T(self.motion.T_world_camera) @ T_predicted,
            self.camera.bf / self.sensor.min_close_disparity_px,
        )
        return None if T_prev_curr is None else self.motion.T_world_camera @ T_prev_curr

    def _relocalise(self, view: View, sparse_map: SparseMap) -> Array | None:
        """T_world_camera (4, 4) by descriptors alone, against points of the latest keyframes."""
        recent = sparse_map.keyframes[-_RELOCALISE_AGAINST:]
        if not recent:
            return None
        ids = np.unique(np.concatenate([k.tracks.point_ids for k in recent]))
        ids = ids[sparse_map.alive[ids]]
        points, features = match_all(
            sparse_map.descriptor[ids],
            view.features.descriptors,
            self.config.max_hamming,
            _RELOCALISE_RATIO,
        )
        if len(points) < self.config.min_inliers:
            return None
        world, uv = sparse_map.position_m[ids[points]], view.features.uv_px[features]
        limit = _RELOCALISE_SLACK * self.config.inlier_px
        T = estimate_pnp(self.camera, world, uv, limit, self.config.seed)
        if T is None:
            return None
        n = reprojection_inliers(self.camera, T, world, uv, limit).sum()
        enough = max(self.config.min_inliers, _RELOCALISED_SHARE * len(world))
        return T if n >= enough else None

    # ----------------------------------------------------------------- noise

    def _learn_noise(
        self, sparse_map: SparseMap, measured: Measurement, estimate: PoseEstimate
    ) -> None:
        """Each source's own residuals at the inliers teach its noise, not those of their mean."""
        good = estimate.inliers  # all in front of the camera
        points = sparse_map.position_m[measured.tracks.point_ids[good]]
        points = transform_points(invert_T(estimate.T_world_camera), points)
        predicted = project_stereo(self.camera, points)[:, :2]
        for source, uv in measured.sources_px.items():
            residual = uv[good] - predicted
            self.noise.learn_uv(source, residual[np.isfinite(residual).all(axis=1)])
        r = estimate.residuals_px[good]
        disparity = r[:, 0] - r[:, 2]
        self.noise.learn_disparity(disparity[np.isfinite(disparity)])

    def _learn_orb_noise(self, estimate: PoseEstimate, n_measured: int) -> None:
        r = estimate.residuals_px[n_measured:][estimate.inliers[n_measured:]]
        self.noise.learn_uv("orb", r[:, :2])
