"""Pictures in a page: within their bytes, first by smaller ones, then by fewer."""

from __future__ import annotations

import base64
from pathlib import Path

import cv2
import numpy as np
import pytest

from viz.browser.pictures import EMBEDDED, embed_pictures, encode_jpeg, read_jpeg


@pytest.fixture(scope="module")
def paths(tmp_path_factory) -> list[Path | None]:
    """Twelve pictures that do not compress well, and two gaps."""
    folder = tmp_path_factory.mktemp("frames")
    rng = np.random.default_rng(0)
    files: list[Path | None] = []
    for k in range(12):
        rough = rng.integers(0, 256, (75, 250, 3)).astype(np.uint8)
        files.append(folder / f"{k}.png")
        cv2.imwrite(str(files[-1]), cv2.resize(rough, (1000, 300)))
    files[3:3] = [None]
    return [*files, None]


def width(uri: str) -> int:
    data = base64.b64decode(uri.removeprefix("data:image/jpeg;base64,"))
    return cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape[1]


def test_with_room_enough_all_are_large(paths):
    uris = embed_pictures(paths, 50e6)
    assert [uri is None for uri in uris] == [path is None for path in paths]
    assert {width(uri) for uri in uris if uri} == {EMBEDDED[0][0]}


@pytest.mark.parametrize("max_bytes", [6e5, 2e5, 6e4])
def test_with_less_room_they_are_smaller_and_then_fewer(paths, max_bytes):
    uris = [uri for uri in embed_pictures(paths, max_bytes) if uri]
    assert 0.3 * max_bytes < sum(map(len, uris)) <= max_bytes
    assert {width(uri) for uri in uris} < {w for w, _ in EMBEDDED[1:]} or len(uris) == 12
    if max_bytes < 1e5:
        assert 0 < len(uris) < 12 and width(uris[0]) == EMBEDDED[-1][0]


def test_without_room_there_is_none(paths):
    assert embed_pictures(paths, 0) == [None] * len(paths)


def test_colours_survive_and_a_damaged_file_is_left_out(tmp_path):
    red = np.tile(np.array([230, 20, 10], np.uint8), (40, 60, 1))
    (tmp_path / "red.jpg").write_bytes(encode_jpeg(red, 30, 90))
    back = cv2.imread(str(tmp_path / "red.jpg"))[..., ::-1]
    assert back.shape == (20, 30, 3)
    np.testing.assert_allclose(back, red[:20, :30], atol=6)
    (tmp_path / "bad.png").write_bytes(b"no picture")
    assert read_jpeg(tmp_path / "bad.png", 30, 90) is None
    uris = embed_pictures([tmp_path / "bad.png", tmp_path / "red.jpg"], 1e6)
    assert uris[0] is None and uris[1] is not None
