"""What a batch changes in a run: trajectory, rows of objects, map points, standard deviations.

Owns the way from a `BatchResult` back to what the front-end answers. Reads and writes no file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.batch_problem import BatchProblem, Stretch
from pipelines.backend.global_batch import BatchResult
from pipelines.frame_observations import STATIC, FrameObservations
from pipelines.geometry import (
    invert_T,
    orthonormalise,
    rotation_vector,
    skew,
    transform_points,
)
from pipelines.object_types import ObjectEstimates
from pipelines.objects.kalman import direction_std
from pipelines.objects.motion import displacement, largest_std
from pipelines.objects.track import middle_doubt_mps
from pipelines.types import Array


def corrections(log: Sequence[FrameObservations], result: BatchResult) -> Array:
    """(K, 4, 4) how the batch moved the world around each frame of the log: new X times inv(old X).

    A frame that was lost follows the tracked one before it.
    """
    before, after = result.before, result.after
    moved = after.Ts_world_camera @ invert_T(before.Ts_world_camera)
    index = np.array([entry.frame_index for entry in log], np.int64)
    place = np.searchsorted(before.frame_index, index, side="right") - 1
    return orthonormalise(moved[np.maximum(place, 0)])


def trajectory_after(log: Sequence[FrameObservations], moved: Array) -> Array:
    """(K, 4, 4) T_world_camera of every frame. moved: (K, 4, 4) of `corrections`."""
    Ts = np.array([entry.T_world_camera for entry in log]).reshape(-1, 4, 4)
    return orthonormalise(moved @ Ts)


def objects_after(
    objects: ObjectEstimates,
    log: Sequence[FrameObservations],
    moved: Array,
    result: BatchResult,
) -> tuple[ObjectEstimates, Array]:
    """All rows after the batch, and standard deviations (M, 2) of L in m and deg, NaN unknown.

    What the batch did not estimate, or was refused, stays as it was seen from its camera.
    """
    index = np.array([entry.frame_index for entry in log], np.int64)
    place = np.clip(np.searchsorted(index, objects.frame_index), 0, len(index) - 1)
    C, C_before = moved[place], moved[np.maximum(place - 1, 0)]
    rows = replace(
        objects,
        Ts_world_object=C @ objects.Ts_world_object,
        Hs_world_curr_prev=C @ objects.Hs_world_curr_prev @ invert_T(C_before),
        centers_m=np.einsum("mij,mj->mi", C[:, :3, :3], objects.centers_m) + C[:, :3, 3],
        velocities_mps=np.einsum("mij,mj->mi", C[:, :3, :3], objects.velocities_mps),
        motion_covariances=objects.motion_covariances.copy(),
        speed_mps=objects.speed_mps.copy(),
        speed_std_mps=objects.speed_std_mps.copy(),
        velocity_std_mps=objects.velocity_std_mps.copy(),
    )
    pose_std = np.full((len(objects), 2), np.nan)
    for stretch in result.before.stretches:
        if stretch.object_id in result.accepted_objects:
            _take_stretch(rows, pose_std, stretch, result, objects.centers_m)
    return rows, pose_std


def _take_stretch(
    rows: ObjectEstimates, pose_std: Array, stretch: Stretch, result: BatchResult, centers_m: Array
) -> None:
    """Fill in the rows of one stretch. centers_m: (M, 3) by the front-end."""
    poses = result.after.Ts_world_object[stretch.poses]
    before = result.before.Ts_world_object[stretch.poses]
    dts_s = np.diff(result.before.timestamps_s[stretch.frames])
    for n, row in enumerate(stretch.rows):
        if row < 0:
            continue
        L, o = poses[n], stretch.first_pose + n
        rows.Ts_world_object[row] = L
        if (
            result.covariances is not None
            and not result.kept_motions[stretch.first_pose : o + 1].any()
        ):
            pose_std[row] = _spread(result.covariances.objects[o])
        if n == 0:
            continue  # the stretch begins here: the motion to it is not known
        # The centre rides on the object, from where the front-end had both
        center = transform_points(L @ invert_T(before[n]), centers_m[row : row + 1])[0]
        H = L @ invert_T(poses[n - 1])
        way_m = displacement(H, transform_points(invert_T(H), center[None])[0])
        rows.Hs_world_curr_prev[row], rows.centers_m[row] = H, center
        rows.velocities_mps[row] = way_m / dts_s[n - 1]
        rows.speed_mps[row] = np.linalg.norm(way_m) / dts_s[n - 1]
        if result.covariances is None or result.kept_motions[o]:
            continue  # the front-end's own
        covariance = _about_center(result.covariances.steps[o], L, center)
        rows.motion_covariances[row] = covariance
        std_mps = direction_std(way_m, covariance[3:, 3:]) / dts_s[n - 1]
        # Better motions do not tell better where the middle is, whose speed is told
        turn_std = float(largest_std(covariance[:3, :3]))
        turn = max(0.0, float(np.linalg.norm(rotation_vector(H))) - turn_std)
        doubt_mps = middle_doubt_mps(rows.extents_m[row], turn / float(dts_s[n - 1]))
        rows.speed_std_mps[row] = rows.velocity_std_mps[row] = np.hypot(std_mps, doubt_mps)


def _about_center(covariance: Array, T_world_object: Array, center_m: Array) -> Array:
    """A covariance (6, 6) in the object's axes as one of `ObjectEstimates.motion_covariances`."""
    R = T_world_object[:3, :3]
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = R
    A[3:, :3] = -R @ skew(R.T @ (center_m - T_world_object[:3, 3]))
    return A @ covariance @ A.T


