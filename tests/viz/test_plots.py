"""Diagrams: those that the files allow, readable and not blank."""

import json

import cv2
import numpy as np
import pytest

from pipelines.errors import DyObError
from pipelines.evaluation import evaluate_result
from pipelines.geometry import exp_se3
from pipelines.io.result import ResultWriter, load_result
from pipelines.object_types import ObjectEstimates
from pipelines.types import GroundTruth, ObjectTruth, TrackingStatus
from tests.frame_results import frame_result
from viz import style
from viz.plots import figure_of, plot_result, possible_plots


def write(folder, n: int, *, truth: bool, timings: bool = True) -> None:
    step = exp_se3(np.array([0.0, 0.05, 0.0, 0.0, 0.0, 1.0]))
    Ts = np.array([np.linalg.matrix_power(step, k) for k in range(n)]).reshape(-1, 4, 4)
    errors = exp_se3(np.random.default_rng(0).normal(0.0, 1e-3, (n, 6)))
    results = [
        frame_result(
            k,
            T @ error,
            status=TrackingStatus.LOST if k == 7 else TrackingStatus.OK,
            timings_ms={"orb": 9.0, "total": 12.0 + k % 3} if timings else {},
        )
        for k, (T, error) in enumerate(zip(Ts, errors, strict=True))
    ]
    writer = ResultWriter(folder)
    writer.write_camera(results)
    writer.write_timings(results)
    if truth:
        writer.write_ground_truth(results, GroundTruth(np.arange(n) * 0.1, Ts))


def test_all_plots(tmp_path):
    write(tmp_path, 30, truth=True)
    paths = plot_result(tmp_path)
    assert [path.name for path in paths] == ["trajectory.png", "rpe.png", "timings.png"]
    for path in paths:
        picture = cv2.imread(str(path))[..., ::-1].astype(int)
        assert min(picture.shape[:2]) > 400
        blue = np.abs(picture - style.ESTIMATE).sum(2) < 60
        assert blue.sum() > 100, path.name


def test_the_path_is_seen_from_above_where_the_first_camera_looked_down(tmp_path):
    """In a hand: it turns about upright on a level circle of about a metre."""
    level = [exp_se3(np.array([0.0, a, 0, 0, 0, 0])) for a in np.linspace(0.0, 2 * np.pi, 40)]
    down = exp_se3(np.array([-0.6, 0.0, 0.0, 0.0, 0.0, -1.0]))
    turned = np.array(level) @ down
    Ts = np.linalg.inv(turned[0]) @ turned
    writer = ResultWriter(tmp_path)
    writer.write_camera([frame_result(k, T, status=TrackingStatus.OK) for k, T in enumerate(Ts)])
    lines = {line.get_label(): line for line in figure_of(tmp_path, "trajectory").axes[0].lines}
    circle = np.column_stack(lines["estimate"].get_data())
    middle = (circle.max(0) + circle.min(0)) / 2
    radii = np.linalg.norm(circle - middle, axis=1)
    assert 0.9 < radii.mean() < 1.0
    assert np.ptp(radii) < 0.02


def test_only_what_the_files_allow(tmp_path):
    write(tmp_path / "a", 30, truth=False)
    assert [path.name for path in plot_result(tmp_path / "a")] == ["trajectory.png", "timings.png"]
    write(tmp_path / "b", 0, truth=False)
    assert plot_result(tmp_path / "b") == []
    write(tmp_path / "c", 1, truth=True, timings=False)
    assert [path.name for path in plot_result(tmp_path / "c")] == ["trajectory.png"]


def write_objects(folder, n: int = 30) -> None:
    """A car that drives at 36 km/h, and one that is parked and then not seen."""
    step = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 1.0]))
    poses = np.array([np.linalg.matrix_power(step, k) for k in range(n)])
    still = np.tile(np.eye(4), (n, 1, 1))
    keys = [(k, j) for k in range(n) for j in (1, 2)]
    states = ["moving" if j == 1 else "stopped" if k < 15 else "coasting" for k, j in keys]
    M, box = len(keys), np.array([10.0, 10.0, 60.0, 60.0])
    T = np.array([poses[k] if j == 1 else still[k] for k, j in keys])
    H = np.array([step if j == 1 else np.eye(4) for _, j in keys])
    speed = np.array([10.0 if j == 1 else 0.0 for _, j in keys])
    boxes = np.array([box + 100 * j for _, j in keys])
    index, ids = np.array([k for k, _ in keys]), np.array([j for _, j in keys])
    objects = ObjectEstimates(
        index, 0.1 * index, ids, np.full(M, "car"), np.ones(M), np.array(states), boxes,
        np.full(M, 50), T, H, np.full((M, 6, 6), np.nan), T[:, :3, 3], speed, np.full(M, 0.3),
        np.outer(speed, [0, 0, 1]), np.full(M, 0.2), np.ones((M, 3)),
    )  # fmt: skip
    truth = ObjectTruth(index, ids, np.full(M, "car"), T, boxes, ids == 1)
    results = [
        frame_result(
            k, np.eye(4), objects=objects[objects.frame_index == k], timings_ms={"total": 12.0}
        )
        for k in range(n)
    ]
    writer = ResultWriter(folder)
    writer.write_camera(results)
    writer.write_timings(results)
    writer.write_objects(results)
    writer.write_ground_truth(results, GroundTruth(0.1 * np.arange(n), still, truth))


