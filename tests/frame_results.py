"""Results of frames in which nothing was seen, for tests of what is written and drawn of a run."""

from __future__ import annotations

from typing import Any

import numpy as np

from pipelines.types import FrameResult, MotionHypothesis, TrackingStatus


def frame_result(k: int, T_world_camera: np.ndarray, **changes: Any) -> FrameResult:
    """Frame `k` of ten a second, tracked, without points and objects; `changes` are its fields."""
    fields = {
        "frame_index": k,
        "timestamp_s": 0.1 * k,
        "status": TrackingStatus.OK,
        "T_world_camera": T_world_camera,
        "pose_covariance": np.eye(6),
        "hypothesis": MotionHypothesis.CONSTANT_VELOCITY,
        "is_keyframe": False,
        "keypoints_px": np.empty((0, 2)),
        "point_ids": np.empty(0, np.int64),
        "inliers": np.empty(0, bool),
        "reprojection_rmse_px": 0.0,
    }
    return FrameResult(**(fields | changes))
