"""`bench`: in a process of its own on a few frames, its files re-read; and what Ctrl-C leaves."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import cv2
import pytest

from app import bench, cli, console
from pipelines.errors import ConfigError

ROOT = Path(__file__).resolve().parents[2]
N_FRAMES = 8


def words(line: str):
    return cli.build_parser().parse_args(line.split())


def test_bench_measures_and_goes_on_after_a_failure(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "app", "bench", "simulated:demo", "no/such/data"]
    command += ["--frames", str(N_FRAMES), "--runs", "2", "--output", str(tmp_path / "b")]
    environment = {**os.environ, "DYOB_NO_SETUP": "1"}
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 1, done.stdout + done.stderr  # one of them failed
    assert "no/such/data" in done.stdout and "Traceback" not in done.stderr
    content = json.loads((tmp_path / "b" / "bench.json").read_text())
    demo, missing = content["sequences"]
    assert [run["state"] for run in demo["runs"]] == ["done", "done"]
    assert [run["state"] for run in missing["runs"]] == ["failed", "failed"]
    for run in demo["runs"]:
        metrics = json.loads((tmp_path / "b" / run["folder"] / "metrics.json").read_text())
        assert run["errors"]["ate_m"] == metrics["camera"]["ate_rmse_m"]
        assert run["errors"]["speed_kmh"] == metrics["objects"]["speed"]["error_mean_kmh"]
        assert run["frames"] == N_FRAMES
        assert run["timings"]["objects"]["median_ms"] > 0.0
        assert not (tmp_path / "b" / run["folder"] / "frames").exists()  # no pictures
    assert 0.0 < demo["mean"]["rpe_trans_m"] < 0.002
    text = (tmp_path / "b" / "bench.md").read_text()
    assert f"{demo['mean']['ate_m']:.4f}" in text and "on the clock" in done.stdout
    for name in ("errors_by_run.png", "speed_errors.png"):
        assert cv2.imread(str(tmp_path / "b" / "plots" / name)).shape[1] == 1350


@pytest.fixture
def interrupted_run(monkeypatch):
    """The benchmark's runs, of which the second hears Ctrl-C; how it takes it is to be set."""
    seen: list[int] = []
    how = {"swallow": False}

    def run(sequence, config, output, **options):
        seen.append(config.tracking.seed)
        if len(seen) == 2:
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt:
                if not how["swallow"]:
                    raise
        counts = {"frames": 5, "tracked": 5, "interrupted": False}
        return SimpleNamespace(metrics={"run": counts}, timings={})

    class Opened(SimpleNamespace):
        def __len__(self) -> int:
            return 9

    sequence = Opened(dataset="vdo", name="x", camera=SimpleNamespace(width=64, height=48))
    monkeypatch.setattr("pipelines.bench.benchmark.run", run)
    monkeypatch.setattr("pipelines.bench.cases.open_sequence", lambda *a, **o: sequence)
    monkeypatch.setattr(console, "warnings", nullcontext)
    return seen, how


@pytest.mark.parametrize("swallow", [False, True], ids=["while rendering", "within the batch"])
def test_ctrl_c_leaves_what_was_done(interrupted_run, tmp_path, capsys, swallow) -> None:
    seen, how = interrupted_run
    how["swallow"] = swallow
    before = signal.getsignal(signal.SIGINT)
    code = bench.bench(words(f"bench data --runs 5 --quiet --output {tmp_path / 'b'}"))
    assert code == 130 and seen == [0, 1]
    assert signal.getsignal(signal.SIGINT) is before
    content = json.loads((tmp_path / "b" / "bench.json").read_text())
    assert content["stopped"] is True
    assert [run["seed"] for run in content["sequences"][0]["runs"]] == ([0, 1] if swallow else [0])
    assert "Stopped before the end" in (tmp_path / "b" / "bench.md").read_text()
    assert capsys.readouterr().out == f"{tmp_path / 'b'}\n"


def test_flags_of_inputs_need_sequences_that_are_named(tmp_path) -> None:
    with pytest.raises(ConfigError, match="leave --degrade out"):
        bench.bench(words(f"bench --degrade --output {tmp_path / 'b'}"))
    with pytest.raises(ConfigError, match="data is none"):
        bench.bench(words(f"bench data --degrade --output {tmp_path / 'b'}"))
    assert not (tmp_path / "b").exists()
