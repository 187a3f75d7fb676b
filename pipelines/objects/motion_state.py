"""Whether an object moves: the rule in m/s with its uncertainty, and the paper's in m a frame.

Owns the decision and its hysteresis; step 5. Estimates no motion.
"""

from __future__ import annotations

import numpy as np

from pipelines.config import ObjectsConfig
from pipelines.object_types import ObjectState
from pipelines.types import Array

_SLOWED = 0.5  # of the least speed: an object that moved is still when slower than this
_STILL_SIGMAS = 2.0  # standard deviations by which a speed must be below the limit to be none


def decide_by_speed(
    config: ObjectsConfig, before: ObjectState, speed_mps: float, std_mps: float
) -> ObjectState:
    """State by speed and its standard deviation, in m/s.

    Moving: above the least speed by `significance` standard deviations. Stopped: surely below it.
    Between them what was known before stays, if the speed does not contradict it: a moving object
    stays so down to half of the least speed, by one standard deviation, and a stopped one until it
    surely moves.
    Deviation: the paper's threshold is in m a frame, whatever the frame rate and the distance.
    """
    low, sigma = config.min_speed_mps, std_mps
    if speed_mps - config.significance * sigma > low:
        return ObjectState.MOVING
    if before is ObjectState.MOVING and speed_mps - sigma > _SLOWED * low:
        return ObjectState.MOVING
    if speed_mps + _STILL_SIGMAS * sigma < low:
        return ObjectState.STOPPED
    if before is ObjectState.STOPPED:
        return ObjectState.STOPPED
    return ObjectState.UNKNOWN


def decide_by_scene_flow(config: ObjectsConfig, scene_flow_m: Array) -> ObjectState:
    """State by the scene flow vectors (N, 3) of an object's points, in m since the last frame.

    Still if more than `scene_flow_share` of the points have less than `scene_flow_m` (paper,
    section Object Motion Tracking; the share is VDO-SLAM's).
    """
    if len(scene_flow_m) == 0:
        return ObjectState.UNKNOWN
    still = np.linalg.norm(scene_flow_m, axis=1) < config.scene_flow_m
    return ObjectState.STOPPED if still.mean() > config.scene_flow_share else ObjectState.MOVING
