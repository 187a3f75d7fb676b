"""Times of frames: reading them, judging them, and pairing two lists by time.

Owns the rule of which source of time is believed. Knows no layout.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import DatasetError
from pipelines.types import Array

log = logging.getLogger("dyob")
MAX_SPACING_ERROR = (
    0.2  # times.txt whose spacing differs more than this from 1 / fps is not believed
)
ASSOCIATE_MAX_S = 0.02  # two measurements within this are of one moment (TUM's tool)


def frame_times(path: Path | None, fps: float | None, n_frames: int, root: Path) -> Array:
    """Times (N,) in seconds of `n_frames` frames from a file of one time a line, or from `fps`.

    The file is believed unless it is short, does not increase, or its median spacing differs from
    1 / fps by more than 20 % (KITTI samples of VDO-SLAM say 0.05 s where 0.1 s is true); then fps
    is, with a warning. Raises DatasetError where neither is there.
    """
    regular = None if not fps or fps <= 0 else np.arange(n_frames) / fps
    if path is None or not path.is_file():
        if regular is None:
            raise DatasetError(
                f"{root}: no times, expected times.txt (one time in seconds a line) or fps in the "
                "settings, found neither; add one of them."
            )
        return regular
    times, fault = _read_times(path), None
    if len(times) < n_frames:
        fault = f"expected {n_frames} times, found {len(times)}"
    elif not np.all(np.diff(times[:n_frames]) > 0):
        fault = "expected increasing times"
    elif fps and n_frames > 1:
        spacing_s = float(np.median(np.diff(times[:n_frames])))
        if abs(spacing_s * fps - 1) > MAX_SPACING_ERROR:
            fault = f"found {spacing_s:.3g} s a frame, the settings say {1 / fps:.3g} s"
    if fault is None:
        return times[:n_frames]
    if regular is None:
        raise DatasetError(f"{path}: {fault}; correct it, or set fps in the settings.")
    log.warning("%s: %s; using %.4g frames a second", path, fault, fps)
    return regular


def _read_times(path: Path) -> Array:
    try:
        return np.loadtxt(path, ndmin=2)[:, 0]
    except (OSError, ValueError, IndexError) as error:
        raise DatasetError(f"{path}: expected one time in seconds a line ({error}).") from error


def associate(
    times_s: Array, others_s: Array, max_difference_s: float = ASSOCIATE_MAX_S
) -> NDArray[np.int64]:
    """For each time (N,) the index of its partner among `others_s` (M,), -1 where it has none.

    Partners are nearest to each other and within `max_difference_s`, so each is used once.
    """
    if len(times_s) == 0 or len(others_s) == 0:
        return np.full(len(times_s), -1)
    nearest = _nearest(np.asarray(others_s), np.asarray(times_s))
    back = _nearest(np.asarray(times_s), np.asarray(others_s))
    mutual = back[nearest] == np.arange(len(times_s))
    close = np.abs(others_s[nearest] - times_s) <= max_difference_s
    return np.where(mutual & close, nearest, -1)


def _nearest(values: Array, wanted: Array) -> NDArray[np.int64]:
    """Index of the value nearest to each wanted one; the earlier of two equally near."""
    order = np.argsort(values, kind="stable")
    at = np.searchsorted(values[order], wanted).clip(0, len(values) - 1)
    below = np.maximum(at - 1, 0)
    take_below = np.abs(values[order][below] - wanted) <= np.abs(values[order][at] - wanted)
    return order[np.where(take_below, below, at)]
