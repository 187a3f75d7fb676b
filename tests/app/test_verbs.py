"""Each verb in a process of its own, on a few simulated frames; its files re-read by evo."""

from __future__ import annotations

import csv
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
ENVIRONMENT = {**os.environ, "DYOB_NO_SETUP": "1"}
N_FRAMES = 5


def app(*words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "app", *map(str, words)]
    return subprocess.run(
        command, cwd=ROOT, env=ENVIRONMENT, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def result(tmp_path_factory) -> Path:
    """The folder of one short run."""
    folder = tmp_path_factory.mktemp("results") / "short"
    done = app("run", "simulated:demo", "--frames", N_FRAMES, "--output", folder, "--quiet")
    assert done.returncode == 0, done.stdout + done.stderr
    assert Path(done.stdout.strip()) == folder
    return folder


def test_run_writes_a_trajectory_that_evo_reads(result: Path) -> None:
    from evo.tools import file_interface

    trajectory = file_interface.read_tum_trajectory_file(result / "camera_tum.txt")
    truth = file_interface.read_tum_trajectory_file(result / "camera_gt_tum.txt")
    assert trajectory.num_poses == truth.num_poses == N_FRAMES
    assert trajectory.check()[0]
    assert abs(trajectory.path_length - truth.path_length) < 0.05 * truth.path_length


def test_run_counts_what_it_did(result: Path) -> None:
    counts = json.loads((result / "metrics.json").read_text())["run"]
    assert (counts["frames"], counts["tracked"], counts["lost"]) == (N_FRAMES, N_FRAMES, 0)
    assert counts["interrupted"] is False


def test_run_annotates_each_frame(result: Path) -> None:
    names = [file.name for file in sorted((result / "frames").iterdir())]
    assert names == [f"{index:06d}.jpg" for index in range(N_FRAMES)]


def test_run_leaves_its_objects_as_points(result: Path) -> None:
    """After its batch too; they are where boxes of the objects were, in the colours of ids."""
    from pipelines.io.ply import read_point_cloud
    from pipelines.object_colors import object_color

    points_m, colors = read_point_cloud(result / "objects_map.ply")
    with (result / "objects.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["center_x_m"] and row["L_tx_m"]]
    ids = {int(row["object_id"]) for row in rows}
    assert len(points_m) > 200
    assert {tuple(color) for color in colors.tolist()} <= {object_color(j) for j in ids}
    best = max(rows, key=lambda row: int(row["n_points"]))
    own = points_m[(colors == object_color(int(best["object_id"]))).all(1)]
    center = [float(best[f"center_{axis}_m"]) for axis in "xyz"]
    assert np.linalg.norm(np.median(own, axis=0) - center) < 2.0


def test_eval_restores_metrics_that_were_lost(result: Path) -> None:
    before = json.loads((result / "metrics.json").read_text())
    damaged = {key: value for key, value in before.items() if key != "camera"}
    (result / "metrics.json").write_text(json.dumps(damaged))
    done = app("eval", result)
    assert done.returncode == 0, done.stderr
    assert "ATE" in done.stdout
    after = json.loads((result / "metrics.json").read_text())
    assert after["camera"] == pytest.approx(before["camera"], nan_ok=True)


def test_render_draws_pictures_of_the_size_asked_for(result: Path) -> None:
    import cv2

    done = app("render", result, "--size", "320x200", "--video")
    assert done.returncode == 0, done.stderr
    files = [Path(line) for line in done.stdout.splitlines() if line.endswith(".png")]
    diagrams = [file for file in files if file.parent.name == "plots"]
    # No speeds: four steps are too few to draw
    names = {"trajectory", "rpe", "timings", "objects_timeline", "objects_motion"}
    assert {file.stem for file in diagrams} == names
    maps = [file for file in files if file.parent.name == "renders"]
    assert len(maps) == 5
    for file in maps:
        image = cv2.imread(str(ROOT / file))
        assert image.shape == (200, 320, 3)
        assert image.std() > 1.0, f"{file} is empty"
    (video,) = [Path(line) for line in done.stdout.splitlines() if line.endswith(".mp4")]
    reader = cv2.VideoCapture(str(ROOT / video))
    assert int(reader.get(cv2.CAP_PROP_FRAME_COUNT)) == N_FRAMES
    assert reader.get(cv2.CAP_PROP_FPS) == pytest.approx(10.0)
    ok, first = reader.read()
    assert ok and first.shape[1] == 320 and first.std() > 10.0
    assert "report.html" in done.stdout


def test_eval_renews_the_report_where_there_is_one(result: Path) -> None:
    report = result / "report.html"
    report.write_text("of an earlier evaluation")
    assert app("eval", result).returncode == 0
    assert "ATE, SE(3) aligned" in report.read_text(encoding="utf-8")


def test_ctrl_c_leaves_a_valid_partial_result(tmp_path: Path) -> None:
    folder = tmp_path / "partial"
    command = [sys.executable, "-m", "app", "run", "simulated:demo", "--output", str(folder)]
    with subprocess.Popen(
        command, cwd=ROOT, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as running:
        log = folder / "run.log"
        deadline = time.monotonic() + 120
        while not (log.exists() and "frame 2 " in log.read_text()):
            assert running.poll() is None, "ended before its third frame"
            assert time.monotonic() < deadline, "did not reach its third frame"
            time.sleep(0.01)
        running.send_signal(signal.SIGINT)
        said = running.communicate(timeout=120)[0].decode()
    counts = json.loads((folder / "metrics.json").read_text())["run"]
    if running.returncode == 0 and counts["frames"] == 40:
        pytest.skip("the run had finished before the signal came")
    assert running.returncode == 130
    assert "Stopped before the end" in said
    assert counts["interrupted"] is True
    assert 3 <= counts["frames"] < 40
    lines = (folder / "camera_tum.txt").read_text().splitlines()
    assert len([line for line in lines if line[0] != "#"]) == counts["tracked"]


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["run", "no/such/folder"], "no/such/folder"),
        (["run", "simulated:demo", "--config", "no.yaml"], "cannot read the settings file no.yaml"),
        (["run", "simulated:demo", "--set", "orb.n_feature=3"], "'orb.n_features'"),
        (["run", ".", "--dataset", "vd"], "vdo"),
        (["run", "simulated:demo", "--resume", "--output", "no/such"], "of an interrupted run"),
        (["eval", "no/such/result"], "expected a result folder, found nothing"),
        (["render", "no/such/result"], "expected a result folder, found nothing"),
    ],
)
def test_bad_input_is_code_2_and_a_sentence(words: list[str], sentence: str) -> None:
    done = app(*words)
    assert done.returncode == 2, done.stdout + done.stderr
    assert sentence in done.stderr
    assert "Traceback" not in done.stderr


