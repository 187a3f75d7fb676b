"""The paper's two figures, from a benchmark: the table of errors, and the bars of speed errors.

Owns how they look. The figures in them are those of bench.json.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.bench.benchmark import BENCH_JSON
from pipelines.bench.measures import MEASURES, cell, published_cell
from pipelines.bench.report import OURS, RUN_KEYS, done_runs
from pipelines.errors import DyObError
from pipelines.io import folder as names
from pipelines.io.files import disk_error, read_json
from viz import style
from viz.figures import WIDTH_IN, new_figure, save_figure
from viz.style import hex_color

PEER = "VDO-SLAM"  # the system that the paper compares with
ROW_IN = 0.27
PALE: style.Color = (178, 208, 235)
# Where the columns of the table begin (the first) and end, as shares of its width.
_COLUMNS = (0.02, 0.44, 0.59, 0.82, 0.97)
_HEADINGS = ("translation, m", "rotation, deg", "translation, m", "rotation, deg")
_MEAN = "mean"
_TABLE_KEYS = RUN_KEYS[:4]
_MEASURES = {m.key: m for m in MEASURES}


def plot_bench(folder: Path | str) -> list[Path]:
    """Write plots/errors_by_run.png and plots/speed_errors.png of a benchmark; the paths written.

    Without a finished run there is no table, without moving objects of known speed no chart. Raises
    FormatError where `folder` holds no benchmark.
    """
    folder = Path(folder)
    content = read_json(folder / BENCH_JSON)
    target = folder / names.PLOTS
    written = []
    for name in possible_bench_plots(content):
        try:
            target.mkdir(exist_ok=True)
        except OSError as error:
            raise DyObError(disk_error(target, error)) from error
        save_figure(bench_figure_of(content, name), target / f"{name}.png")
        written.append(target / f"{name}.png")
    return written


def possible_bench_plots(content: dict[str, Any]) -> list[str]:
    """Names of the figures that a benchmark allows, by the content of bench.json."""
    return [name for name, (_, rows) in BENCH_PLOTS.items() if rows(content)]


def bench_figure_of(content: dict[str, Any], name: str) -> Any:
    """The figure `name` of BENCH_PLOTS, with no file written; for notebooks as for `plot_bench`."""
    if name not in possible_bench_plots(content):
        raise DyObError(
            f"expected a figure of {', '.join(BENCH_PLOTS)} for which there are runs, found "
            f"'{name}'; this benchmark allows {', '.join(possible_bench_plots(content)) or 'none'}"
        )
    draw, rows = BENCH_PLOTS[name]
    with new_figure() as figure:
        draw(figure, rows(content))
    return figure


def _judged(content: dict[str, Any]) -> list[dict[str, Any]]:
    """The sequences with a finished run and a true camera."""
    return [s for s in content["sequences"] if s.get("mean", {}).get("rpe_trans_m") is not None]


def _with_speeds(content: dict[str, Any]) -> list[dict[str, Any]]:
    return [s for s in content["sequences"] if s.get("mean", {}).get("speed_kmh") is not None]


def _peer(sequence: dict[str, Any]) -> dict[str, Any] | None:
    """What is published of the paper's peer on a sequence."""
    found = (e for e in sequence["published"] if e["system"] == PEER)
    return next(found, None)


def plot_errors_table(figure: Any, sequences: list[dict[str, Any]]) -> None:
    """Camera and object errors of each run, their mean, and VDO-SLAM's where they are known."""
    lines = [line for sequence in sequences for line in _table_lines(sequence)]
    height = len(lines) + 2.7
    figure.set_size_inches(WIDTH_IN, ROW_IN * height)
    axes = figure.subplots()
    axes.set(xlim=(0.0, 1.0), ylim=(height, 0.0))
    axes.set_axis_off()
    ink = hex_color(style.INK)
    for first, text in ((1, "Camera"), (3, "Motion of objects")):
        left, right = _COLUMNS[first] - 0.13, _COLUMNS[first + 1]
        axes.text((left + right) / 2, 0.6, text, ha="center", va="center", weight="bold", color=ink)
        axes.plot([left, right], [1.15, 1.15], color=ink, lw=0.8)
    _put(axes, 1.7, "run", _HEADINGS)
    for y in (2.25, height - 0.1):
        axes.plot([0.0, 1.0], [y, y], color=ink, lw=1.4)
    for at, (name, cells) in enumerate(lines):
        y = 2.85 + at
        if not cells:
            axes.text(0.0, y, name, va="center", weight="bold", color=ink)
            if at:
                axes.plot([0.0, 1.0], [y - 0.52, y - 0.52], color="#c8c8cc", lw=0.7)
        else:
            color = hex_color(style.ESTIMATE) if name == _MEAN else ink
            _put(axes, y, name, cells, color=color, weight="bold" if name == _MEAN else "normal")


