"""The verbs around a run: which settings and options reach it, and what its outcome means."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from app import cli, console, runs
from pipelines.errors import ConfigError, DyObError
from pipelines.lasting_map import LastingMap


@pytest.fixture
def calls(monkeypatch, tmp_path) -> dict[str, Any]:
    """What the verbs hand to the library, whose functions are replaced; "counts" is the outcome."""
    seen: dict[str, Any] = {"counts": {"interrupted": False, "tracked": 3}}

    def open_sequence(path, dataset=None, name=None, **options):
        seen["opened"] = (path, dataset, name, options)
        return "the sequence"

    def run(
        sequence, config=None, output=None, *, sinks=(), batch_progress=None, lasting_map=None,
        **span,
    ):  # fmt: skip
        seen["lasting_map"] = lasting_map
        seen.update(sequence=sequence, config=config, output=output, sinks=sinks, span=span)
        return SimpleNamespace(folder=tmp_path, metrics={"run": seen["counts"]}, timings={})

    def render_result(folder, **options):
        seen.update(rendered=folder, options=options)
        return [Path(folder) / "renders" / "top.png"]

    def plot_result(folder):
        return [Path(folder) / "plots" / "trajectory.png"]

    def write_report(result):
        return tmp_path / "report.html"

    stand_ins = {"pipelines.runner": run, "viz.render": render_result, "viz.plots": plot_result}
    stand_ins["viz.report"] = write_report
    for name, function in stand_ins.items():
        module = ModuleType(name)
        setattr(module, function.__name__, function)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr("pipelines.datasets.open_sequence", open_sequence)
    monkeypatch.setattr(console, "warnings", nullcontext)
    return seen


def words(line: str):
    return cli.build_parser().parse_args(line.split())


def test_flags_reach_the_run(calls) -> None:
    line = "run data --dataset vdo --sequence a --start 2 --frames 5 --stride 3 --output out"
    assert runs.run(words(f"{line} --set orb.n_features=900")) == 0
    assert calls["opened"] == ("data", "vdo", "a", {})
    expected = {"start": 2, "frames": 5, "stride": 3, "checkpoint_every": 50, "resume": False}
    assert calls["span"] == expected
    assert calls["lasting_map"] == LastingMap()
    assert calls["output"] == "out"
    assert calls["config"].orb.n_features == 900
    assert [type(sink).__name__ for sink in calls["sinks"]] == ["Progress", "FrameWriter"]


def test_pictures_of_frames_can_be_thinned_out_or_left_out(calls) -> None:
    runs.run(words("run data --pictures 5"))
    assert calls["sinks"][1].every == 5
    runs.run(words("run data --pictures 0"))
    assert [type(sink).__name__ for sink in calls["sinks"]] == ["Progress"]


def test_the_seed_reaches_settings_and_simulation(calls) -> None:
    runs.run(words("run simulated:street --seed 7 --degrade"))
    assert calls["config"].tracking.seed == 7
    options = calls["opened"][3]
    assert callable(options.pop("progress"))
    assert options == {"seed": 7, "degrade": "all"}
    runs.run(words("run simulated:street --degrade flow,masks"))
    assert calls["opened"][3]["degrade"] == "flow,masks"
    runs.run(words("run data --seed 7"))
    assert calls["config"].tracking.seed == 7
    assert calls["opened"][3] == {}


def test_degrade_is_refused_for_real_data(calls) -> None:
    with pytest.raises(ConfigError, match="data is none"):
        runs.run(words("run data --degrade"))
    assert "opened" not in calls


def test_wrong_settings_are_found_before_the_data_are_opened(calls) -> None:
    with pytest.raises(ConfigError, match="unknown setting"):
        runs.run(words("run data --set no.such=1"))
    assert "opened" not in calls


def test_quiet_prints_the_folder_alone(calls, capsys, tmp_path) -> None:
    assert runs.run(words("run data --quiet --pictures 0")) == 0
    assert calls["sinks"] == []
    assert capsys.readouterr().out == f"{tmp_path}\n"


@pytest.mark.parametrize("line", ["run data", "run data --quiet", "demo"])
def test_an_interrupted_run_ends_with_130(calls, line) -> None:
    calls["counts"]["interrupted"] = True
    verb = runs.demo if line == "demo" else runs.run
    assert verb(words(line)) == 130
    assert "rendered" not in calls


def test_map_folders_reach_the_run(calls) -> None:
    assert runs.run(words("run data --load-map old --localize")) == 0
    assert calls["lasting_map"] == LastingMap("old", None, localize=True)
    assert runs.run(words("run data --load-map old --save-map new")) == 0
    assert calls["lasting_map"] == LastingMap("old", "new")


def test_a_run_that_tracked_nothing_is_an_error(calls) -> None:
    calls["counts"]["tracked"] = 0
    with pytest.raises(DyObError, match="no frame could be tracked"):
        runs.run(words("run data"))


def test_the_demo_runs_renders_and_says_what_comes_next(calls, capsys, tmp_path) -> None:
    assert runs.demo(words("demo --frames 4")) == 0
    assert calls["opened"][0] == "simulated:demo"
    assert calls["span"] == {"frames": 4}
    assert calls["rendered"] == tmp_path
    said = capsys.readouterr().out
    assert "top.png" in said and "report.html" in said
    assert "python3 -m app run PATH" in said


def test_render_hands_on_its_flags(calls, capsys, tmp_path) -> None:
    (tmp_path / "camera_tum.txt").write_text("")
    line = f"render {tmp_path} --size 640x360 --view top --background black --frame 7"
    assert runs.render(words(line)) == 0
    assert calls["rendered"] == tmp_path.resolve()
    options = {"size": (640, 360), "views": ("top",), "background": "black", "frame": 7}
    assert calls["options"] == options
    runs.render(words(f"render {tmp_path}"))
    assert calls["options"]["views"] == ("top", "iso", "chase")


def test_render_makes_a_video_where_one_is_asked_for(calls, capsys, tmp_path, monkeypatch) -> None:
    seen: list[Any] = []
    monkeypatch.setattr("viz.video.write_video", lambda *a, **o: seen.append((a, o)) or a[1])
    monkeypatch.setitem(sys.modules, "viz.render", sys.modules["viz.render"])
    sys.modules["viz.render"].renders_folder = lambda result: result.folder / "renders"
    (tmp_path / "camera_tum.txt").write_text("")
    runs.render(words(f"render {tmp_path} --size 640x360"))
    assert seen == []
    runs.render(words(f"render {tmp_path} --size 640x360 --video top"))
    ((result, path), options) = seen[0]
    assert result.folder == tmp_path.resolve() and path == result.folder / "renders" / "video.mp4"
    assert (options["view"], options["width"], options["background"]) == ("top", 640, "white")
    assert capsys.readouterr().out.splitlines()[-3].endswith("video.mp4")
