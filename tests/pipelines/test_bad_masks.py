"""Masks of a folder that are of another size, all black, all white, high or missing."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.datasets import open_sequence
from pipelines.errors import DatasetError
from pipelines.io.result import load_result
from tests.pipelines.damage import blacken, rewrite, run_folder, warnings_of


def masks_of(folder: Path) -> list[Path]:
    return sorted((folder / "semantic").iterdir())


def write_folder(street, root: Path, n_frames: int = 6) -> Path:
    """The street in the layout for data of one's own, with masks."""
    camera = street.camera
    for name in ("images", "depth", "masks"):
        (root / name).mkdir(parents=True)
    for k in range(n_frames):
        frame = street.read(k)
        assert cv2.imwrite(str(root / f"images/{k}.png"), frame.image[..., ::-1])
        assert cv2.imwrite(str(root / f"masks/{k}.png"), frame.instance_labels.astype(np.uint16))
        np.save(root / f"depth/{k}.npy", frame.depth_m)
    (root / "camera.yaml").write_text(
        f"fx: {camera.fx}\nfy: {camera.fy}\ncx: {camera.cx}\ncy: {camera.cy}\nbf: {camera.bf}\n"
        "fps: 10\n"
    )
    return root


def test_a_mask_of_another_size_is_named_and_its_frame_skipped(street, tmp_path, caplog) -> None:
    """Whoever masks pictures of another size has masked other pictures."""
    folder = write_folder(street, tmp_path / "own")
    rewrite(folder / "masks/3.png", lambda mask: mask[:-10, :-20])
    result = run_folder(folder)
    counts = result.metrics["run"]
    assert (counts["frames"], counts["tracked"], counts["skipped"]) == (6, 5, 1)
    (said,) = [line for line in warnings_of(caplog).splitlines() if "frame 3 skipped" in line]
    assert str(Path("masks/3.png")) in said
    assert "497 x 150" in said
    assert "477 x 140" in said
    assert len(result.objects) > 30
    assert 3 not in result.objects.frame_index


def test_masks_that_are_all_of_another_size_are_one_clear_sentence(street, tmp_path) -> None:
    folder = write_folder(street, tmp_path / "own")
    for mask in (folder / "masks").iterdir():
        rewrite(mask, lambda pixels: pixels[:-10, :-20])
    with pytest.raises(DatasetError, match="expected frames that can be read, found none"):
        run_folder(folder)


def test_masks_of_labels_up_to_65535_are_read_as_they_are(street, tmp_path) -> None:
    plain = run_folder(write_folder(street, tmp_path / "plain" / "own"))
    folder = write_folder(street, tmp_path / "high" / "own")
    for mask in (folder / "masks").iterdir():
        rewrite(mask, lambda labels: np.where(labels > 0, 65335 + labels, 0).astype(np.uint16))
    high = run_folder(folder)
    assert (open_sequence(folder).read(0).instance_labels > 65335).any()
    for name in ("objects.csv", "camera_kitti.txt"):
        assert (high.folder / name).read_bytes() == (plain.folder / name).read_bytes()
    assert len(plain.objects) > 30


def test_masks_that_are_all_black_are_a_street_without_objects(vdo_folder) -> None:
    for mask in masks_of(vdo_folder):
        rewrite(mask, blacken)
    result = run_folder(vdo_folder)
    assert result.metrics["run"]["tracked"] == 10
    assert len(result.objects) == 0
    assert not (result.folder / "objects").exists()
    assert load_result(result.folder).metrics["objects"]["object_frames"] == 0


def test_masks_that_hide_all_are_a_clear_outcome(vdo_folder) -> None:
    for mask in masks_of(vdo_folder):
        rewrite(mask, np.ones_like)
    result = run_folder(vdo_folder)
    counts = result.metrics["run"]
    assert (counts["tracked"], counts["lost"]) == (0, 10)
    assert np.isnan(result.objects.speed_mps).all()


def test_masks_that_are_missing_are_carried_by_flow(vdo_folder, caplog) -> None:
    """The very first among them: it does not decide that there are none."""
    for k in (0, 5):
        (vdo_folder / f"semantic/{k:06d}.png").unlink()
    result = run_folder(vdo_folder)
    assert result.metrics["run"]["tracked"] == 10
    for k in (0, 5):
        assert f"frame {k} has no mask" in warnings_of(caplog)
    objects = result.objects
    assert objects.frame_index.min() == 1
    carried = objects[objects.frame_index == 5]
    seen = carried[np.isfinite(carried.score)]
    assert len(seen) > 3
    assert (seen.score == 0).all()
    assert (seen.speed_mps > 5).any()
    assert result.metrics["objects"]["id_switches_while_moving"] == 0
