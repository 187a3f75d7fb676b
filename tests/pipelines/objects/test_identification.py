"""Detections given lasting ids by points, boxes and gates; and masks of what was missed."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.config import ObjectsConfig
from pipelines.object_types import Detections
from pipelines.objects.following import Followed
from pipelines.objects.frame import LastObjects
from pipelines.objects.identification import carry_missed, identify
from pipelines.objects.instances import describe_instances
from pipelines.objects.points import ObjectPoints
from pipelines.objects.track import ObjectTrack

SHAPE = (120, 400)
LEFT, RIGHT = (slice(40, 80), slice(50, 130)), (slice(30, 90), slice(220, 340))


def instances_at(kitti, *parts, names=None, disparity_px=20.0, image=None):
    labels = np.zeros(SHAPE, np.int32)
    for row, part in enumerate(parts):
        labels[part] = row + 1
    ids = np.arange(1, len(parts) + 1, dtype=np.int32)
    classes = np.array(names or ["car"] * len(parts), "U16")
    seen = Detections(labels, ids, classes, np.full(len(parts), 0.9))
    if image is None:
        image = np.full((*SHAPE, 3), 128, np.uint8)
    return describe_instances(kitti, image, np.full(SHAPE, disparity_px, np.float32), seen)


def points_in(object_id, part, n=30, shift=(0.0, 0.0), seed=0):
    """Points that lay in a part of the last image and are followed by a shift."""
    rows, columns = part
    rng = np.random.default_rng(seed)
    uv = rng.uniform([columns.start, rows.start], [columns.stop - 1, rows.stop - 1], (n, 2))
    points = ObjectPoints(
        np.full(n, object_id), np.ones((n, 3)), np.zeros((n, 3, 3)), uv, np.arange(n)
    )
    now = uv + shift
    return points, Followed(now, np.ones(n, bool), np.full(n, 0.3), now, now, np.zeros(n))


def track_at(object_id, part=None, center_m=None, **changes):
    track = ObjectTrack(object_id, ObjectsConfig())
    track.take_detection("car", 0.9, np.full(64, 1 / 64))
    if part is not None:
        rows, columns = part
        track.box_px = np.array([columns.start, rows.start, columns.stop - 1, rows.stop - 1], float)
        track.area_px = (rows.stop - rows.start) * (columns.stop - columns.start)
    if center_m is not None:
        track.take_center(np.asarray(center_m))
    for name, value in changes.items():
        setattr(track, name, value)
    return track


NO_POINTS = ObjectPoints.empty(), Followed.empty()


def test_points_say_who_is_who_whatever_the_order(kitti):
    tracks = {7: track_at(7, LEFT), 3: track_at(3, RIGHT)}
    (a, fa), (b, fb) = points_in(3, RIGHT), points_in(7, LEFT)
    points, followed = ObjectPoints.concatenate(a, b), Followed.concatenate(fa, fb)
    for parts, expected in (((LEFT, RIGHT), {7: 0, 3: 1}), ((RIGHT, LEFT), {7: 1, 3: 0})):
        found = identify(tracks, instances_at(kitti, *parts), points, followed, np.eye(4))
        assert found == expected


def test_an_object_is_found_again_by_its_filter_in_the_world(kitti):
    """The camera went 2 m on; the object is where the filter has it, in the world's axes."""
    seen = instances_at(kitti, LEFT, RIGHT)
    seen.colors[:] = 1 / 64
    T = np.eye(4)
    T[2, 3] = 2.0
    for row in range(2):
        center = seen.centers_m[row] + [0, 0, 2.0]
        tracks = {5: track_at(5, center_m=center + np.array([0.4, 0.0, 0.3]))}
        assert identify(tracks, seen, *NO_POINTS, T) == {5: row}
    nearby = {5: track_at(5, center_m=seen.centers_m[0] + [0, 12.0, 2.0])}
    assert identify(nearby, seen, *NO_POINTS, T) == {}


