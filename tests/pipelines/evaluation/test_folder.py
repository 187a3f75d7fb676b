"""Evaluation of result folders, from their files alone."""

import json
from dataclasses import replace

import numpy as np
import pytest

from pipelines.errors import FormatError
from pipelines.evaluation import evaluate_result, metrics_text
from pipelines.evaluation.table import STATISTICS
from pipelines.geometry import exp_se3, invert_T
from pipelines.io.result import ResultWriter, run_metrics
from pipelines.types import FrameResult, GroundTruth, StaticMap
from tests.frame_results import frame_result

STEP = exp_se3(np.array([0.0, 0.01, 0.0, 0.0, 0.0, 1.0]))
NO_MAP = StaticMap(
    np.empty((0, 3)),
    np.empty((0, 3), np.uint8),
    np.empty(0, np.int32),
    np.empty((0, 4, 4)),
    np.empty(0, np.int64),
)


def truth(n: int) -> GroundTruth:
    Ts = np.array([np.linalg.matrix_power(STEP, k) for k in range(n)])
    return GroundTruth(np.arange(n) * 0.1, Ts)


def results(n: int, jump_at: int, left_out: tuple[int, ...] = ()) -> list[FrameResult]:
    """Exact poses with a jump of 1 m before frame `jump_at`; frames left out were unreadable."""
    out = []
    for k in range(n):
        T = np.linalg.matrix_power(STEP, k)
        T[1, 3] += float(k >= jump_at)
        out.append(frame_result(k, T, timings_ms={"total": 20.0}))
    return [r for r in out if r.frame_index not in left_out]


def write(folder, frames, gt) -> ResultWriter:
    writer = ResultWriter(folder)
    writer.write_run(frames, NO_MAP, gt)
    run = run_metrics(frames, NO_MAP, sequence="s", dataset="vdo")
    writer.write_metrics({"run": run, "extra": {"a": 1}}, "")
    return writer


def test_camera_block_is_renewed_and_others_stay(tmp_path):
    write(tmp_path, results(20, jump_at=8), truth(20))
    metrics = evaluate_result(tmp_path)
    assert metrics["camera"]["rpe_pairs"] == 19
    assert metrics["camera"]["rpe_trans_max_m"] == pytest.approx(1.0, abs=1e-6)
    assert metrics["run"]["sequence"] == "s"
    assert metrics["extra"] == {"a": 1}
    assert json.loads((tmp_path / "metrics.json").read_text()) == metrics
    text = (tmp_path / "metrics.txt").read_text()
    row = next(line for line in text.splitlines() if line.startswith("RPE, translation"))
    assert f" {metrics['camera']['rpe_trans_rmse_m']:.5f} " in row
    assert row.endswith("m a frame")
    assert "20.0  ms" in text
    assert evaluate_result(tmp_path) == metrics


def test_a_pair_over_a_skipped_frame_does_not_count(tmp_path):
    write(tmp_path, results(20, jump_at=8, left_out=(7, 8)), truth(20))
    metrics = evaluate_result(tmp_path)
    assert metrics["camera"]["frames_matched"] == 18
    assert metrics["camera"]["rpe_pairs"] == 16
    assert metrics["camera"]["rpe_trans_max_m"] < 1e-6


def test_a_pair_over_unknown_truth_does_not_count(tmp_path):
    gt = truth(20)
    gt.Ts_world_camera[[7, 8]] = np.nan
    write(tmp_path, results(20, jump_at=8), gt)
    metrics = evaluate_result(tmp_path)
    assert metrics["camera"]["rpe_pairs"] == 16
    assert metrics["camera"]["rpe_trans_max_m"] < 1e-6


def test_no_truth_no_camera_block(tmp_path):
    write(tmp_path, results(5, jump_at=9), None)
    assert "camera" not in evaluate_result(tmp_path)
    assert "No ground truth" in (tmp_path / "metrics.txt").read_text()


def test_no_folder(tmp_path):
    with pytest.raises(FormatError, match="expected a result folder"):
        evaluate_result(tmp_path / "gone")