def _put(axes: Any, y: float, name: str, cells: Sequence[str], **look: Any) -> None:
    """One line of the table: the name to the left, the cells to the right of their columns."""
    for x, text in zip(_COLUMNS, (name, *cells), strict=True):
        axes.text(x, y, text, ha="left" if text == name else "right", va="center", **look)


def _table_lines(sequence: dict[str, Any]) -> list[tuple[str, list[str]]]:
    """(name, cells) of each line; the sequence's own name stands alone in the first."""
    measures = [_MEASURES[key] for key in _TABLE_KEYS]
    runs = done_runs(sequence)
    words = f"{sequence['label']}, {runs[0]['frames']} frames"
    lines: list[tuple[str, list[str]]] = [(words, [])]
    values = [(f"run {run['seed'] + 1}", run["errors"], cell) for run in runs]
    if len(runs) > 1:
        values.append((_MEAN, sequence["mean"], cell))
    peer = _peer(sequence)
    if peer is not None:
        also = f", over {peer['frames']} frames" if peer["frames"] != runs[0]["frames"] else ""
        values.append((f"{PEER}{also}", peer["values"], published_cell))
    lines += [(name, [write(m, v.get(m.key)) for m in measures]) for name, v, write in values]
    return lines


def plot_speed_errors(figure: Any, sequences: list[dict[str, Any]]) -> None:
    """A chart a sequence: by run, the mean size of the speed's error, and its signed mean."""
    columns = min(2, len(sequences))
    lines = -(-len(sequences) // columns)
    figure.set_size_inches(WIDTH_IN, 1.2 + 2.4 * lines)
    grid = figure.subplots(lines, columns, squeeze=False)
    for axes, sequence in zip(grid.ravel(), sequences, strict=False):
        _plot_speed_bars(axes, sequence)
    for axes in grid.ravel()[len(sequences) :]:
        axes.set_axis_off()
    for row in grid:
        row[0].set_ylabel("km/h")
    entries: dict[str, Any] = {}
    for axes in grid.ravel():
        handles, labels = axes.get_legend_handles_labels()
        entries |= dict(zip(labels, handles, strict=True))
    figure.legend(
        list(entries.values()), list(entries), loc="outside lower center", ncols=len(entries)
    )
    figure.suptitle(f"Error of object speed in each run of {OURS}", fontsize=12)


def _plot_speed_bars(axes: Any, sequence: dict[str, Any]) -> None:
    runs = [r for r in done_runs(sequence) if r["errors"].get("speed_kmh") is not None]
    at = np.arange(len(runs))
    sizes = np.array([run["errors"]["speed_kmh"] for run in runs])
    signed = np.array([run["errors"]["speed_signed_kmh"] for run in runs])
    color = hex_color(style.ESTIMATE)
    axes.bar(at - 0.2, sizes, 0.38, color=color, label="mean size of the error")
    # Paler, not of another hue: told apart by every eye and on grey paper.
    pale = {"facecolor": hex_color(PALE), "edgecolor": color, "lw": 0.8}
    axes.bar(at + 0.2, signed, 0.38, label="signed mean, |V_est| - |V|, eq. (8)", **pale)
    # As many decimals as give the highest bar two digits: longer numbers would run into bars.
    highest = max(np.abs([*sizes, *signed]).max(), 1e-9)
    decimals = max(1 - int(np.floor(np.log10(highest))), 0)
    for x, values in ((at - 0.2, sizes), (at + 0.2, signed)):
        for place, value in zip(x, values, strict=True):
            below = bool(value < 0)
            axes.annotate(
                f"{value:.{decimals}f}", (place, value), (0, -3 if below else 3),
                textcoords="offset points", ha="center", va="top" if below else "bottom",
                fontsize=9,
            )  # fmt: skip
    peer = _peer(sequence)
    if peer is not None and "speed_kmh" in peer["values"]:
        known = peer["values"]["speed_kmh"]
        words = f"{PEER}, mean size"
        axes.axhline(known, color=hex_color(style.TRUTH), lw=2.5, zorder=0.5, label=words)
    axes.axhline(0.0, color=hex_color(style.INK), lw=0.8)
    axes.set_xticks(at, [f"run {run['seed'] + 1}" for run in runs])
    axes.set_xlim(-0.6, max(len(runs), 3) - 0.4)
    axes.grid(visible=False, axis="x")
    axes.margins(y=0.18)
    axes.set_title(sequence["label"], fontsize=10.5, loc="left")


Rows = list[dict[str, Any]]
BENCH_PLOTS: dict[str, tuple[Callable[[Any, Rows], None], Callable[[dict[str, Any]], Rows]]] = {
    "errors_by_run": (plot_errors_table, _judged),
    "speed_errors": (plot_speed_errors, _with_speeds),
}
