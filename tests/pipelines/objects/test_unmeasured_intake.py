"""Objects whose motion a frame does not tell: what their tracks and the frame come to say."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.config import DepthConfig, ObjectsConfig
from pipelines.frontend.sensor import Sensor
from pipelines.geometry import make_T
from pipelines.object_types import ObjectState
from pipelines.objects.following import Followed
from pipelines.objects.frame import ObjectFrame
from pipelines.objects.points import ObjectPoints, tight_window
from pipelines.objects.rows import RowTable
from pipelines.objects.track import ObjectTrack
from pipelines.objects.unmeasured_intake import UnmeasuredIntake

DT_S = 0.1
CENTER_M = np.array([0.5, 0.2, 9.0])


@pytest.fixture
def seen(board, street_of):
    """A camera that stands at (0, 0, 1), a board that stands, and the frame that shows it."""
    street = street_of((board(lambda t: tuple(CENTER_M)),), lambda t: (0.0, 0.0, 1.0))
    view, found = street.view(0)
    frame = ObjectFrame(found.labels, True, ObjectPoints.empty(), Followed.empty(), True)
    frame.windows[1], frame.scores[1] = tight_window(found.labels == 1), 0.9
    return street, view, frame


def track_of(speed_mps: float = 0.0) -> ObjectTrack:
    """Object 1, whose motion along x was measured in the frame before."""
    track = ObjectTrack(1, ObjectsConfig())
    H = make_T(np.eye(3), np.array([speed_mps * DT_S, 0.0, 0.0]))
    track.take_motion(H, 1e-6 * np.eye(6), CENTER_M, DT_S)
    state = ObjectState.MOVING if speed_mps else ObjectState.STOPPED
    track.set_state(state, 0.0)
    track.predict(DT_S)
    return track


def take(seen, track, measured=frozenset()):
    """The rows, and the tracks that are left."""
    street, view, frame = seen
    sensor, tracks = Sensor(street.camera, DepthConfig()), {1: track}
    table = RowTable(view.frame_index, view.timestamp_s)
    intake = UnmeasuredIntake(sensor, track.config, view, frame, street.T_world_camera(0))
    intake.take(tracks, measured, DT_S, table)
    return table.estimates(), tracks


def out_of_sight(seen):
    seen[2].remove(1)
    return seen


def test_a_new_object_is_unknown_and_where_its_depth_says(seen) -> None:
    track = ObjectTrack(1, ObjectsConfig())
    rows, _ = take(seen, track)
    assert rows.state.tolist() == ["unknown"]
    assert rows.score.tolist() == [0.9]
    np.testing.assert_allclose(rows.centers_m[0], CENTER_M, atol=0.05)
    np.testing.assert_allclose(track.filter.center_m, CENTER_M, atol=0.05)
    assert np.isnan(rows.speed_mps).all()


def test_a_mask_that_is_mostly_hidden_does_not_move_the_object(seen) -> None:
    track = ObjectTrack(1, ObjectsConfig())
    track.area_px = 3 * int(np.count_nonzero(seen[2].mask(1)))
    rows, _ = take(seen, track)
    np.testing.assert_allclose(rows.centers_m[0], CENTER_M, atol=0.05)
    assert track.filter is None


def test_what_stood_a_moment_ago_still_stands(seen) -> None:
    assert take(seen, track_of())[0].state.tolist() == ["stopped"]
    long_ago = track_of()
    long_ago.unmeasured_s = 1.0
    assert take(seen, long_ago)[0].state.tolist() == ["unknown"]


def test_what_moved_coasts_out_of_sight(seen) -> None:
    track = track_of(5.0)
    track.box_px = np.array([10.0, 20.0, 30.0, 40.0])  # where it was last
    rows, _ = take(out_of_sight(seen), track)
    assert rows.state.tolist() == ["coasting"]
    assert track.H_world_curr_prev is None
    assert np.isnan(rows.boxes_px).all()
    assert np.isnan(rows.score).all()
    np.testing.assert_allclose(rows.centers_m[0], CENTER_M + np.array([0.5, 0, 0]), atol=0.05)


def test_what_stood_is_remembered_out_of_sight_and_not_told(seen) -> None:
    rows, tracks = take(out_of_sight(seen), track_of())
    assert len(rows) == 0
    assert list(tracks) == [1]


def test_what_is_out_of_sight_for_long_is_forgotten(seen) -> None:
    street, view, frame = out_of_sight(seen)
    track = track_of(5.0)
    later = replace(view, timestamp_s=track.config.max_age_s + 0.05)
    rows, tracks = take((street, later, frame), track)
    assert len(rows) == 0
    assert tracks == {}


def test_a_carried_mask_that_no_motion_bears_out_leaves_the_frame(seen) -> None:
    frame = seen[2]
    frame.carried_ids.add(1)
    rows, _ = take(seen, track_of(5.0))
    assert rows.state.tolist() == ["coasting"]
    assert not frame.windows
    assert not frame.labels.any()


def test_measured_objects_are_left_alone(seen) -> None:
    track = track_of(5.0)
    rows, _ = take(seen, track, measured={1})
    assert len(rows) == 0
    assert track.state is ObjectState.MOVING
    assert track.H_world_curr_prev is not None
