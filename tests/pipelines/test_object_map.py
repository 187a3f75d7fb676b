"""objects_map.ply: points ride on their objects to where these were last, in their own colours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
import pytest

from pipelines.frame_observations import FrameObservations, Sightings
from pipelines.geometry import exp_se3, invert_T, transform_points
from pipelines.io import folder as names
from pipelines.io.objects import write_objects
from pipelines.io.trajectory import write_tum
from pipelines.object_colors import object_color
from pipelines.object_map import object_points, write_object_map
from pipelines.object_types import ObjectEstimates

N = 6
STEP = exp_se3(np.array([0.0, 0.1, 0.0, 0.2, 0.0, 0.9]))  # of car 4 a frame; 7 stands still
SHAPE = np.random.default_rng(0).uniform(-1.0, 1.0, (20, 3))  # points of either, on the object
Xs = np.array([exp_se3(np.array([0.0, 0.02 * k, 0.0, 0.0, 0.0, 0.5 * k])) for k in range(N)])
STAMPS = 0.1 * np.arange(N)


def pose(object_id: int, k: int) -> np.ndarray:
    start = exp_se3(np.array([0.0, 0.3, 0.0, 1.0 if object_id == 4 else -4.0, 0.5, 9.0]))
    return np.linalg.matrix_power(STEP, k) @ start if object_id == 4 else start


def make_objects() -> ObjectEstimates:
    """Car 4 moves and is only predicted in the last frame; car 7 stands."""
    keys = [(k, j) for k in range(N) for j in (4, 7)]
    index, ids = np.array(keys).T
    Ls = np.array([pose(j, k) for k, j in keys])
    state = np.where(ids == 4, np.where(index == N - 1, "coasting", "moving"), "stopped")
    M, nan = len(keys), np.full(len(keys), np.nan)
    return ObjectEstimates(
        index, 0.1 * index, ids, np.full(M, "car"), np.ones(M), state,
        np.full((M, 4), 9.0), np.full(M, 20), Ls, np.full((M, 4, 4), np.nan),
        np.full((M, 6, 6), np.nan), Ls[:, :3, 3], nan, nan, np.full((M, 3), np.nan), nan,
        np.full((M, 3), 2.0),
    )  # fmt: skip


def make_log() -> list[FrameObservations]:
    """What each frame saw of both cars and the street; the last sighting of a point is exact."""
    log = []
    for k in range(N):
        parts = []
        for object_id in (0, 4, 7):
            # Half of the points are lost from sight after the third frame.
            tracks = np.arange(20 if k < 3 else 10)
            last = np.where(tracks < 10, 4 if object_id == 4 else N - 1, 2)
            world = transform_points(pose(object_id, k), SHAPE[tracks])
            local = transform_points(invert_T(Xs[k]), world) + 0.3 * (k < last)[:, None]
            n, nan = len(tracks), np.full(len(tracks), np.nan)
            parts.append(
                Sightings(
                    np.full(n, k), np.full(n, object_id), tracks, np.zeros((n, 2)),
                    nan, nan, nan, local,
                )
            )  # fmt: skip
        sightings = Sightings.concatenate(*parts)
        log.append(FrameObservations(k, STAMPS[k], True, np.eye(4), sightings))
    return log


def test_points_are_where_their_objects_were_last():
    points_m, ids = object_points(make_objects(), make_log(), STAMPS, Xs)
    assert sorted(set(ids.tolist())) == [4, 7] and len(ids) == 40
    expected = {4: pose(4, N - 2), 7: pose(7, 0)}  # where 4 was predicted to be, nothing was seen
    for object_id, T in expected.items():
        np.testing.assert_allclose(points_m[ids == object_id], transform_points(T, SHAPE))


def test_what_is_not_on_the_object_is_left_out():
    """Points of a house seen through its windows, and frames in which too little is known."""
    log, objects = make_log(), make_objects()
    far = log[-1].sightings.position_m + np.array([0.0, 0.0, 15.0])
    spilled = replace(log[-1].sightings, position_m=far, track_id=log[-1].sightings.track_id + 100)
    log.append(replace(log[-1], sightings=spilled))
    points_m, _ = object_points(objects, log, STAMPS, Xs)
    assert len(points_m) == 40
    unknown = objects.state.astype("U16")
    unknown[objects.object_id == 7] = "unknown"
    _, ids = object_points(replace(objects, state=unknown), log, STAMPS, Xs)
    assert set(ids.tolist()) == {4}


def test_a_lost_camera_and_an_object_without_a_pose_leave_no_points():
    tracked = np.arange(N) != 2  # in which the second half of the points was seen last
    objects = make_objects()
    points_m, ids = object_points(
        objects[objects.object_id == 4], make_log(), STAMPS[tracked], Xs[tracked]
    )
    assert set(ids.tolist()) == {4} and len(ids) == 20
    exact = transform_points(pose(4, N - 2), SHAPE)
    np.testing.assert_allclose(points_m[:10], exact[:10])
    assert np.linalg.norm(points_m[10:] - exact[10:], axis=1).min() > 0.1  # of a frame before


def test_the_file_holds_points_and_ways_in_the_colours_of_ids(tmp_path: Path):
    write_tum(tmp_path / names.CAMERA_TUM, STAMPS, Xs)
    write_objects(tmp_path / names.OBJECTS_CSV, make_objects())
    write_object_map(tmp_path, make_log())
    cloud = o3d.io.read_point_cloud(str(tmp_path / names.OBJECTS_MAP))
    colors = np.round(255 * np.asarray(cloud.colors)).astype(int)
    of_car = (colors == object_color(4)).all(1)
    assert of_car.sum() == 20 + N - 1 and (colors[~of_car] == object_color(7)).all()
    way = np.array([pose(4, k)[:3, 3] for k in range(N - 1)])
    np.testing.assert_allclose(np.asarray(cloud.points)[-(N - 1) :], way, atol=1e-5)


@pytest.mark.parametrize("case", ["objects", "no objects", "no file"])
def test_without_a_log_there_are_the_ways_alone(tmp_path: Path, case: str):
    write_tum(tmp_path / names.CAMERA_TUM, STAMPS, Xs)
    objects = make_objects()
    if case != "no file":
        chosen = objects if case == "objects" else objects[:0]
        write_objects(tmp_path / names.OBJECTS_CSV, chosen)
    write_object_map(tmp_path)
    cloud = o3d.t.io.read_point_cloud(tmp_path / names.OBJECTS_MAP)
    found = len(cloud.point.positions) if "positions" in cloud.point else 0
    assert found == (N - 1 if case == "objects" else 0)