def _spread(covariance: Array) -> Array:
    """(2,) square roots of the traces of both blocks (6, 6): m and deg."""
    variance = np.diagonal(covariance)
    return np.array([np.sqrt(variance[3:].sum()), np.degrees(np.sqrt(variance[:3].sum()))])


def map_after(
    points_m: Array, track_ids: NDArray[np.int64], log_ids: NDArray[np.int64], result: BatchResult
) -> Array:
    """(N, 3) points of the saved map after the batch. track_ids: (N,) of them, or none known.

    log_ids: (P,) track ids of the batch's points, -1 for those of objects. Points that the batch
    did not have move with the camera that is nearest to them.
    """
    before, after = result.before, result.after
    if len(points_m) == 0:
        return points_m
    from scipy.spatial import cKDTree

    _, nearest = cKDTree(before.Ts_world_camera[:, :3, 3]).query(points_m)
    moved = after.Ts_world_camera @ invert_T(before.Ts_world_camera)
    new = np.einsum("nij,nj->ni", moved[nearest, :3, :3], points_m) + moved[nearest, :3, 3]
    if len(track_ids) != len(points_m):
        return new
    order = np.argsort(log_ids, kind="stable")
    place = np.searchsorted(log_ids[order], track_ids)
    place = order[np.minimum(place, len(order) - 1)] if len(order) else np.zeros(len(new), int)
    known = (log_ids[place] == track_ids) if len(log_ids) else np.zeros(len(new), bool)
    estimated = after.points_m[place]
    limit = _STRAY_SHARE * np.linalg.norm(points_m - before.Ts_world_camera[nearest, :3, 3], axis=1)
    known &= np.linalg.norm(estimated - new, axis=1) < np.maximum(limit, _STRAY_M)
    new[known] = estimated[known]
    return new


_STRAY_SHARE, _STRAY_M = 0.3, 0.3  # a point that went farther was badly seen: it stays


def static_track_ids(problem: BatchProblem, log: Sequence[FrameObservations]) -> NDArray[np.int64]:
    """(P,) the lasting number of each point of a problem, -1 for points of objects."""
    ids = np.concatenate([entry.sightings.track_id for entry in log])
    owner = np.concatenate([entry.sightings.object_id for entry in log])
    first = problem.sighting_rows[problem.tracks.starts]
    return np.where(owner[first] == STATIC, ids[first], -1)
