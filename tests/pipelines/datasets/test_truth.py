"""Parsing of truth files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.datasets.truth import ever_moves, read_kitti_poses, read_tum_poses
from pipelines.errors import DatasetError
from pipelines.geometry import rotation_angle_deg


def test_tum_poses_between_at_and_beyond_their_stamps(tmp_path: Path) -> None:
    half = np.sin(np.pi / 8), np.cos(np.pi / 8)  # 45 deg about y
    (tmp_path / "gt.txt").write_text(
        "# comment\n0.0 0 0 0 0 0 0 1\n"
        f"0.1 1 0 2 0 {half[0]} 0 {half[1]}\n"
        "1.0 5 0 0 0 0 0 1\n2.0 0 0 0 0 0 0 0\n"
    )
    Ts = read_tum_poses(tmp_path / "gt.txt", np.array([0.0, 0.025, 0.1, 0.5, 0.985, 1.5, 2.0]))
    known = np.isfinite(Ts).all(axis=(1, 2))
    assert known.tolist() == [True, True, True, False, True, False, False]
    np.testing.assert_allclose(Ts[1, :3, 3], [0.25, 0, 0.5])
    assert rotation_angle_deg(Ts[1]) == pytest.approx(45 / 4)
    np.testing.assert_allclose(Ts[4, :3, 3], [5, 0, 0])  # 15 ms off: the nearest


def test_kitti_poses_by_order_or_number(tmp_path: Path) -> None:
    rows = np.tile(np.eye(4)[:3].ravel(), (4, 1))
    rows[:, 11] = np.arange(4)
    np.savetxt(tmp_path / "poses.txt", rows)
    in_order = read_kitti_poses(tmp_path / "poses.txt", [10, 11, 12, 13])
    by_number = read_kitti_poses(tmp_path / "poses.txt", [1, 3, 5])
    np.testing.assert_array_equal(in_order[:, 2, 3], [0, 1, 2, 3])
    np.testing.assert_array_equal(by_number[:, 2, 3], [1, 3, np.nan])


def test_rows_of_another_length(tmp_path: Path) -> None:
    (tmp_path / "poses.txt").write_text("1 2 3\n")
    with pytest.raises(DatasetError, match="12 numbers a row, found 3"):
        read_kitti_poses(tmp_path / "poses.txt", [0])


@pytest.mark.parametrize(
    ("speed_mps", "seconds", "moves"), [(0.5, 5.0, False), (1.5, 5.0, True), (1.5, 0.4, True)]
)
def test_moving_is_a_speed_over_a_second(speed_mps: float, seconds: float, moves: bool) -> None:
    t = np.arange(0, seconds, 0.1)
    noise = np.random.default_rng(3).normal(0, 0.05, (len(t), 3))
    positions = np.outer(t, [speed_mps, 0, 0]) + noise
    assert ever_moves(np.full(len(t), 4), t, positions).all() == moves


def test_start_after_a_long_wait_is_moving() -> None:
    t = np.arange(0, 20, 0.1)
    positions = np.outer(np.clip(t - 18, 0, None) * 2, [1, 0, 0])
    ids = np.repeat([1, 2], len(t))
    both = np.concatenate([positions, np.zeros_like(positions)])
    moving = ever_moves(ids, np.tile(t, 2), both)
    assert moving[ids == 1].all()
    assert not moving[ids == 2].any()
