"""Diagrams: those that the files allow, readable and not blank."""

import cv2
import numpy as np

from pipelines.geometry import exp_se3
from pipelines.io.result import ResultWriter
from pipelines.types import FrameResult, GroundTruth, MotionHypothesis, TrackingStatus
from viz import style
from viz.plots import plot_result


def write(folder, n: int, *, truth: bool, timings: bool = True) -> None:
    step = exp_se3(np.array([0.0, 0.05, 0.0, 0.0, 0.0, 1.0]))
    Ts = np.array([np.linalg.matrix_power(step, k) for k in range(n)]).reshape(-1, 4, 4)
    results = [
        FrameResult(
            frame_index=k,
            timestamp_s=0.1 * k,
            status=TrackingStatus.LOST if k == 7 else TrackingStatus.OK,
            T_world_camera=T,
            pose_covariance=np.eye(6),
            hypothesis=MotionHypothesis.NONE,
            is_keyframe=False,
            keypoints_px=np.empty((0, 2)),
            point_ids=np.empty(0, np.int64),
            inliers=np.empty(0, bool),
            reprojection_rmse_px=0.0,
            timings_ms={"orb": 9.0, "total": 12.0 + k % 3} if timings else {},
        )
        for k, T in enumerate(Ts)
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


def test_only_what_the_files_allow(tmp_path):
    write(tmp_path / "a", 30, truth=False)
    assert [path.name for path in plot_result(tmp_path / "a")] == ["trajectory.png", "timings.png"]
    write(tmp_path / "b", 0, truth=False)
    assert plot_result(tmp_path / "b") == []
    write(tmp_path / "c", 1, truth=True, timings=False)
    assert [path.name for path in plot_result(tmp_path / "c")] == ["trajectory.png"]
