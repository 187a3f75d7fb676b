"""Decoding single files, and the errors of those that cannot be used."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.datasets.files import (
    DamagedFileError,
    DepthCoding,
    clean_depth,
    read_depth,
    read_flow,
    read_image,
    read_labels,
)
from pipelines.errors import DatasetError, FrameError


@pytest.fixture
def png(tmp_path: Path) -> Path:
    path = tmp_path / "image.png"
    bgr = np.zeros((6, 8, 3), np.uint8)
    bgr[..., 2] = 200
    assert cv2.imwrite(str(path), bgr)
    return path


def test_colour_images_are_rgb(png: Path) -> None:
    image = read_image(png, (8, 6))
    assert image.shape == (6, 8, 3)
    assert image[0, 0].tolist() == [200, 0, 0]


def test_grey_and_transparent_images(tmp_path: Path) -> None:
    pixels = np.full((6, 8), 7, np.uint8)
    cv2.imwrite(str(tmp_path / "grey.png"), pixels)
    cv2.imwrite(str(tmp_path / "alpha.png"), np.dstack([pixels, pixels + 1, pixels + 2, pixels]))
    assert read_image(tmp_path / "grey.png").shape == (6, 8)
    assert read_image(tmp_path / "alpha.png")[0, 0].tolist() == [9, 8, 7]


@pytest.mark.parametrize("content", [b"", b"plain text", None])
def test_unreadable_images(png: Path, content: bytes | None) -> None:
    png.write_bytes(png.read_bytes()[:-20] if content is None else content)
    with pytest.raises(DamagedFileError, match=r"image\.png: expected an image, found"):
        read_image(png)


def test_missing_and_sixteen_bit_images(tmp_path: Path) -> None:
    with pytest.raises(FrameError, match="No such file"):
        read_image(tmp_path / "none.png")
    cv2.imwrite(str(tmp_path / "deep.png"), np.zeros((6, 8), np.uint16))
    with pytest.raises(FrameError, match="expected 8 bits"):
        read_image(tmp_path / "deep.png")


def test_wrong_size_is_not_damage(png: Path) -> None:
    with pytest.raises(FrameError, match=r"64 x 48.*found 8 x 6") as error:
        read_image(png, (64, 48))
    assert not isinstance(error.value, DamagedFileError)


def test_depth_codings() -> None:
    raw = np.array([[0, 256, 2560, 65535]], np.uint16)
    disparity = DepthCoding("disparity", 256.0, bf=400.0).to_metres(raw)
    np.testing.assert_allclose(disparity, [[np.nan, 400.0, 40.0, np.nan]])
    metric = DepthCoding("metric", 1000.0).to_metres(raw)
    np.testing.assert_allclose(metric, [[np.nan, 0.256, 2.56, np.nan]], rtol=1e-6)
    absurd = DepthCoding("disparity", 256.0, bf=400.0).to_metres(np.array([[1]], np.uint16))
    assert np.isnan(absurd).all()  # 102 km


@pytest.mark.parametrize(
    ("form", "factor", "bf"), [("inverse", 1.0, 1.0), ("metric", 0.0, 0.0), ("disparity", 1.0, 0.0)]
)
def test_depth_coding_rejects_nonsense(form: str, factor: float, bf: float) -> None:
    with pytest.raises(DatasetError, match="expected"):
        DepthCoding(form, factor, bf)  # type: ignore[arg-type]


def test_depth_that_is_no_distance_becomes_nan() -> None:
    depth = clean_depth(np.array([[-1.0, 0.0, np.nan, np.inf, 2.0, 5000.0]]))
    np.testing.assert_array_equal(np.isnan(depth), [[1, 1, 1, 1, 0, 1]])
    assert depth.dtype == np.float32


def test_depth_from_arrays_and_from_wrong_images(tmp_path: Path, png: Path) -> None:
    coding = DepthCoding("metric", 1.0)
    np.save(tmp_path / "depth.npy", np.array([[1.5, -2.0]]))
    np.testing.assert_array_equal(read_depth(tmp_path / "depth.npy", coding), [[1.5, np.nan]])
    np.save(tmp_path / "counts.npy", np.array([[1, 2]]))
    with pytest.raises(FrameError, match="floats in metres"):
        read_depth(tmp_path / "counts.npy", coding)
    with pytest.raises(
        FrameError, match="expected a 16-bit image of one channel, found uint8 of 3"
    ):
        read_depth(png, coding)


def test_object_arrays_are_refused(tmp_path: Path) -> None:
    np.save(tmp_path / "depth.npy", np.array([{"a": 1}], object), allow_pickle=True)
    with pytest.raises(DamagedFileError):
        read_depth(tmp_path / "depth.npy", DepthCoding("metric", 1.0))


def test_flow_round_trip_and_unknown_vectors(tmp_path: Path) -> None:
    flow = np.random.default_rng(0).normal(0, 5, (6, 8, 2)).astype(np.float32)
    flow[2, 3] = 2e9
    cv2.writeOpticalFlow(str(tmp_path / "a.flo"), flow)
    read = read_flow(tmp_path / "a.flo", (8, 6))
    assert np.isnan(read[2, 3]).all()
    known = ~np.isnan(read)
    assert known.sum() == flow.size - 2
    np.testing.assert_array_equal(read[known], flow[known])
    assert read.flags.c_contiguous


def test_damaged_flow(tmp_path: Path) -> None:
    cv2.writeOpticalFlow(str(tmp_path / "a.flo"), np.zeros((6, 8, 2), np.float32))
    content = (tmp_path / "a.flo").read_bytes()
    (tmp_path / "a.flo").write_bytes(content[:-8])
    with pytest.raises(DamagedFileError, match="8 x 6 vectors"):
        read_flow(tmp_path / "a.flo")
    (tmp_path / "a.flo").write_bytes(b"XXXX" + content[4:])
    with pytest.raises(DamagedFileError, match="another format"):
        read_flow(tmp_path / "a.flo")


def test_labels_in_each_format(tmp_path: Path) -> None:
    labels = np.zeros((6, 8), np.int32)
    labels[1:3, 2:5], labels[4, 4] = 3, 117
    np.savetxt(tmp_path / "a.txt", labels, fmt="%d")
    cv2.imwrite(str(tmp_path / "a.png"), labels.astype(np.uint8))
    np.save(tmp_path / "a.npy", labels - (labels == 0))  # -1 is background too
    for name in ("a.txt", "a.png", "a.npy"):
        read = read_labels(tmp_path / name, (8, 6))
        assert read.dtype == np.int32
        np.testing.assert_array_equal(read, labels)


@pytest.mark.parametrize(("text", "message"), [("1 2 3", "found 3"), ("1 two 3", "expected")])
def test_labels_that_are_no_matrix(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(FrameError, match=message):
        read_labels(tmp_path / "a.txt", (8, 6))
