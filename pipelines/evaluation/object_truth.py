"""What the true objects did between two processed frames, and which of them are to be judged.

Owns the truth's side of every figure on objects. Knows no estimate.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.evaluation.object_matching import box_areas_px
from pipelines.geometry import rotation_angle_deg
from pipelines.types import Array, ObjectTruth

KMH = 3.6  # km/h in 1 m/s


@dataclass(frozen=True, slots=True)
class ObjectLimits:
    """What counts in the evaluation of objects."""

    min_overlap: float = 0.3  # of boxes that show the same object
    min_pixels: int = 150  # seen of an object; of its box where the truth has no masks
    max_distance_m: float = 25.0  # from the camera to the object's origin
    still_kmh: float = 0.5  # slower truth stands still, unless it turns
    still_dps: float = 20.0  # deg/s, slower turning may be the labels' noise
    moving_kmh: float = 3.0  # faster truth should be found moving (coverage)


@dataclass(frozen=True, slots=True)
class RunFrames:
    """The processed frames in order, N of them.

    index: (N,) int64. timestamp_s: (N,). Ts_world_camera: (N, 4, 4), true, in the world of the
    estimate; NaN where unknown.
    """

    index: NDArray[np.int64]
    timestamp_s: Array
    Ts_world_camera: Array


@dataclass(frozen=True, slots=True)
class TrueSteps:
    """What there is to know of each truth row (M of them) beside its pose.

    previous_row: (M,) int64, the object's row in the processed frame before, -1 where none.
    speed_kmh: (M,) of its origin since then, NaN where unknown. distance_m: (M,) from the camera.
    is_judged: (M,) seen well enough to match with. is_moving, is_still: (M,) bool, neither where
    the step is not known. is_wanted: (M,) near, seen and fast enough that it should be found
    moving.
    """

    previous_row: NDArray[np.int64]
    speed_kmh: Array
    distance_m: Array
    is_judged: NDArray[np.bool_]
    is_moving: NDArray[np.bool_]
    is_still: NDArray[np.bool_]
    is_wanted: NDArray[np.bool_]


def true_steps(truth: ObjectTruth, frames: RunFrames, limits: ObjectLimits) -> TrueSteps:
    """Steps over the spans that the estimator saw: from one processed frame to the next.

    So frames that a run left out lengthen the step, as they do for the estimate. An object that
    never moves in the sequence is still, whatever its labels' noise says.
    """
    place = {int(index): n for n, index in enumerate(frames.index)}
    at = np.array([place.get(int(k), -1) for k in truth.frame_index], np.int64)
    row_of = {
        (int(n), int(j)): row
        for row, (n, j) in enumerate(zip(at, truth.object_id, strict=True))
        if n >= 0
    }
    keys = zip(at.tolist(), truth.object_id.tolist(), strict=True)
    previous = np.array([row_of.get((n - 1, j), -1) if n > 0 else -1 for n, j in keys], np.int64)
    position = truth.Ts_world_object[:, :3, 3]
    known = (previous >= 0) & np.isfinite(position).all(1)
    dt_s = np.full(len(truth), np.nan)
    dt_s[known] = frames.timestamp_s[at[known]] - frames.timestamp_s[at[known] - 1]
    speed_kmh = KMH * np.linalg.norm(position - position[previous], axis=1) / dt_s
    distance_m = np.full(len(truth), np.nan)
    run = at >= 0
    camera_m = frames.Ts_world_camera[at[run], :3, 3]
    distance_m[run] = np.linalg.norm(position[run] - camera_m, axis=1)
    size = box_areas_px(truth.boxes_px) if truth.n_pixels is None else truth.n_pixels
    is_judged = np.isfinite(truth.boxes_px).all(1) & (size >= limits.min_pixels)
    turn_deg = np.zeros(len(truth))
    Rs = truth.Ts_world_object[:, :3, :3]
    turn_deg[known] = rotation_angle_deg(np.swapaxes(Rs[previous[known]], 1, 2) @ Rs[known])
    turns = turn_deg / dt_s >= limits.still_dps
    is_moving = truth.moving & ((speed_kmh >= limits.still_kmh) | turns)
    is_near = is_judged & (distance_m < limits.max_distance_m)
    return TrueSteps(
        previous,
        speed_kmh,
        distance_m,
        is_judged,
        is_moving,
        np.isfinite(speed_kmh) & ~is_moving,
        is_near & is_moving & (speed_kmh > limits.moving_kmh),
    )
