"""Folders on disk that are damaged and run: images rewritten, and what came of it."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.io.result import Result
from pipelines.runner import run


def run_folder(folder: Path) -> Result:
    """A run of a folder into a result beside it."""
    return run(open_sequence(folder), output=folder.parent / "result")


def camera_errors_m(result: Result) -> tuple[float, float]:
    """RPE and ATE, RMSE in metres."""
    camera = result.metrics["camera"]
    return camera["rpe_trans_rmse_m"], camera["ate_rmse_m"]


def warnings_of(caplog: pytest.LogCaptureFixture) -> str:
    return "\n".join(r.getMessage() for r in caplog.records if r.levelno >= logging.WARNING)


def rewrite(path: Path, change: Callable[[np.ndarray], np.ndarray]) -> None:
    """The image at `path` passed through `change`."""
    assert cv2.imwrite(str(path), change(cv2.imread(str(path), cv2.IMREAD_UNCHANGED)))


def blacken(image: np.ndarray) -> np.ndarray:
    return np.zeros_like(image)
