"""Stereo depth on a pair with exact truth: a slanted plane with texture and a board before it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.config import DepthConfig
from pipelines.datasets import open_sequence
from pipelines.depth import StereoDepth, to_gray
from pipelines.types import StereoCamera

WIDTH, HEIGHT = 320, 160
CAMERA = StereoCamera(WIDTH, HEIGHT, 300.0, 300.0, 160.0, 80.0, 90.0)
BOARD = (slice(40, 110), slice(150, 220))  # rows, columns in the left image
BOARD_PX = 26.4  # its disparity


@dataclass(frozen=True)
class Pair:
    """A stereo pair and its true disparity; `hidden` pixels are not in the right image."""

    left: np.ndarray
    right: np.ndarray
    disparity: np.ndarray
    hidden: np.ndarray


def texture(seed: int) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(HEIGHT, 2 * WIDTH)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.3) + 2 * cv2.GaussianBlur(noise, (0, 0), 5)
    return np.clip(120 + 45 * smooth / smooth.std(), 5, 250).astype(np.float32)


@pytest.fixture(scope="module")
def pair() -> Pair:
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float32)
    a, b, c = 4.0, 0.02, 0.03
    disparity = a + b * u + c * v  # a plane
    wall, board = texture(1), texture(2)

    def sample(image: np.ndarray, columns: np.ndarray) -> np.ndarray:
        return cv2.remap(image, columns + WIDTH / 2, v, cv2.INTER_CUBIC)

    left = sample(wall, u)
    right = sample(wall, (u + a + c * v) / (1 - b))  # solved for the left column
    hidden = (u - disparity) < 0
    on_board = np.zeros((HEIGHT, WIDTH), bool)
    on_board[BOARD] = True
    left[on_board] = sample(board, u)[on_board]
    shifted = u + np.float32(BOARD_PX)
    rows, columns = BOARD
    in_right = (v >= rows.start) & (v < rows.stop)
    in_right &= (shifted >= columns.start - 0.5) & (shifted < columns.stop - 0.5)
    right[in_right] = sample(board, shifted)[in_right]
    behind = (u - disparity > columns.start - BOARD_PX) & (u < columns.start)
    hidden |= behind & (v >= rows.start) & (v < rows.stop)
    disparity[on_board] = BOARD_PX
    return Pair(to_uint8(left), to_uint8(right), disparity, hidden)


def to_uint8(image: np.ndarray) -> np.ndarray:
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def stereo() -> StereoDepth:
    return StereoDepth(DepthConfig(sgbm_num_disparities=48), CAMERA)


def test_disparity_is_dense_and_sub_pixel(pair: Pair, stereo: StereoDepth) -> None:
    found = stereo.disparity(pair.left, pair.right)
    assert found.dtype == np.float32
    seen = ~pair.hidden
    assert 0.85 < np.isfinite(found[seen]).mean() <= 1.0
    error = np.abs(found - pair.disparity)[seen & np.isfinite(found)]
    assert 0.0 < np.median(error) < 0.06
    assert (error > 1).mean() < 0.02


def test_left_right_check_empties_what_only_one_eye_sees(pair: Pair, stereo: StereoDepth) -> None:
    found = stereo.disparity(pair.left, pair.right)
    rows, columns = BOARD
    behind_board = pair.hidden[rows, columns.start - 15 : columns.start]
    assert behind_board.mean() > 0.5  # the test has something to hide
    kept = np.isfinite(found[rows, columns.start - 15 : columns.start])[behind_board]
    assert kept.mean() < 0.25
    on_board = found[rows, columns][8:-8, 8:-8]
    assert abs(np.nanmedian(on_board) - BOARD_PX) < 0.08


def test_refinement_beats_the_steps_of_the_matcher(
    pair: Pair, stereo: StereoDepth, monkeypatch: pytest.MonkeyPatch
) -> None:
    refined = stereo.disparity(pair.left, pair.right)
    monkeypatch.setattr(StereoDepth, "_refine", lambda self, d, known, left, right: (d, known))
    plain = stereo.disparity(pair.left, pair.right)
    both = np.isfinite(refined) & np.isfinite(plain) & ~pair.hidden
    errors = [np.median(np.abs(d - pair.disparity)[both]) for d in (refined, plain)]
    assert errors[0] < 0.6 * errors[1]


def test_depth_is_bf_over_disparity(pair: Pair, stereo: StereoDepth) -> None:
    depth, disparity = (
        stereo.compute(pair.left, pair.right),
        stereo.disparity(pair.left, pair.right),
    )
    assert depth.dtype == np.float32
    np.testing.assert_allclose(depth, 90.0 / disparity, rtol=1e-6)
    colour = [np.repeat(image[..., None], 3, axis=2) for image in (pair.left, pair.right)]
    np.testing.assert_array_equal(stereo.compute(*colour), depth)
    tiny = np.array([[0.05, 0.1, -1.0, np.nan]], np.float32)
    np.testing.assert_allclose(stereo.depth_of(tiny), [[np.nan, 900.0, np.nan, np.nan]], rtol=1e-5)


def test_right_image_of_another_exposure(pair: Pair, stereo: StereoDepth) -> None:
    brighter = to_uint8(pair.right * 1.05 + 8.0)
    found = stereo.disparity(pair.left, brighter)
    seen = ~pair.hidden & np.isfinite(found)
    assert seen.mean() > 0.75
    assert np.median(np.abs(found - pair.disparity)[seen]) < 0.1


def test_odd_sizes_halve_as_well_as_even_ones(pair: Pair) -> None:
    camera = StereoCamera(WIDTH - 1, HEIGHT - 1, 300.0, 300.0, 160.0, 80.0, 90.0)
    stereo = StereoDepth(DepthConfig(sgbm_num_disparities=48), camera)
    inside = np.s_[:-1, :-1]
    found = stereo.disparity(pair.left[inside], pair.right[inside])
    seen = ~pair.hidden[inside]
    assert 0.85 < np.isfinite(found[seen]).mean() <= 1.0
    error = np.abs(found - pair.disparity[inside])[seen & np.isfinite(found)]
    assert 0.0 < np.median(error) < 0.06
    assert (error > 1).mean() < 0.02


def test_search_range_is_kept(pair: Pair) -> None:
    narrow = StereoDepth(DepthConfig(sgbm_num_disparities=16), CAMERA)
    assert np.nanmax(narrow.disparity(pair.left, pair.right)) < 17


@pytest.mark.parametrize("level", [0, 255])
def test_images_without_texture_give_no_depth(stereo: StereoDepth, level: int) -> None:
    flat = np.full((HEIGHT, WIDTH), level, np.uint8)
    assert np.isnan(stereo.compute(flat, flat)).all()


def test_unrelated_images_give_next_to_no_depth(stereo: StereoDepth) -> None:
    images = np.random.default_rng(0).integers(0, 255, (2, HEIGHT, WIDTH), dtype=np.uint8)
    assert np.isfinite(stereo.compute(images[0], images[1])).mean() < 0.05


def test_images_of_another_size_are_refused(stereo: StereoDepth, pair: Pair) -> None:
    with pytest.raises(ValueError, match=r"expected two images of \(160, 320\)"):
        stereo.compute(pair.left[:-1], pair.right[:-1])


def test_grey_of_rgb() -> None:
    red = np.zeros((2, 2, 3), np.uint8)
    red[..., 0] = 255
    assert (to_gray(red) == 76).all()


def test_real_stereo_road_is_a_plane(real_data: Callable[[str], Path]) -> None:
    """On the road ahead disparity is linear in the row, at 1.65 m below the camera."""
    sequence = open_sequence(real_data("kitti_odom06_000-050_stereo"))
    frame, camera = sequence.read(20), sequence.camera
    assert frame.image_right is not None
    depth = StereoDepth(DepthConfig(), camera).compute(frame.image, frame.image_right)
    assert 0.6 < np.isfinite(depth).mean() < 0.95
    v = np.arange(260, 350)[:, None]
    road = depth[260:350, 480:700]
    height_m = (v - camera.cy) / camera.fy * road
    assert np.isfinite(road).mean() > 0.9
    assert 1.45 < np.nanmedian(height_m) < 1.85
    assert np.nanstd(height_m) < 0.12
