"""The system frame by frame: accuracy on a golden tiny sequence, losing track, and what it knows.

Bounds are about twice what was measured; lower ones say that a perfect score would be suspicious.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.datasets.sequence import Sequence
from pipelines.dyob_slam import DyObSlam
from pipelines.errors import FrameError
from pipelines.evaluation import evaluate_camera
from pipelines.geometry import invert_T
from pipelines.io.config import load_config
from pipelines.types import (
    Frame,
    FrameResult,
    GroundTruth,
    MotionHypothesis,
    ObjectTruth,
    TrackingStatus,
)

OK, LOST = TrackingStatus.OK, TrackingStatus.LOST
Alter = Callable[[Frame], Frame]


def process(sequence: Sequence, alter: Alter = lambda frame: frame) -> list[FrameResult]:
    slam = DyObSlam(sequence.camera)
    return [slam.process(alter(sequence.read(k))) for k in range(len(sequence))]


def errors(sequence: Sequence, results: Iterable[FrameResult]) -> dict[str, Any]:
    """Camera metrics of the measured frames, as the evaluator defines them."""
    tracked = [r for r in results if r.status is OK]
    stamps = np.array([r.timestamp_s for r in tracked])
    Ts = np.array([r.T_world_camera for r in tracked])
    truth = sequence.ground_truth()
    return evaluate_camera(stamps, Ts, truth.timestamps_s, truth.Ts_world_camera)


def statuses(results: Iterable[FrameResult]) -> list[TrackingStatus]:
    return [r.status for r in results]


def without_flow(frame: Frame) -> Frame:
    return dataclasses.replace(frame, flow_prev_to_curr_px=None)


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


@pytest.fixture(scope="module")
def golden(street: Sequence) -> list[FrameResult]:
    """The results of the exact street; not to be changed by tests."""
    return process(street)


# ------------------------------------------------------------------ accuracy


def test_exact_street_is_tracked_to_fractions_of_a_millimetre(street, golden) -> None:
    assert statuses(golden) == [OK] * len(street)
    found = errors(street, golden)
    assert found["frames_matched"] == len(street)
    assert 1e-5 < found["rpe_trans_rmse_m"] < 1.5e-3
    assert 1e-5 < found["rpe_rot_rmse_deg"] < 4e-3
    assert 1e-5 < found["ate_rmse_m"] < 2e-3
    assert 0.999 < found["step_length_ratio"] < 1.001


def test_degraded_street_is_tracked_to_a_centimetre(render_cache) -> None:
    worn = open_sequence(
        "simulated:street", frames=20, scale=0.4, degrade="all", cache=render_cache
    )
    results = process(worn)
    assert statuses(results) == [OK] * len(worn)
    found = errors(worn, results)
    assert 5e-4 < found["rpe_trans_rmse_m"] < 0.015
    assert 1e-3 < found["rpe_rot_rmse_deg"] < 0.03
    assert 1e-3 < found["ate_rmse_m"] < 0.05


def test_stereo_images_alone_give_depth_scale_and_trajectory(stereo_street) -> None:
    results = process(stereo_street)
    assert statuses(results) == [OK] * len(stereo_street)
    found = errors(stereo_street, results)
    assert 1e-4 < found["rpe_trans_rmse_m"] < 0.013
    assert 1e-4 < found["rpe_rot_rmse_deg"] < 0.04
    assert 0.985 < found["step_length_ratio"] < 1.015


def test_flow_is_optional(street) -> None:
    results = process(street, without_flow)
    assert statuses(results) == [OK] * len(street)
    found = errors(street, results)
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


# ------------------------------------------------------------- losing track


def test_black_frames_are_lost_and_tracking_goes_on(street) -> None:
    results = process(street, black_between(8, 11))
    assert statuses(results) == [OK] * 8 + [LOST] * 3 + [OK] * 9
    for result in results[8:11]:
        assert result.hypothesis is MotionHypothesis.NONE
        assert np.isnan(result.pose_covariance).all()
        assert not result.inliers.any()
        assert not result.is_keyframe
    found = errors(street, results)
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
    found = errors(street, results)
    assert found["rpe_trans_rmse_m"] < 0.02
    assert found["ate_rmse_m"] < 0.5  # the camera drove 7 m in the dark


def test_a_black_beginning_postpones_the_start(street) -> None:
    results = process(street, black_between(0, 3))
    assert statuses(results) == [LOST] * 3 + [OK] * 17
    assert results[3].hypothesis is MotionHypothesis.FIRST_FRAME
    np.testing.assert_array_equal(results[3].T_world_camera, np.eye(4))
    assert 1e-4 < errors(street, results)["rpe_trans_rmse_m"] < 0.045


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
    found = errors(street, results)
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
    assert 1e-5 < errors(street, results)["rpe_trans_rmse_m"] < 3e-3
    assert all(np.isfinite(r.T_world_camera).all() for r in results)


@pytest.mark.parametrize("value", [np.nan, 0.0, -1.0, np.inf])
def test_scattered_useless_depths_cost_little(street, value: float) -> None:
    def spoil(depth: np.ndarray) -> None:
        depth[np.random.default_rng(0).random(depth.shape) < 0.3] = value

    results = process(street, depth_changed(spoil))
    assert statuses(results) == [OK] * len(street)
    found = errors(street, results)
    assert 1e-5 < found["rpe_trans_rmse_m"] < 3e-3
    assert all(np.isfinite(r.T_world_camera).all() for r in results)


def test_nan_depth_throughout_is_lost_throughout(street) -> None:
    slam = DyObSlam(street.camera)
    blind = depth_changed(lambda depth: depth.fill(np.nan))
    results = [slam.process(blind(street.read(k))) for k in range(8)]
    assert statuses(results) == [LOST] * 8
    assert len(slam.static_map()) == 0


# -------------------------------------------------------------------- truth


def test_frames_have_no_room_for_truth() -> None:
    assert {field.name for field in dataclasses.fields(Frame)} == {
        "index",
        "timestamp_s",
        "image",
        "image_right",
        "depth_m",
        "flow_prev_to_curr_px",
        "instance_labels",
        "instance_classes",
    }


def test_nothing_in_the_system_leads_to_truth_or_to_a_sequence(street) -> None:
    slam = DyObSlam(street.camera)
    for k in range(3):
        slam.process(street.read(k))
    seen: dict[int, Any] = {}
    _collect(slam, seen)
    kinds = {type(item).__name__ for item in seen.values()}
    assert {"DyObSlam", "SparseMap", "StereoCamera", "Config"} <= kinds  # the walk went somewhere
    forbidden = (GroundTruth, ObjectTruth, Sequence)
    assert not [item for item in seen.values() if isinstance(item, forbidden)]


def _collect(item: Any, seen: dict[int, Any]) -> None:
    """All objects reachable from `item` by attributes, slots and containers; not array contents."""
    if id(item) in seen or isinstance(item, type | str | bytes | int | float):
        return
    seen[id(item)] = item
    inner: list[Any] = []
    if isinstance(item, dict):
        inner += [*item.keys(), *item.values()]
    elif isinstance(item, list | tuple | set | frozenset):
        inner += list(item)
    inner += list(getattr(item, "__dict__", {}).values())
    for kind in type(item).__mro__:
        slots = kind.__dict__.get("__slots__", ())
        names = [slots] if isinstance(slots, str) else slots
        inner += [getattr(item, name) for name in names if hasattr(item, name)]
    if getattr(item, "__self__", None) is not None and not isinstance(item.__self__, type):
        inner.append(item.__self__)  # of bound methods
    if getattr(item, "__closure__", None):
        inner += [cell.cell_contents for cell in item.__closure__]
    for child in inner:
        if type(child).__name__ != "module":
            _collect(child, seen)


def test_an_image_of_another_size_than_the_cameras_is_refused(street) -> None:
    frame = street.read(0)
    half = Frame(0, 0.0, frame.image[::2, ::2].copy())
    height, width = half.image.shape[:2]
    with pytest.raises(FrameError, match=f"found {width} x {height}"):
        DyObSlam(street.camera).process(half)
