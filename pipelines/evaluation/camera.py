"""Errors of a camera trajectory against the truth: ATE, RPE per frame, KITTI odometry.

Owns the definitions (Sturm et al. 2012 for ATE and RPE; the KITTI odometry development kit for
t_rel and r_rel). Reads and writes no file.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import invert_T, orthonormalise, rotation_angle_deg
from pipelines.types import Array

MAX_TIME_DIFFERENCE_S = 0.02  # of associated stamps (the TUM tools)
KITTI_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
KITTI_START_STEP = 10  # frames between the starts of segments


def evaluate_camera(
    est_timestamps_s: Array, est_Ts: Array, gt_timestamps_s: Array, gt_Ts: Array
) -> dict[str, Any]:
    """Compare estimated with true camera-to-world poses.

    est_Ts: (N, 4, 4) of the tracked frames. gt_Ts: (M, 4, 4), a row a frame of the sequence, NaN
    where the truth is unknown; it may live in any world frame. Poses count as consecutive when
    their truth rows are. Values that the data cannot give (too few frames, too short a path) are
    None. Metres, degrees, percent; see the keys.
    """
    gt_stamps = np.asarray(gt_timestamps_s, float)
    gt = np.array(gt_Ts, float).reshape(-1, 4, 4)
    known = np.isfinite(gt).all((1, 2))
    gt[~known] = np.eye(4)
    gt = orthonormalise(gt) if len(gt) else gt
    est_rows, gt_rows = associate(est_timestamps_s, gt_stamps)
    usable = known[gt_rows]
    est_rows, gt_rows = est_rows[usable], gt_rows[usable]
    est = np.asarray(est_Ts, float).reshape(-1, 4, 4)[est_rows]
    est = orthonormalise(est) if len(est) else est
    matched = gt[gt_rows]
    return {
        "frames_matched": len(gt_rows),
        **_ate(est, matched),
        **_rpe(est, matched, np.diff(gt_rows) == 1),
        **_kitti(est, gt_rows, gt, known),
        "path_length_m": _path_length(gt[known & _between(len(gt), gt_rows)]),
    }


def associate(a_timestamps_s: Array, b_timestamps_s: Array) -> tuple[NDArray, NDArray]:
    """Indices (n,), (n,) of stamps that are each other's nearest and at most 0.02 s apart.

    No stamp is used twice. Pairs come in order of time.
    """
    a, b = np.asarray(a_timestamps_s, float), np.asarray(b_timestamps_s, float)
    if len(a) == 0 or len(b) == 0:
        return np.empty(0, int), np.empty(0, int)
    nearest_b, nearest_a = _nearest(a, b), _nearest(b, a)
    index = np.arange(len(a))
    mutual = nearest_a[nearest_b] == index
    # The 1 ns keeps a difference of exactly 0.02 s in, whatever the rounding of the stamps.
    close = np.abs(a - b[nearest_b]) <= MAX_TIME_DIFFERENCE_S + 1e-9
    rows = index[mutual & close]
    rows = rows[np.argsort(a[rows], kind="stable")]
    return rows, nearest_b[rows]


def _nearest(queries: Array, stamps: Array) -> NDArray:
    """Index into `stamps` of the one nearest to each query; the earlier one on a tie."""
    order = np.argsort(stamps, kind="stable")
    in_order = stamps[order]
    right = np.clip(np.searchsorted(in_order, queries), 1, max(len(stamps) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(stamps) - 1)
    take_left = np.abs(queries - in_order[left]) <= np.abs(in_order[right] - queries)
    return order[np.where(take_left, left, right)]


def relative_errors(est: Array, gt: Array) -> Array:
    """Body-frame errors (N-1, 4, 4) of consecutive motions of poses (N, 4, 4).

    E = inv(inv(T_est_k) T_est_k+1) (inv(T_gt_k) T_gt_k+1).
    """
    step_est = invert_T(est[:-1]) @ est[1:]
    step_gt = invert_T(gt[:-1]) @ gt[1:]
    return invert_T(step_est) @ step_gt


def align(est_m: Array, gt_m: Array) -> Array:
    """`est_m` (N, 3) moved onto `gt_m` (N, 3) by the best rigid motion (Umeyama 1991, no scale)."""
    from evo.core.geometry import GeometryException, umeyama_alignment

    logging.getLogger("evo").setLevel(logging.ERROR)
    try:
        R, t, _ = umeyama_alignment(est_m.T, gt_m.T, with_scale=False)
    except GeometryException:
        # Straight paths leave the turn about the path open, and evo refuses. It does not change
        # the residuals, so any of the equally good rotations serves.
        R, t = _any_best_motion(est_m, gt_m)
    return est_m @ R.T + t


def _any_best_motion(est_m: Array, gt_m: Array) -> tuple[Array, Array]:
    centre_est, centre_gt = est_m.mean(0), gt_m.mean(0)
    U, _, Vt = np.linalg.svd((gt_m - centre_gt).T @ (est_m - centre_est))
    R = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))]) @ Vt
    return R, centre_gt - R @ centre_est


def _ate(est: Array, gt: Array) -> dict[str, float | None]:
    if len(est) < 2:
        return statistics("ate", "m", np.empty(0))
    aligned = align(est[:, :3, 3], gt[:, :3, 3])
    return statistics("ate", "m", np.linalg.norm(aligned - gt[:, :3, 3], axis=1))


def _rpe(est: Array, gt: Array, consecutive: NDArray[np.bool_]) -> dict[str, Any]:
    E = relative_errors(est, gt)[consecutive]
    step_est_m = np.linalg.norm(np.diff(est[:, :3, 3], axis=0), axis=1)[consecutive]
    step_gt_m = np.linalg.norm(np.diff(gt[:, :3, 3], axis=0), axis=1)[consecutive]
    moved = len(E) > 0 and step_gt_m.mean() > 0
    return {
        "rpe_pairs": len(E),
        **statistics("rpe_trans", "m", np.linalg.norm(E[:, :3, 3], axis=1)),
        **statistics("rpe_rot", "deg", rotation_angle_deg(E)),
        "step_length_ratio": float(step_est_m.mean() / step_gt_m.mean()) if moved else None,
    }


def _kitti(
    est: Array, gt_rows: NDArray, gt: Array, known: NDArray[np.bool_]
) -> dict[str, float | None]:
    """Mean translation and rotation error over segments of 100, 200, ... 800 m of the true path.

    A segment ends at the first frame beyond its length and counts where both its ends are tracked
    (on a fully tracked sequence, the development kit's own numbers).
    """
    frames = np.flatnonzero(known)
    path = gt[frames]
    steps_m = np.linalg.norm(np.diff(path[:, :3, 3], axis=0), axis=1)
    distance_m = np.concatenate([[0.0], np.cumsum(steps_m)])[: len(frames)]
    est_row = np.full(len(gt), -1)
    est_row[gt_rows] = np.arange(len(gt_rows))
    starts = np.arange(0, len(frames), KITTI_START_STEP)
    t_errors: list[Array] = []
    r_errors: list[Array] = []
    for length_m in KITTI_LENGTHS_M:
        ends = np.searchsorted(distance_m, distance_m[starts] + length_m, side="right")
        there = ends < len(frames)
        a, b = starts[there], ends[there]
        tracked = (est_row[frames[a]] >= 0) & (est_row[frames[b]] >= 0)
        a, b = a[tracked], b[tracked]
        est_a, est_b = est[est_row[frames[a]]], est[est_row[frames[b]]]
        E = invert_T(invert_T(est_a) @ est_b) @ (invert_T(path[a]) @ path[b])
        t_errors.append(np.linalg.norm(E[:, :3, 3], axis=1) / length_m)
        r_errors.append(rotation_angle_deg(E) / length_m)
    t, r = np.concatenate(t_errors), np.concatenate(r_errors)
    return {
        "kitti_t_rel_percent": float(100.0 * t.mean()) if len(t) else None,
        "kitti_r_rel_deg_per_100m": float(100.0 * r.mean()) if len(r) else None,
    }


def statistics(name: str, unit: str, values: Array) -> dict[str, float | None]:
    """RMSE, mean, median and largest of `values` (N,), as keys; None where there are none."""
    if len(values) == 0:
        return {f"{name}_{kind}_{unit}": None for kind in ("rmse", "mean", "median", "max")}
    return {
        f"{name}_rmse_{unit}": float(np.sqrt(np.mean(values**2))),
        f"{name}_mean_{unit}": float(values.mean()),
        f"{name}_median_{unit}": float(np.median(values)),
        f"{name}_max_{unit}": float(values.max()),
    }


def _between(n: int, rows: NDArray) -> NDArray[np.bool_]:
    """Mask (n,) of the rows from the first to the last of `rows`."""
    mask = np.zeros(n, bool)
    if len(rows):
        mask[rows.min() : rows.max() + 1] = True
    return mask


def _path_length(Ts: Array) -> float:
    return float(np.linalg.norm(np.diff(Ts[:, :3, 3], axis=0), axis=1).sum())
