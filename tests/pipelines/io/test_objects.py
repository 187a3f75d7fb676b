"""objects.csv, objects/ and objects_gt.csv: exact columns, round trips, gaps, other readers."""

import csv
from dataclasses import replace

import numpy as np
import pytest

from pipelines.errors import FormatError
from pipelines.geometry import exp_se3, invert_T, rotation_angle_deg
from pipelines.io.folder import clear_result_folder
from pipelines.io.object_truth import read_object_truth, write_object_truth
from pipelines.io.objects import read_objects, write_object_trajectories, write_objects
from pipelines.io.result import ResultWriter, load_result, run_metrics
from pipelines.object_types import ObjectEstimates
from pipelines.types import FrameResult, GroundTruth, ObjectTruth, StaticMap
from tests.frame_results import frame_result

FIRST_COLUMNS = (
    "frame,timestamp_s,object_id,class_name,score,state,x1_px,y1_px,x2_px,y2_px,n_points,"
    "L_tx_m,L_ty_m,L_tz_m,L_qx,L_qy,L_qz,L_qw,H_tx_m,H_ty_m,H_tz_m,H_qx,H_qy,H_qz,H_qw,"
    "speed_kmh,speed_std_kmh"
)
NO_MAP = StaticMap(
    np.empty((0, 3)), np.empty((0, 3), np.uint8), np.empty(0, np.int32),
    np.empty((0, 4, 4)), np.empty(0, np.int64),
)  # fmt: skip