def test_optimize_starts_from_the_front_end_however_often(tmp_path: Path) -> None:
    """The run's own batch and two more give the same; the front-end's answers stay beside."""
    result = tmp_path / "worn"  # where there is something to make better
    how = ("--degrade", "--frames", N_FRAMES, "--pictures", 0, "--output", result, "--quiet")
    run = app("run", "simulated:demo", *how)
    assert run.returncode == 0, run.stdout + run.stderr
    kept = (result / "front_end" / "camera_tum.txt").read_text()
    by_run = (result / "camera_tum.txt").read_text()
    assert by_run != kept
    for _ in range(2):
        done = app("optimize", result, "--quiet")
        assert done.returncode == 0, done.stdout + done.stderr
        assert (result / "camera_tum.txt").read_text() == by_run
        assert (result / "front_end" / "camera_tum.txt").read_text() == kept
    metrics = json.loads((result / "metrics.json").read_text())
    assert metrics["batch"]["accepted"] and metrics["batch"]["frames"] == N_FRAMES
    assert metrics["front_end"]["camera"]["ate_rmse_m"] > 0.0
    rows = (result / "camera_std.csv").read_text().splitlines()
    assert rows[0].startswith("frame,timestamp_s,std_rx_deg") and len(rows) == 1 + N_FRAMES
    partial = app("optimize", result, "--set", "batch.method=partial")
    assert partial.returncode == 0, partial.stdout + partial.stderr
    assert "Held-out sightings" in partial.stdout
    assert app("optimize", result, "--quiet").returncode == 0


def test_optimize_needs_what_the_run_recorded(tmp_path: Path) -> None:
    (tmp_path / "camera_tum.txt").write_text("0 0 0 0 0 0 0 1\n")
    done = app("optimize", tmp_path)
    assert done.returncode != 0
    assert "batch.record=true" in done.stderr
