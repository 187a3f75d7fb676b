"""Disparity or depth, told from planes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.datasets.depth_form import disparity_share


def room(noise: float) -> np.ndarray:
    """Depth (H, W) in metres of a floor, a back wall and a slanted wall, with relative noise."""
    v, u = np.mgrid[:240, :320]
    floor = 200 / np.maximum(v - 100, 1e-3)
    wall = 1 / (0.05 + 0.002 * u)
    depth = np.minimum(np.minimum(floor, wall), 6.0)
    return depth * (1 + noise * np.random.default_rng(1).normal(size=depth.shape))


@pytest.mark.parametrize("noise", [0.0, 0.004])
@pytest.mark.parametrize("units", [200.0, 3000.0])
def test_planes_tell_disparity_from_depth(noise: float, units: float) -> None:
    depth = room(noise)
    as_metric = np.round(depth * units).astype(np.uint16)
    as_disparity = np.round(4 * units / depth).astype(np.uint16)
    assert disparity_share([as_metric]) < 0.3
    assert disparity_share([as_disparity]) > 0.7


def test_nothing_to_see() -> None:
    flat = np.full((240, 320), 1000, np.uint16)
    assert np.isnan(disparity_share([flat, np.zeros_like(flat)]))
    assert np.isnan(disparity_share([]))


@pytest.mark.parametrize(
    ("name", "is_disparity"),
    [
        ("kitti_tracking_0003_vdo_format_10f", True),
        ("7scenes_redkitchen_200f", False),
        ("redwood_open3d_5f", False),
    ],
)
def test_real_depth(real_data: Callable[[str], Path], name: str, is_disparity: bool) -> None:
    paths = sorted((real_data(name) / "depth").iterdir())
    images = [cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in paths[:: max(len(paths) // 5, 1)]]
    share = disparity_share(images)
    assert share > 0.7 if is_disparity else share < 0.3