def motions(n: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([exp_se3(rng.normal(0, 1.0, 6) * [1, 1, 1, 40, 3, 90]) for _ in range(n)])


def make_objects(n: int = 6) -> ObjectEstimates:
    """Rows of two objects: one measured, one that coasts from the third row on."""
    rng = np.random.default_rng(0)
    state = np.array(["moving", "stopped", "moving", "coasting", "unknown", "coasting"])[:n]
    coasting, seen = state == "coasting", state != "coasting"
    Hs, Ls = motions(n, 1), motions(n, 2)
    Hs[~np.isin(state, ["moving", "stopped"])] = np.nan
    Ls[coasting] = np.nan
    has_H = np.isfinite(Hs).all((1, 2))
    covariances = np.full((n, 6, 6), np.nan)
    covariances[has_H] = np.diag([1e-4, 2e-4, 3e-4, 0.01, 0.02, 0.06])
    return ObjectEstimates(
        frame_index=np.arange(n) // 2,
        timestamp_s=1403636579.763555 + 0.1 * (np.arange(n) // 2),
        object_id=np.array([3, 12] * 3)[:n],
        class_name=np.array(["car", "traffic, light"] * 3)[:n],
        score=np.where(coasting, np.nan, 0.75),
        state=state,
        boxes_px=np.where(seen[:, None], rng.uniform(0, 1000, (n, 4)).round(1), np.nan),
        n_points=np.where(seen, 250, 0),
        Ts_world_object=Ls,
        Hs_world_curr_prev=Hs,
        motion_covariances=covariances,
        centers_m=rng.normal(0, 50, (n, 3)),
        speed_mps=np.where(has_H, rng.uniform(0, 20, n), np.nan),
        speed_std_mps=np.where(has_H, 0.3, np.nan),
        velocities_mps=rng.normal(0, 5, (n, 3)),
        velocity_std_mps=rng.uniform(0.1, 1, n),
        extents_m=rng.uniform(1, 4, (n, 3)),
    )


def make_frames(objects: ObjectEstimates) -> list[FrameResult]:
    return [
        frame_result(int(k), np.eye(4), objects=objects[objects.frame_index == k])
        for k in np.unique(objects.frame_index)
    ]


def test_columns_and_cells_as_any_reader_sees_them(tmp_path):
    objects = make_objects()
    write_objects(tmp_path / "objects.csv", objects)
    text = (tmp_path / "objects.csv").read_text()
    assert text.splitlines()[0].startswith(FIRST_COLUMNS + ",")
    with (tmp_path / "objects.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    assert rows[1]["class_name"] == "traffic, light"
    assert abs(float(rows[0]["timestamp_s"]) - objects.timestamp_s[0]) < 1e-6
    assert float(rows[0]["speed_kmh"]) == pytest.approx(3.6 * objects.speed_mps[0])
    # A coasting row shows the filter's speed, and nothing of what was not measured.
    smoothed = 3.6 * np.linalg.norm(objects.velocities_mps[3])
    assert float(rows[3]["speed_kmh"]) == pytest.approx(smoothed)
    assert float(rows[3]["smoothed_speed_kmh"]) == pytest.approx(smoothed)
    empty = ("score", "x1_px", "L_tx_m", "H_tx_m", "H_qw", "H_std_t_m")
    assert [rows[3][name] for name in empty] == [""] * len(empty)
    assert rows[4]["speed_kmh"] == rows[4]["H_tx_m"] == ""  # seen, but no motion
    assert rows[4]["L_tx_m"] != ""
    assert float(rows[0]["H_std_t_m"]) == pytest.approx(0.3)
    assert float(rows[0]["H_std_R_deg"]) == pytest.approx(np.degrees(np.sqrt(6e-4)))
    assert "nan" not in text.lower()


def test_round_trip(tmp_path):
    objects = make_objects()
    write_objects(tmp_path / "objects.csv", objects)
    back = read_objects(tmp_path / "objects.csv")
    # Of the covariances the file has the traces of both blocks
    for block in (slice(3), slice(3, 6)):
        ours, theirs = (
            np.trace(o.motion_covariances[:, block, block], axis1=1, axis2=2)
            for o in (objects, back)
        )
        np.testing.assert_allclose(theirs, ours, rtol=1e-6)
    for name in ("frame_index", "object_id", "class_name", "state", "n_points"):
        assert getattr(back, name).tolist() == getattr(objects, name).tolist(), name
    for name in objects.__slots__:
        ours, theirs = getattr(objects, name), getattr(back, name)
        if ours.dtype.kind == "f" and name != "motion_covariances":
            np.testing.assert_allclose(theirs, ours, rtol=1e-8, atol=1e-7, err_msg=name)
    known = np.isfinite(objects.Hs_world_curr_prev).all((1, 2))
    E = invert_T(objects.Hs_world_curr_prev[known]) @ back.Hs_world_curr_prev[known]
    assert np.linalg.norm(E[:, :3, 3], axis=1).max() < 1e-9
    assert rotation_angle_deg(E).max() < 1e-8


def test_no_objects_are_a_header(tmp_path):
    write_objects(tmp_path / "objects.csv", ObjectEstimates.empty())
    assert len((tmp_path / "objects.csv").read_text().splitlines()) == 1
    assert len(read_objects(tmp_path / "objects.csv")) == 0


@pytest.mark.parametrize(
    ("before", "after", "found"),
    [
        ("moving", "moving,7", "expected a number in"),
        ("0,1403636579", "zero,1403636579", "line 2: expected a number in frame, found 'zero'"),
        ("object_id,class_name", "object,class_name", "expected the column object_id"),
        ("H_qw", "H_q4", "expected the column H_qw"),
    ],
)
def test_a_damaged_table_is_named(tmp_path, before, after, found):
    path = tmp_path / "objects.csv"
    write_objects(path, make_objects())
    path.write_text(path.read_text().replace(before, after, 1))
    with pytest.raises(FormatError, match=found) as raised:
        read_objects(path)
    assert str(path) in str(raised.value)


def test_trajectories_are_read_by_evo(tmp_path):
    from evo.tools import file_interface

    objects = make_objects()
    folder = tmp_path / "objects"
    folder.mkdir()
    (folder / "099_bus_tum.txt").write_text("of an earlier run")
    (folder / "notes.txt").write_text("mine")
    paths = write_object_trajectories(folder, objects)
    assert [path.name for path in paths] == ["003_car_tum.txt", "012_traffic-light_tum.txt"]
    assert not (folder / "099_bus_tum.txt").exists()
    assert (folder / "notes.txt").exists()
    trajectory = file_interface.read_tum_trajectory_file(str(paths[0]))
    assert trajectory.check()[0]
    own = objects[objects.object_id == 3]
    np.testing.assert_allclose(np.array(trajectory.poses_se3), own.Ts_world_object, atol=1e-7)
    np.testing.assert_allclose(trajectory.timestamps, own.timestamp_s, atol=1e-6)
    assert len(paths[1].read_text().splitlines()) == 2  # a header, and the one known pose


def make_truth() -> ObjectTruth:
    return ObjectTruth(
        np.array([0, 0, 1, 1, 5]), np.array([1, 2, 1, 2, 1]),
        np.array(["car", "person"] * 2 + ["car"]),
        motions(5, 4), np.array([[1.0, 2, 30, 40]] * 4 + [[np.nan] * 4]),
        np.array([True, False, True, False, True]), np.array([900, 3, 901, 4, 0]),
    )  # fmt: skip


@pytest.mark.parametrize("with_pixels", [True, False])
def test_truth_round_trip(tmp_path, with_pixels):
    truth = make_truth() if with_pixels else replace(make_truth(), n_pixels=None)
    write_object_truth(tmp_path / "gt.csv", 0.1 * truth.frame_index, truth)
    back = read_object_truth(tmp_path / "gt.csv")
    for name in ("frame_index", "object_id", "class_name", "moving"):
        assert getattr(back, name).tolist() == getattr(truth, name).tolist()
    np.testing.assert_allclose(back.Ts_world_object, truth.Ts_world_object, atol=1e-9)
    np.testing.assert_array_equal(back.boxes_px, truth.boxes_px)
    if with_pixels:
        np.testing.assert_array_equal(back.n_pixels, truth.n_pixels)
    else:
        assert back.n_pixels is None


def test_a_result_folder_holds_objects_and_their_truth_in_our_world(tmp_path):
    objects = make_objects()
    frames = make_frames(objects)
    T = motions(1, 9)[0]
    gt = GroundTruth(0.1 * np.arange(7), np.tile(T, (7, 1, 1)), make_truth())
    ResultWriter(tmp_path).write_run(frames, NO_MAP, gt)
    result = load_result(tmp_path)
    assert result.objects.object_id.tolist() == objects.object_id.tolist()
    assert result.gt_objects.frame_index.tolist() == [0, 0, 1, 1]  # frame 5 was not run
    expected = invert_T(T) @ make_truth().Ts_world_object[:4]
    np.testing.assert_allclose(result.gt_objects.Ts_world_object, expected, atol=1e-8)
    assert (tmp_path / "objects" / "003_car_tum.txt").exists()
    (tmp_path / "run.log").touch()
    clear_result_folder(tmp_path)
    left = {path.name for path in tmp_path.rglob("*") if path.is_file()}
    assert not left


def test_the_truth_changes_nothing_of_the_estimates(tmp_path):
    frames = make_frames(make_objects())
    gt = GroundTruth(0.1 * np.arange(7), np.tile(np.eye(4), (7, 1, 1)), make_truth())
    ResultWriter(tmp_path / "a").write_run(frames, NO_MAP, gt)
    ResultWriter(tmp_path / "b").write_run(frames, NO_MAP)
    assert not (tmp_path / "b" / "objects_gt.csv").exists()
    for name in ("objects.csv", "objects/003_car_tum.txt"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert load_result(tmp_path / "b").gt_objects is None


def test_run_metrics_count_objects():
    metrics = run_metrics(make_frames(make_objects()), NO_MAP, sequence="s", dataset="vdo")
    assert metrics["objects"] == {
        "tracked": 2,
        "moving": 1,
        "by_class": {"car": 1, "traffic, light": 1},
        "rows_by_state": {"moving": 2, "stopped": 1, "coasting": 2, "unknown": 1},
    }