def test_objects_have_their_diagrams(tmp_path):
    write_objects(tmp_path)
    names = [path.name for path in plot_result(tmp_path)]
    assert names[-2:] == ["objects_speed.png", "objects_timeline.png"]
    speeds, lives = (
        cv2.imread(str(tmp_path / "plots" / name))[..., ::-1].astype(int) for name in names[-2:]
    )
    moving, parked = style.object_color(1), style.object_color(2)
    assert (np.abs(speeds - moving).sum(2) < 40).sum() > 100
    assert (np.abs(speeds - parked).sum(2) < 40).sum() == 0  # it never moved
    full = (np.abs(lives - moving).sum(2) < 20).sum()
    thin = (np.abs(lives - parked).sum(2) < 20).sum()
    assert full > 3 * thin > 300  # predicted only: a thin line
    shade = 255 - 0.42 * (255 - np.array(parked))
    assert (np.abs(lives - shade).sum(2) < 12).sum() > 2 * thin


def test_each_moving_object_has_its_error_of_motion(tmp_path):
    """Only where it is evaluated; the bars are as long as the figures in metrics.json."""
    write_objects(tmp_path)
    assert "objects_motion" not in possible_plots(load_result(tmp_path))
    evaluate_result(tmp_path)
    path = tmp_path / "metrics.json"
    metrics = json.loads(path.read_text())
    block = metrics["objects"]["per_object"]["1"]
    assert block["scored_ids"] == [1]
    block["class_name"] = "bus"  # the true one; the run calls it a car in every picture
    block.update(trans_rmse_m=0.04, trans_median_m=0.03, rot_rmse_deg=0.5, rot_median_deg=0.7)
    path.write_text(json.dumps(metrics))
    left, right = figure_of(tmp_path, "objects_motion").axes
    assert [text.get_text() for text in left.get_yticklabels()] == ["1 car, 29 frames"]
    assert [bar.get_width() for bar in left.patches] == pytest.approx([4.0])
    assert "cm" in left.get_xlabel()
    assert [bar.get_width() for bar in right.patches] == pytest.approx([0.5])
    assert right.lines[0].get_xdata() == pytest.approx([0.7])
    assert right.get_xlim()[1] > 0.7


def test_a_figure_shows_itself_and_writes_no_file(tmp_path):
    write(tmp_path, 30, truth=True)
    files = sorted(tmp_path.rglob("*"))
    picture = figure_of(load_result(tmp_path), "rpe")._repr_png_()
    assert cv2.imdecode(np.frombuffer(picture, np.uint8), 1).shape == (780, 1350, 3)
    assert sorted(tmp_path.rglob("*")) == files


def test_a_figure_that_cannot_be_is_one_sentence(tmp_path):
    write(tmp_path, 5, truth=False)
    with pytest.raises(DyObError, match="needs the camera's ground truth"):
        figure_of(tmp_path, "rpe")
    with pytest.raises(DyObError, match="found 'rpr'"):
        figure_of(tmp_path, "rpr")


def test_one_slow_frame_does_not_flatten_the_others(tmp_path):
    write(tmp_path, 30, truth=False)
    path = tmp_path / "timings.json"
    timings = json.loads(path.read_text())
    timings["frames_total_ms"][0] = 900.0
    path.write_text(json.dumps(timings))
    upper = figure_of(tmp_path, "timings").axes[0]
    assert 14.0 < upper.get_ylim()[1] < 40.0
    assert "slowest 900 ms, frame 0" in [text.get_text() for text in upper.get_legend().texts]


def test_stopped_objects_alone_have_no_speeds_to_show(tmp_path):
    write_objects(tmp_path, 4)  # too short to be called moving
    names = [path.name for path in plot_result(tmp_path)]
    assert "objects_speed.png" not in names
    assert "objects_timeline.png" in names
