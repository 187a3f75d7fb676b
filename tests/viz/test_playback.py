"""Boxes and playback of a run: one size over a rigid motion, every frame, trails where it moved."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from pipelines.geometry import exp_se3, make_T, transform_points
from pipelines.io.result import Result
from pipelines.object_types import ObjectEstimates, ObjectState
from viz.boxes import LARGEST_M, frame_boxes, run_boxes
from viz.playback import build_playback

STEP = exp_se3(np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.8]))  # of the object a frame, in the world
STAMPS = np.arange(8) * 0.1


def car(n: int = 8, object_id: int = 3, state: str = "moving") -> ObjectEstimates:
    """A car whose seen part grows along its own x axis while it drives: the middle wanders."""
    Ls = [make_T(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.array([2.0, 0.5, 9.0]))]
    for _ in range(n - 1):
        Ls.append(STEP @ Ls[-1])
    lengths = np.linspace(1.0, 4.0, n)
    middles = np.column_stack([0.5 * lengths, np.zeros(n), np.zeros(n)])
    Hs = np.array([np.full((4, 4), np.nan)] + [STEP] * (n - 1))
    nan3 = np.full((n, 3), np.nan)
    return ObjectEstimates(
        np.arange(n), STAMPS[:n], np.full(n, object_id), np.full(n, "car"), np.ones(n),
        np.full(n, state), np.tile([10.0, 10, 40, 30], (n, 1)), np.full(n, 80), np.array(Ls), Hs,
        np.full((n, 6, 6), np.nan),
        np.array([transform_points(L, m[None])[0] for L, m in zip(Ls, middles, strict=True)]),
        np.full(n, 8.0), np.full(n, 0.2), nan3, np.full(n, np.nan),
        np.column_stack([lengths, np.full(n, 1.4), np.full(n, 1.7)]),
    )  # fmt: skip


def a_result(objects: ObjectEstimates, tmp_path: Path, lost: int | None = None) -> Result:
    keep = np.arange(8) != lost
    Ts = np.array([make_T(np.eye(3), np.array([0.0, 0.0, 0.5 * k])) for k in range(8)])
    points = np.random.default_rng(0).uniform([-5, -5, 3], [5, 5, 13], (200, 3))
    timings = {"frames_index": list(range(8)), "frames_timestamp_s": STAMPS.tolist()}
    return Result(
        tmp_path, STAMPS[keep], Ts[keep], None, None, points, np.full((200, 3), 90, np.uint8),
        timings=timings, objects=objects,
    )  # fmt: skip


def test_hindsight_gives_every_frame_the_whole_box():
    objects = car()
    boxes = run_boxes(objects)
    assert len(boxes) == 8
    for box in boxes:
        np.testing.assert_allclose(box.size_m, [4.0, 1.4, 1.7])
    for before, after in pairwise(boxes):
        np.testing.assert_allclose(STEP @ before.T_world_box, after.T_world_box, atol=1e-9)
    live = frame_boxes(objects[np.array([0])])[0]
    assert live.size_m[0] == 1.0 and live.words == "3 car 29 km/h"


def test_corners_enclose_what_the_box_holds():
    box = run_boxes(car())[-1]
    local = transform_points(np.linalg.inv(box.T_world_box), box.corners_m)
    np.testing.assert_allclose(np.ptp(local, axis=0), box.size_m)
    assert len(np.unique(np.round(local, 6), axis=0)) == 8
    assert (local[0b101] > 0).tolist() == [True, False, True]


def test_what_stands_on_the_ground_stays_upright_in_its_heading():
    objects = car()
    tilt = exp_se3(np.array([0.3, 0.0, -0.2, 0.0, 0.0, 0.0]))[:3, :3]
    Ls = objects.Ts_world_object.copy()
    Ls[:, :3, :3] = Ls[:, :3, :3] @ tilt
    for box, straight in zip(
        frame_boxes(replace(objects, Ts_world_object=Ls)), frame_boxes(objects), strict=True
    ):
        R, R_straight = box.T_world_box[:3, :3], straight.T_world_box[:3, :3]
        np.testing.assert_allclose(R[:, 1], [0.0, 1.0, 0.0], atol=1e-12)
        np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(R) > 0.99 and R[:, 0] @ R_straight[:, 0] > 0.97
    tumbling = replace(objects, Ts_world_object=Ls, class_name=np.full(8, "object"))
    np.testing.assert_allclose(frame_boxes(tumbling)[0].T_world_box[:3, :3], Ls[0, :3, :3])


def test_what_is_unknown_has_no_box_and_noise_makes_none_larger_than_its_kind():
    objects = car()
    state = objects.state.astype("U16")
    state[5:] = str(ObjectState.UNKNOWN)
    known = run_boxes(replace(objects, state=state))
    assert [box.row for box in known] == [0, 1, 2, 3, 4]
    drawn_out = replace(objects, extents_m=objects.extents_m * [9.0, 1.0, 1.0])
    assert max(box.size_m[0] for box in run_boxes(drawn_out)) == LARGEST_M["car"][0]


def test_a_pose_that_is_set_up_anew_begins_another_box():
    objects = car()
    Ls = objects.Ts_world_object.copy()
    Ls[4:, :3, :3] = Ls[4:, :3, :3] @ exp_se3(np.array([0, 1.2, 0, 0, 0, 0]))[:3, :3]
    boxes = run_boxes(replace(objects, Ts_world_object=Ls))
    lengths = [round(float(box.size_m[0]), 3) for box in boxes]
    assert len(set(lengths[:4])) == 1 and len(set(lengths[4:])) == 1
    assert lengths[0] < lengths[-1]


def test_every_processed_frame_is_played_with_its_objects(tmp_path):
    playback = build_playback(a_result(car(), tmp_path, lost=3))
    assert len(playback) == 8
    assert playback.is_tracked.tolist() == [True] * 3 + [False] + [True] * 4
    np.testing.assert_allclose(playback.Ts_world_camera[3], playback.Ts_world_camera[2])
    assert [len(boxes) for boxes in playback.boxes] == [1] * 8
    (trail,) = playback.trails
    assert trail.object_id == 3 and trail.frames.tolist() == list(range(8))
    np.testing.assert_allclose(trail.points_m[2], playback.boxes[2][0].T_world_box[:3, 3])


def test_parked_objects_have_boxes_but_no_trail(tmp_path):
    playback = build_playback(a_result(car(state="stopped"), tmp_path))
    assert playback.trails == () and len(playback.boxes[0]) == 1


def test_a_result_without_objects_or_files_still_plays(tmp_path):
    result = a_result(ObjectEstimates.empty(), tmp_path)
    playback = build_playback(replace(result, timings={}))
    assert len(playback) == 8 and playback.is_tracked.all()
    assert playback.pictures == (None,) * 8 and playback.camera is None
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "000002.png").touch()
    assert [p is not None for p in build_playback(result).pictures].index(True) == 2
