"""Result folders: what is written, what is read back, partial and damaged ones."""

import logging

import numpy as np
import pytest

from pipelines.errors import DyObError, FormatError
from pipelines.geometry import exp_se3, make_T
from pipelines.io.folder import clear_result_folder
from pipelines.io.result import ResultWriter, create_result_folder, load_result, run_metrics
from pipelines.io.trajectory import read_kitti, read_tum
from pipelines.types import (
    FrameResult,
    GroundTruth,
    MotionHypothesis,
    StaticMap,
    TrackingStatus,
)


def poses(n: int) -> np.ndarray:
    step = exp_se3(np.array([0.0, 0.02, 0.0, 0.05, 0.0, 0.9]))
    return np.array([np.linalg.matrix_power(step, k) for k in range(n)])


def frame_results(n: int, lost: tuple[int, ...] = ()) -> list[FrameResult]:
    return [
        FrameResult(
            frame_index=k,
            timestamp_s=0.1 * k,
            status=TrackingStatus.LOST if k in lost else TrackingStatus.OK,
            T_world_camera=T,
            pose_covariance=np.eye(6),
            hypothesis=MotionHypothesis.NONE if k in lost else MotionHypothesis.CONSTANT_VELOCITY,
            is_keyframe=k % 3 == 0,
            keypoints_px=np.zeros((4, 2)),
            point_ids=np.arange(4),
            inliers=np.array([True, True, True, False]),
            reprojection_rmse_px=0.5,
            timings_ms={"orb": 10.0 + k, "pose": 1.0, "total": 12.0 + k},
        )
        for k, T in enumerate(poses(n))
    ]


def static_map(n: int = 6) -> StaticMap:
    return StaticMap(
        np.arange(3.0 * n).reshape(n, 3),
        np.full((n, 3), 77, np.uint8),
        np.full(n, 2, np.int32),
        poses(2),
        np.array([0, 3]),
    )


def test_folders_are_unique_and_latest_follows(tmp_path):
    folders = [create_result_folder(tmp_path / "results", "a/b c") for _ in range(3)]
    assert len(set(folders)) == 3
    assert all(folder.is_dir() and "a_b_c" in folder.name for folder in folders)
    latest = tmp_path / "results" / "latest"
    assert latest.is_symlink()
    assert latest.resolve() == folders[-1].resolve()
    assert not latest.readlink().is_absolute()  # a moved results/ keeps its link


def test_an_output_that_is_a_file(tmp_path):
    (tmp_path / "results").write_text("")
    with pytest.raises(DyObError, match="expected a folder to put results in"):
        create_result_folder(tmp_path / "results", "run")


def test_an_output_with_other_files_is_left_alone(tmp_path):
    (tmp_path / "frames").mkdir()
    picture = tmp_path / "frames" / "000000.png"
    picture.write_bytes(b"dear")
    with pytest.raises(DyObError, match=r"expected a new or empty folder.*found frames in it"):
        clear_result_folder(tmp_path)
    assert picture.read_bytes() == b"dear"
    (tmp_path / "run.log").touch()  # a run was here: its pictures are replaced
    clear_result_folder(tmp_path)
    assert not picture.exists()
    clear_result_folder(tmp_path / "new" / "folder")
    assert (tmp_path / "new" / "folder").is_dir()
    (tmp_path / "file").touch()
    with pytest.raises(DyObError, match="found a file; choose another --output"):
        clear_result_folder(tmp_path / "file")


def test_round_trip(tmp_path):
    folder = create_result_folder(tmp_path, "street")
    writer = ResultWriter(folder)
    results = frame_results(9, lost=(4,))
    T_any = make_T(exp_se3(np.array([0.3, -0.2, 0.9, 0, 0, 0]))[:3, :3], np.array([5.0, -3.0, 9.0]))
    truth = GroundTruth(np.arange(20) * 0.1, T_any @ poses(20))
    writer.write_config({"orb": {"n_features": 5}})
    writer.write_run(results, static_map(), truth)
    writer.write_metrics({"run": {"frames": 9}}, "table\n")

    result = load_result(tmp_path / "latest")
    assert result.folder == folder.resolve()
    ok = [0, 1, 2, 3, 5, 6, 7, 8]
    np.testing.assert_allclose(result.timestamps_s, np.array(ok) * 0.1, atol=1e-9)
    np.testing.assert_allclose(result.Ts_world_camera, poses(9)[ok], atol=1e-8)
    # The truth is moved into the world of the first camera, and ends where the run does.
    np.testing.assert_allclose(result.gt_Ts_world_camera, poses(9), atol=1e-8)
    np.testing.assert_allclose(result.static_points_m, static_map().points_m, atol=1e-6)
    assert result.static_colors.tolist() == static_map().colors.tolist()
    assert result.metrics == {"run": {"frames": 9}}
    assert result.config == {"orb": {"n_features": 5}}
    assert result.timings["orb"] == {
        "median_ms": 14.0,
        "mean_ms": 14.0,
        "p95_ms": pytest.approx(17.6),
        "max_ms": 18.0,
        "n": 9,
    }
    assert result.timings["frames_total_ms"] == [12.0 + k for k in range(9)]
    assert result.timings["frames_status"][4] == "LOST"


