"""A short run whose camera follows a car, for what shows runs, and a browser to look at pages."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from app.system_libraries import browser as find_browser
from pipelines.geometry import exp_se3, make_T
from pipelines.io.result import Result
from pipelines.object_types import ObjectEstimates

BROWSER_FLAGS = [
    "--no-sandbox",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--use-gl=angle",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
]
N = 8
STEP = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.8]))  # of the car a frame, along z


def car_ahead(state: str = "moving", object_id: int = 3) -> ObjectEstimates:
    """4 m long, its own x along its way; 9 m before the first camera, on its left."""
    first = make_T(np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]]), np.array([-1.0, 0.8, 9.0]))
    Ls = np.array([np.linalg.matrix_power(STEP, k) @ first for k in range(N)])
    Hs = np.concatenate([np.full((1, 4, 4), np.nan), np.tile(STEP, (N - 1, 1, 1))])
    nan3 = np.full((N, 3), np.nan)
    return ObjectEstimates(
        np.arange(N), np.arange(N) * 0.1, np.full(N, object_id), np.full(N, "car"), np.ones(N),
        np.full(N, state), np.tile([10.0, 10, 40, 30], (N, 1)), np.full(N, 80), Ls, Hs,
        np.full((N, 6, 6), np.nan), Ls[:, :3, 3], np.full(N, 8.0), np.full(N, 0.2), nan3,
        np.full(N, np.nan), np.tile([4.0, 1.4, 1.7], (N, 1)),
    )  # fmt: skip


@pytest.fixture
def short_run(tmp_path: Path) -> Result:
    """Eight frames, 0.1 s apart, the camera 0.5 m further in each; walls and ground of points."""
    rng = np.random.default_rng(0)
    stamps = np.arange(N) * 0.1
    Ts = np.array([make_T(np.eye(3), np.array([0.0, 0.0, 0.5 * k])) for k in range(N)])
    walls = np.column_stack(
        [rng.choice([-6.0, 6.0], 300), rng.uniform(-3, 1.5, 300), rng.uniform(0, 25, 300)]
    )
    ground = np.column_stack([rng.uniform(-6, 6, 300), np.full(300, 1.5), rng.uniform(1, 25, 300)])
    points = np.concatenate([walls, ground])
    (tmp_path / "frames").mkdir()
    for k in range(N):
        image = np.full((64, 201, 3), (200, 30 * k, 0), np.uint8)
        assert cv2.imwrite(str(tmp_path / "frames" / f"{k:06d}.png"), image)
    timings = {"frames_index": list(range(N)), "frames_timestamp_s": stamps.tolist()}
    return Result(
        tmp_path, stamps, Ts, None, None, points, np.full(points.shape, 90, np.uint8),
        timings=timings, objects=car_ahead(),
    )  # fmt: skip


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """Chromium without a display. For a module alone: playwright's loop would disturb others."""
    program = find_browser()
    if program is None:
        pytest.skip("needs chromium, which is not there: apt-get install chromium")
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    with playwright.sync_playwright() as running:
        chromium = running.chromium.launch(executable_path=program, args=BROWSER_FLAGS)
        yield chromium
        chromium.close()
