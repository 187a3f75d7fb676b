"""bench.md: the benchmark's tables as text that reads well raw, in a terminal and rendered.

Owns layout, headings and notes. Reads the content of bench.json and computes nothing but means.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from pipelines.bench.measures import FRAME_TIME, FURTHER, MEASURES, Measure, cell, published_cell
from pipelines.bench.published import PAPER
from pipelines.evaluation.table import TIMING_LABELS
from pipelines.io.timings import TOTAL, WALL

OURS = "DyOb-SLAM"
ABREAST = 4  # sequences beside each other in the table of times
CAMERA_KEYS = ("ate_m", "rpe_trans_m", "rpe_rot_deg", "t_rel_percent", "r_rel_deg")
OBJECT_KEYS = (
    "motion_trans_m", "motion_rot_deg", "speed_kmh", "coverage_share", "false_movers",
    "id_switches",
)  # fmt: skip
RUN_KEYS = (
    "rpe_trans_m", "rpe_rot_deg", "motion_trans_m", "motion_rot_deg", "speed_kmh",
    "speed_signed_kmh",
)  # fmt: skip
RUN_HEADINGS = ("camera m", "camera deg", "object m", "object deg", "speed km/h", "signed km/h")
BY_KEY = {m.key: m for m in (*MEASURES, *FURTHER, FRAME_TIME)}

_SPEED_NOTE = (
    "RMSEs over frames, but for speed: the mean size of its error. Our speeds are those of the "
    "centre of what is seen of an object, against the speed of the true one's origin; VDO-SLAM's "
    "are taken at its own centre in both."
)

Table = list[list[str]]
Cell = Callable[[Measure, float | None], str]


def bench_text(content: dict[str, Any]) -> str:
    """The whole of bench.md, from the content of bench.json."""
    parts = ["# Benchmark of DyOb-SLAM", *_facts(content)]
    sources: list[str] = []
    for heading, body in (
        ("Time a frame, ms: median / 95th percentile", _times(content)),
        ("Camera", _accuracy(content, (*CAMERA_KEYS, FRAME_TIME.key), sources)),
        ("Moving objects", _accuracy(content, OBJECT_KEYS, sources)),
        ("Each run", _each_run(content, sources)),
    ):
        if body:
            parts += [f"## {heading}", *body]
    if sources:
        lines = [_wrapped(f"[{n}] {source}.") for n, source in enumerate(sources, 1)]
        parts += ["## Sources", "\n\n".join(lines)]
    failures = _failures(content)
    if failures:
        parts += ["## Not done", "\n".join(failures)]
    return "\n\n".join(parts) + "\n"


def done_runs(sequence: dict[str, Any]) -> list[dict[str, Any]]:
    """The runs of a sequence that came to their end."""
    return [run for run in sequence["runs"] if run["state"] == "done"]


def _facts(content: dict[str, Any]) -> list[str]:
    made = content["machine"]
    loads = [r["load"] for s in content["sequences"] for r in s["runs"] if r["load"] is not None]
    lines = [f"{content['started']}, {made['processor']}, {made['cores']} cores, {made['system']}."]
    if loads and max(loads) > made["cores"]:
        lines.append(
            f"Other programs were running (up to {max(loads):.0f} wanted the {made['cores']} "
            "cores as a run began): times are longer than they need be."
        )
    if content["stopped"]:
        lines.append("Stopped before the end: what was done until then.")
    return [_wrapped(" ".join(lines))]


def _times(content: dict[str, Any]) -> list[str]:
    """Blocks of sequences side by side, a row a stage; means over the runs."""
    timed = [s for s in content["sequences"] if done_runs(s)]
    blocks = []
    for first in range(0, len(timed), ABREAST):
        block = timed[first : first + ABREAST]
        stages = list(dict.fromkeys(name for s in block for r in done_runs(s) for name in
                                    r["timings"]))  # fmt: skip
        stages.sort(key=lambda name: (name == WALL) * 2 + (name == TOTAL))
        table: Table = [["stage", *(s["label"] for s in block)]]
        for stage in stages:
            label = TIMING_LABELS.get(stage, stage.replace("_", " "))
            table.append([label, *(_time_cell(s, stage) for s in block)])
        size = [f"{s['width']}x{s['height']}, {done_runs(s)[0]['frames']} frames" for s in block]
        table.append(["pictures", *size])
        blocks.append(_markdown(table, 1))
    return blocks


def _time_cell(sequence: dict[str, Any], stage: str) -> str:
    values = [r["timings"][stage] for r in done_runs(sequence) if stage in r["timings"]]
    if not values:
        return "-"
    median, p95 = (sum(v[key] for v in values) / len(values) for key in ("median_ms", "p95_ms"))
    return f"{median:.1f} / {p95:.1f}"


def _accuracy(content: dict[str, Any], keys: Sequence[str], sources: list[str]) -> list[str]:
    """Ours and beneath it what others have published, in the columns that are known at all."""
    rows: list[tuple[list[str], dict[str, float | None], Cell]] = []
    for sequence in content["sequences"]:
        runs = done_runs(sequence)
        if not runs or all(sequence["mean"].get(key) is None for key in keys[:3]):
            continue
        several = f", mean of {len(runs)}" if len(runs) > 1 else ""
        frames = str(runs[0]["frames"])
        rows.append(([sequence["label"], OURS + several, frames], sequence["mean"], cell))
        for entry in sequence["published"]:
            if any(key in entry["values"] for key in keys):
                frames = "-" if entry["frames"] is None else str(entry["frames"])
                words = ["", f"{entry['system']} [{_number(entry['source'], sources)}]", frames]
                rows.append((words, entry["values"], published_cell))
    shown = [BY_KEY[key] for key in keys if any(v.get(key) is not None for _, v, _ in rows)]
    if not rows:
        return []
    table = [["sequence", "system", "frames", *(m.heading for m in shown)]]
    table += [[*words, *_cells(shown, values, write)] for words, values, write in rows]
    return [_markdown(table, 2), *([_wrapped(_SPEED_NOTE)] if "speed_kmh" in keys else [])]


def _each_run(content: dict[str, Any], sources: list[str]) -> list[str]:
    """The paper's table: errors of camera and objects, run by run, and VDO-SLAM's."""
    measures = [BY_KEY[key] for key in RUN_KEYS]
    table: Table = [["sequence", "run", *RUN_HEADINGS]]
    for sequence in content["sequences"]:
        label = sequence["label"]
        for run in done_runs(sequence):
            table.append([label, str(run["seed"] + 1), *_cells(measures, run["errors"])])
            label = ""
        if len(done_runs(sequence)) > 1:
            table.append(["", "mean", *_cells(measures, sequence["mean"])])
        for entry in sequence.get("published", []):
            if label == "" and entry["system"] == "VDO-SLAM":
                name = f"VDO-SLAM [{_number(entry['source'], sources)}]"
                table.append(["", name, *_cells(measures, entry["values"], published_cell)])
    if len(table) == 1:
        return []
    return [_markdown(table, 2), _wrapped(" ".join(run_notes(content))), _wrapped(PAPER)]


def run_notes(content: dict[str, Any]) -> list[str]:
    """Sentences that say in what one run differs from another."""
    notes = ["RMSEs over frames of one run; the signed error is eq. (8) of the paper, averaged."]
    done = [s for s in content["sequences"] if done_runs(s)]
    if not any(len(done_runs(s)) > 1 for s in done):
        return notes
    noisy = [s["label"] for s in done if s["is_noisy"]]
    of_noise = f", and by that of the inputs' noise in {_listed(noisy)}" if noisy else ""
    notes.append(
        "With the same seed two runs give the same figures: these differ by the seed of the "
        f"estimator's random choices{of_noise}."
    )
    alike = [s["label"] for s in done if s.get("alike")]
    if alike:
        notes.append(f"All runs of {_listed(alike)} gave the very same errors.")
    return notes


def _failures(content: dict[str, Any]) -> list[str]:
    """A line for each way in which runs of a sequence did not come to their end."""
    lines = []
    for sequence in content["sequences"]:
        reasons: dict[str, list[str]] = {}
        for run in sequence["runs"]:
            if run["state"] != "done":
                reasons.setdefault(f"{run['state']}: {run['sentence']}", []).append(
                    str(run["seed"] + 1)
                )
        for reason, runs in reasons.items():
            which = f"run{'s' * (len(runs) > 1)} {_listed(runs)}"
            lines.append(f"- {sequence['label']}, {which}: {reason}")
    return lines


def _cells(
    measures: Iterable[Measure], values: dict[str, float | None], write: Cell = cell
) -> list[str]:
    return [write(measure, values.get(measure.key)) for measure in measures]


def _number(source: str, sources: list[str]) -> int:
    """The source's number in the list, which grows by those that are new."""
    if source not in sources:
        sources.append(source)
    return sources.index(source) + 1


def _listed(words: list[str]) -> str:
    return ", ".join(words[:-1]) + " and " * (len(words) > 1) + "".join(words[-1:])


def _wrapped(text: str) -> str:
    return textwrap.fill(text, 100, break_long_words=False, break_on_hyphens=False)


def _markdown(table: Table, words: int) -> str:
    """Aligned, so that it needs no rendering: the first `words` columns to the left."""
    widths = [max(map(len, column)) for column in zip(*table, strict=True)]
    rows = []
    for row in table:
        cells = zip(row, widths, strict=True)
        padded = [c.ljust(w) if k < words else c.rjust(w) for k, (c, w) in enumerate(cells)]
        rows.append(f"| {' | '.join(padded)} |")
    lines = ["-" * (w + 1) + ("-" if k < words else ":") for k, w in enumerate(widths)]
    return "\n".join([rows[0], f"|{'|'.join(lines)}|", *rows[1:]])
