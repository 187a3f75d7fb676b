"""What stands still serves the camera as a landmark where others are few, until it drives off.

Owns no scene: a painted board before the street stands or slides, see `board_frames`.
"""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.dyob_slam import DyObSlam
from pipelines.io.config import load_config
from pipelines.object_types import ObjectState
from pipelines.types import Frame, FrameResult, TrackingStatus

MOVING, STOPPED = str(ObjectState.MOVING), str(ObjectState.STOPPED)


def run_board(camera, frames: list[Frame], *settings: str) -> tuple[DyObSlam, list[FrameResult]]:
    """Keyframes are frequent, so that the map grows while the board stands."""
    settings = ("mapping.keyframe_max_interval=3", *settings)
    slam = DyObSlam(camera, load_config(None, settings))
    return slam, [slam.process(frame) for frame in frames]


def n_keypoints_on(frame: Frame, result: FrameResult) -> int:
    x, y = np.rint(result.keypoints_px).astype(int).T
    return int((frame.instance_labels[y, x] > 0).sum())


def n_map_points_at_board(slam: DyObSlam, frames: list[Frame], depth_m: float = 8.0) -> int:
    """Points of the map where the board ever was; nothing else of the street is there."""
    points = slam.map.position_m[slam.map.alive]
    camera = slam.camera
    z = points[:, 2]
    u = np.rint(camera.fx * points[:, 0] / z + camera.cx).astype(int)
    v = np.rint(camera.fy * points[:, 1] / z + camera.cy).astype(int)
    near = (np.abs(z - depth_m) < 0.3) & (u >= 0) & (u < camera.width)
    near &= (v >= 0) & (v < camera.height)
    touched = np.any([frame.instance_labels > 0 for frame in frames], axis=0)
    street = np.abs(frames[0].depth_m - depth_m) < 0.6
    street &= frames[0].instance_labels == 0
    u, v = u[near], v[near]
    return int((touched[v, u] & ~street[v, u]).sum())


def test_a_sliding_board_has_the_speed_that_it_was_given(street, board_frames) -> None:
    frames = board_frames(8, step_px=lambda k: 3)
    _, results = run_board(street.camera, frames)
    true_mps = 3 * 8.0 / street.camera.fx / 0.1
    for result in results[2:]:
        assert result.objects.state.tolist() == [MOVING]
        assert result.objects.speed_mps[0] == pytest.approx(true_mps, rel=0.01)
        H = result.objects.Hs_world_curr_prev[0]
        np.testing.assert_allclose(H[:3, 3], [0.1 * true_mps, 0, 0], atol=0.01)
        np.testing.assert_allclose(H[:3, :3], np.eye(3), atol=2e-3)


def test_what_stands_still_is_no_landmark_while_there_are_others(street, board_frames) -> None:
    frames = board_frames(14)
    slam, results = run_board(street.camera, frames)
    assert results[-1].objects.state.tolist() == [STOPPED]
    assert slam._objects.landmark_ids(frames[-1].timestamp_s) == [1]  # it might serve
    for frame, result in zip(frames, results, strict=True):
        assert n_keypoints_on(frame, result) == 0
    assert n_map_points_at_board(slam, frames) == 0


def test_what_has_stood_still_is_a_landmark_where_others_are_few(street, board_frames) -> None:
    """It fills nearly all of the picture."""
    frames = board_frames(14, size=(130, 380), at=(10, 30))
    slam, results = run_board(street.camera, frames, "objects.still_after_s=0.5")
    assert [r.status for r in results] == [TrackingStatus.OK] * 14
    on_board = [n_keypoints_on(f, r) for f, r in zip(frames, results, strict=True)]
    first = next(k for k, n in enumerate(on_board) if n > 0)
    stood_s = frames[first].timestamp_s - frames[1].timestamp_s
    assert 0.5 <= stood_s < 1.0
    assert min(on_board[first:]) > 500
    assert n_map_points_at_board(slam, frames) > 500


def test_never_scarce_enough_means_never(street, board_frames) -> None:
    frames = board_frames(14, size=(130, 380), at=(10, 30))
    how = ("objects.still_after_s=0.5", "objects.landmarks_below=0")
    slam, results = run_board(street.camera, frames, *how)
    assert sum(n_keypoints_on(f, r) for f, r in zip(frames, results, strict=True)) == 0
    assert n_map_points_at_board(slam, frames) == 0


def test_a_landmark_that_drives_off_takes_its_map_points_with_it(street, board_frames) -> None:
    how = ("objects.still_after_s=0.4", "objects.landmarks_below=1")
    frames = board_frames(13, step_px=lambda k: 3 if k >= 9 else 0)
    slam, before = run_board(street.camera, frames[:9], *how)
    assert before[-1].objects.state.tolist() == [STOPPED]
    assert n_keypoints_on(frames[8], before[-1]) > 40
    assert n_map_points_at_board(slam, frames) > 40
    for frame in frames[9:]:
        result = slam.process(frame)
        assert result.status is TrackingStatus.OK
        assert result.objects.state.tolist() == [MOVING]
        assert n_keypoints_on(frame, result) == 0
        assert n_map_points_at_board(slam, frames) == 0
        assert np.linalg.norm(result.T_world_camera[:3, 3]) < 1e-3
    assert len(slam.static_map()) > 500
