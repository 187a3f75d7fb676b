"""Corrections of the map: what a back-end answers some frames after it was asked.

Owns how poses and points move when keyframes do, also those that came since the question. Points
and frames hang on keyframes: a correction moves each with its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import invert_T, make_T, rotation_of, rotation_vector
from pipelines.mapping.fusion import fuse_points
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.types import Array, FrameResult

Ids = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class MapCorrection:
    """Keyframes (K,) by their row with old and new poses (K, 4, 4), and points (N,) that move.

    shifts_m: (N, 3) how the named points move, to be added to wherever they are by now. All other
    points move with the keyframe that first saw them, keyframes that are newer than the newest one
    named with that one. sights: a keyframe's row and the points that it sees besides its own.
    duplicates: (P, 2) points that are one, of which the first is kept.
    """

    keyframes: Ids
    Ts_old: Array
    Ts_new: Array
    point_ids: Ids
    shifts_m: Array
    sights: tuple[int, Tracks] | None = None
    duplicates: Ids = field(default_factory=lambda: np.empty((0, 2), np.int64))


def correct_map(sparse_map: SparseMap, correction: MapCorrection) -> Array:
    """Move the map's keyframes and points; returns C (4, 4) that moves what is newest.

    C is a motion of the world: p_new = C @ p_old around the latest keyframes.
    """
    rows, n = correction.keyframes, len(sparse_map.keyframes)
    moved = correction.Ts_new @ np.stack([invert_T(T) for T in correction.Ts_old])
    newest = int(np.argmax(rows))
    Cs = np.repeat(np.eye(4)[None], n, axis=0)
    Cs[int(rows[newest]) + 1 :] = moved[newest]
    Cs[rows] = moved
    for k in np.flatnonzero(np.abs(Cs - np.eye(4)).max(axis=(1, 2)) > 0).tolist():
        sparse_map.move_keyframe(k, Cs[k] @ sparse_map.keyframes[k].T_world_camera)
    named = correction.point_ids[sparse_map.alive[correction.point_ids]]
    shifts = correction.shifts_m[sparse_map.alive[correction.point_ids]]
    sparse_map.move_points(Cs, named, shifts)
    if correction.sights is not None:
        sparse_map.add_sights(*correction.sights)
    fuse_points(sparse_map, correction.duplicates)
    return Cs[-1]


@dataclass(slots=True)
class FrameAnchors:
    """Where each frame lies from the latest keyframe of its time, and each keyframe from the last.

    frame_index: of the frames. keyframes: (K,) their latest keyframe, -1 before there is one.
    Ts_keyframe_frame: (K, 4, 4). firsts: per keyframe, the place among the frames that it has.
    Ts_last_keyframe: per keyframe, its pose in the one before it, when it came.
    """

    frame_index: list[int] = field(default_factory=list)
    keyframes: list[int] = field(default_factory=list)
    Ts_keyframe_frame: list[Array] = field(default_factory=list)
    firsts: list[int] = field(default_factory=list)
    Ts_last_keyframe: list[Array] = field(default_factory=list)

    def add(self, sparse_map: SparseMap, frame_index: int, T_world_camera: Array) -> None:
        """Hang the next frame on the latest keyframe, or on the world where there is none."""
        while len(self.firsts) < len(sparse_map.keyframes):
            k = len(self.firsts)
            T_world_last = sparse_map.keyframes[k - 1].T_world_camera if k else np.eye(4)
            T = invert_T(T_world_last) @ sparse_map.keyframes[k].T_world_camera
            self.firsts.append(len(self.keyframes))
            self.Ts_last_keyframe.append(T)
        last = len(sparse_map.keyframes) - 1
        T_world_keyframe = sparse_map.keyframes[last].T_world_camera if last >= 0 else np.eye(4)
        self.frame_index.append(frame_index)
        self.keyframes.append(last)
        self.Ts_keyframe_frame.append(invert_T(T_world_keyframe) @ T_world_camera)

    def trajectory(self, sparse_map: SparseMap) -> Array:
        """(K, 4, 4) T_world_camera of all frames so far, with their keyframes where they are now.

        What lies between the corrections of two keyframes is spread evenly over the frames between.
        """
        Ts = []
        for n, (k, T) in enumerate(zip(self.keyframes, self.Ts_keyframe_frame, strict=True)):
            if k < 0:
                Ts.append(T)
                continue
            T_world_keyframe = sparse_map.keyframes[k].T_world_camera
            if k + 1 < len(self.firsts):
                T_next = invert_T(T_world_keyframe) @ sparse_map.keyframes[k + 1].T_world_camera
                change = T_next @ invert_T(self.Ts_last_keyframe[k + 1])
                share = (n - self.firsts[k]) / (self.firsts[k + 1] - self.firsts[k])
                T_world_keyframe = T_world_keyframe @ _part(change, share)
            Ts.append(T_world_keyframe @ T)
        return np.array(Ts).reshape(-1, 4, 4)

    def revise(self, sparse_map: SparseMap, results: Sequence[FrameResult]) -> list[FrameResult]:
        """The results, in their order, with cameras and objects where they are now.

        Objects follow the cameras that saw them: with C_k = X_k,new inv(X_k,old) their poses are
        L' = C_k L and their motions H' = C_k H inv(C_k-1). Results of unknown frames stay.
        """
        now = dict(zip(self.frame_index, self.trajectory(sparse_map), strict=True))
        revised, C_before = [], np.eye(4)
        for result in results:
            T_new = now.get(result.frame_index, result.T_world_camera)
            C = T_new @ invert_T(result.T_world_camera)
            revised.append(_moved(result, T_new, C, C_before))
            C_before = C
        return revised


def _part(T: Array, share: float) -> Array:
    """A share of a small motion (4, 4)."""
    return make_T(rotation_of(share * rotation_vector(T)), share * T[:3, 3])


def _moved(result: FrameResult, T_world_camera: Array, C: Array, C_before: Array) -> FrameResult:
    objects = result.objects
    moved = replace(
        objects,
        Ts_world_object=C @ objects.Ts_world_object,
        Hs_world_curr_prev=C @ objects.Hs_world_curr_prev @ invert_T(C_before),
        centers_m=objects.centers_m @ C[:3, :3].T + C[:3, 3],
        velocities_mps=objects.velocities_mps @ C[:3, :3].T,
    )
    return replace(result, T_world_camera=T_world_camera, objects=moved)
