"""What a tracked frame does to the map: refine points, add points, make keyframes, cull.

Owns step 10 and its order. Storage is `sparse_map`, formulas are `point_filter` and
`triangulation`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.config import MappingConfig, OrbConfig
from pipelines.frontend.disparity_offset import follow_camera, offset_share
from pipelines.frontend.sensor import Sensor
from pipelines.frontend.tracking import TrackedFrame
from pipelines.frontend.view import View
from pipelines.geometry import invert_T, projection_jacobian, transform_points
from pipelines.mapping.keyframe import Keyframe, needs_keyframe
from pipelines.mapping.point_filter import make_points, refine_points
from pipelines.mapping.sparse_map import SparseMap
from pipelines.mapping.triangulation import (
    check_triangulated,
    match_along_epipolar_lines,
    triangulate,
)
from pipelines.observations import StereoObservations, Tracks
from pipelines.types import Array, Features, StereoCamera

_SIGMA_NEW_UV_PX = 0.05  # px, small: a point is by definition where it was first seen
_FAR_RELATIVE_SIGMA = 0.5  # sigma / disparity of a far point: a first guess, to be triangulated
_TRIANGULATED_SIGMA_PX = 1.0  # px, of both pixels of a triangulated point


class LocalMapping:
    """Grows a `SparseMap` frame by frame.

    Deviation: in the paper far points wait until they are triangulated. Here every point with some
    depth enters at once with its covariance, which says how much to believe of it, and each view
    refines it (`point_filter`); only what has no depth at all waits for two keyframes.
    """

    def __init__(self, sensor: Sensor, config: MappingConfig, orb: OrbConfig) -> None:
        self.sensor, self.config, self.orb = sensor, config, orb
        self.camera = sensor.camera

    def integrate(
        self, sparse_map: SparseMap, view: View, tracked: TrackedFrame
    ) -> tuple[Tracks, bool]:
        """Take a tracked frame into the map.

        Returns the tracks that the next frame will follow, and whether this is a keyframe.
        """
        tracks = tracked.tracks[tracked.inliers]
        visible = np.union1d(tracked.visible_ids, tracked.tracks.point_ids)
        sparse_map.record_sight(visible, tracks.point_ids)
        if len(tracks):
            observations = sparse_map.observe(tracks, self.sensor.noise.sigma_disparity_px)
            if self.sensor.calibrates_disparity:
                self._learn_offset(sparse_map, tracked, tracks, observations, visible)
            self._refine(sparse_map, tracked, tracks, observations)
        free = self.mappable_features(view, tracks)
        budget = max(0, self.orb.n_features - len(tracks))
        new = self._add_points(sparse_map, view, tracked.T_world_camera, free[:budget])
        last = sparse_map.keyframes[-1] if sparse_map.keyframes else None
        # Without the new ones: most of what is seen for the first time is never found again
        is_keyframe = needs_keyframe(self.config, tracks, last, view.frame_index)
        tracks = Tracks.concatenate(tracks, new)
        if is_keyframe:
            tracks = self._add_keyframe(sparse_map, view, tracked, tracks)
        if self.sensor.calibrates_disparity:
            # Last, as this view's own disparities were read with the old offset
            step_px = self.sensor.offset.step()
            sparse_map.shift_offset(np.union1d(visible, tracks.point_ids), step_px)
        sparse_map.cull_points(tracks.point_ids, visible)
        return tracks[sparse_map.alive[tracks.point_ids]], is_keyframe

    def localize(self, sparse_map: SparseMap, tracked: TrackedFrame) -> Tracks:
        """The tracks that the next frame will follow where the map must stay as it is.

        Only the disparity offset is learned: the map's points do not depend on this run's.
        """
        tracks = tracked.tracks[tracked.inliers]
        if len(tracks) and self.sensor.calibrates_disparity:
            sigma = self.sensor.noise.sigma_disparity_px
            observations = sparse_map.observe(tracks, sigma)
            still = np.zeros((len(tracks), 3))
            self.sensor.offset.learn(self.camera, tracked.T_world_camera, observations, still)
            self.sensor.offset.step()
        return tracks

    def mappable_features(self, view: View, tracks: Tracks) -> NDArray[np.int64]:
        """Indices (N,) of features with some depth, away from the tracks; the strongest first."""
        features = view.features
        if len(features) == 0:
            return np.empty(0, np.int64)
        usable = self.camera.bf / features.depth_m >= self.sensor.min_disparity_px
        usable &= self._away_from(features.uv_px, tracks.uv_px)
        chosen = np.flatnonzero(usable)
        return chosen[np.argsort(-features.response[chosen], kind="stable")]

    def _away_from(self, uv_px: Array, occupied_px: Array) -> NDArray[np.bool_]:
        """Which pixels (N, 2) keep `min_points_apart_px` from all of the occupied ones (M, 2)."""
        if len(occupied_px) == 0:
            return np.ones(len(uv_px), bool)
        apart = self.config.min_points_apart_px
        distance, _ = cKDTree(occupied_px).query(uv_px, distance_upper_bound=apart)
        return ~np.isfinite(distance)

    def _learn_offset(
        self,
        sparse_map: SparseMap,
        tracked: TrackedFrame,
        tracks: Tracks,
        observations: StereoObservations,
        visible: NDArray[np.int64],
    ) -> None:
        """Learn the disparity offset; let the points depend on it as seen from this camera."""
        T = tracked.T_world_camera
        slopes = sparse_map.offset_slope[tracks.point_ids]
        pose_slope = self.sensor.offset.learn(self.camera, T, observations, slopes)
        sparse_map.offset_slope[visible] += follow_camera(
            T, sparse_map.position_m[visible], pose_slope
        )

    def _refine(
        self,
        sparse_map: SparseMap,
        tracked: TrackedFrame,
        tracks: Tracks,
        observations: StereoObservations,
    ) -> None:
        ids, T = tracks.point_ids, tracked.T_world_camera
        points, covariances, slopes = refine_points(
            self.camera, T, tracked.covariance, observations, sparse_map.offset_slope[ids]
        )
        sparse_map.position_m[ids] = points
        sparse_map.covariance_m2[ids] = covariances
        sparse_map.offset_slope[ids] = slopes

    def _add_points(
        self,
        sparse_map: SparseMap,
        view: View,
        T_world_camera: Array,
        chosen: NDArray[np.int64],
    ) -> Tracks:
        """Close points at once; far ones with hardly any say of their depth, until it is seen."""
        features = view.features[chosen]
        if len(features) == 0:
            return Tracks.empty()
        disparity = self.camera.bf / features.depth_m
        close = disparity >= self.sensor.min_close_disparity_px
        sigma = self.sensor.noise.sigma_disparity_px
        sigma_disparity = np.where(close, sigma, np.maximum(sigma, _FAR_RELATIVE_SIGMA * disparity))
        points, covariances = make_points(
            self.camera,
            T_world_camera,
            features.uv_px,
            disparity,
            _SIGMA_NEW_UV_PX,
            sigma_disparity,
        )
        slopes = (T_world_camera[:3, 3] - points) / disparity[:, None]  # as z = bf / d
        slopes *= offset_share(self.camera, disparity)[:, None]
        colors = read_colors(view, features.uv_px)
        ids = sparse_map.add_points(points, covariances, slopes, features.descriptors, colors)
        return Tracks(
            ids,
            features.uv_px,
            np.where(close, disparity, np.nan),
            np.full(len(ids), _SIGMA_NEW_UV_PX),
        )

    def _add_keyframe(
        self, sparse_map: SparseMap, view: View, tracked: TrackedFrame, tracks: Tracks
    ) -> Tracks:
        """Remember the frame; triangulate what has no point yet with its neighbours."""
        free = view.features[self._away_from(view.features.uv_px, tracks.uv_px)]
        T = tracked.T_world_camera
        for index in self._triangulation_partners(sparse_map, tracks, T):
            new, used = self._triangulate_with(
                sparse_map, sparse_map.keyframes[index], view, T, free
            )
            tracks = Tracks.concatenate(tracks, new)
            free = free[~used]
        offset_px = self.sensor.offset.offset_px
        sparse_map.add_keyframe(
            Keyframe(view.frame_index, view.timestamp_s, T, tracks, free, offset_px)
        )
        return tracks

    def _triangulation_partners(
        self, sparse_map: SparseMap, tracks: Tracks, T: Array
    ) -> NDArray[np.int64]:
        """Local keyframes with enough baseline for parallax, the nearest of these first."""
        indices = sparse_map.local_keyframes(tracks.point_ids, T)
        if len(indices) == 0:
            return indices
        centres = np.stack([sparse_map.keyframes[i].T_world_camera[:3, 3] for i in indices])
        distance = np.linalg.norm(centres - T[:3, 3], axis=1)
        shortest = self.config.min_triangulation_baselines * self.camera.baseline_m
        apart = np.flatnonzero(distance >= shortest)
        nearest = apart[np.argsort(distance[apart], kind="stable")]
        return indices[nearest[: self.config.triangulate_with]]

    def _triangulate_with(
        self, sparse_map: SparseMap, other: Keyframe, view: View, T: Array, free: Features
    ) -> tuple[Tracks, NDArray[np.bool_]]:
        """Points from the free features of this frame and of one keyframe.

        Returns their tracks in this frame, and which of the features (N,) they took.
        """
        used = np.zeros(len(free), bool)
        T_curr_other = invert_T(T) @ other.T_world_camera
        i, j = match_along_epipolar_lines(
            self.camera,
            T_curr_other,
            free,
            other.free_features,
            self.config.max_epipolar_px,
            self.orb.scale_factor,
        )
        if len(i) == 0:
            return Tracks.empty(), used
        a, b = free[i], other.free_features[j]
        points = triangulate(self.camera, T, other.T_world_camera, a.uv_px, b.uv_px)
        good = check_triangulated(
            self.camera,
            T,
            other.T_world_camera,
            points,
            a,
            b,
            self.config,
            self.orb.scale_factor,
        )
        points, a = points[good], a[good]
        used[i[good]] = True
        ids = sparse_map.add_points(
            points,
            triangulation_covariance(self.camera, T, other.T_world_camera, points),
            np.zeros_like(points),  # no disparity went into them
            a.descriptors,
            read_colors(view, a.uv_px),
        )
        n = len(ids)
        return Tracks(ids, a.uv_px, np.full(n, np.nan), np.full(n, _TRIANGULATED_SIGMA_PX)), used


def triangulation_covariance(
    camera: StereoCamera, T_world_a: Array, T_world_b: Array, points_world_m: Array
) -> Array:
    """Covariances (N, 3, 3) in the world, in m^2, of two-view points (N, 3), from pixel noise."""
    information = np.zeros((len(points_world_m), 3, 3))
    for T in (T_world_a, T_world_b):
        points = transform_points(invert_T(T), points_world_m)
        J = projection_jacobian(camera, points)[:, :2] @ T[:3, :3].T
        information += J.transpose(0, 2, 1) @ J / _TRIANGULATED_SIGMA_PX**2
    return np.linalg.inv(information + 1e-6 * np.eye(3))  # along a ray nothing may be known


def read_colors(view: View, uv_px: Array) -> NDArray[np.uint8]:
    """RGB colours (N, 3) of the image at pixels (N, 2)."""
    H, W = view.gray.shape
    x = np.clip(np.rint(uv_px[:, 0]).astype(np.int64), 0, W - 1)
    y = np.clip(np.rint(uv_px[:, 1]).astype(np.int64), 0, H - 1)
    values = view.image[y, x]
    return values if values.ndim == 2 else np.repeat(values[:, None], 3, axis=1)