def test_text_has_only_what_there_is():
    text = metrics_text(
        {"run": {"frames": 3, "tracked": 2}, "camera": {"ate_rmse_m": 0.5, "ate_max_m": None}}
    )
    frames, blank, heading, ate = text.splitlines()
    assert frames.split() == ["Frames", "2", "of", "3", "tracked"]
    assert blank == ""
    assert heading.split()[-1] == "largest"
    assert ate.split()[-2:] == ["0.5000", "m"]
    assert metrics_text({}).startswith("No metrics")


def test_values_stand_under_their_headings():
    camera = {f"ate_{name}_m": value for name, value in zip(STATISTICS, (4, 3, 2, 5), strict=True)}
    camera["step_length_ratio"] = 1.01
    run = {"sequence": "a_name_that_is_wider_than_80_columns" + 60 * "_"}
    heading, ate, ratio = metrics_text({"run": run, "camera": camera}).splitlines()[2:]
    for words, value in (("RMSE", "4.0000"), ("mean", "3.0000"), ("largest", "5.0000")):
        assert ate[: heading.index(words) + len(words)].endswith(value)
    assert ratio[: heading.index("RMSE") + 4].endswith("1.0100")
    assert len(ate) < 80


def write_objects_run(folder, world, index, noise=lambda objects: objects) -> None:
    """A run over the frames `index` of the small world, with its truth, as files."""
    estimates = noise(world.estimates(index))
    frames = [
        frame_result(
            k,
            invert_T(world.cameras[index[0]]) @ world.cameras[k],
            timestamp_s=float(world.stamps[k]),
            objects=estimates[estimates.frame_index == k],
            timings_ms={"total": 20.0},
        )
        for k in index.tolist()
    ]
    gt = GroundTruth(world.stamps, world.cameras, world.truth())
    write(folder, frames, gt)


@pytest.mark.parametrize("index", [np.arange(30), np.arange(0, 30, 2)], ids=["all", "stride 2"])
def test_objects_are_evaluated_from_files_alone(tmp_path, world, index):
    write_objects_run(tmp_path, world, index)
    found = evaluate_result(tmp_path)["objects"]
    assert found["object_frames"] == 2 * (len(index) - 1)
    assert found["motion"]["trans_max_m"] < 1e-7  # what the digits of the files leave
    assert found["coverage"]["share"] == found["tracking"]["mota"] == 1.0
    (tmp_path / "timings.json").unlink()  # the frames are then those of objects.csv
    again = evaluate_result(tmp_path)["objects"]
    assert again["object_frames"] == found["object_frames"]
    assert again["motion"]["trans_max_m"] < 1e-7
    assert again["coverage"] == found["coverage"]
    (tmp_path / "objects_gt.csv").unlink()
    assert "objects" not in evaluate_result(tmp_path)


def test_a_run_that_starts_later_has_another_world(tmp_path, world):
    """Its world is its first camera; estimates in the old world would be far off."""
    index = np.arange(5, 30)
    T = invert_T(world.cameras[5])

    def moved(objects):
        return replace(
            objects,
            Hs_world_curr_prev=T @ objects.Hs_world_curr_prev @ invert_T(T),
            Ts_world_object=T @ objects.Ts_world_object,
        )

    write_objects_run(tmp_path, world, index, moved)
    found = evaluate_result(tmp_path)["objects"]
    assert found["motion"]["trans_max_m"] < 1e-7
    assert found["pose"]["trans_max_m"] < 1e-7


def test_the_table_shows_objects(tmp_path, world):
    write_objects_run(tmp_path, world, np.arange(30))
    metrics = evaluate_result(tmp_path)
    text = (tmp_path / "metrics.txt").read_text()
    assert "Objects     3 tracked (3 car), 2 of them seen moving" in text
    for label in ("Motion, translation", "Motion, rotation", "Speed  ", "Pose, translation"):
        row = next(line for line in text.splitlines() if line.startswith(label))
        assert len(row.split()) >= 6
    coverage = metrics["objects"]["coverage"]
    assert f"Coverage      100.0 % ({coverage['found']} of {coverage['truth']} with > 3" in text
    assert "MOTA 1.000, IDF1 1.000, 0 ID switches" in text
    of_objects = text[text.index("Object errors") : text.index("Time a frame")]
    assert [line for line in of_objects.splitlines() if len(line) >= 80] == []
