"""Indices of palette PNGs are labels, whatever their colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.datasets.files import DamagedFileError, read_labels
from pipelines.datasets.palette import is_palette_png


def write(path: Path, indices: np.ndarray, palette: list[int]) -> None:
    image = Image.fromarray(indices, mode="P")
    image.putpalette(palette)
    image.save(path, transparency=0)


@pytest.mark.parametrize("palette", [[9, 9, 9] * 256, list(range(256)) * 3], ids=["one", "many"])
def test_indices_survive_any_palette(tmp_path: Path, palette: list[int]) -> None:
    indices = np.random.default_rng(0).integers(0, 256, (48, 64)).astype(np.uint8)
    write(tmp_path / "a.png", indices, palette)
    assert is_palette_png((tmp_path / "a.png").read_bytes())
    labels = read_labels(tmp_path / "a.png", (64, 48))
    assert labels.dtype == np.int32
    np.testing.assert_array_equal(labels, indices)


def test_a_palette_png_cut_short_is_a_damaged_file(tmp_path: Path) -> None:
    write(tmp_path / "a.png", np.eye(200, dtype=np.uint8) * 7, [1] * 768)
    content = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(content[:-60])
    labels = (tmp_path / "a.png").read_bytes()
    assert is_palette_png(labels)
    with pytest.raises(DamagedFileError):
        read_labels(tmp_path / "a.png", (200, 200))


def test_grey_and_colour_are_no_palettes(tmp_path: Path) -> None:
    for shape in ((4, 5), (4, 5, 3)):
        Image.fromarray(np.zeros(shape, np.uint8)).save(tmp_path / "a.png")
        assert not is_palette_png((tmp_path / "a.png").read_bytes())
    assert not is_palette_png(b"\x89PNG\r\n\x1a\n")
