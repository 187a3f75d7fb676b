"""The sparse static map: points with uncertainty, keyframes, and who sees what.

Owns the storage of points (growing parallel arrays), covisibility and culling. It estimates
nothing itself; `point_filter` and `triangulation` hold the formulas.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.config import MappingConfig
from pipelines.geometry import (
    MIN_DEPTH_M,
    inside_image,
    invert_T,
    project_stereo,
    transform_points,
)
from pipelines.mapping.keyframe import Keyframe
from pipelines.mapping.patch_album import PatchAlbum
from pipelines.observations import StereoObservations, Tracks
from pipelines.paged_arrays import PagedArrays
from pipelines.patches import Patches
from pipelines.shapes import check_ids, check_shape
from pipelines.types import Array, StaticMap, StereoCamera

Ids = NDArray[np.int64]

_FIRST_CAPACITY = 4096  # rows; doubled whenever they are full
_MIN_CHANCES = 8  # frames that should have seen a point before its found ratio counts
_NEIGHBOURS = 5  # covisible keyframes that each keyframe brings into the local map
_LASTING = 3  # keyframes that saw a point whose looks are worth keeping
_SAME_DIRECTION_DEG = 40.0  # optical axes closer than this look at the same things

_COLUMNS: dict[str, tuple[tuple[int, ...], type]] = {
    "position_m": ((3,), np.float64),  # in the world
    "covariance_m2": ((3, 3), np.float64),  # in the world
    "offset_slope": ((3,), np.float64),  # d position / d disparity offset, m / px
    "descriptor": ((32,), np.uint8),
    "color": ((3,), np.uint8),
    "n_found": ((), np.int32),  # frames that observed the point
    "n_visible": ((), np.int32),  # frames that should have
    "n_keyframes": ((), np.int32),  # keyframes that observe it
    "first_keyframe": ((), np.int64),  # position in `keyframes` of the first one, -1 before that
    "alive": ((), np.bool_),
    "serial": ((), np.int64),  # the point's lasting number, as rows are used again
}


class SparseMap:
    """Points and keyframes of the static world.

    album: how lasting points looked at first. Attributes named in `_COLUMNS` are arrays of capacity
    N; a point's id is its row, and is used again where no keyframe saw a point before it died.
    """

    position_m: Array
    covariance_m2: Array
    offset_slope: Array
    descriptor: NDArray[np.uint8]
    color: NDArray[np.uint8]
    n_found: NDArray[np.int32]
    n_visible: NDArray[np.int32]
    n_keyframes: NDArray[np.int32]
    first_keyframe: NDArray[np.int64]
    alive: NDArray[np.bool_]
    serial: NDArray[np.int64]

    def __init__(self, camera: StereoCamera, config: MappingConfig) -> None:
        self.camera, self.config = camera, config
        self.keyframes: list[Keyframe] = []
        self.album = PatchAlbum()
        self._arrays = PagedArrays()
        self._covisible: list[Ids] = []  # per keyframe, its covisible ones, most shared first
        self._n_shared: list[Ids] = []  # with each of them
        self._size = 0
        self._next_serial = 0
        self._free = np.empty(0, np.int64)
        self._young = np.empty(0, np.int64)  # points that no keyframe has seen yet
        self._keyframe_Ts = np.empty((0, 4, 4))
        for name, (shape, dtype) in _COLUMNS.items():
            setattr(self, name, np.zeros((_FIRST_CAPACITY, *shape), dtype))

    @classmethod
    def from_arrays(
        cls,
        camera: StereoCamera,
        config: MappingConfig,
        columns: Mapping[str, NDArray],
        keyframes: Sequence[Keyframe],
        covisible: Sequence[tuple[Ids, Ids]],
    ) -> SparseMap:
        """A map as another one's `columns`, `keyframes` and `covisibility` tell; nothing is shared.

        Points that no keyframe has seen are young again. Raises ValueError, naming the first, where
        arrays do not fit each other or name points or keyframes that are not there.
        """
        sparse_map = cls(camera, config)
        size = sparse_map._size = len(columns["alive"])
        for name, (shape, dtype) in _COLUMNS.items():
            check_shape("SparseMap", name, columns[name], (size, *shape))
            column: NDArray = np.zeros((max(size, _FIRST_CAPACITY), *shape), dtype)
            column[:size] = columns[name]
            setattr(sparse_map, name, column)
        first = sparse_map.first_keyframe[:size]
        check_ids("SparseMap", "first_keyframe", first, (-1, len(keyframes)))
        for keyframe in keyframes:
            check_ids("SparseMap", "point_ids", keyframe.tracks.point_ids, (0, size))
        for others, n_shared in covisible:
            check_shape("SparseMap", "n_shared", n_shared, others.shape)
            check_ids("SparseMap", "covisible", others, (0, len(keyframes)))
        if len(covisible) != len(keyframes):
            raise ValueError(f"SparseMap.covisible: {len(covisible)} of {len(keyframes)} keyframes")
        sparse_map._next_serial = int(columns["serial"].max(initial=-1)) + 1
        unseen = sparse_map.n_keyframes[:size] == 0
        sparse_map._free = np.flatnonzero(unseen & ~sparse_map.alive[:size])
        sparse_map._young = np.flatnonzero(unseen & sparse_map.alive[:size])
        sparse_map.keyframes = list(keyframes)
        sparse_map._keyframe_Ts = np.array([k.T_world_camera for k in keyframes]).reshape(-1, 4, 4)
        sparse_map._covisible = [others.astype(np.int64) for others, _ in covisible]
        sparse_map._n_shared = [n_shared.astype(np.int64) for _, n_shared in covisible]
        return sparse_map

    def __getstate__(self) -> dict[str, Any]:
        """All of it, without the columns' spare capacity."""
        used = {name: getattr(self, name)[: self._size] for name in _COLUMNS}
        return {**vars(self), **used}

    def columns(self) -> dict[str, NDArray]:
        """Read-only views of all columns of points by name; a point's id is its row, dead or not.

        position_m and the others are as in `_COLUMNS`, each (N, ...) without spare capacity.
        """
        views = {name: getattr(self, name)[: self._size] for name in _COLUMNS}
        for view in views.values():
            view.flags.writeable = False
        return views

    def covisibility(self) -> list[tuple[Ids, Ids]]:
        """Per keyframe, the covisible ones, most shared first, and how many points each shares."""
        return list(zip(self._covisible, self._n_shared, strict=True))

    def move_into(self, arrays: PagedArrays) -> None:
        """Keep all of it in such arrays from now on."""
        self._arrays = arrays
        for name in _COLUMNS:
            column = getattr(self, name)
            setattr(self, name, arrays.grown(column, len(column)))
        self.keyframes = [arrays.keep(keyframe) for keyframe in self.keyframes]
        self.album.move_into(arrays)

    # ---------------------------------------------------------------- points

    def add_points(
        self,
        points_world_m: Array,
        covariances_m2: Array,
        offset_slopes: Array,
        descriptors: NDArray[np.uint8],
        colors: NDArray[np.uint8],
    ) -> Ids:
        """Store new points, seen once so far, and return their ids (N,).

        points_world_m: (N, 3). covariances_m2: (N, 3, 3) in the world. offset_slopes: (N, 3)
        d(point) / d(disparity offset), m / px. descriptors: (N, 32). colors: (N, 3) RGB.
        """
        ids = self._allocate(len(points_world_m))
        self.position_m[ids] = points_world_m
        self.covariance_m2[ids] = covariances_m2
        self.offset_slope[ids] = offset_slopes
        self.descriptor[ids] = descriptors
        self.color[ids] = colors
        self.n_found[ids] = self.n_visible[ids] = 1
        self.n_keyframes[ids] = 0
        self.first_keyframe[ids] = -1
        self.alive[ids] = True
        self.serial[ids] = self._next_serial + np.arange(len(ids))
        self._next_serial += len(ids)
        self._young = np.concatenate([self._young, ids])
        return ids

    def _allocate(self, n: int) -> Ids:
        reused, self._free = self._free[:n], self._free[n:]
        fresh = n - len(reused)
        capacity = len(self.alive)
        if self._size + fresh > capacity:
            grown = max(2 * capacity, self._size + fresh)
            for name in _COLUMNS:
                setattr(self, name, self._arrays.grown(getattr(self, name), grown))
        ids = np.concatenate([reused, np.arange(self._size, self._size + fresh)])
        self._size += fresh
        return ids

    def observe(self, tracks: Tracks, sigma_disparity_px: float) -> StereoObservations:
        """The tracks with their points as the map has them, all with one noise of disparity."""
        ids = tracks.point_ids
        return StereoObservations(
            self.position_m[ids],
            self.covariance_m2[ids],
            tracks.uvr_px,
            tracks.sigma_uv_px,
            np.full(len(ids), sigma_disparity_px),
        )

    def shift_offset(self, ids: Ids, step_px: float) -> None:
        """Let points follow a change of the disparity offset, to first order."""
        self.position_m[ids] += step_px * self.offset_slope[ids]

    def detach_offset(self) -> None:
        """Let no point depend on the disparity offset: theirs was that of an earlier run."""
        self.offset_slope[: self._size] = 0.0

    def record_sight(self, visible_ids: Ids, found_ids: Ids) -> None:
        """Count which points a frame should have seen, and which it did see."""
        self.n_visible[visible_ids] += 1
        self.n_found[found_ids] += 1

    def cull_points(self, tracked_ids: Ids, visible_ids: Ids) -> None:
        """Forget points that proved no good: lost while young, or mostly not found."""
        tracked = np.zeros(self._size, bool)
        tracked[tracked_ids] = True
        self._young = self._young[self.n_keyframes[self._young] == 0]
        ratio = self.n_found[visible_ids] / np.maximum(self.n_visible[visible_ids], 1)
        poor = (self.n_visible[visible_ids] >= _MIN_CHANCES) & (ratio < self.config.min_found_ratio)
        broken = tracked_ids[~np.isfinite(self.position_m[tracked_ids]).all(axis=1)]
        doomed = np.concatenate([self._young, visible_ids[poor]])
        doomed = np.unique(np.concatenate([doomed[~tracked[doomed]], broken]))
        self.remove_points(doomed)

    def remove_points(self, ids: Ids) -> None:
        """Forget points, each named once.

        Points that no keyframe saw free their rows; others only die, as keyframes name them.
        """
        doomed = ids[self.alive[ids]]
        self.alive[doomed] = False
        self.album.forget(doomed)
        self._young = self._young[self.alive[self._young]]
        self._free = np.concatenate([self._free, doomed[self.n_keyframes[doomed] == 0]])

    def keep_patches(self, patches: Patches) -> None:
        """Keep how points look that have lasted for some keyframes by now.

        What was kept before stays: it is nearer to what a point was at first.
        """
        ids = patches.point_ids
        lasting = self.alive[ids] & (self.n_keyframes[ids] >= _LASTING) & ~self.album.has(ids)
        patches = patches[lasting]
        Ts = self._keyframe_Ts[self.first_keyframe[patches.point_ids]]
        self.album.add(patches.moved(invert_T(Ts)))

    def kept_patches(self, ids: Ids) -> Patches:
        """The patches that are kept of some points, in the world as it is now."""
        patches = self.album.of(ids)
        return patches.moved(self._keyframe_Ts[self.first_keyframe[patches.point_ids]])

    # ------------------------------------------------------------- keyframes

    def add_keyframe(self, keyframe: Keyframe) -> None:
        """Remember a keyframe, and work out which earlier ones see the same points."""
        index, ids = len(self.keyframes), keyframe.tracks.point_ids
        new = ids[self.first_keyframe[ids] < 0]
        others = self.local_keyframes(ids, keyframe.T_world_camera)
        self._covisible.append(np.empty(0, np.int64))
        self._n_shared.append(np.empty(0, np.int64))
        self.first_keyframe[new] = index
        self.n_keyframes[ids] += 1
        self.keyframes.append(self._arrays.keep(keyframe))
        self._keyframe_Ts = np.concatenate([self._keyframe_Ts, keyframe.T_world_camera[None]])
        self._tie(index, others)

    def add_sights(self, index: int, tracks: Tracks) -> None:
        """Let a keyframe see old points as well, as a loop has shown; who sees the same is told."""
        keyframe = self.keyframes[index]
        ids = tracks.point_ids
        tracks = tracks[self.alive[ids] & ~np.isin(ids, keyframe.tracks.point_ids)]
        self.replace_tracks(index, Tracks.concatenate(keyframe.tracks, tracks))

    def replace_tracks(self, index: int, tracks: Tracks) -> None:
        """Give a keyframe other tracks; who sees the same as those that are new is told."""
        keyframe = self.keyframes[index]
        joined = np.setdiff1d(tracks.point_ids, keyframe.tracks.point_ids)
        self.n_keyframes[joined] += 1
        self.keyframes[index] = replace(keyframe, tracks=self._arrays.keep(tracks))
        others = self.local_keyframes(joined, keyframe.T_world_camera)
        self._tie(index, np.setdiff1d(others, np.append(self._covisible[index], index)))

    def _tie(self, index: int, others: Ids) -> None:
        """Note which of some keyframes see so many points of a keyframe that they are covisible."""
        flags = np.zeros(self._size, bool)
        flags[self.keyframes[index].tracks.point_ids] = True
        shared = [int(flags[self.keyframes[k].tracks.point_ids].sum()) for k in others]
        for other, n in zip(others.tolist(), shared, strict=True):
            if n >= self.config.min_shared_points:
                self._note_covisible(index, other, n)
                self._note_covisible(other, index, n)

    def _note_covisible(self, index: int, other: int, n_shared: int) -> None:
        place = np.searchsorted(-self._n_shared[index], -n_shared, side="right")
        self._covisible[index] = np.insert(self._covisible[index], place, other)
        self._n_shared[index] = np.insert(self._n_shared[index], place, n_shared)

    def covisible_keyframes(self, index: int) -> Ids:
        """Positions in `keyframes` of those covisible with keyframe `index`, most shared first."""
        return self._covisible[index]

    def local_keyframes(self, point_ids: Ids, T_world_camera: Array) -> Ids:
        """Positions in `keyframes` of those that may see these points, in ascending order.

        They are the points' first observers, the neighbours of these by covisibility, the latest,
        and those near in place and direction, which is where a path crosses itself.
        """
        if not self.keyframes:
            return np.empty(0, np.int64)
        first = self.first_keyframe[point_ids]
        votes = np.bincount(first[first >= 0], minlength=len(self.keyframes))
        chosen = np.argsort(-votes, kind="stable")[: self.config.local_keyframes]
        chosen = chosen[votes[chosen] > 0]
        chosen = np.union1d(chosen, [len(self.keyframes) - 1])
        neighbours = [self.covisible_keyframes(k)[:_NEIGHBOURS] for k in chosen]
        near = self._near_keyframes(T_world_camera)
        return np.unique(np.concatenate([chosen, near, *neighbours])).astype(np.int64)

    def _near_keyframes(self, T_world_camera: Array) -> Ids:
        """The keyframes nearest in place that look the same way, within sight of their points."""
        Ts = self._keyframe_Ts
        distance = np.linalg.norm(Ts[:, :3, 3] - T_world_camera[:3, 3], axis=1)
        cosine = Ts[:, :3, 2] @ T_world_camera[:3, 2]
        reach = self.config.near_keyframe_baselines * self.camera.baseline_m
        alike = cosine > np.cos(np.radians(_SAME_DIRECTION_DEG))
        near = np.flatnonzero((distance < reach) & alike)
        return near[np.argsort(distance[near], kind="stable")[: self.config.local_keyframes]]

    def local_points(self, T_world_camera: Array, tracked_ids: Ids) -> tuple[Ids, Array]:
        """Points of the local map in view but not tracked: ids (N,) and predicted pixels (N, 2)."""
        keyframes = self.local_keyframes(tracked_ids, T_world_camera)
        flags = np.zeros(self._size, bool)
        for index in keyframes:
            flags[self.keyframes[index].tracks.point_ids] = True
        flags &= self.alive[: self._size]
        flags[tracked_ids] = False
        ids = np.flatnonzero(flags)
        points = transform_points(invert_T(T_world_camera), self.position_m[ids])
        front = points[:, 2] > MIN_DEPTH_M
        ids, points = ids[front], points[front]
        uv = project_stereo(self.camera, points)[:, :2]
        inside = inside_image(self.camera, uv)
        return ids[inside], uv[inside]

    # ----------------------------------------------------------- corrections

    def move_keyframe(self, index: int, T_world_camera: Array) -> None:
        """Put a keyframe elsewhere; its points stay."""
        self.keyframes[index] = replace(self.keyframes[index], T_world_camera=T_world_camera)
        self._keyframe_Ts[index] = T_world_camera

    def move_points(self, Cs: Array, ids: Ids, shifts_m: Array) -> None:
        """Move each point by the motion of its first keyframe, but named ones by their own shifts.

        Cs: (K, 4, 4) p_new = C @ p_old, of all keyframes; points that no keyframe has seen yet go
        with the last. ids: (N,) of the points with shifts (N, 3) in m.
        """
        first = self.first_keyframe[: self._size]
        changed = np.abs(Cs - np.eye(4)).max(axis=(1, 2)) > 0
        rows = np.flatnonzero(self.alive[: self._size] & changed[first])
        named = np.zeros(self._size, bool)
        named[ids] = True
        by = first[rows]
        R, t = Cs[by, :3, :3], Cs[by, :3, 3]
        position = np.einsum("nij,nj->ni", R, self.position_m[rows]) + t
        self.position_m[rows] = np.where(named[rows, None], self.position_m[rows], position)
        self.position_m[ids] += shifts_m
        self.covariance_m2[rows] = R @ self.covariance_m2[rows] @ R.transpose(0, 2, 1)
        self.offset_slope[rows] = np.einsum("nij,nj->ni", R, self.offset_slope[rows])

    # --------------------------------------------------------------- outside

    def snapshot(self) -> StaticMap:
        """The well-measured points and all keyframe poses, copied for the outside."""
        ids = np.flatnonzero(self.alive[: self._size] & (self.n_keyframes[: self._size] > 0))
        seen_from = self._keyframe_Ts[self.first_keyframe[ids], :3, 3]
        distance = np.linalg.norm(self.position_m[ids] - seen_from, axis=1)
        spread = np.sqrt(np.trace(self.covariance_m2[ids], axis1=1, axis2=2))
        good = (self.n_found[ids] >= self.config.min_observations) & (
            spread < self.config.max_relative_depth_sigma * distance
        )
        ids = ids[good]
        return StaticMap(
            self.position_m[ids].copy(),
            self.color[ids].copy(),
            self.n_found[ids].copy(),
            self._keyframe_Ts.copy(),
            np.array([k.frame_index for k in self.keyframes], np.int64),
            self.serial[ids].copy(),
        )
