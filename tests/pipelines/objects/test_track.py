"""One object over time: its pose, its predicted motion, its box and what is remembered of it."""

import numpy as np
import pytest

from pipelines.config import ObjectsConfig
from pipelines.geometry import exp_se3, make_T, rotation_vector, transform_points
from pipelines.object_types import UNNAMED_CLASS, ObjectState
from pipelines.objects.kalman import ObjectFilter
from pipelines.objects.motion import displacement
from pipelines.objects.track import ObjectTrack

DT_S = 0.1
SURE = np.diag([1e-3, 1e-3, 1e-3, 0.01, 0.01, 0.01]) ** 2
CENTER = np.array([4.0, 1.0, 20.0])


def turn_and_go(center, turn_rad, way_m):
    R = exp_se3(np.array([0.0, turn_rad, 0.0, 0, 0, 0]))[:3, :3]
    return make_T(R, center + way_m - R @ center)


def drive(n, turn_rad=0.0, way_m=(0.0, 0.0, 1.0), seen_every=1):
    """A track of n measured motions on a circle or a line, and the true pose after each."""
    track, T, truth = ObjectTrack(1, ObjectsConfig()), make_T(np.eye(3), CENTER), []
    for k in range(n):
        H = turn_and_go(T[:3, 3], turn_rad, T[:3, :3] @ way_m)
        T = H @ T
        if track.filter is not None:
            track.filter.predict(DT_S)
        if k % seen_every == 0:
            track.take_motion(H, SURE, T[:3, 3], DT_S)
        else:
            track.coast(DT_S)
        truth.append(T)
    return track, truth


def test_the_pose_begins_at_the_centre_with_the_worlds_axes():
    """Before its first motion, which has turned it by now."""
    track, truth = drive(1, turn_rad=0.1)
    np.testing.assert_allclose(track.T_world_object, truth[0], atol=1e-12)


