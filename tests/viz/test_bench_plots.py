"""The paper's figures from a benchmark: of the right size, not empty, and of the figures in it."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from pipelines.errors import DyObError, FormatError
from viz import style
from viz.bench_plots import PALE, bench_figure_of, plot_bench, possible_bench_plots

WIDTH_PX = 1350


def sequence(label: str, speeds: list[float], peer: bool) -> dict:
    runs = [
        {
            "seed": k,
            "state": "done",
            "frames": 8,
            "errors": {
                "rpe_trans_m": 0.00123, "rpe_rot_deg": 0.0456, "motion_trans_m": 0.0078,
                "motion_rot_deg": 0.9, "speed_kmh": speed, "speed_signed_kmh": -speed / 2,
            },
        }
        for k, speed in enumerate(speeds)
    ]  # fmt: skip
    values = {"speed_kmh": 0.32, "rpe_trans_m": 0.0062}
    known = [{"system": "VDO-SLAM", "source": "s", "frames": 100, "values": values}] * peer
    return {"label": label, "runs": runs, "mean": runs[0]["errors"], "published": known}


@pytest.fixture
def content() -> dict:
    return {"sequences": [sequence("demo", [0.1, 0.2], False), sequence("drive", [0.3], True)]}


def texts(figure) -> list[str]:
    return [text.get_text() for axes in figure.axes for text in axes.texts]


def test_both_figures_are_written_and_not_blank(content, tmp_path) -> None:
    (tmp_path / "bench.json").write_text(json.dumps(content))
    paths = plot_bench(tmp_path)
    assert [path.name for path in paths] == ["errors_by_run.png", "speed_errors.png"]
    table, bars = (cv2.imread(str(path))[..., ::-1].astype(int) for path in paths)
    assert table.shape[1] == bars.shape[1] == WIDTH_PX
    assert min(table.shape[0], bars.shape[0]) > 300
    dark = (table.max(2) < 120).sum()
    assert 2000 < dark < 0.2 * table[..., 0].size  # print on paper
    for color in (style.ESTIMATE, PALE, style.TRUTH):
        assert (np.abs(bars - color).sum(2) < 30).sum() > 500


def test_the_table_holds_the_runs_their_mean_and_the_peer(content) -> None:
    found = texts(bench_figure_of(content, "errors_by_run"))
    assert [t for t in found if t.startswith(("run ", "mean", "VDO", "demo", "drive"))] == [
        "demo, 8 frames", "run 1", "run 2", "mean",
        "drive, 8 frames", "run 1", "VDO-SLAM, over 100 frames",
    ]  # fmt: skip
    assert found.count("0.00123") == 4 and found.count("0.0062") == 1


def test_the_bars_are_as_high_as_the_errors(content) -> None:
    demo, drive = bench_figure_of(content, "speed_errors").axes[:2]
    assert [bar.get_height() for bar in demo.patches] == pytest.approx([0.1, 0.2, -0.05, -0.1])
    assert [line.get_ydata()[0] for line in drive.lines] == [0.32, 0.0]
    assert [text.get_text() for text in demo.texts] == ["0.10", "0.20", "-0.05", "-0.10"]


def test_what_is_not_known_is_not_drawn(content, tmp_path) -> None:
    for entry in content["sequences"]:
        entry["mean"] = dict.fromkeys(entry["mean"])
    assert possible_bench_plots(content) == []
    with pytest.raises(DyObError, match="allows none"):
        bench_figure_of(content, "speed_errors")
    (tmp_path / "bench.json").write_text(json.dumps(content))
    assert plot_bench(tmp_path) == []
    assert not (tmp_path / "plots").exists()
    with pytest.raises(FormatError):
        plot_bench(tmp_path / "nothing")
