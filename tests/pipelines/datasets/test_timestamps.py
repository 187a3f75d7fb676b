"""Times of frames, and pairing by time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.datasets.timestamps import associate, frame_times
from pipelines.errors import DatasetError


def times_file(root: Path, *times: float) -> Path:
    (root / "times.txt").write_text("\n".join(map(str, times)))
    return root / "times.txt"


def test_good_times_are_kept_as_they_are(tmp_path: Path) -> None:
    path = times_file(tmp_path, 5.0, 5.11, 5.19, 5.3, 5.4)
    np.testing.assert_array_equal(frame_times(path, 10.0, 4, tmp_path), [5.0, 5.11, 5.19, 5.3])
    np.testing.assert_array_equal(frame_times(path, None, 4, tmp_path), [5.0, 5.11, 5.19, 5.3])


@pytest.mark.parametrize(
    ("times", "fault"),
    [
        ((0.0, 0.05, 0.1), "0.05 s a frame"),
        ((0.0, 0.13, 0.26), "0.13 s a frame"),
        ((0.0, 0.1), "expected 3 times, found 2"),
        ((0.0, 0.1, 0.1), "increasing"),
    ],
)
def test_times_not_to_be_believed(
    tmp_path: Path, times: tuple[float, ...], fault: str, caplog: pytest.LogCaptureFixture
) -> None:
    path = times_file(tmp_path, *times)
    np.testing.assert_allclose(frame_times(path, 10.0, 3, tmp_path), [0, 0.1, 0.2])
    assert fault in caplog.text


def test_no_times_at_all(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no times"):
        frame_times(tmp_path / "times.txt", None, 3, tmp_path)
    with pytest.raises(DatasetError, match="increasing"):
        frame_times(times_file(tmp_path, 2.0, 1.0), None, 2, tmp_path)
    (tmp_path / "times.txt").write_text("noon\n")
    with pytest.raises(DatasetError, match="one time in seconds"):
        frame_times(tmp_path / "times.txt", 10.0, 1, tmp_path)


def test_association_is_one_to_one_and_near() -> None:
    times, others = np.array([0.0, 0.010, 1.0, 2.0]), np.array([2.03, 0.008, 1.015])
    np.testing.assert_array_equal(associate(times, others), [-1, 1, 2, -1])
    np.testing.assert_array_equal(associate(times, others, 0.05), [-1, 1, 2, 0])
    np.testing.assert_array_equal(associate(times, np.empty(0)), [-1] * 4)