def test_the_pose_moves_with_the_matter():
    track, truth = drive(40, turn_rad=0.02)
    np.testing.assert_allclose(track.T_world_object, truth[-1], atol=1e-9)
    R = track.T_world_object[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("turn_rad", [0.0, 0.05])
@pytest.mark.parametrize("measured", [True, False])
def test_the_predicted_motion_leads_to_where_the_object_will_be(turn_rad, measured):
    """From the last motion and, where the last frame measured none, from the filter alone."""
    track, truth = drive(60, turn_rad, seen_every=1)
    if not measured:
        track.H_world_curr_prev = None
    track.filter.predict(DT_S)
    H = track.predicted_motion(DT_S)
    step = turn_and_go(truth[-1][:3, 3], turn_rad, truth[-1][:3, :3] @ [0.0, 0.0, 1.0])
    np.testing.assert_allclose(displacement(H, truth[-1][:3, 3]), step[:3, 3] - truth[-1][:3, 3]
                               + step[:3, :3] @ truth[-1][:3, 3], atol=0.02)  # fmt: skip
    np.testing.assert_allclose(rotation_vector(H), [0.0, turn_rad, 0.0], atol=2e-3)


def test_half_the_time_takes_it_half_the_way():
    track, truth = drive(60)
    track.filter.predict(0.5 * DT_S)
    way = displacement(track.predicted_motion(0.5 * DT_S), truth[-1][:3, 3])
    np.testing.assert_allclose(way, [0, 0, 0.5], atol=0.02)


def test_a_new_object_is_predicted_to_stand():
    track = ObjectTrack(1, ObjectsConfig())
    np.testing.assert_array_equal(track.predicted_motion(DT_S), np.eye(4))
    expected, covariance = track.expected_motion(CENTER, DT_S)
    np.testing.assert_array_equal(expected, np.eye(4))
    np.testing.assert_allclose(np.sqrt(np.diag(covariance)), [0.2] * 3 + [2.0] * 3)


def test_the_expected_motion_may_change_by_what_objects_can_do():
    """In rad and m over the step: rates in rad/s^2 and m/s^2, between the steps' middles."""
    config = ObjectsConfig(acceleration_mps2=3.0, turn_radps2=1.0)
    track, truth = drive(3)
    track.config = config
    expected, covariance = track.expected_motion(truth[-1][:3, 3], 2 * DT_S)
    way = displacement(expected, truth[-1][:3, 3])
    np.testing.assert_allclose(way, [0.0, 0.0, 2.0], atol=1e-9)
    middles_apart_s = 0.5 * (DT_S + 2 * DT_S)
    change = np.repeat([1.0, 3.0], 3) * middles_apart_s * 2 * DT_S
    np.testing.assert_allclose(covariance, 4 * SURE + np.diag(change**2))


def test_the_covariance_of_the_filter_is_that_of_the_origin():
    """A turn that is wrong about a centre 10 m away puts the origin wrong as well."""
    track, _ = drive(2)
    wrong_turn = np.diag([0.0, 0.01**2, 0.0, 0.0, 0.0, 0.0])
    far = track.T_world_object[:3, 3] + [10.0, 0.0, 0.0]
    seen = []
    track.filter.update_motion = lambda *args, **_: seen.append(args)
    track.take_motion(np.eye(4), wrong_turn, far, DT_S)
    velocity_covariance = seen[0][3]
    assert np.sqrt(velocity_covariance[2, 2]) == pytest.approx(0.01 * 10.0 / DT_S, rel=1e-6)
    assert velocity_covariance[0, 0] < 1e-12


def test_coasting_moves_pose_and_box_and_forgets_the_box_in_the_end():
    track, truth = drive(40)
    box = np.random.default_rng(0).uniform(-1, 1, (200, 3)) + truth[-1][:3, 3]
    track.take_points(box)
    middle = track.box_center_m
    for k in range(1, 8):
        track.filter.predict(DT_S)
        track.coast(DT_S)
        assert track.H_world_curr_prev is None
        assert track.T_world_object[2, 3] - truth[-1][2, 3] == pytest.approx(k, abs=0.1)
        if k <= 5:
            # The box stays with the matter, which the last motion takes along
            assert (track.box_center_m - middle)[2] == pytest.approx(k, abs=0.1)
    assert track.box_center_m is None and np.isfinite(track.extent_m).all()


def test_a_centre_alone_moves_the_pose_and_not_the_box():
    track, truth = drive(20, way_m=(0.0, 0.0, 0.0))
    track.take_points(np.random.default_rng(1).uniform(-1, 1, (200, 3)) + truth[-1][:3, 3])
    middle = track.box_center_m
    track.filter.predict(DT_S)
    track.take_center(truth[-1][:3, 3] + [0.5, 0.0, 0.0])
    np.testing.assert_allclose(track.T_world_object, truth[-1], atol=1e-9)  # it knows better
    track.unmeasured_s = 1.0
    track.take_center(truth[-1][:3, 3] + [0.5, 0.0, 0.0])
    assert 0.0 < track.T_world_object[0, 3] - truth[-1][0, 3] < 0.5
    np.testing.assert_allclose(track.box_center_m, middle, atol=1e-9)


def test_the_first_centre_makes_filter_and_pose():
    track = ObjectTrack(1, ObjectsConfig())
    assert track.box_center_m is None and np.isnan(track.velocity_at(CENTER)).all()
    track.coast(DT_S)
    track.take_center(CENTER)
    np.testing.assert_allclose(track.T_world_object, make_T(np.eye(3), CENTER))
    assert isinstance(track.filter, ObjectFilter) and track.center_sigma_m == 1.0


def test_middles_of_masks_leave_no_speed_once_a_motion_is_measured():
    """A parked car behind something: the middle of its mask wanders off before it comes free."""
    track = ObjectTrack(1, ObjectsConfig())
    for k in range(6):
        track.take_center(CENTER + np.array([0.0, 0.0, 1.5]) * k)
        track.filter.predict(DT_S)
    assert np.linalg.norm(track.filter.velocity_mps) > 3.0
    track.take_motion(turn_and_go(CENTER, 0.0, np.zeros(3)), SURE, CENTER, DT_S)
    assert np.linalg.norm(track.filter.velocity_mps) < 0.01
    assert not track.surely_moves
    np.testing.assert_allclose(track.filter.center_m, CENTER, atol=0.01)


def test_the_box_ignores_a_stray_point_and_grows_gradually():
    track, _ = drive(1)
    rng, T = np.random.default_rng(2), track.T_world_object
    corners = rng.uniform(-1, 1, (400, 3)) * [0.9, 0.7, 2.0]
    track.take_points(transform_points(T, np.r_[corners, [[30.0, 0, 0]]]))
    np.testing.assert_allclose(track.extent_m, [1.8, 1.4, 4.0], rtol=0.15)
    before = track.extent_m[2]
    track.take_points(transform_points(T, corners * [1, 1, 2.0]))
    assert before < track.extent_m[2] < 1.75 * before
    for _ in range(20):
        track.take_points(transform_points(T, corners * [1, 1, 2.0]))
    assert track.extent_m[2] == pytest.approx(7.4, rel=0.07)  # its 4th to 96th percentile
    assert track.center_sigma_m == 1.75  # four of it are half of the longest things


def test_velocity_of_a_point_off_the_centre_of_a_turning_object():
    track, truth = drive(80, turn_rad=0.05)
    center, forward = track.filter.center_m, truth[-1][:3, :3] @ [0.0, 0.0, 1.0]
    side = track.velocity_at(center + np.array([1.0, 0, 0])) - track.velocity_at(center)
    np.testing.assert_allclose(side, np.cross([0.0, 0.5, 0.0], [1.0, 0, 0]), atol=0.02)
    speed = track.velocity_at(np.full(3, np.nan))
    assert np.linalg.norm(speed) == pytest.approx(10.0, abs=0.2)
    assert np.dot(speed, forward) > 9.8


def test_the_class_is_the_one_seen_most_and_any_name_beats_none():
    track, gray = ObjectTrack(1, ObjectsConfig()), np.full(64, 1 / 64)
    assert track.class_name == UNNAMED_CLASS
    for _ in range(5):
        track.take_detection(UNNAMED_CLASS, 0.9, gray)
    assert track.class_name == UNNAMED_CLASS
    track.take_detection("van", 0.3, gray)
    assert track.class_name == "van"
    track.take_detection("car", 0.2, gray)
    track.take_detection("car", 0.2, gray)
    assert track.class_name == "car"


def test_colours_and_misses_of_a_detection():
    track = ObjectTrack(1, ObjectsConfig())
    track.missed_s = 0.4
    red, blue = np.eye(64)[3], np.eye(64)[60]
    track.take_detection("car", 0.9, red)
    np.testing.assert_array_equal(track.color, red)
    track.take_detection("car", 0.9, blue)
    assert track.color[3] == pytest.approx(0.8) and track.color.sum() == pytest.approx(1.0)
    assert track.missed_s == 0.0


def test_an_old_box_says_nothing_any_more():
    track = ObjectTrack(1, ObjectsConfig(max_carried_s=0.5))
    track.box_px = np.array([1.0, 2, 3, 4])
    np.testing.assert_array_equal(track.fresh_box_px, track.box_px)
    track.missed_s = 0.6
    assert np.isnan(track.fresh_box_px).all()


def test_what_stands_for_long_enough_is_a_landmark():
    track = ObjectTrack(1, ObjectsConfig(still_after_s=1.0))
    assert not track.is_landmark(100.0)
    track.set_state(ObjectState.STOPPED, 10.0)
    track.set_state(ObjectState.STOPPED, 10.5)
    assert not track.is_landmark(10.9) and track.is_landmark(11.0)
    track.set_state(ObjectState.MOVING, 11.5)
    track.set_state(ObjectState.STOPPED, 12.0)
    assert not track.is_landmark(12.5) and track.is_landmark(13.0)


def test_what_never_moved_stays_where_it_was_and_what_moved_coasts():
    still, _ = drive(10, way_m=(0.0, 0.0, 0.0))
    moving, _ = drive(10)
    assert moving.surely_moves and not still.surely_moves
    for track, way_m in ((still, 0.0), (moving, 5.0)):
        start = track.filter.center_m
        for _ in range(5):
            track.coast(DT_S)
            track.unconfirmed_s += DT_S
            track.predict(DT_S)
        assert np.linalg.norm(track.filter.center_m - start) == pytest.approx(way_m, abs=0.1)


def test_the_middle_of_the_box_outlasts_it():
    track, truth = drive(10, way_m=(0.0, 0.0, 0.0))
    points = np.random.default_rng(0).uniform(-1, 1, (200, 3)) + np.array([0.0, 0.0, 2.0])
    track.take_points(points + truth[-1][:3, 3])
    for _ in range(8):
        track.predict(DT_S)
        track.coast(DT_S)
    assert track.box_center_m is None
    np.testing.assert_allclose(track.middle_offset_m, [0.0, 0.0, 2.0], atol=0.15)


def test_few_points_have_strays_too():
    track, truth = drive(10, way_m=(0.0, 0.0, 0.0))
    points = np.random.default_rng(0).uniform(-1, 1, (20, 3)) + truth[-1][:3, 3]
    track.take_points(np.r_[points, truth[-1][:3, 3] + [[0.0, 0.0, 13.0]]])
    assert 1.0 < track.extent_m[2] < 2.1


def test_the_speed_of_what_turns_is_the_less_certain():
    straight, _ = drive(40)
    turning, _ = drive(40, turn_rad=0.05)
    for track in (straight, turning):
        track.take_points(track.filter.center_m + np.random.default_rng(0).uniform(-2, 2, (99, 3)))
    assert straight.middle_doubt_mps(0.0) == 0.0
    assert turning.middle_doubt_mps(0.5) == pytest.approx(0.5 * 0.12 * turning.extent_m.max())
    assert turning.velocity_std_mps > straight.velocity_std_mps + 0.05
