"""Errors of moving objects against the truth: motion, pose, speed, coverage, and identity.

Owns the "objects" block of metrics.json and its definitions (VDO-SLAM's object motion error; see
`object_tracks` for MOTA and IDF1). Reads and writes no file.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.evaluation.camera import statistics
from pipelines.evaluation.object_matching import ObjectMatches, is_seen, match_objects, of_match
from pipelines.evaluation.object_tracks import count_switches, track_scores
from pipelines.evaluation.object_truth import (
    KMH,
    ObjectLimits,
    RunFrames,
    TrueSteps,
    true_steps,
)
from pipelines.geometry import invert_T, orthonormalise, rotation_angle_deg
from pipelines.object_types import ObjectEstimates, ObjectState
from pipelines.types import Array, ObjectTruth

INTERVAL_95 = 1.96  # standard deviations either way
MIN_TRACK_FRAMES = 3  # fewer say nothing of an object's pose or mean (VDO-SLAM, DynoSAM)
LIMITS = ObjectLimits()


def evaluate_objects(
    estimates: ObjectEstimates,
    truth: ObjectTruth,
    frames: RunFrames,
    limits: ObjectLimits = LIMITS,
) -> dict[str, Any]:
    """Compare estimated objects with the true ones, both in the world of the estimate.

    Errors are over object-frames that are matched, move in truth (`limits.still_kmh`) and were said
    to move, with a motion H. Values that the data cannot give are None. Metres, degrees and km/h a
    frame; see the keys.
    """
    truth = truth[np.isin(truth.frame_index, frames.index)]
    steps = true_steps(truth, frames, limits)
    matches = match_objects(
        estimates, truth, steps.is_judged, limits.min_overlap, limits.min_pixels
    )
    says_moving = estimates.state == str(ObjectState.MOVING)
    says_moving &= np.isfinite(estimates.Hs_world_curr_prev).all((1, 2))
    row = matches.truth_row
    scored = np.flatnonzero(says_moving & of_match(steps.is_moving, row))
    errors = motion_errors(estimates, truth, steps, scored, row[scored])
    near = steps.is_judged & (steps.distance_m < limits.max_distance_m)
    wanted, covered = (
        int(steps.is_wanted.sum()),
        int((says_moving & of_match(steps.is_wanted, row)).sum()),
    )
    return {
        "object_frames": len(scored),
        "motion": {
            **statistics("trans", "m", errors["trans_m"]),
            **statistics("rot", "deg", errors["rot_deg"]),
        },
        "speed": _speed_errors(errors["speed_kmh"], errors["speed_std_kmh"]),
        "smoothed_speed": _speed_errors(errors["smoothed_kmh"], errors["smoothed_std_kmh"]),
        "pose": _pose_errors(estimates, truth, row),
        "coverage": {
            "truth": wanted,
            "found": covered,
            "share": covered / wanted if wanted else None,
        },
        "false_movers": int((says_moving & of_match(steps.is_still, row)).sum()),
        "ghosts": int((says_moving & (row < 0) & ~matches.is_ignored & is_seen(estimates)).sum()),
        "id_switches_while_moving": count_switches(
            estimates.object_id[scored], truth.object_id[row[scored]], estimates.frame_index[scored]
        ),
        "tracking": track_scores(estimates, truth, matches, near),
        "tracking_moving": track_scores(estimates, truth, matches, near & steps.is_moving),
        "vdo_compatible": _vdo_compatible(errors, truth.object_id[row[scored]]),
        "per_object": _per_object(estimates, truth, steps, matches, scored, errors),
        "limits": {name: getattr(limits, name) for name in limits.__slots__},
    }


def motion_errors(
    estimates: ObjectEstimates,
    truth: ObjectTruth,
    steps: TrueSteps,
    rows: NDArray[np.int64],
    true_rows: NDArray[np.int64],
) -> dict[str, Array]:
    """Errors (n,) of estimated motions `rows` (n,) against the steps of `true_rows` (n,).

    In the object's frame, so that it does not matter where the world's origin is: B = inv(L) H L
    with the true pose L one processed frame before, and E = inv(B_est) B_gt (VDO-SLAM). Speeds are
    signed, estimate minus truth, where the truth is the displacement of the object's origin.
    """
    L_prev = truth.Ts_world_object[steps.previous_row[true_rows]]
    L_curr = truth.Ts_world_object[true_rows]
    B_est = invert_T(L_prev) @ estimates.Hs_world_curr_prev[rows] @ L_prev
    E = invert_T(B_est) @ (invert_T(L_prev) @ L_curr)
    true_kmh = steps.speed_kmh[true_rows]
    return {
        "trans_m": np.linalg.norm(E[:, :3, 3], axis=1),
        "rot_deg": rotation_angle_deg(E),
        "speed_kmh": KMH * estimates.speed_mps[rows] - true_kmh,
        "speed_std_kmh": KMH * estimates.speed_std_mps[rows],
        "smoothed_kmh": KMH * estimates.smoothed_speed_mps[rows] - true_kmh,
        "smoothed_std_kmh": KMH * estimates.velocity_std_mps[rows],
    }


def pose_errors(Ts_est: Array, Ts_gt: Array) -> tuple[Array, Array]:
    """Errors (N,) in m and (N,) in deg of one object's poses (N, 4, 4), after the best offset.

    The estimate's frame sits anywhere in the body, so T_est = T_gt D up to errors, with a constant
    D, which is found by least squares over the track: the mean of inv(T_gt) T_est.
    """
    offsets = invert_T(Ts_gt) @ Ts_est
    D = orthonormalise(offsets.mean(0))
    E = invert_T(Ts_gt @ D) @ Ts_est
    return np.linalg.norm(E[:, :3, 3], axis=1), rotation_angle_deg(E)


def _pose_errors(
    estimates: ObjectEstimates, truth: ObjectTruth, row: NDArray[np.int64]
) -> dict[str, Any]:
    """Over all matched tracks of objects that ever move; a track is a pair of true and own id.

    Poses count where the motion to them was measured; elsewhere they are only predicted.
    """
    known = np.isfinite(estimates.Hs_world_curr_prev).all((1, 2))
    usable = np.flatnonzero(known & of_match(truth.moving, row))
    pairs = np.stack([truth.object_id[row[usable]], estimates.object_id[usable]], 1)
    kinds, which = np.unique(pairs, axis=0, return_inverse=True)
    t_errors: list[Array] = [np.empty(0)]
    r_errors: list[Array] = [np.empty(0)]
    for kind in range(len(kinds)):
        rows = usable[which.ravel() == kind]
        if len(rows) < MIN_TRACK_FRAMES:
            continue
        t, r = pose_errors(estimates.Ts_world_object[rows], truth.Ts_world_object[row[rows]])
        t_errors.append(t)
        r_errors.append(r)
    t, r = np.concatenate(t_errors), np.concatenate(r_errors)
    return {
        "object_frames": len(t),
        "tracks": len(t_errors) - 1,
        **statistics("trans", "m", t),
        **statistics("rot", "deg", r),
        "aligned_by": "constant offset of the object's frame, least squares over each track",
    }


def _speed_errors(errors_kmh: Array, std_kmh: Array) -> dict[str, Any]:
    """Signed mean, and statistics of the sizes; the share of truths inside the 95 % interval."""
    known = np.isfinite(errors_kmh)
    errors, std = errors_kmh[known], std_kmh[known]
    has_std = np.isfinite(std)
    inside = np.abs(errors[has_std]) <= INTERVAL_95 * std[has_std]
    return {
        "object_frames": len(errors),
        "signed_mean_kmh": float(errors.mean()) if len(errors) else None,
        **statistics("error", "kmh", np.abs(errors)),
        "inside_95_share": float(inside.mean()) if len(inside) else None,
    }


def _vdo_compatible(errors: dict[str, Array], true_id: NDArray[np.int64]) -> dict[str, Any]:
    """As VDO-SLAM prints: means over the object-frames that succeeded, RMSE for speed."""
    ids, counts = np.unique(true_id, return_counts=True)
    return {
        **_means(errors, np.ones(len(true_id), bool)),
        "per_object": {
            str(j): _means(errors, true_id == j) for j in ids[counts >= MIN_TRACK_FRAMES]
        },
    }


def _means(errors: dict[str, Array], which: NDArray[np.bool_]) -> dict[str, Any]:
    if not which.any():
        return {"trans_mean_m": None, "rot_mean_deg": None, "speed_rmse_kmh": None}
    return {
        "trans_mean_m": float(errors["trans_m"][which].mean()),
        "rot_mean_deg": float(errors["rot_deg"][which].mean()),
        "speed_rmse_kmh": float(np.sqrt(np.mean(errors["speed_kmh"][which] ** 2))),
    }


def _per_object(
    estimates: ObjectEstimates,
    truth: ObjectTruth,
    steps: TrueSteps,
    matches: ObjectMatches,
    scored: NDArray[np.int64],
    errors: dict[str, Array],
) -> dict[str, Any]:
    """By the true id: what was found of it, by which ids, those that were scored, and errors."""
    row = matches.truth_row
    true_id = truth.object_id[row[scored]]
    shown_by: dict[int, list[int]] = {
        int(j): [] for j in np.unique(truth.object_id[steps.is_judged])
    }
    for i in np.flatnonzero(row >= 0):
        own = shown_by[int(truth.object_id[row[i]])]
        if int(estimates.object_id[i]) not in own:
            own.append(int(estimates.object_id[i]))
    blocks = {}
    for j, ids in shown_by.items():
        which, is_own = true_id == j, truth.object_id == j
        wanted = int((steps.is_wanted & is_own).sum())
        hits = scored[which & steps.is_wanted[row[scored]]]
        speed = _speed_errors(errors["speed_kmh"][which], errors["speed_std_kmh"][which])
        trans = statistics("trans", "m", errors["trans_m"][which])
        rot = statistics("rot", "deg", errors["rot_deg"][which])
        blocks[str(j)] = {
            "class_name": str(truth.class_name[is_own][0]),
            "moves": bool(truth.moving[is_own][0]),
            "estimated_ids": ids,
            "scored_ids": list(dict.fromkeys(estimates.object_id[scored[which]].tolist())),
            "object_frames": int(which.sum()),
            "coverage_share": len(hits) / wanted if wanted else None,
            **{key: trans[key] for key in ("trans_rmse_m", "trans_median_m")},
            **{key: rot[key] for key in ("rot_rmse_deg", "rot_median_deg")},
            "speed_signed_mean_kmh": speed["signed_mean_kmh"],
            "speed_abs_mean_kmh": speed["error_mean_kmh"],
        }
    return blocks