def test_a_person_is_not_found_again_as_a_car_nor_a_blue_car_as_a_red_one(kitti):
    seen = instances_at(kitti, LEFT, names=["person"])
    seen.colors[:] = 1 / 64
    track = track_at(5, center_m=seen.centers_m[0])
    assert identify({5: track}, seen, *NO_POINTS, np.eye(4)) == {}
    seen = instances_at(kitti, LEFT)
    seen.colors[:] = np.eye(64)[0]
    track.color = np.eye(64)[63]
    assert identify({5: track}, seen, *NO_POINTS, np.eye(4)) == {}


def test_a_box_speaks_for_an_object_without_points_while_it_is_fresh(kitti):
    seen = instances_at(kitti, RIGHT, disparity_px=np.nan)
    shifted = (RIGHT[0], slice(RIGHT[1].start + 20, RIGHT[1].stop + 20))
    assert identify({5: track_at(5, shifted)}, seen, *NO_POINTS, np.eye(4)) == {5: 0}
    old = track_at(5, shifted, missed_s=2.0)
    assert identify({5: old}, seen, *NO_POINTS, np.eye(4)) == {}


def test_points_of_unknown_objects_and_lost_points_do_not_count(kitti):
    seen = instances_at(kitti, LEFT, disparity_px=np.nan)
    points, followed = points_in(3, LEFT)
    lost = replace(followed, uv_px=followed.uv_px * np.nan, valid=~followed.valid)
    assert identify({3: track_at(3, area_px=99)}, seen, points, lost, np.eye(4)) == {}
    assert identify({8: track_at(8, area_px=99)}, seen, points, followed, np.eye(4)) == {}


def test_no_tracks_or_no_instances(kitti):
    points, followed = points_in(3, LEFT)
    assert identify({}, instances_at(kitti, LEFT), points, followed, np.eye(4)) == {}
    assert identify({3: track_at(3)}, instances_at(kitti), points, followed, np.eye(4)) == {}


# -------------------------------------------------------------------- carrying


def last_of(object_id, part, points):
    labels = np.zeros(SHAPE, np.int32)
    labels[part] = object_id
    return LastObjects(None, np.eye(4), True, labels, {object_id: part}, points)


def carry(shift=(6.0, -3.0), n=30, missed_s=0.0, taken=None):
    points, followed = points_in(3, LEFT, n, shift)
    labels = np.zeros(SHAPE, np.int32)
    if taken is not None:
        labels[taken] = 9
    track = track_at(3, LEFT, missed_s=missed_s)
    window = carry_missed(ObjectsConfig(), track, last_of(3, LEFT, points), followed, labels)
    return window, labels


def test_a_missed_object_keeps_its_mask_where_its_points_went():
    window, labels = carry()
    assert window == (slice(37, 77), slice(56, 136))
    assert (labels[window] == 3).all() and (labels == 3).sum() == 40 * 80


def test_what_others_hold_is_not_painted_over_and_the_window_fits_the_rest():
    window, labels = carry(taken=(slice(0, SHAPE[0]), slice(100, 200)))
    assert (labels[:, 100:200] == 9).all()
    assert window == (slice(37, 77), slice(56, 100))
    window, labels = carry(taken=(slice(0, SHAPE[0]), slice(60, 200)))
    assert window is None and not (labels == 3).any()  # hidden nearly whole


@pytest.mark.parametrize("changes", [{"n": 5}, {"missed_s": 0.6}, {"shift": (-300.0, 0.0)}])
def test_what_cannot_be_carried(changes):
    window, labels = carry(**changes)
    assert window is None and not labels.any()


def test_an_object_that_was_not_in_sight_has_no_mask_to_carry():
    points, followed = points_in(3, LEFT)
    labels = np.zeros(SHAPE, np.int32)
    last = last_of(8, LEFT, points)
    assert carry_missed(ObjectsConfig(), track_at(3), last, followed, labels) is None
