"""The system frame by frame: accuracy on a golden tiny sequence, and what a result tells.

Bounds are about twice what was measured; lower ones say that a perfect score would be suspicious.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.datasets.sequence import Sequence
from pipelines.dyob_slam import DyObSlam
from pipelines.errors import FrameError
from pipelines.paged_arrays import PagedArrays
from pipelines.types import (
    Frame,
    FrameResult,
    MotionHypothesis,
    TrackingStatus,
)
from tests.pipelines.processing import camera_errors, process, statuses, without_flow

OK, LOST = TrackingStatus.OK, TrackingStatus.LOST


@pytest.fixture(scope="module")
def golden(street: Sequence) -> list[FrameResult]:
    """The results of the exact street; not to be changed by tests."""
    return process(street)


# ------------------------------------------------------------------ accuracy


def test_exact_street_is_tracked_to_fractions_of_a_millimetre(street, golden) -> None:
    assert statuses(golden) == [OK] * len(street)
    found = camera_errors(street, golden)
    assert found["frames_matched"] == len(street)
    assert 1e-5 < found["rpe_trans_rmse_m"] < 1.5e-3
    assert 1e-5 < found["rpe_rot_rmse_deg"] < 4e-3
    assert 1e-5 < found["ate_rmse_m"] < 2e-3
    assert 0.999 < found["step_length_ratio"] < 1.001


def test_a_map_on_the_disk_is_the_same_map(street, golden, tmp_path) -> None:
    slam = DyObSlam(street.camera, arrays=PagedArrays(tmp_path))
    for k, before in enumerate(golden):
        result = slam.process(street.read(k))
        slam.arrays.let_go()
        np.testing.assert_array_equal(result.T_world_camera, before.T_world_camera)
        np.testing.assert_array_equal(result.keypoints_px, before.keypoints_px)
        np.testing.assert_array_equal(result.objects.centers_m, before.objects.centers_m)
    slam.close()


def test_degraded_street_is_tracked_to_a_centimetre(render_cache) -> None:
    worn = open_sequence(
        "simulated:street", frames=20, scale=0.4, degrade="all", cache=render_cache
    )
    results = process(worn)
    assert statuses(results) == [OK] * len(worn)
    found = camera_errors(worn, results)
    assert 5e-4 < found["rpe_trans_rmse_m"] < 0.015
    assert 1e-3 < found["rpe_rot_rmse_deg"] < 0.03
    assert 1e-3 < found["ate_rmse_m"] < 0.05


def test_stereo_images_alone_give_depth_scale_and_trajectory(stereo_street) -> None:
    results = process(stereo_street)
    assert statuses(results) == [OK] * len(stereo_street)
    found = camera_errors(stereo_street, results)
    assert 1e-4 < found["rpe_trans_rmse_m"] < 0.013
    assert 1e-4 < found["rpe_rot_rmse_deg"] < 0.04
    assert 0.985 < found["step_length_ratio"] < 1.015


def test_flow_is_optional(street) -> None:
    results = process(street, without_flow)
    assert statuses(results) == [OK] * len(street)
    found = camera_errors(street, results)
    assert 1e-4 < found["rpe_trans_rmse_m"] < 0.02
    assert 1e-4 < found["ate_rmse_m"] < 0.08


def test_grey_images_serve_as_well_as_colour(street, golden) -> None:
    import cv2

    def grey(frame: Frame) -> Frame:
        return dataclasses.replace(frame, image=cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY))

    results = process(street, grey)
    for one, other in zip(results, golden, strict=True):
        np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)


def test_the_world_is_the_first_camera(golden) -> None:
    first = golden[0]
    np.testing.assert_array_equal(first.T_world_camera, np.eye(4))
    assert first.hypothesis is MotionHypothesis.FIRST_FRAME
    assert first.is_keyframe


# ------------------------------------------------------------------- results


def test_results_name_their_frame(street, golden) -> None:
    assert [r.frame_index for r in golden] == list(range(len(street)))
    np.testing.assert_array_equal([r.timestamp_s for r in golden], street.timestamps_s)


def test_measured_points_lie_on_static_pixels(street, golden) -> None:
    n_masked = 0
    for result in golden[1:]:
        labels = street.read(result.frame_index).instance_labels
        n_masked += (labels > 0).sum()
        x, y = np.rint(result.keypoints_px).astype(int).T
        assert (labels[y, x] == 0).all(), f"frame {result.frame_index} has points on objects"
        assert len(result.keypoints_px) > 100
    assert n_masked > 0  # else the sequence shows no object to keep off


def test_inliers_observe_map_points(golden) -> None:
    for result in golden[1:]:
        assert result.inliers.sum() > 0.5 * len(result.inliers) > 50
        assert (result.point_ids[result.inliers] >= 0).all()
        assert 0 < result.reprojection_rmse_px < 1


def test_covariance_is_one_of_a_small_error(golden) -> None:
    for result in golden[1:]:
        np.testing.assert_allclose(result.pose_covariance, result.pose_covariance.T, atol=1e-15)
        sigmas = np.sqrt(np.linalg.eigvalsh(result.pose_covariance))
        assert 0 < sigmas[0] <= sigmas[-1] < 0.01


def test_timings_name_the_stages(golden) -> None:
    for result in golden[1:]:
        assert {"total", "depth", "features", "track", "pose", "mapping"} <= set(result.timings_ms)
        assert all(spent >= 0 for spent in result.timings_ms.values())


def test_static_map_lies_where_the_street_is(street) -> None:
    slam = DyObSlam(street.camera)
    for k in range(6):
        slam.process(street.read(k))
    static_map = slam.static_map()
    assert len(static_map) > 100
    assert static_map.keyframe_indices[0] == 0
    # Seen from the true first camera, points agree with its exact depth where they are in view.
    x, y, z = static_map.points_m.T
    camera, depth = street.camera, street.read(0).depth_m
    u, v = np.rint(camera.fx * x / z + camera.cx), np.rint(camera.fy * y / z + camera.cy)
    inside = (z > 1) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    seen = depth[v[inside].astype(int), u[inside].astype(int)]
    error = np.abs(z[inside] - seen) / seen
    assert inside.sum() > 100
    assert np.nanmedian(error) < 0.01


def test_processing_changes_no_input(street) -> None:
    slam = DyObSlam(street.camera)
    for k in range(3):
        frame, same = street.read(k), street.read(k)
        slam.process(frame)
        for field in dataclasses.fields(Frame):
            np.testing.assert_array_equal(getattr(frame, field.name), getattr(same, field.name))


def test_two_systems_agree_to_the_last_bit(street, golden) -> None:
    for one, other in zip(process(street), golden, strict=True):
        np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)
        np.testing.assert_array_equal(one.keypoints_px, other.keypoints_px)
        np.testing.assert_array_equal(one.point_ids, other.point_ids)
        assert one.hypothesis is other.hypothesis


def test_an_image_of_another_size_than_the_cameras_is_refused(street) -> None:
    frame = street.read(0)
    half = Frame(0, 0.0, frame.image[::2, ::2].copy())
    height, width = half.image.shape[:2]
    with pytest.raises(FrameError, match=f"found {width} x {height}"):
        DyObSlam(street.camera).process(half)