def test_kitti_file_has_a_row_for_every_frame(tmp_path):
    ResultWriter(tmp_path).write_camera(frame_results(7, lost=(2, 3)))
    np.testing.assert_allclose(read_kitti(tmp_path / "camera_kitti.txt"), poses(7), atol=1e-8)
    assert len(read_tum(tmp_path / "camera_tum.txt")[0]) == 5


def test_truth_that_starts_late_meets_the_estimate_there(tmp_path):
    Ts = poses(8).copy()
    Ts[:3] = np.nan
    ResultWriter(tmp_path).write_ground_truth(frame_results(8), GroundTruth(np.arange(8) * 0.1, Ts))
    stamps, Ts_read = read_tum(tmp_path / "camera_gt_tum.txt")
    np.testing.assert_allclose(stamps, np.arange(3, 8) * 0.1, atol=1e-9)
    np.testing.assert_allclose(Ts_read, poses(8)[3:], atol=1e-8)


def test_every_partial_run_is_a_valid_result(tmp_path):
    writer = ResultWriter(tmp_path / "r")
    truth = GroundTruth(np.arange(5) * 0.1, poses(5))
    for n in range(4):
        writer.write_run(frame_results(n), static_map(n), truth)
        result = load_result(tmp_path / "r")
        assert len(result.timestamps_s) == n
        assert len(result.static_points_m) == n
        assert len(result.timings["frames_total_ms"]) == n


def test_only_the_trajectory_is_needed(tmp_path):
    ResultWriter(tmp_path).write_camera(frame_results(3))
    result = load_result(tmp_path)
    assert result.gt_Ts_world_camera is None
    assert result.static_points_m.shape == (0, 3)
    assert result.metrics == {}


def test_what_is_no_result_folder(tmp_path):
    with pytest.raises(FormatError, match="found nothing; run a sequence first"):
        load_result(tmp_path / "gone")
    with pytest.raises(FormatError, match=r"camera_tum\.txt.*run a sequence first"):
        load_result(tmp_path)
    (tmp_path / "file").write_text("")
    with pytest.raises(FormatError, match="found a file"):
        load_result(tmp_path / "file")
    (tmp_path / "latest").symlink_to("deleted")
    with pytest.raises(FormatError, match="its target is gone"):
        load_result(tmp_path / "latest")


def test_the_folder_above_is_told_of_latest(tmp_path):
    ResultWriter(create_result_folder(tmp_path, "a")).write_camera(frame_results(2))
    with pytest.raises(FormatError, match=r"did you mean .*latest"):
        load_result(tmp_path)


def test_damaged_files_are_named(tmp_path):
    ResultWriter(tmp_path).write_run(frame_results(3), static_map())
    (tmp_path / "timings.json").write_text("{")
    with pytest.raises(FormatError, match=r"timings\.json"):
        load_result(tmp_path)


def test_log_file_lasts_as_long_as_the_run(tmp_path):
    writer = ResultWriter(tmp_path)
    logger = logging.getLogger("dyob.test")
    level = logging.getLogger("dyob").level
    with writer.log_to_file():
        logger.info("frame 3 was skipped")
    logger.warning("after the run")
    text = (tmp_path / "run.log").read_text()
    assert "frame 3 was skipped" in text
    assert "after the run" not in text
    assert logging.getLogger("dyob").level == level
    assert not [h for h in logging.getLogger("dyob").handlers if hasattr(h, "baseFilename")]


def test_run_metrics_count():
    metrics = run_metrics(
        frame_results(9, lost=(4, 5)), static_map(), sequence="s", dataset="vdo", skipped=1
    )
    assert metrics["frames"] == 10
    assert (metrics["tracked"], metrics["lost"], metrics["skipped"]) == (7, 2, 1)
    assert metrics["hypotheses"] == {"constant_velocity": 7, "none": 2}
    assert metrics["keyframes"] == 2
    assert metrics["interrupted"] is False
