"""The tracker on rendered boards of known motion: who, how, how fast, and through occlusions."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.config import DepthConfig, ObjectsConfig
from pipelines.frontend.sensor import Sensor
from pipelines.object_types import Detections, ObjectEstimates
from pipelines.objects.tracking import ObjectTracker

POSE_COVARIANCE = 1e-10 * np.eye(6)


def taught(camera):
    """A sensor that knows its noise, as the tracking of the camera teaches it before objects."""
    sensor, residuals = Sensor(camera, DepthConfig()), np.full((50, 2), 0.03)
    for source in list(sensor.noise.sigma_uv_px):
        sensor.noise.learn_uv(source, residuals)
    sensor.noise.learn_disparity(residuals[:, 0])
    return sensor


def run(street, frames, config=None, see=lambda k, found: found, pose=None, change=None):
    """All estimates over frames, and the tracker. see: changes what the detector answers."""
    tracker = ObjectTracker(taught(street.camera), config or ObjectsConfig())
    rows = []
    for k in frames:
        view, found = street.view(k)
        if change is not None:
            view = change(k, view)
        T = street.T_world_camera(k)
        frame = tracker.associate(view, see(k, found), T)
        covariance = POSE_COVARIANCE if pose is None else pose(k)
        rows.append(tracker.estimate(view, frame, T, covariance))
    return ObjectEstimates.concatenate(*rows), tracker


def without(found, *labels):
    """What the detector answers where it misses some objects."""
    keep = ~np.isin(found.label_ids, labels)
    pixels = np.where(np.isin(found.labels, labels), 0, found.labels)
    return Detections(pixels, found.label_ids[keep], found.class_names[keep], found.scores[keep])


@pytest.fixture(scope="module")
def traffic(board, street_of):
    """A car that drives at 3 m/s across, one that stands, before a camera on its way at 5 m/s."""
    return street_of(
        (
            board(lambda t: (-2.5 + 3.0 * t, 0.2, 10.0 + 5.0 * t)),
            board(lambda t: (2.5, 0.0, 16.0), seed=2, value=90, size_m=(3.0, 2.0)),
        ),
        lambda t: (0.1 * t, 0.0, 5.0 * t),
    )


@pytest.fixture(scope="module")
def driven(traffic):
    return run(traffic, range(10))


def of(rows, object_id):
    return rows[rows.object_id == object_id]


def test_speed_by_equation_6_and_its_claim(driven):
    rows, _ = driven
    moving = of(rows, 1)[2:]
    true = np.hypot(3.0, 5.0)
    errors = moving.speed_mps - true
    assert len(moving) == 8 and np.isfinite(errors).all()
    assert 1e-5 < np.abs(errors).mean() < 0.1
    assert (moving.speed_std_mps > 1e-4).all() and (moving.speed_std_mps < 0.5).all()
    assert (np.abs(errors) < 4.0 * moving.speed_std_mps).all()
    assert np.abs(moving.smoothed_speed_mps - true).max() < 0.3


def test_motion_and_pose_in_the_world(driven):
    moving = of(driven[0], 1)
    way = moving.Hs_world_curr_prev[2:] @ np.append(moving.centers_m[2], 1.0)
    np.testing.assert_allclose(
        (way[0] - np.append(moving.centers_m[2], 1.0))[:3], [0.3, 0.0, 0.5], atol=0.03
    )
    start, end = moving.Ts_world_object[1], moving.Ts_world_object[-1]
    np.testing.assert_allclose(end[:3, 3] - start[:3, 3], np.array([0.3, 0, 0.5]) * 8, atol=0.12)
    np.testing.assert_allclose(moving.centers_m[-1, :2], [-2.5 + 2.7, 0.2], atol=0.25)


def test_one_moves_and_one_stands(driven):
    rows, tracker = driven
    assert set(of(rows, 1).state[2:]) == {"moving"}
    assert set(of(rows, 2).state[3:]) == {"stopped"}
    assert np.nanmax(of(rows, 2).speed_mps[2:]) < 0.2
    assert tracker.landmark_ids(0.9) == [] and tracker.landmark_ids(5.0) == [2]
    assert tracker.class_names() == {1: "car", 2: "car"}


def test_the_paper_s_rule_agrees_on_them(traffic):
    rows, _ = run(traffic, range(6), ObjectsConfig(motion_rule="scene_flow"))
    assert set(of(rows, 1).state[1:]) == {"moving"}
    assert set(of(rows, 2).state[1:]) == {"stopped"}


def test_objects_have_motions_in_their_very_first_frames(driven):
    """There is none in the first frame of all; in the second there is, by points and by seeds."""
    for object_id in (1, 2):
        known = np.isfinite(of(driven[0], object_id).speed_mps)
        assert not known[0] and known[1:].all()


def test_what_is_detected_late_is_measured_at_once(traffic):
    rows, _ = run(traffic, range(5), see=lambda k, found: found if k >= 3 else without(found, 1))
    late = rows[(rows.frame_index == 3) & (rows.object_id == 2)]
    assert late.speed_mps[0] == pytest.approx(np.hypot(3.0, 5.0), abs=0.3)


def test_a_missed_detection_is_bridged_by_the_flow(traffic):
    rows, _ = run(traffic, range(8), see=lambda k, f: without(f, 1) if k in (4, 5) else f)
    own = of(rows, 1)
    assert own.frame_index.tolist() == list(range(8))
    assert set(own.state[2:]) == {"moving"}
    assert own.score[4] == own.score[5] == 0.0 and own.score[6] == 0.9
    assert np.abs(own.speed_mps[2:] - np.hypot(3.0, 5.0)).max() < 0.2
    assert set(rows.object_id) == {1, 2}


def test_no_answer_in_every_second_frame(traffic):
    rows, _ = run(traffic, range(8), see=lambda k, found: None if k % 2 else found)
    assert set(rows.object_id) == {1, 2}
    assert np.abs(of(rows, 1).speed_mps[2:] - np.hypot(3.0, 5.0)).max() < 0.2


@pytest.fixture(scope="module")
def passage(board, street_of):
    """A small car drives behind a van that stands: out of sight for some frames."""
    return street_of((
        board(lambda t: (-2.53 + 4.0 * t, 0.2, 9.0), size_m=(1.2, 1.5)),
        board(lambda t: (0.0, 0.0, 7.0), size_m=(1.8, 2.0), seed=2, value=60, name="truck"),
    ))  # fmt: skip


def test_behind_another_it_coasts_and_is_recognised_again(passage):
    rows, _ = run(passage, range(18))
    own = of(rows, 1)
    assert set(rows.object_id) == {1, 2}
    coasting = own.state == "coasting"
    assert 2 <= coasting.sum() <= 8
    assert np.isnan(own.boxes_px[coasting]).all() and np.isnan(own.score[coasting]).all()
    k = own.frame_index[coasting]
    np.testing.assert_allclose(own.centers_m[coasting, 0], -2.53 + 0.4 * k, atol=0.7)
    after = own.frame_index > k.max() + 3  # half of it is in sight by then
    assert after.sum() == 7
    assert np.abs(own.speed_mps[after] - 4.0).max() < 0.4
    # Half hidden, no wild estimate goes out
    assert np.nanmax(np.abs(own.speed_mps - 4.0)) < 1.5


def test_what_does_not_come_back_is_forgotten(passage):
    config = ObjectsConfig(max_age_s=0.5)
    rows, tracker = run(passage, range(16), config, lambda k, f: without(f, 1) if k > 4 else f)
    assert of(rows, 1).frame_index.max() < 12
    assert list(tracker.tracks) == [2]


def test_an_object_too_fast_for_the_flow_is_found_by_its_look(board, street_of):
    """It jumps by 1.6 m a frame, and the flow knows nothing of it."""
    street = street_of((board(lambda t: (-2.8 + 16.0 * t, 0.0, 8.0)),))

    def lose(k, view):
        flow = view.flow_prev_to_curr_px
        return view if flow is None else replace(view, flow_prev_to_curr_px=np.zeros_like(flow))

    rows, _ = run(street, range(4), change=lose)
    own = rows[rows.object_id == rows.object_id[-1]]
    assert np.nanmedian(own.speed_mps) == pytest.approx(16.0, abs=0.8)


def test_no_motion_is_told_while_the_camera_is_lost(traffic):
    rows, _ = run(
        traffic, range(8), pose=lambda k: np.full((6, 6), np.nan) if k == 4 else POSE_COVARIANCE
    )
    own = of(rows, 1)
    assert np.isnan(own.speed_mps[[4, 5]]).all() and np.isfinite(own.speed_mps[[3, 6, 7]]).all()
    assert np.isfinite(own.centers_m[[4, 5]]).all()


def test_beyond_the_range_objects_are_there_but_unknown(traffic):
    rows, _ = run(traffic, range(4), ObjectsConfig(max_depth_m=12.0))
    far = of(rows, 2)
    assert set(far.state) == {"unknown"} and np.isnan(far.speed_mps).all()
    assert np.isfinite(far.centers_m).all() and np.isfinite(of(rows, 1).speed_mps[1:]).all()


def test_without_depth_an_object_has_a_box_and_nothing_more(traffic):
    def blind(k, view):
        return replace(view, disparity_px=np.full_like(view.disparity_px, np.nan))

    rows, _ = run(traffic, range(3), change=blind)
    assert len(rows) == 6 and set(rows.state) == {"unknown"}
    assert np.isfinite(rows.boxes_px).all()
    assert np.isnan(rows.centers_m).all() and np.isnan(rows.Ts_world_object).all()


def test_a_repeated_time_stamp_gives_no_motion_and_does_no_harm(traffic):
    rows, _ = run(
        traffic, range(6), change=lambda k, view: replace(view, timestamp_s=0.3) if k == 4 else view
    )
    own = of(rows, 1)
    assert np.isnan(own.speed_mps[4]) and np.isfinite(own.centers_m).all()


def test_frames_without_any_object(traffic):
    rows, tracker = run(traffic, range(4), see=lambda k, f: Detections.empty(f.labels.shape))
    assert len(rows) == 0 and tracker.tracks == {}


def test_an_object_of_three_pixels(traffic):
    def speck(k, found):
        labels = np.zeros_like(found.labels)
        labels[100, 200:203] = 1
        return Detections(labels, np.array([1], np.int32), np.array(["car"]), np.array([0.9]))

    rows, _ = run(traffic, range(4), see=speck)
    assert (rows.state == "unknown").all() and np.isnan(rows.speed_mps).all()


def test_geometry_revises_what_was_associated(traffic):
    """A nameless new instance gets a lasting id, a repaired mask keeps its own."""
    tracker = ObjectTracker(taught(traffic.camera), ObjectsConfig())
    for k in range(2):
        view, found = traffic.view(k)
        frame = tracker.associate(view, without(found, 2), traffic.T_world_camera(k))
        if k == 1:
            both = Detections(
                np.where(found.labels == 2, 77, found.labels).astype(np.int32),
                np.array([1, 77], np.int32),
                np.array(["car", "object"]),
                np.array([0.9, 0.6]),
            )
            names = tracker.revise(view, frame, both, traffic.T_world_camera(k))
            assert names == {1: 1, 77: 2}
            assert frame.new_ids == [2] and set(frame.windows) == {1, 2}
            assert frame.scores == {1: 0.9, 2: 0.6}
            np.testing.assert_array_equal(frame.labels == 2, found.labels == 2)
        rows = tracker.estimate(view, frame, traffic.T_world_camera(k), POSE_COVARIANCE)
    assert rows.object_id.tolist() == [1, 2] and np.isfinite(rows.speed_mps).all()
    assert tracker.class_names()[2] == "object"
