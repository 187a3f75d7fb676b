"""Camera tracking: the pose of each frame from the points of the last one and of the local map.

Owns the contest of motion hypotheses and the state between frames (last view, velocity). Points
are found by `measurement`, poses by `motion_only_ba`; the map belongs to `mapping`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
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
from pipelines.frontend.map_search import search_local_map
from pipelines.frontend.matching import match_all
from pipelines.frontend.measurement import (
    LastFrame,
    Measurement,
    measure_points,
)
from pipelines.frontend.motion_only_ba import PoseEstimate, estimate_camera_pose
from pipelines.frontend.patch_cutting import Shot, renew_patches
from pipelines.frontend.rgbd_odometry import estimate_rgbd_odometry
from pipelines.frontend.sensor import Sensor
from pipelines.frontend.view import View
from pipelines.geometry import invert_T, project_stereo, rotation_angle_deg, transform_points
from pipelines.mapping.fusion import rename_points
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.patches import Patches
from pipelines.types import Array, MotionHypothesis, TrackingStatus

_SEEN_ALIKE_DEG = 1.0  # turned by less, a patch looks the same
_GATE = 2.0  # inlier limits: observations farther from the chosen hypothesis adjust it later
_REGAINED_NEAR = 0.5  # of the way predicted since the last good frame, to be about there
_RELOCALISED_SHARE = 0.5  # of descriptor matches that must agree with a pose found by them
_RECOGNISED_SHARE = 0.1  # of the features, or of the map's points if fewer, at a place regained
_RELOCALISE_AGAINST = 5  # latest keyframes tried when lost, before places by their looks
_PLACE_NEIGHBOURS = 5  # covisible keyframes whose points help to recognise a place
_JUMP_BASELINES = 5.0  # off the prediction at least, of a camera found at another place
_RELOCALISE_RATIO = 0.8  # of the best to the second best distance (Lowe)
_RELOCALISE_SLACK = 2.0  # times `inlier_px`: features lie on coarse levels too, unaligned

Stage = Callable[[str], AbstractContextManager[None]]
SeenBefore = Callable[[NDArray[np.uint8]], Sequence[int]]


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """The answer of tracking one view.

    T_world_camera: (4, 4), predicted if LOST. covariance: (6, 6) of the right perturbation
    [omega rad, v m], NaN if LOST. tracks: all points measured. inliers: (N,) bool of the tracks.
    rmse_px: of the inliers' pixels (u_L, v). visible_ids: (M,) points of the local map in view,
    whether found or not. is_jump: recognised at a place where the motion did not lead.
    """

    status: TrackingStatus
    hypothesis: MotionHypothesis
    T_world_camera: Array
    covariance: Array
    tracks: Tracks
    inliers: NDArray[np.bool_]
    rmse_px: float
    visible_ids: NDArray[np.int64]
    is_jump: bool = False


@dataclass(frozen=True, slots=True)
class _Guess:
    """A pose (4, 4) to measure around; matches: of descriptors that led to it, if any did."""

    T_world_camera: Array
    matches: Measurement | None = None


class Tracker:
    """Tracks a camera against a sparse map; step 4."""

    def __init__(
        self,
        sensor: Sensor,
        config: TrackingConfig,
        seen_before: SeenBefore = lambda descriptors: (),
    ) -> None:
        """seen_before: rows of keyframes that look like an image with ORB descriptors (N, 32)."""
        self.sensor, self.config, self.seen_before = sensor, config, seen_before
        self.camera, self.noise = sensor.camera, sensor.noise
        self.motion: ConstantVelocity | None = None
        self._last: LastFrame | None = None

    # ----------------------------------------------------------------- state

    @property
    def remembers(self) -> bool:
        """Whether there is a frame to track from; else every view must be recognised."""
        return self._last is not None

    def start(self, view: View, T_world_camera: Array) -> ConstantVelocity:
        """Begin, or begin anew, with a known pose and no velocity; returns the motion."""
        self.motion = ConstantVelocity(T_world_camera, view.timestamp_s)
        return self.motion

    def remember(
        self, view: View, T_world_camera: Array, tracks: Tracks, sparse_map: SparseMap
    ) -> None:
        """Keep what the next frame will be tracked from: a view from (4, 4), and what it saw."""
        points = sparse_map.position_m[tracks.point_ids]
        depth_m = transform_points(invert_T(T_world_camera), points)[:, 2]
        shot = Shot(self.camera, view, T_world_camera, self.noise.sigma_disparity_px)
        old = Patches.empty() if self._last is None else self._last.patches
        back = np.setdiff1d(tracks.point_ids, old.point_ids)
        old = Patches.concatenate(old, sparse_map.kept_patches(back))
        patches = renew_patches(old, shot, tracks, depth_m)
        sparse_map.keep_patches(patches)
        self._last = LastFrame(view, tracks, patches=patches)

    def forget_flow(self) -> None:
        """Say that the next frame's flow does not start at the remembered view."""
        if self._last is not None:
            self._last = replace(self._last, flow_starts_here=False)

    def move_world(self, C: Array) -> None:
        """Let what is remembered follow a correction of the map: p_new = C (4, 4) @ p_old."""
        if self.motion is not None:
            self.motion.T_world_camera = C @ self.motion.T_world_camera
        if self._last is not None:
            self._last = replace(self._last, patches=self._last.patches.moved(C))

    def rename_points(self, pairs: NDArray[np.int64]) -> None:
        """Follow the first point of each pair (P, 2) where the second one was followed."""
        if self._last is not None:
            self._last = replace(self._last, tracks=rename_points(self._last.tracks, pairs))

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
        if not self._is_trusted(estimate, T_predicted, hypothesis):
            return self._lost(T_predicted, measured.tracks)
        # The weights were guesses, or the patches were warped for another view than this
        turned_deg = rotation_angle_deg(invert_T(T_predicted) @ estimate.T_world_camera)
        again = not self.noise.is_learned or turned_deg > _SEEN_ALIKE_DEG
        self._learn_noise(sparse_map, measured, estimate)
        if again and measured.sources_px:
            measured = self._measure(view, sparse_map, estimate.T_world_camera)
            estimate = self._adjust(sparse_map, measured.tracks, estimate.T_world_camera)
        with stage("local_map"):
            T, tracks = estimate.T_world_camera, measured.tracks
            self.noise.borrow("looks", "orb")
            found_again = search_local_map(view, sparse_map, tracks, T, self.sensor, self.config)
            found, visible = found_again.tracks, found_again.visible_ids
            if not measured.sources_px:  # recognised by features alone, as coarse in depth
                coarse = np.where(found_again.by_looks, found.disparity_px, np.nan)
                found = replace(found, disparity_px=coarse)
            if len(found):
                tracks = Tracks.concatenate(tracks, found)
                estimate = self._adjust(sparse_map, tracks, T, robust_rounds=1)
                if not self._is_trusted(estimate, T_predicted, hypothesis):
                    return self._lost(T_predicted, tracks)
                self._learn_found_noise(estimate, found_again.by_looks)
        is_jump = self._is_jump(hypothesis, estimate.T_world_camera, T_predicted)
        in_sight = min(len(measured.tracks) + len(visible), len(view.features))
        if is_jump and estimate.n_inliers < _RECOGNISED_SHARE * in_sight:
            return self._lost(T_predicted, tracks)  # alike in some lines, not in what is between
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
            is_jump,
        )

    def _is_trusted(
        self, estimate: PoseEstimate, T_predicted: Array, hypothesis: MotionHypothesis
    ) -> bool:
        """Whether enough points agree with a pose.

        After a lost frame, or where a view was recognised, any place may be in sight, and places
        look alike: more must agree then, unless the pose is about where the motion led.
        """
        share = self.config.min_inlier_share
        lost_before = self._last is None or not self._last.flow_starts_here
        T = estimate.T_world_camera
        is_regained = lost_before and self._is_elsewhere(T, T_predicted)
        if is_regained or self._is_jump(hypothesis, T, T_predicted):
            share = self.config.min_regained_share
        return estimate.n_inliers >= max(self.config.min_inliers, share * len(estimate.inliers))

    def _is_elsewhere(self, T: Array, T_predicted: Array, at_least_m: float = 0.0) -> bool:
        """Whether a pose is far from where the motion since the last good frame led, if any did."""
        assert self.motion is not None
        if self._last is None:
            return True
        led_m = float(np.linalg.norm(T_predicted[:3, 3] - self.motion.T_world_camera[:3, 3]))
        off_m = float(np.linalg.norm(T_predicted[:3, 3] - T[:3, 3]))
        return off_m > max(_REGAINED_NEAR * led_m, at_least_m)

    def _is_jump(self, hypothesis: MotionHypothesis, T: Array, T_predicted: Array) -> bool:
        """Whether a place was recognised that is another one than where the motion led."""
        least_m = _JUMP_BASELINES * self.camera.baseline_m
        recognised = hypothesis is MotionHypothesis.RELOCALISATION
        return recognised and self._is_elsewhere(T, T_predicted, least_m)

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
        search among keyframes, recent or alike, try as well, each with measurements around its own
        guess. Deviation: dense odometry costs too much to compete in every frame, as designed.
        """
        measured = self._measure(view, sparse_map, T_predicted)
        constant_velocity = MotionHypothesis.CONSTANT_VELOCITY
        name, T, n_inliers = self._compete(sparse_map, measured, constant_velocity, T_predicted)
        fallbacks: tuple[tuple[MotionHypothesis, Callable[[], _Guess | None]], ...] = (
            (MotionHypothesis.RGBD_ODOMETRY, lambda: self._dense_odometry(view, T_predicted)),
            (MotionHypothesis.RELOCALISATION, lambda: self._relocalise(view, sparse_map)),
        )
        for rival, make_guess in fallbacks:
            if not self._is_weak(n_inliers, len(measured.tracks)):
                break
            guess = make_guess()
            if guess is None:
                continue
            again = self._measure(view, sparse_map, guess.T_world_camera)
            _, T_again, n_again = self._compete(sparse_map, again, rival, guess.T_world_camera)
            if guess.matches is not None and self._is_weak(n_again, len(again.tracks)):
                # Far from the last frame, whose points are out of sight: those of the place itself
                again = guess.matches
                _, T_again, n_again = self._compete(sparse_map, again, rival, guess.T_world_camera)
            if n_again > n_inliers:  # whoever won: it did on measurements that the rival led to
                name, T, n_inliers, measured = rival, T_again, n_again, again
        return name, T, measured

    def _measure(self, view: View, sparse_map: SparseMap, T: Array) -> Measurement:
        if self._last is None:
            return Measurement(Tracks.empty(), {})
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

    def _dense_odometry(self, view: View, T_predicted: Array) -> _Guess | None:
        """T_world_camera (4, 4) by RGB-D odometry from the last view, seeded by prediction."""
        if not self.config.use_rgbd_odometry or self._last is None:
            return None
        assert self.motion is not None
        last = self._last.view
        T_prev_curr = estimate_rgbd_odometry(
            self.camera,
            (last.gray, last.depth_of_static_m(self.camera)),
            (view.gray, view.depth_of_static_m(self.camera)),
            invert_T(self.motion.T_world_camera) @ T_predicted,
            self.camera.bf / self.sensor.min_close_disparity_px,
        )
        return None if T_prev_curr is None else _Guess(self.motion.T_world_camera @ T_prev_curr)

    def _relocalise(self, view: View, sparse_map: SparseMap) -> _Guess | None:
        """Pose by descriptors alone, against the latest keyframes, then against places alike.

        Of the places the one with which most points agree wins.
        """
        n = len(sparse_map.keyframes)
        latest = range(max(0, n - _RELOCALISE_AGAINST), n)
        found = self._recognise(view, sparse_map, latest)
        if found is not None:
            return found[0]
        best: tuple[_Guess, int] | None = None
        for row in self.seen_before(view.features.descriptors):
            near = [row, *sparse_map.covisible_keyframes(row)[:_PLACE_NEIGHBOURS]]
            found = self._recognise(view, sparse_map, near)
            if found is not None and (best is None or found[1] > best[1]):
                best = found
        return None if best is None else best[0]

    def _recognise(
        self, view: View, sparse_map: SparseMap, rows: Sequence[int]
    ) -> tuple[_Guess, int] | None:
        """Pose by the points of some keyframes, and how many agree; None where too few do."""
        if not rows:
            return None
        seen = [sparse_map.keyframes[row].tracks.point_ids for row in rows]
        ids = np.unique(np.concatenate(seen))
        ids = ids[sparse_map.alive[ids]]
        points, features = match_all(
            sparse_map.descriptor[ids],
            view.features.descriptors,
            self.config.max_hamming,
            _RELOCALISE_RATIO,
        )
        if len(points) < self.config.min_inliers:
            return None
        ids, uv = ids[points], view.features.uv_px[features]
        world = sparse_map.position_m[ids]
        limit = _RELOCALISE_SLACK * self.config.inlier_px
        T = estimate_pnp(self.camera, world, uv, limit, self.config.seed)
        if T is None:
            return None
        n_agree = int(reprojection_inliers(self.camera, T, world, uv, limit).sum())
        if n_agree < max(self.config.min_inliers, _RELOCALISED_SHARE * len(world)):
            return None
        # Without disparities: a feature of a coarse level lies pixels off, on another depth
        sigma = np.full(len(uv), self.noise.sigma_uv_px["orb"])
        tracks = Tracks(ids, uv, np.full(len(uv), np.nan), sigma)
        return _Guess(T, Measurement(tracks, {})), n_agree

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

    def _learn_found_noise(self, estimate: PoseEstimate, by_looks: NDArray[np.bool_]) -> None:
        """by_looks: (N,) of the last N observations, which were found again in the local map."""
        n = len(estimate.inliers) - len(by_looks)
        good = estimate.inliers[n:]
        r = estimate.residuals_px[n:, :2]
        self.noise.learn_uv("looks", r[good & by_looks])
        self.noise.learn_uv("orb", r[good & ~by_looks])
