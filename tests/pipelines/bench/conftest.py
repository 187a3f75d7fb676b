"""The content of a bench.json with two sequences, the second of which others have scored too."""

from __future__ import annotations

from typing import Any

import pytest

from pipelines.bench.measures import means_of


def run_of(seed: int, **errors: float | None) -> dict[str, Any]:
    known = {"rpe_trans_m": 0.002, "rpe_rot_deg": 0.01, "ate_m": 0.01, "frame_ms": 40.0}
    return {
        "seed": seed,
        "state": "done",
        "load": 0.5,
        "frames": 8,
        "errors": {**known, "speed_kmh": None, "speed_signed_kmh": None, **errors},
        "timings": {
            "orb": {"median_ms": 10.0 + seed, "p95_ms": 20.0},
            "total": {"median_ms": 30.0, "p95_ms": 50.0},
            "wall": {"median_ms": 40.0, "p95_ms": 60.0},
        },
    }


@pytest.fixture
def content() -> dict[str, Any]:
    peer = {
        "system": "VDO-SLAM",
        "source": "a book",
        "frames": 100,
        "values": {"rpe_trans_m": 0.0062, "motion_trans_m": 0.0175, "speed_kmh": 0.32},
    }
    speeds = [{"speed_kmh": 0.2, "speed_signed_kmh": -0.1}, {"speed_kmh": 0.4}]
    moved = {"motion_trans_m": 0.003, "motion_rot_deg": 0.09, "coverage_share": 0.955}
    sequences: list[dict[str, Any]] = [
        {"label": "still", "is_noisy": False, "published": [], "runs": [run_of(0), run_of(1)]},
        {
            "label": "drive",
            "is_noisy": True,
            "published": [peer],
            "runs": [run_of(k, **moved, **speed) for k, speed in enumerate(speeds)],
        },
    ]
    for sequence in sequences:
        sequence |= {"width": 64, "height": 48}
        sequence["mean"] = means_of(run["errors"] for run in sequence["runs"])
    sequences[0]["alike"] = True
    machine = {"processor": "a processor", "cores": 2, "system": "Linux"}
    return {
        "started": "2026-01-01 00:00:00",
        "machine": machine,
        "runs": 2,
        "stopped": False,
        "sequences": sequences,
    }
