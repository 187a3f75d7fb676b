"""Own data in a folder with a camera.yaml."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.datasets.folder import FolderSequence
from pipelines.errors import DatasetError

Write = Callable[[str], Path]


def change_yaml(root: Path, **changes: float | str | None) -> None:
    lines = (root / "camera.yaml").read_text().splitlines()
    kept = [line for line in lines if line.split(":")[0] not in changes]
    added = [f"{k}: {v}" for k, v in changes.items() if v is not None]
    (root / "camera.yaml").write_text("\n".join([*kept, *added]))


def test_everything_there_is(write_tree: Write) -> None:
    sequence = FolderSequence.open(write_tree("folder"))
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(4) / 20)
    frame = sequence.read(3)
    assert frame.depth_m is not None
    assert frame.depth_m[20, 30] == pytest.approx(4.0 + 0.6 + 0.2 + 0.3, rel=1e-3)
    assert frame.flow_prev_to_curr_px is not None
    assert frame.flow_prev_to_curr_px[5, 5, 0] == 3.0  # from 2.npy
    assert frame.instance_labels is not None
    assert set(np.unique(frame.instance_labels)) == {0, 1, 12}


def test_frames_are_in_order_of_their_numbers(write_tree: Write) -> None:
    root = write_tree("folder")
    for k in (0, 1, 2, 3):
        (root / f"images/{k}.png").rename(root / f"images/x{k * 4}.png")  # x0 x4 x8 x12
    sequence = FolderSequence.open(root)
    last = cv2.imread(str(root / "images/x12.png"))[..., ::-1]
    np.testing.assert_array_equal(sequence.read(3).image, last)


def test_stereo_with_a_baseline(write_tree: Write) -> None:
    root = write_tree("folder")
    (root / "images").rename(root / "left")
    (root / "depth").rename(root / "elsewhere")
    (root / "right").mkdir()
    for k in range(4):
        cv2.imwrite(str(root / f"right/{k}.png"), np.full((48, 64, 3), k, np.uint8))
    change_yaml(root, bf=None, depth_scale=None)
    with pytest.raises(DatasetError, match=r"bf \(px \* m\) or baseline_m"):
        open_sequence(root)
    change_yaml(root, baseline_m=0.3)
    sequence = open_sequence(root)
    assert sequence.camera.bf == pytest.approx(15.0)
    right = sequence.read(2).image_right
    assert right is not None
    assert (right == 2).all()


def test_times_file_or_frame_rate(write_tree: Write) -> None:
    root = write_tree("folder")
    change_yaml(root, fps=None)
    with pytest.raises(DatasetError, match=r"times\.txt .* or fps"):
        FolderSequence.open(root)
    (root / "times.txt").write_text("1.0\n1.3\n1.4\n1.9\n")
    np.testing.assert_allclose(FolderSequence.open(root).timestamps_s, [1.0, 1.3, 1.4, 1.9])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fx": None, "cy": None}, "missing calibration, expected fx, .* found no fx, cy"),
        ({"fx": "wide"}, "expected a number for `fx`, found 'wide'"),
        ({"fx": -3}, "expected positive fx"),
        ({"cx": 500}, "principal point inside the image of 64 x 48"),
        ({"depth_scal": 1000}, "unknown key `depth_scal`; did you mean `depth_scale`"),
        ({"depth_scale": None}, "expected depth_scale"),
        ({"width": 1280, "height": 720}, "expected images of 1280 x 720 .* found 64 x 48"),
    ],
)
def test_wrong_settings(
    write_tree: Write, changes: dict[str, float | str | None], message: str
) -> None:
    root = write_tree("folder")
    change_yaml(root, **changes)
    with pytest.raises(DatasetError, match=message):
        open_sequence(root)


def test_neither_depth_nor_right_images(write_tree: Write) -> None:
    root = write_tree("folder")
    (root / "depth").rename(root / "elsewhere")
    with pytest.raises(DatasetError, match="no depth and no right images"):
        open_sequence(root)


def test_depth_in_metres_needs_no_scale(write_tree: Write) -> None:
    root = write_tree("folder")
    for path in sorted((root / "depth").iterdir()):
        np.save(path.with_suffix(".npy"), np.full((48, 64), 2.5, np.float32))
        path.unlink()
    change_yaml(root, depth_scale=None)
    depth = open_sequence(root).read(1).depth_m
    assert depth is not None
    assert (depth == 2.5).all()
