"""The run loop: which frames it takes, what it writes, and whom it tells."""

from __future__ import annotations

import dataclasses
import json
import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.errors import DatasetError
from pipelines.io.config import config_to_dict, load_config
from pipelines.io.ply import read_point_cloud
from pipelines.io.result import Result, load_result
from pipelines.io.trajectory import read_tum
from pipelines.runner import run
from pipelines.types import Frame, FrameResult, TrackingStatus
from tests.pipelines.result_files import ESTIMATES, estimates, names_in

FILES = {
    *ESTIMATES,
    "config.yaml",
    "metrics.json",
    "metrics.txt",
    "timings.json",
    "run.log",
    "camera_gt_tum.txt",
    "objects_gt.csv",
}
BATCH = {"front_end", "observations", "camera_std.csv"}
TRAJECTORIES = {"objects"}  # a folder, where there was an object


class Witness:
    """A sink that notes what it is told, and can raise at a frame."""

    def __init__(self, at: int | None = None, error: BaseException | None = None) -> None:
        self.at, self.error = at, error
        self.told: list[str] = []
        self.frames: list[tuple[Frame, FrameResult]] = []
        self.start_arguments: tuple[Any, ...] = ()

    def start(self, *arguments: Any) -> None:
        self.told.append("start")
        self.start_arguments = arguments

    def frame(self, frame: Frame, result: FrameResult) -> None:
        self.told.append("frame")
        self.frames.append((frame, result))
        if self.error is not None and frame.index == self.at:
            raise self.error

    def finish(self) -> None:
        self.told.append("finish")


def poses_of(path: Path) -> Any:
    from evo.tools import file_interface

    return file_interface.read_tum_trajectory_file(path)


@pytest.fixture(scope="module")
def whole(street, tmp_path_factory) -> tuple[Result, Witness]:
    """A run of all frames with a witness; not to be changed by tests."""
    witness = Witness()
    folder = tmp_path_factory.mktemp("whole") / "result"
    return run(street, output=folder, sinks=[witness]), witness


# ----------------------------------------------------------- result folder


def test_the_folder_holds_the_files_of_the_design_and_no_others(whole) -> None:
    folder = whole[0].folder
    assert names_in(folder) == FILES | TRAJECTORIES | BATCH
    ids = np.unique(whole[0].objects.object_id)
    assert len(ids) > 5
    written = {path.name for path in (folder / "objects").iterdir()}
    assert {name[:4] for name in written} == {f"{i:03d}_" for i in ids}
    assert {name[4:] for name in written} == {"car_tum.txt", "person_tum.txt"}


def test_evo_reads_both_trajectories_and_they_agree(whole, street) -> None:
    from evo.tools import file_interface

    folder = whole[0].folder
    tum = poses_of(folder / "camera_tum.txt")
    kitti = file_interface.read_kitti_poses_file(folder / "camera_kitti.txt")
    assert tum.num_poses == kitti.num_poses == len(street)
    assert tum.check()[0]
    np.testing.assert_allclose(tum.timestamps, street.timestamps_s, atol=1e-9)
    np.testing.assert_allclose(tum.poses_se3, kitti.poses_se3, atol=1e-7)


def test_truth_is_written_in_the_estimates_world(whole, street) -> None:
    truth = poses_of(whole[0].folder / "camera_gt_tum.txt")
    assert truth.num_poses == len(street)
    np.testing.assert_allclose(truth.poses_se3[0], np.eye(4), atol=1e-8)
    true_end_m = street.ground_truth().Ts_world_camera[-1][:3, 3]
    np.testing.assert_allclose(truth.positions_xyz[-1], true_end_m, atol=1e-6)
    estimated_end_m = whole[0].Ts_world_camera[-1][:3, 3]
    assert 1e-6 < np.linalg.norm(estimated_end_m - true_end_m) < 0.05


def test_errors_in_the_metrics_are_what_evo_finds(whole) -> None:
    from evo.core import metrics

    folder = whole[0].folder
    truth, estimate = poses_of(folder / "camera_gt_tum.txt"), poses_of(folder / "camera_tum.txt")
    rpe = metrics.RPE(metrics.PoseRelation.translation_part, 1, metrics.Unit.frames)
    rpe.process_data((truth, estimate))
    ours = whole[0].metrics["camera"]["rpe_trans_rmse_m"]
    assert ours == pytest.approx(rpe.get_statistic(metrics.StatisticsType.rmse), rel=0.01)


def test_metrics_count_the_frames(whole, street) -> None:
    counts = whole[0].metrics["run"]
    expected = {"frames": len(street), "tracked": len(street), "lost": 0, "skipped": 0}
    assert {name: counts[name] for name in expected} == expected
    assert counts["interrupted"] is False
    assert (counts["sequence"], counts["dataset"]) == ("street", "simulated")
    assert sum(counts["hypotheses"].values()) == len(street)
    assert counts["map_points"] == len(whole[0].static_points_m) > 100


