"""Rows of a frame: order, defaults, and the speed's parts."""

import numpy as np
import pytest

from pipelines.config import ObjectsConfig
from pipelines.object_types import ObjectState
from pipelines.objects.rows import RowTable
from pipelines.objects.track import ObjectTrack


def test_a_frame_without_objects():
    assert len(RowTable(3, 0.3).estimates()) == 0


def test_rows_come_in_the_order_of_their_ids():
    table = RowTable(3, 0.3)
    for object_id in (5, 2, 9):
        table.add(ObjectTrack(object_id, ObjectsConfig()), 0.5, center_m=np.zeros(3))
    rows = table.estimates()
    assert rows.object_id.tolist() == [2, 5, 9]
    assert (rows.frame_index == 3).all() and (rows.timestamp_s == 0.3).all()


def test_what_is_not_known_is_nan():
    table, track = RowTable(0, 0.0), ObjectTrack(1, ObjectsConfig())
    track.set_state(ObjectState.STOPPED, 0.0)
    table.add(track, 0.5, center_m=np.full(3, np.nan))
    rows = table.estimates()
    assert rows.state[0] == "stopped" and rows.n_points[0] == 0
    for name in ("Ts_world_object", "Hs_world_curr_prev", "motion_covariances", "speed_mps",
                 "speed_std_mps", "velocities_mps", "velocity_std_mps", "boxes_px"):  # fmt: skip
        assert np.isnan(getattr(rows, name)).all(), name


def test_what_is_known_is_told():
    table, track = RowTable(0, 0.0), ObjectTrack(4, ObjectsConfig())
    track.take_detection("truck", 0.8, np.zeros(64))
    track.take_center(np.array([1.0, 2.0, 3.0]))
    track.box_px = np.array([1.0, 2, 3, 4])
    H, covariance = np.eye(4), np.eye(6)
    table.add(track, 0.8, center_m=np.array([1.0, 2.0, 3.0]), n_points=17, H_world_curr_prev=H,
              motion_covariance=covariance, speed_mps=3.0, speed_std_mps=0.1,
              state=ObjectState.MOVING)  # fmt: skip
    rows = table.estimates()
    assert rows.class_name[0] == "truck" and rows.score[0] == 0.8 and rows.n_points[0] == 17
    assert rows.state[0] == "moving" and rows.speed_mps[0] == 3.0
    np.testing.assert_array_equal(rows.Ts_world_object[0, :3, 3], [1, 2, 3])
    np.testing.assert_array_equal(rows.Hs_world_curr_prev[0], H)
    np.testing.assert_array_equal(rows.boxes_px[0], [1, 2, 3, 4])
    # Middles of masks alone say nothing of a speed
    assert np.isnan(rows.velocities_mps).all() and np.isnan(rows.velocity_std_mps).all()
    track.take_motion(np.eye(4), 1e-4 * np.eye(6), np.array([1.0, 2.0, 3.0]), 0.1)
    table.add(track, 0.8, center_m=np.array([1.0, 2.0, 3.0]))
    rows = table.estimates()
    assert rows.velocity_std_mps[1] == pytest.approx(0.1, rel=0.05)
