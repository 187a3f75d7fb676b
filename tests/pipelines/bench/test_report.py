"""The tables of bench.md: what stands where, and what is said where something is missing."""

from __future__ import annotations

from pipelines.bench.report import bench_text


def rows_of(text: str, heading: str) -> list[list[str]]:
    """Cells of the first table below a heading, without the line beneath its head."""
    block = text.split(f"## {heading}")[1].split("\n\n")[1]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in block.splitlines()]
    return [rows[0], *rows[2:]]


def test_times_are_means_over_the_runs_with_the_sums_last(content) -> None:
    rows = rows_of(bench_text(content), "Time a frame")
    assert rows[0] == ["stage", "still", "drive"]
    assert rows[1] == ["orb", "10.5 / 20.0", "10.5 / 20.0"]
    assert [row[0] for row in rows[2:]] == [
        "all work, in two threads", "on the clock, with reading", "pictures",
    ]  # fmt: skip
    assert rows[-1][1] == "64x48, 8 frames"


def test_published_figures_stand_beneath_ours_with_their_own_digits(content) -> None:
    text = bench_text(content)
    head, still, ours, theirs = rows_of(text, "Camera")
    assert "t_rel %" not in head  # known of neither
    column = head.index("RPE m")
    assert (still[column], ours[column], theirs[column]) == ("0.00200", "0.00200", "0.0062")
    assert ours[:3] == ["drive", "DyOb-SLAM, mean of 2", "8"]
    assert theirs[:3] == ["", "VDO-SLAM [1]", "100"]
    assert theirs[head.index("ATE m")] == "-"
    assert text.count("[1] a book.") == 1
    head, ours, theirs = rows_of(text, "Moving objects")  # nothing moves in the other
    assert ours[head.index("speed km/h")] == "0.300"
    assert theirs[head.index("speed km/h")] == "0.32"
    assert ours[head.index("coverage %")] == "95.5"
    content["sequences"][1]["mean"]["false_movers"] = 2.2
    head, ours, _ = rows_of(bench_text(content), "Moving objects")
    assert ours[head.index("false movers")] == "2.2"


def test_each_run_has_its_line_as_in_the_paper(content) -> None:
    text = bench_text(content)
    rows = rows_of(text, "Each run")
    assert [row[:2] for row in rows[1:]] == [
        ["still", "1"], ["", "2"], ["", "mean"],
        ["drive", "1"], ["", "2"], ["", "mean"], ["", "VDO-SLAM [1]"],
    ]  # fmt: skip
    assert rows[4][-2:] == ["0.200", "-0.100"]
    assert rows[6][-2:] == ["0.300", "-0.100"]  # of the runs that have one
    words = " ".join(text.split())
    assert "by that of the inputs' noise in drive." in words
    assert "All runs of still gave the very same errors." in words
    assert "0.96-1.20" in words


def test_what_failed_or_stopped_is_told_once(content) -> None:
    for sequence in content["sequences"]:
        for run in sequence["runs"]:
            run |= {"state": "failed", "sentence": "no such folder"}
    content["sequences"][1]["runs"].pop()
    content["stopped"] = True
    text = bench_text(content)
    assert "Stopped before the end" in text
    assert "- still, runs 1 and 2: failed: no such folder" in text
    assert "- drive, run 1: failed: no such folder" in text
    assert "|" not in text  # no table is left


def test_a_busy_machine_is_named(content) -> None:
    assert "Other programs" not in bench_text(content)
    content["sequences"][0]["runs"][0]["load"] = 7.6
    assert "up to 8 wanted the 2 cores" in " ".join(bench_text(content).split())