def test_metrics_for_people_hold_those_for_programs(whole) -> None:
    text = (whole[0].folder / "metrics.txt").read_text()
    assert "ATE" in text
    assert f"{whole[0].metrics['camera']['ate_rmse_m']:.4f}" in text


def test_timings_have_an_entry_a_frame(whole, street) -> None:
    timings = json.loads((whole[0].folder / "timings.json").read_text())
    assert timings["total"]["n"] == len(street)
    assert timings["frames_index"] == list(range(len(street)))
    assert timings["frames_status"] == ["OK"] * len(street)


def test_config_is_saved_resolved_and_starts_the_same_run(street, tmp_path) -> None:
    config = load_config(None, ["orb.n_features=500", "tracking.seed=7"])
    result = run(street, config, tmp_path / "one", frames=3)
    again = load_config(result.folder / "config.yaml")
    assert again == config
    assert result.config == config_to_dict(config)


def test_the_log_has_a_line_a_frame(whole, street) -> None:
    log = (whole[0].folder / "run.log").read_text()
    for k in range(len(street)):
        assert f"frame {k} OK" in log
    assert not logging.getLogger("dyob").handlers


def test_the_map_has_colours_of_the_street(whole) -> None:
    points, colors = read_point_cloud(whole[0].folder / "static_map.ply")
    assert np.isfinite(points).all()
    assert colors.std(axis=0).min() > 5  # not one grey for all


