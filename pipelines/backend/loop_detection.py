"""Loops: a keyframe that sees a place which was mapped long before, and where it is by that map.

Owns which places are asked about, and the geometric proof. Corrects nothing: see `pose_graph`.
How keyframes look is known to `seen_places`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.seen_places import SeenPlaces
from pipelines.frontend.hypotheses import estimate_pnp, reprojection_inliers
from pipelines.frontend.matching import match_all, match_in_radius
from pipelines.frontend.motion_only_ba import estimate_camera_pose
from pipelines.frontend.sensor import Sensor
from pipelines.geometry import (
    MIN_DEPTH_M,
    inside_image,
    invert_T,
    project_stereo,
    rotation_angle_deg,
    transform_points,
)
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.types import Array, Features

Ids = NDArray[np.int64]

_ASKED = 20  # places by the score of their own
_TRIED = 3  # places whose geometry is tried, by the score of them and their neighbours
_RECENT = 20  # latest keyframes, which are no loops
FEWEST_KEYFRAMES = _RECENT + 2  # before so many there can be no loop
_NEIGHBOURS = 5  # covisible keyframes whose points a place brings
_MAX_HAMMING, _RATIO = 64, 0.8  # of matches; best to second best (Lowe)
_PNP_PX = 4.0  # reprojection error of an inlier: corners lie on coarse levels too
_MIN_MATCHES, _MIN_PNP_INLIERS, _MIN_PNP_SHARE = 25, 20, 0.3
_GUIDED_PX = 8.0  # radius of the second search, once the pose is known
_MIN_INLIERS, _MIN_SHARE = 50, 0.5  # of the guided matches, for proof
# Houses resemble each other: two keyframes must tell the same of where the map is off
_WITHIN = 5  # keyframes
_SAME_SHARE, _SAME_DEG = 0.03, 1.0  # of the depth of what was seen, and of direction
_OPEN_SHARE, _OPEN_DEG = 0.005, 0.2  # less is not worth a correction
# Copies of a house look alike to the last brick: no tracking is off by so much of its way
_DRIFT_SHARE, _DRIFT_DEG = 0.15, 30.0
_SEED = 0


@dataclass(frozen=True, slots=True)
class LoopClosure:
    """A place seen again.

    keyframe: row of the new keyframe. place: row of the old one. T_world_camera: (4, 4) where the
    old part of the map says that the new one is. tracks: old points that it sees. off: (4, 4) how
    the new keyframe would move, p_new = off @ p_old. depth_m: median of what it sees.
    """

    keyframe: int
    place: int
    T_world_camera: Array
    tracks: Tracks
    off: Array
    depth_m: float

    @property
    def is_open(self) -> bool:
        """Whether the map is off by more than a loop is measured to."""
        seen = invert_T(self.T_world_camera) @ self.off @ self.T_world_camera
        far_m = float(np.linalg.norm(seen[:3, 3]))
        return far_m > _OPEN_SHARE * self.depth_m or float(rotation_angle_deg(seen)) > _OPEN_DEG

    def agrees_with(self, other: LoopClosure) -> bool:
        """Whether two closures move what this one sees alike."""
        between = invert_T(self.T_world_camera) @ self.off @ invert_T(other.off)
        between = between @ self.T_world_camera
        far_m = float(np.linalg.norm(between[:3, 3]))
        turned_deg = float(rotation_angle_deg(between))
        return far_m <= _SAME_SHARE * self.depth_m and turned_deg <= _SAME_DEG


def _may_be_drift(sparse_map: SparseMap, closure: LoopClosure) -> bool:
    """Whether a camera that went from the place to the keyframe can have come to be off so far."""
    Ts = [k.T_world_camera for k in sparse_map.keyframes[closure.place : closure.keyframe + 1]]
    centers = np.array([T[:3, 3] for T in Ts])
    way_m = float(np.linalg.norm(np.diff(centers, axis=0), axis=1).sum())
    off_m = float(np.linalg.norm(closure.T_world_camera[:3, 3] - centers[-1]))
    most_m = _DRIFT_SHARE * way_m + _SAME_SHARE * closure.depth_m  # which may turn on the spot
    return off_m <= most_m and float(rotation_angle_deg(closure.off)) <= _DRIFT_DEG


class LoopDetector:
    """Proves that two keyframes are of one place. places: all of the map, the latest one, too."""

    def __init__(self, sensor: Sensor, places: SeenPlaces) -> None:
        self.sensor, self._places = sensor, places
        self._unconfirmed: list[LoopClosure] = []

    def take(self, sparse_map: SparseMap, features: Features) -> LoopClosure | None:
        """Ask about the latest keyframe, whose ORB features these are.

        A loop is told when a second keyframe, a few later at most, bears out the first.
        """
        closure = self._find(sparse_map, features)
        if closure is None:
            return None
        recent = [c for c in self._unconfirmed if closure.keyframe - c.keyframe <= _WITHIN]
        if any(closure.agrees_with(other) for other in recent):
            self._unconfirmed = []
            return closure
        self._unconfirmed = [*recent, closure]
        return None

    def _find(self, sparse_map: SparseMap, features: Features) -> LoopClosure | None:
        """The loop that the latest keyframe alone would prove."""
        index = len(sparse_map.keyframes) - 1
        candidates = self._places.like_latest(self._near(sparse_map, index), _ASKED)
        score = dict(zip(candidates.keyframes.tolist(), candidates.scores.tolist(), strict=True))
        together = {
            k: s + sum(score.get(int(n), 0.0) for n in sparse_map.covisible_keyframes(k)[:2])
            for k, s in score.items()
        }
        best = sorted(together, key=lambda k: (-together[k], k))
        tried: set[int] = set()
        for place in best:
            if place in tried:
                continue
            if len(tried) >= _TRIED:
                break
            tried.add(place)
            closure = self._prove(sparse_map, index, place, features)
            if closure is not None and _may_be_drift(sparse_map, closure):
                return closure
        return None

    def _near(self, sparse_map: SparseMap, index: int) -> set[int]:
        """Keyframes that are no loops: the latest, and those covisible in one or two steps."""
        near = set(range(max(0, index - _RECENT), index + 1))
        first = sparse_map.covisible_keyframes(index).tolist()
        near.update(first)
        for k in first:
            near.update(sparse_map.covisible_keyframes(k).tolist())
        return near

    def _prove(
        self, sparse_map: SparseMap, index: int, place: int, features: Features
    ) -> LoopClosure | None:
        """The pose by a place's points, if enough of them agree with one."""
        camera, keyframes = sparse_map.camera, sparse_map.keyframes
        around = np.append(sparse_map.covisible_keyframes(place)[:_NEIGHBOURS], place)
        ids = np.unique(np.concatenate([keyframes[k].tracks.point_ids for k in around]))
        ids = ids[sparse_map.alive[ids]]
        if len(ids) < _MIN_MATCHES:
            return None
        points, matched = match_all(
            sparse_map.descriptor[ids], features.descriptors, _MAX_HAMMING, _RATIO
        )
        if len(points) < _MIN_MATCHES:
            return None
        world, uv = sparse_map.position_m[ids[points]], features.uv_px[matched]
        T = estimate_pnp(camera, world, uv, _PNP_PX, _SEED)
        if T is None:
            return None
        n = int(reprojection_inliers(camera, T, world, uv, _PNP_PX).sum())
        if n < max(_MIN_PNP_INLIERS, _MIN_PNP_SHARE * len(world)):
            return None
        return self._refine(sparse_map, index, place, features, ids, T)

    def _refine(
        self,
        sparse_map: SparseMap,
        index: int,
        place: int,
        features: Features,
        ids: Ids,
        T: Array,
    ) -> LoopClosure | None:
        """Search all of the place's points around the pose; eq. (1) on stereo pixels; count."""
        camera = sparse_map.camera
        local = transform_points(invert_T(T), sparse_map.position_m[ids])
        front = local[:, 2] > MIN_DEPTH_M
        ids, local = ids[front], local[front]
        predicted = project_stereo(camera, local)[:, :2]
        inside = inside_image(camera, predicted)
        ids, predicted = ids[inside], predicted[inside]
        points, matched = match_in_radius(
            predicted,
            sparse_map.descriptor[ids],
            features.uv_px,
            features.descriptors,
            _GUIDED_PX,
            _MAX_HAMMING,
        )
        if len(points) < _MIN_INLIERS:
            return None
        noise = self.sensor.noise
        disparity = camera.bf / features.depth_m[matched]
        close = disparity >= self.sensor.min_close_disparity_px
        tracks = Tracks(
            ids[points],
            features.uv_px[matched],
            np.where(close, disparity, np.nan),
            np.full(len(points), noise.sigma_uv_px["orb"]),
        )
        observations = sparse_map.observe(tracks, noise.sigma_disparity_px)
        estimate = estimate_camera_pose(camera, T, observations)
        enough = max(_MIN_INLIERS, _MIN_SHARE * len(points))
        if estimate.n_inliers < enough:
            return None
        T = estimate.T_world_camera
        seen = transform_points(invert_T(T), sparse_map.position_m[tracks.point_ids])
        return LoopClosure(
            index,
            place,
            T,
            tracks[estimate.inliers],
            T @ invert_T(sparse_map.keyframes[index].T_world_camera),
            float(np.median(seen[estimate.inliers, 2])),
        )
