"""The benchmark's loop: seeds, failures that stop nothing, and files after every run."""

from __future__ import annotations

import json
from types import SimpleNamespace
from typing import Any

import pytest

from pipelines.bench import benchmark
from pipelines.bench.benchmark import Benchmark
from pipelines.bench.cases import BenchCase, labels_of
from pipelines.config import Config
from pipelines.errors import ConfigError, DatasetError, DyObError


class Opened(SimpleNamespace):
    """In place of a sequence."""

    def __len__(self) -> int:
        return 40


@pytest.fixture
def opened(monkeypatch) -> list[tuple[str, dict[str, Any]]]:
    asked: list[tuple[str, dict[str, Any]]] = []

    def open_sequence(path, dataset=None, **options):
        if path == "gone":
            raise DatasetError("gone: expected a folder, found nothing; correct the path")
        options.pop("progress", None)
        asked.append((path, options))
        camera = SimpleNamespace(width=64, height=48)
        names = {"vdo_data": ("vdo", "drive_deg")}
        layout, name = names.get(path, ("simulated", "demo"))
        return Opened(dataset=layout, name=name, camera=camera, root=f"root-{len(asked)}")

    monkeypatch.setattr("pipelines.bench.cases.open_sequence", open_sequence)
    return asked


@pytest.fixture
def runs(monkeypatch) -> list[dict[str, Any]]:
    seen: list[dict[str, Any]] = []

    def run(sequence, config, output, *, frames, sinks, batch_progress):
        seen.append({"config": config, "output": output, "frames": frames})
        counts = {"frames": 5, "tracked": 5, "interrupted": False}
        rmse = 0.001 * (1 + config.tracking.seed)
        metrics = {"run": counts, "camera": {"rpe_trans_rmse_m": rmse}}
        timings = {"wall": {"median_ms": 9.0, "p95_ms": 11.0, "n": 5}, "frames_total_ms": [9.0]}
        return SimpleNamespace(metrics=metrics, timings=timings)

    monkeypatch.setattr(benchmark, "run", run)
    return seen


def all_of(bench: Benchmark) -> list[str]:
    states = []
    for case, seed in bench.pending():
        states.append(bench.run(case, seed))
        bench.write()
    return states


def test_each_run_has_its_seed_in_settings_and_noise(opened, runs, tmp_path, monkeypatch) -> None:
    forgotten: list[str] = []
    monkeypatch.setattr("pipelines.datasets.simulated.cache.forget", forgotten.append)
    cases = (BenchCase("simulated:demo", degrade="all"), BenchCase("vdo_data"))
    bench = Benchmark(tmp_path, cases, Config(), runs=2, frames=5)
    assert all_of(bench) == ["done"] * 4
    noise = [options.get("noise_seed") for _, options in opened]
    assert noise == [0, None, 1, None]  # all cases once, before any a second time
    assert [run["config"].tracking.seed for run in runs] == [0, 0, 1, 1]
    assert not runs[0]["config"].batch.record and runs[0]["frames"] == 5
    assert forgotten == ["root-3"]  # the inputs that no one else uses
    content = json.loads((tmp_path / "bench.json").read_text())
    demo, drive = content["sequences"]
    assert [run["errors"]["rpe_trans_m"] for run in drive["runs"]] == [0.001, 0.002]
    assert drive["mean"]["rpe_trans_m"] == pytest.approx(0.0015)
    assert drive["mean"]["frame_ms"] == 9.0 and drive["runs"][0]["timings"]["wall"]["p95_ms"] == 11
    assert drive["published"][0]["values"]["speed_kmh"] == 0.32 and demo["published"] == []
    assert not drive["alike"]
    assert "VDO-SLAM" in (tmp_path / "bench.md").read_text()


def test_a_run_that_fails_is_an_entry_and_the_rest_goes_on(opened, runs, tmp_path) -> None:
    bench = Benchmark(tmp_path, [BenchCase("gone"), BenchCase("vdo_data")], Config())
    assert all_of(bench) == ["failed", "done"]
    gone, drive = bench.content["sequences"]
    assert gone["runs"][0]["sentence"].startswith("gone: expected a folder")
    assert drive["runs"][0]["errors"]["rpe_trans_m"] == 0.001
    assert "gone, run 1: failed: gone: expected" in (tmp_path / "bench.md").read_text()


def test_a_defect_is_an_entry_too(opened, tmp_path, monkeypatch) -> None:
    def run(*arguments, **options):
        raise ZeroDivisionError("x / 0")

    monkeypatch.setattr(benchmark, "run", run)
    bench = Benchmark(tmp_path, [BenchCase("vdo_data")], Config())
    assert all_of(bench) == ["failed"]
    sentence = bench.content["sequences"][0]["runs"][0]["sentence"]
    assert sentence == "a defect of DyOb-SLAM: ZeroDivisionError: x / 0"


@pytest.mark.parametrize(
    ("counts", "state"),
    [
        ({"frames": 3, "tracked": 3, "interrupted": True}, "stopped"),
        ({"frames": 3, "tracked": 0, "interrupted": False}, "failed"),
    ],
)
def test_what_has_no_whole_result_counts_in_no_mean(
    opened, tmp_path, monkeypatch, counts, state
) -> None:
    metrics = {"run": counts, "camera": {"rpe_trans_rmse_m": 7.0}}
    found = SimpleNamespace(metrics=metrics, timings={})
    monkeypatch.setattr(benchmark, "run", lambda *arguments, **options: found)
    bench = Benchmark(tmp_path, [BenchCase("vdo_data")], Config())
    assert all_of(bench) == [state]
    assert bench.content["sequences"][0]["mean"] == {}


def test_a_folder_of_other_things_is_left_alone(tmp_path) -> None:
    (tmp_path / "thesis.tex").write_text("dear")
    with pytest.raises(DyObError, match=r"found thesis\.tex in it"):
        Benchmark(tmp_path, [BenchCase("simulated:demo")], Config())
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_no_two_cases_have_one_name() -> None:
    paths = ["a/0003", "b/0003/", "simulated:demo", "simulated:demo"]
    cases = [BenchCase(path) for path in paths] + [BenchCase("simulated:demo", degrade="all")]
    assert labels_of(cases) == ["0003", "0003-2", "demo", "demo-2", "demo-degraded"]


def test_only_simulated_inputs_are_altered() -> None:
    with pytest.raises(ConfigError, match="some/folder is none"):
        BenchCase("some/folder", degrade="all")
    with pytest.raises(ConfigError):
        BenchCase("some/folder", provide="right")
