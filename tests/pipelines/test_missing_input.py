"""Frames that are black or have no depth: tracking is lost and found again, or goes on without.

Bounds are about twice what was measured; lower ones say that a perfect score would be suspicious.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pipelines.dyob_slam import DyObSlam
from pipelines.geometry import invert_T
from pipelines.io.config import load_config
from pipelines.types import Frame, MotionHypothesis, TrackingStatus
from tests.pipelines.processing import Alter, camera_errors, process, statuses, without_flow

OK, LOST = TrackingStatus.OK, TrackingStatus.LOST


def black_between(first: int, end: int) -> Alter:
    """Frames first <= k < end black, and no flow at all: it would see through the dark."""

    def alter(frame: Frame) -> Frame:
        frame = without_flow(frame)
        if first <= frame.index < end:
            frame = dataclasses.replace(frame, image=np.zeros_like(frame.image))
        return frame

    return alter


def depth_changed(change: Callable[[np.ndarray], Any]) -> Alter:
    """Every frame's depth passed through `change`, which gets a copy."""

    def alter(frame: Frame) -> Frame:
        depth = frame.depth_m.copy()
        change(depth)
        return dataclasses.replace(frame, depth_m=depth)

    return alter


# ------------------------------------------------------------- losing track


def test_black_frames_are_lost_and_tracking_goes_on(street) -> None:
    results = process(street, black_between(8, 11))
    assert statuses(results) == [OK] * 8 + [LOST] * 3 + [OK] * 9
    for result in results[8:11]:
        assert result.hypothesis is MotionHypothesis.NONE
        assert np.isnan(result.pose_covariance).all()
        assert not result.inliers.any()
        assert not result.is_keyframe
    found = camera_errors(street, results)
    assert 1e-4 < found["ate_rmse_m"] < 0.1
    assert 1e-4 < found["rpe_trans_rmse_m"] < 0.02


def test_lost_poses_are_predicted_along_the_motion(street) -> None:
    results = process(street, black_between(8, 11))
    truth = street.ground_truth().Ts_world_camera
    for k in (8, 9, 10):
        away_m = np.linalg.norm((invert_T(truth[k]) @ results[k].T_world_camera)[:3, 3])
        assert away_m < 0.3, f"frame {k} is predicted {away_m:.2f} m off; a step is 0.9 m"


def test_a_long_blackout_ends_with_a_bounded_error(street) -> None:
    results = process(street, black_between(6, 14))
    assert statuses(results[:6]) == [OK] * 6
    assert statuses(results[6:14]) == [LOST] * 8
    assert statuses(results[15:]) == [OK] * 5  # one frame may pass before it is found again
    found = camera_errors(street, results)
    assert found["rpe_trans_rmse_m"] < 0.02
    assert found["ate_rmse_m"] < 0.5  # the camera drove 7 m in the dark


def test_a_black_beginning_postpones_the_start(street) -> None:
    results = process(street, black_between(0, 3))
    assert statuses(results) == [LOST] * 3 + [OK] * 17
    assert results[3].hypothesis is MotionHypothesis.FIRST_FRAME
    np.testing.assert_array_equal(results[3].T_world_camera, np.eye(4))
    assert 1e-4 < camera_errors(street, results)["rpe_trans_rmse_m"] < 0.045


def test_black_from_start_to_end_is_lost_throughout(street) -> None:
    slam = DyObSlam(street.camera)
    results = [slam.process(black_between(0, 99)(street.read(k))) for k in range(8)]
    assert statuses(results) == [LOST] * 8
    assert len(slam.static_map()) == 0
    for result in results:
        np.testing.assert_array_equal(result.T_world_camera, np.eye(4))


def test_after_a_lost_stretch_a_new_place_is_a_new_start(street, other_place) -> None:
    """Six frames of one street, then of another: the map of the first is of no use there."""
    config = load_config(None, ["tracking.restart_after_frames=2"])
    slam = DyObSlam(street.camera, config)
    results = [slam.process(street.read(k)) for k in range(6)]
    for k in range(6, 12):
        # A wall is passed close by: no texture, no depth.
        black = black_between(k, k + 1)(street.read(k))
        nothing = dataclasses.replace(black, depth_m=np.full_like(black.depth_m, np.nan))
        results.append(slam.process(nothing))
    last_predicted = results[-1].T_world_camera
    for k in range(6):
        there = other_place.read(k)
        later_s = street.timestamps_s[12] + there.timestamp_s
        results.append(slam.process(dataclasses.replace(there, index=12 + k, timestamp_s=later_s)))
    found = statuses(results)
    assert found[:12] == [OK] * 6 + [LOST] * 6
    assert found[12] is LOST
    start = 12 + found[12:].index(OK)
    assert found[start:] == [OK] * (18 - start)
    assert results[start].hypothesis is MotionHypothesis.FIRST_FRAME
    step = invert_T(last_predicted) @ results[start].T_world_camera
    assert np.linalg.norm(step[:3, 3]) < 5.0  # one world: it starts where the motion led
    Ts, truth = (
        np.array([r.T_world_camera for r in results[start:]]),
        other_place.ground_truth().Ts_world_camera[start - 12 :],
    )
    E = invert_T(invert_T(Ts[0]) @ Ts[-1]) @ invert_T(truth[0]) @ truth[-1]
    assert len(Ts) >= 4
    assert np.linalg.norm(E[:3, 3]) < 0.03


# -------------------------------------------------------------------- depth


def test_a_frame_without_depth_is_still_tracked(street) -> None:
    def alter(frame: Frame) -> Frame:
        return dataclasses.replace(frame, depth_m=None) if frame.index == 8 else frame

    results = process(street, alter)
    assert statuses(results) == [OK] * len(street)
    found = camera_errors(street, results)
    assert 1e-5 < found["rpe_trans_rmse_m"] < 3e-3


def test_a_first_frame_without_depth_postpones_the_start(street) -> None:
    def alter(frame: Frame) -> Frame:
        return dataclasses.replace(frame, depth_m=None) if frame.index == 0 else frame

    results = process(street, alter)
    assert statuses(results) == [LOST] + [OK] * (len(street) - 1)
    np.testing.assert_array_equal(results[1].T_world_camera, np.eye(4))


def test_a_frame_of_nan_depth_is_one_without_depth(street) -> None:
    def to_nan(frame: Frame) -> Frame:
        if frame.index != 8:
            return frame
        return dataclasses.replace(frame, depth_m=np.full_like(frame.depth_m, np.nan))

    results = process(street, to_nan)
    assert statuses(results) == [OK] * len(street)
    assert 1e-5 < camera_errors(street, results)["rpe_trans_rmse_m"] < 3e-3
    assert all(np.isfinite(r.T_world_camera).all() for r in results)


@pytest.mark.parametrize("value", [np.nan, 0.0, -1.0, np.inf])
def test_scattered_useless_depths_cost_little(street, value: float) -> None:
    def spoil(depth: np.ndarray) -> None:
        depth[np.random.default_rng(0).random(depth.shape) < 0.3] = value

    results = process(street, depth_changed(spoil))
    assert statuses(results) == [OK] * len(street)
    found = camera_errors(street, results)
    assert 1e-5 < found["rpe_trans_rmse_m"] < 3e-3
    assert all(np.isfinite(r.T_world_camera).all() for r in results)


def test_nan_depth_throughout_is_lost_throughout(street) -> None:
    slam = DyObSlam(street.camera)
    blind = depth_changed(lambda depth: depth.fill(np.nan))
    results = [slam.process(blind(street.read(k))) for k in range(8)]
    assert statuses(results) == [LOST] * 8
    assert len(slam.static_map()) == 0