def test_by_default_results_get_a_folder_and_the_link_latest(street, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    first = run(street, frames=2)
    second = run(street, frames=2)
    results = tmp_path / "results"
    assert first.folder.parent == second.folder.parent == results.resolve()
    assert first.folder != second.folder
    assert first.folder.name.endswith("-street")
    assert (results / "latest").is_symlink()
    assert (results / "latest").resolve() == second.folder
    assert load_result(results / "latest").folder == second.folder


def test_lost_frames_are_in_the_kitti_file_but_not_in_the_tum_file(
    street, tmp_path, altered
) -> None:
    def alter(frame: Frame) -> Frame:
        frame = dataclasses.replace(frame, flow_prev_to_curr_px=None)
        if 5 <= frame.index < 7:
            frame = dataclasses.replace(frame, image=np.zeros_like(frame.image))
        return frame

    result = run(altered(street, alter), output=tmp_path / "result", frames=10)
    assert result.timings["frames_status"].count(TrackingStatus.LOST) == 2
    assert result.metrics["run"]["lost"] == 2
    assert poses_of(result.folder / "camera_tum.txt").num_poses == 8
    assert len((result.folder / "camera_kitti.txt").read_text().splitlines()) == 10
    np.testing.assert_allclose(
        result.timestamps_s, np.delete(street.timestamps_s[:10], [5, 6]), atol=1e-9
    )


# ------------------------------------------------------------------- frames


def test_start_frames_and_stride_choose_the_frames(street, tmp_path) -> None:
    witness = Witness()
    result = run(street, output=tmp_path / "some", start=3, frames=5, stride=2, sinks=[witness])
    chosen = [3, 5, 7, 9, 11]
    assert [frame.index for frame, _ in witness.frames] == chosen
    assert witness.start_arguments[1] == 5
    assert result.metrics["run"]["frames"] == 5
    truth = poses_of(result.folder / "camera_gt_tum.txt")
    np.testing.assert_allclose(
        poses_of(result.folder / "camera_tum.txt").timestamps, truth.timestamps[::2]
    )
    np.testing.assert_allclose(result.timestamps_s, street.timestamps_s[chosen], atol=1e-9)


def test_fewer_frames_than_asked_for_are_no_error(street, tmp_path) -> None:
    result = run(street, output=tmp_path / "end", start=len(street) - 2, frames=50)
    assert result.metrics["run"]["frames"] == 2


def test_flow_between_frames_that_are_not_neighbours_is_not_used(street, tmp_path, altered) -> None:
    """The bytes are those of a run whose sequence brings flow for no frame at all."""

    def no_flow(frame: Frame) -> Frame:
        return dataclasses.replace(frame, flow_prev_to_curr_px=None)

    span = {"start": 2, "frames": 4, "stride": 2}
    given = run(street, output=tmp_path / "given", **span)
    none = run(altered(street, no_flow), output=tmp_path / "none", **span)
    assert estimates(given.folder) == estimates(none.folder)
    neighbours = {"start": 2, "frames": 4}
    given = run(street, output=tmp_path / "a", **neighbours)
    none = run(altered(street, no_flow), output=tmp_path / "b", **neighbours)
    assert estimates(given.folder) != estimates(none.folder)  # else nothing was compared


def test_dropped_frames_are_tracked_across(street, tmp_path) -> None:
    """Every second frame: steps of 1.8 m, and no flow to follow them by."""
    result = run(street, output=tmp_path / "result", stride=2)
    assert result.metrics["run"]["tracked"] == len(street) // 2
    assert 1e-4 < result.metrics["camera"]["rpe_trans_rmse_m"] < 0.1


@pytest.mark.parametrize(
    ("span", "found"),
    [
        ({"start": 20}, "start 20"),
        ({"start": -1}, "start -1"),
        ({"stride": 0}, "stride 0"),
        ({"stride": -2}, "stride -2"),
        ({"frames": 0}, "frames 0"),
        ({"frames": -3}, "frames -3"),
    ],
)
def test_a_span_without_frames_is_an_error_that_says_so(street, tmp_path, span, found) -> None:
    with pytest.raises(DatasetError, match=r"expected frames within 0 to 19.*") as raised:
        run(street, output=tmp_path / "none", **span)
    assert found in str(raised.value)
    assert not (tmp_path / "none").exists()


# -------------------------------------------------------------------- sinks


def test_sinks_are_told_of_the_start_each_frame_and_the_end(whole, street) -> None:
    result, witness = whole
    assert witness.told == ["start"] + ["frame"] * len(street) + ["finish"]
    sequence, n_frames, config, folder = witness.start_arguments
    assert (sequence, n_frames, folder) == (street, len(street), result.folder)
    assert config_to_dict(config) == result.config
    for k, (frame, frame_result) in enumerate(witness.frames):
        assert frame.index == frame_result.frame_index == k


def test_every_sink_is_told(street, tmp_path) -> None:
    witnesses = [Witness(), Witness()]
    run(street, output=tmp_path / "result", frames=2, sinks=iter(witnesses))
    assert [w.told for w in witnesses] == [["start", "frame", "frame", "finish"]] * 2


def test_sinks_are_finished_though_one_fails(street, tmp_path) -> None:
    failing, other = Witness(2, RuntimeError("no more paper")), Witness()
    with pytest.raises(RuntimeError, match="no more paper"):
        run(street, output=tmp_path / "result", sinks=[other, failing])
    assert other.told == ["start", "frame", "frame", "frame", "finish"]
    assert failing.told[-1] == "finish"
    assert not logging.getLogger("dyob").handlers


def test_sinks_are_finished_though_the_sequence_fails(street, tmp_path, altered) -> None:
    def fail(frame: Frame) -> Frame:
        if frame.index == 2:
            raise ZeroDivisionError("a defect")
        return frame

    witness = Witness()
    with pytest.raises(ZeroDivisionError):
        run(altered(street, fail), output=tmp_path / "result", sinks=[witness])
    assert witness.told == ["start", "frame", "frame", "finish"]


# -------------------------------------------------------------- interruption


@pytest.mark.parametrize("at", [0, 1, 7])
def test_ctrl_c_leaves_the_frames_done_so_far(street, tmp_path, whole, at: int) -> None:
    witness = Witness(at, KeyboardInterrupt())
    result = run(street, output=tmp_path / "partial", sinks=[witness])
    assert witness.told == ["start"] + ["frame"] * (at + 1) + ["finish"]
    left = FILES | TRAJECTORIES | {"observations", "checkpoint"}  # no batch
    assert names_in(result.folder) == left
    counts = result.metrics["run"]
    assert counts["interrupted"] is True
    assert counts["frames"] == counts["tracked"] == at + 1
    partial = poses_of(result.folder / "camera_tum.txt")
    assert partial.num_poses == at + 1
    _, by_front_end = read_tum(whole[0].folder / "front_end" / "camera_tum.txt")
    np.testing.assert_array_equal(result.Ts_world_camera, by_front_end[: at + 1])
    assert poses_of(result.folder / "camera_gt_tum.txt").num_poses == at + 1
    assert "interrupted" in (result.folder / "run.log").read_text()


def test_ctrl_c_before_the_first_frame_leaves_a_valid_folder(street, tmp_path, altered) -> None:
    def interrupt(frame: Frame) -> Frame:
        raise KeyboardInterrupt

    result = run(altered(street, interrupt), output=tmp_path / "nothing")
    assert result.metrics["run"]["interrupted"] is True
    assert result.metrics["run"]["frames"] == len(result.timestamps_s) == 0
    assert load_result(tmp_path / "nothing").Ts_world_camera.shape == (0, 4, 4)


# -------------------------------------------------------------- determinism


def test_two_runs_give_the_same_bytes(street, tmp_path, whole) -> None:
    again = run(street, output=tmp_path / "again")
    assert estimates(again.folder) == estimates(whole[0].folder)


def test_the_number_of_sinks_changes_no_byte(street, tmp_path, whole) -> None:
    alone = run(street, output=tmp_path / "alone", sinks=[])
    assert estimates(alone.folder) == estimates(whole[0].folder)
