"""Corrections of the map: what a back-end answers some frames after it was asked.

Owns how poses and points move when keyframes do, also those that came since the question. Points
and frames hang on keyframes: a correction moves each with its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import invert_T
from pipelines.mapping.sparse_map import SparseMap
from pipelines.types import Array, FrameResult

Ids = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class MapCorrection:
    """Keyframes (K,) by their row with old and new poses (K, 4, 4), and points (N,) with new places.

    shifts_m: (N, 3) how the named points move, to be added to wherever they are by now. All other
    points move with the keyframe that first saw them, keyframes that are newer than the newest one
    named with that one.
    """

    keyframes: Ids
    Ts_old: Array
    Ts_new: Array
    point_ids: Ids
    shifts_m: Array


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
    return Cs[-1]


@dataclass(slots=True)
class FrameAnchors:
    """Which keyframe each frame hangs on, and where it lies from there."""

    keyframes: list[int] = field(default_factory=list)
    Ts_keyframe_frame: list[Array] = field(default_factory=list)

    def add(self, sparse_map: SparseMap, T_world_camera: Array) -> None:
        """Hang the next frame on the latest keyframe, or on the world where there is none."""
        last = len(sparse_map.keyframes) - 1
        T_world_keyframe = sparse_map.keyframes[last].T_world_camera if last >= 0 else np.eye(4)
        self.keyframes.append(last)
        self.Ts_keyframe_frame.append(invert_T(T_world_keyframe) @ T_world_camera)

    def revise(self, sparse_map: SparseMap, results: Sequence[FrameResult]) -> list[FrameResult]:
        """The results (one a frame, in their order) with cameras and objects where they are now.

        Poses follow their keyframes; an object's pose L and motion H follow the cameras that saw
        them: with C_k = X_k,new inv(X_k,old), L' = C_k L and H' = C_k H inv(C_k-1).
        """
        revised, C_before = [], np.eye(4)
        for result, k, T in zip(results, self.keyframes, self.Ts_keyframe_frame, strict=True):
            T_world_keyframe = sparse_map.keyframes[k].T_world_camera if k >= 0 else np.eye(4)
            T_new = T_world_keyframe @ T
            C = T_new @ invert_T(result.T_world_camera)
            revised.append(_moved(result, T_new, C, C_before))
            C_before = C
        return revised


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
