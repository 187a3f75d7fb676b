"""Masks and moments that no object tracker likes: each gives an answer that says what is known.

Files that are damaged are in `test_bad_masks`; here are frames as a program may hand them in.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from pipelines.datasets.sequence import Sequence
from pipelines.dyob_slam import DyObSlam
from pipelines.object_types import ObjectEstimates, ObjectState
from pipelines.types import Frame, FrameResult, TrackingStatus
from tests.pipelines.processing import Alter, process, rows_of, statuses

OK, LOST = TrackingStatus.OK, TrackingStatus.LOST
N_FRAMES = 10
FASTEST_MPS = 20.0  # of all that moves in the street


def process_some(street: Sequence, alter: Alter = lambda frame: frame) -> list[FrameResult]:
    return process(street, alter, frames=range(N_FRAMES))


def masked(labels: np.ndarray, frame: Frame) -> Frame:
    """The frame with other masks, all of cars."""
    classes = {int(i): "car" for i in np.unique(labels) if i > 0}
    labels = labels.astype(np.int32)
    return dataclasses.replace(frame, instance_labels=labels, instance_classes=classes)


def shape_of(frame: Frame) -> tuple[int, int]:
    return frame.image.shape[:2]


def n_motions(results: list[FrameResult]) -> list[int]:
    """Objects with an H, frame by frame."""
    return [int(np.isfinite(r.objects.Hs_world_curr_prev).all((1, 2)).sum()) for r in results]


def assert_sane(results: list[FrameResult]) -> None:
    """Poses are numbers, and no object is told to be faster than anything there is."""
    for result in results:
        assert np.isfinite(result.T_world_camera).all()
    objects = rows_of(results)
    for speeds in (objects.speed_mps, objects.smoothed_speed_mps):
        assert (speeds[np.isfinite(speeds)] < FASTEST_MPS).all()
    for values in (objects.speed_std_mps, objects.velocity_std_mps):
        assert (values[np.isfinite(values)] >= 0).all()
    known = np.isfinite(objects.Hs_world_curr_prev).all((1, 2))
    np.testing.assert_array_equal(known, np.isfinite(objects.speed_mps))


def assert_unknown(objects: ObjectEstimates) -> None:
    """Seen, but nothing said of a motion."""
    assert set(objects.state) == {str(ObjectState.UNKNOWN)}
    assert np.isnan(objects.Hs_world_curr_prev).all()
    assert np.isnan(objects.speed_mps).all()
    assert np.isnan(objects.smoothed_speed_mps).all()


@pytest.fixture(scope="module")
def exact(street: Sequence) -> list[FrameResult]:
    return process_some(street)


# ------------------------------------------------------------ none, or nothing but


def test_masks_that_are_all_empty_are_a_street_without_objects(street) -> None:
    results = process_some(street, lambda frame: masked(np.zeros(shape_of(frame)), frame))
    assert statuses(results) == [OK] * N_FRAMES
    assert len(rows_of(results)) == 0
    assert all(r.object_labels is None for r in results)
    assert_sane(results)


@pytest.mark.parametrize("n_objects", [1, 2])
def test_a_picture_full_of_objects_is_lost_but_no_crash(street, n_objects: int) -> None:
    def full(frame: Frame) -> Frame:
        labels = np.ones(shape_of(frame))
        labels[:, labels.shape[1] // n_objects :] = 2
        return masked(labels, frame)

    results = process_some(street, full)
    assert statuses(results) == [LOST] * N_FRAMES
    assert [r.objects.object_id.tolist() for r in results] == [[*range(1, n_objects + 1)]] * 10
    assert_unknown(rows_of(results))
    assert_sane(results)


def test_a_mask_over_the_whole_picture_costs_its_frames_alone(street) -> None:
    def full(frame: Frame) -> Frame:
        return masked(np.ones(shape_of(frame)), frame) if 4 <= frame.index < 6 else frame

    results = process_some(street, full)
    assert statuses(results) == [OK] * 4 + [LOST] * 2 + [OK] * 4
    assert n_motions(results)[4:7] == [0, 0, 0]
    assert min(n_motions(results)[8:]) > 2
    assert_sane(results)
    truth = street.ground_truth().Ts_world_camera[N_FRAMES - 1]
    assert np.linalg.norm((results[-1].T_world_camera - truth)[:3, 3]) < 0.3


# ---------------------------------------------------------------- odd objects


def test_an_object_of_three_pixels_is_unknown(street) -> None:
    def speck(frame: Frame) -> Frame:
        labels = np.zeros(shape_of(frame))
        labels[70, 200:203] = 1
        return masked(labels, frame)

    results = process_some(street, speck)
    assert statuses(results) == [OK] * N_FRAMES
    assert [len(r.objects) for r in results] == [1] * N_FRAMES
    assert_unknown(rows_of(results))
    np.testing.assert_array_equal(rows_of(results).boxes_px, [[200, 70, 202, 70]] * N_FRAMES)


@pytest.mark.parametrize("depth_m", [np.nan, 0.0, -1.0, np.inf])
def test_an_object_without_depth_is_unknown(street, board_frames, depth_m: float) -> None:
    """A board that moves, and does so visibly: but how far it is nobody knows."""
    slam = DyObSlam(street.camera)
    frames = board_frames(8, step_px=lambda k: 3, depth_m=depth_m)
    results = [slam.process(frame) for frame in frames]
    assert statuses(results) == [OK] * 8
    objects = rows_of(results)
    assert objects.object_id.tolist() == [1] * 8
    assert_unknown(objects)
    assert np.isnan(objects.centers_m).all()
    assert_sane(results)


def test_depth_that_fails_on_an_object_for_some_frames(street, board_frames) -> None:
    frames = board_frames(12, step_px=lambda k: 3)
    for k in (5, 6):
        depth = np.where(frames[k].instance_labels > 0, np.float32(np.nan), frames[k].depth_m)
        frames[k] = dataclasses.replace(frames[k], depth_m=depth)
    slam = DyObSlam(street.camera)
    results = [slam.process(frame) for frame in frames]
    objects = rows_of(results)
    assert objects.object_id.tolist() == [1] * 12
    speed = 3 * 8.0 / street.camera.fx / 0.1
    known = objects.speed_mps[np.isfinite(objects.speed_mps)]
    assert len(known) >= 7
    np.testing.assert_allclose(known, speed, atol=0.1)
    assert_sane(results)


def test_a_hundred_objects_keep_their_ids(street, board_frames) -> None:
    """Before a camera that stands; all but the few with no depth are found to stand still."""
    H, W = street.camera.height, street.camera.width
    labels = np.zeros((H, W))
    for n in range(100):
        row, column = 5 + 14 * (n // 10), 8 + 48 * (n % 10)
        labels[row : row + 9, column : column + 16] = n + 1
    slam = DyObSlam(street.camera)
    results = [slam.process(masked(labels, frame)) for frame in board_frames(5)]
    assert statuses(results) == [OK] * 5
    first = results[0].object_labels
    assert len(np.unique(first[first > 0])) == 100
    for result in results:
        np.testing.assert_array_equal(result.object_labels, first)
        np.testing.assert_array_equal(result.objects.object_id, np.arange(1, 101))
    assert not (rows_of(results).state == str(ObjectState.MOVING)).any()
    assert (results[-1].objects.state == str(ObjectState.STOPPED)).sum() > 15
    assert_sane(results)


def test_labels_may_be_sparse_and_high(street, exact) -> None:
    """Up to 65535, as 16-bit files hold them. The order of labels is kept: ids are, too."""

    def high(frame: Frame) -> Frame:
        labels = frame.instance_labels
        highest = 65535 - 97 * (400 - labels)
        return masked(np.where(labels > 0, highest, 0), frame)

    def all_cars(frame: Frame) -> Frame:
        return masked(frame.instance_labels, frame)

    results = process_some(street, high)
    for one, other in zip(results, process_some(street, all_cars), strict=True):
        np.testing.assert_array_equal(one.objects.object_id, other.objects.object_id)
        np.testing.assert_array_equal(one.objects.speed_mps, other.objects.speed_mps)
        np.testing.assert_array_equal(one.object_labels, other.object_labels)
    assert sum(n_motions(results)) > 30


@pytest.mark.parametrize("shape", [(10, 10), (150, 496), (497, 150)])
def test_masks_of_another_size_than_the_picture_are_refused(street, shape) -> None:
    labels = np.zeros(shape, np.int32)
    with pytest.raises(ValueError, match=r"Frame\.instance_labels: expected shape .*150, 497"):
        dataclasses.replace(street.read(0), instance_labels=labels)


# --------------------------------------------------------------------- time


def test_a_time_stamp_that_repeats_divides_nothing_by_zero(street, exact) -> None:
    def repeated(frame: Frame) -> Frame:
        return dataclasses.replace(frame, timestamp_s=0.4) if frame.index == 5 else frame

    with np.errstate(divide="raise", invalid="raise"):
        results = process_some(street, repeated)
    assert statuses(results) == [OK] * N_FRAMES
    assert n_motions(results)[5] == 0  # no time has passed: no speed
    assert n_motions(results)[4] > 3
    assert min(n_motions(results)[7:]) > 2
    assert_sane(results)
    for k in (5, 9):
        np.testing.assert_array_equal(results[k].objects.object_id, exact[k].objects.object_id)


def test_time_that_stands_still_throughout(street) -> None:
    results = process_some(street, lambda frame: dataclasses.replace(frame, timestamp_s=1.0))
    assert statuses(results) == [OK] * N_FRAMES
    assert n_motions(results) == [0] * N_FRAMES
    assert set(rows_of(results).state) == {str(ObjectState.UNKNOWN)}
    assert_sane(results)


def test_a_frame_that_is_left_out_doubles_the_step(street, board_frames) -> None:
    """As when it could not be read: no flow leads over the gap, so it is computed."""
    frames = board_frames(10, step_px=lambda k: 3)
    slam = DyObSlam(street.camera)
    results = [slam.process(frame) for frame in frames if frame.index != 5]
    assert {tuple(r.objects.object_id) for r in results} == {(1,)}
    speed = 3 * 8.0 / street.camera.fx / 0.1
    (after,) = [r.objects for r in results if r.frame_index == 6]
    assert after.speed_mps[0] == pytest.approx(speed, rel=0.1)
    assert after.Hs_world_curr_prev[0, 0, 3] == pytest.approx(0.2 * speed, rel=0.1)
    assert_sane(results)


# -------------------------------------------------------------- losing track


def dark(frame: Frame) -> Frame:
    """Frames 5 and 6 black; no flow leads into them, nor out of them."""
    if frame.index in (5, 6):
        black = np.zeros_like(frame.image)
        return dataclasses.replace(frame, image=black, flow_prev_to_curr_px=None)
    return dataclasses.replace(frame, flow_prev_to_curr_px=None) if frame.index == 7 else frame


def test_no_motion_is_told_while_the_camera_is_lost_nor_right_after(street) -> None:
    results = process_some(street, dark)
    assert statuses(results) == [OK] * 5 + [LOST] * 2 + [OK] * 3
    motions = n_motions(results)
    assert motions[4] > 3
    assert motions[5:8] == [0, 0, 0]
    assert min(motions[8:]) > 2
    assert_sane(results)


def test_identities_survive_a_lost_camera(street, exact) -> None:
    """By their masks, which this sequence brings in the dark, too."""
    results = process_some(street, dark)
    moving = exact[4].objects
    n_kept = 0
    for object_id in moving.object_id:
        own = exact[4].object_labels == object_id
        if own.sum() < 150:
            continue
        true_label = int(np.bincount(street.read(4).instance_labels[own]).argmax())
        ids = set()
        for k in (4, 5, 6, 7, 8):
            seen = street.read(k).instance_labels == true_label
            if seen.sum() >= 150:
                ids.add(int(np.bincount(results[k].object_labels[seen]).argmax()))
        assert ids == {int(object_id)}
        n_kept += 1
    assert n_kept >= 5
