"""Points of an object in two images by descriptors alone, however far it moved."""

import cv2
import numpy as np
import pytest

from pipelines.objects.search import match_masks

H, W = 160, 320
SIZE = (70, 90)


def scene(top, left, seed=0):
    """A textured object on a textured background that stands; its mask and window."""
    rng = np.random.default_rng(seed)
    back = cv2.resize(rng.integers(0, 255, (H // 8, W // 8)).astype(np.uint8), (W, H))
    thing = cv2.resize(
        np.random.default_rng(99).integers(0, 255, (SIZE[0] // 5, SIZE[1] // 5)).astype(np.uint8),
        SIZE[::-1],
    )
    back[top : top + SIZE[0], left : left + SIZE[1]] = thing
    return back, np.ones(SIZE, bool), (slice(top, top + SIZE[0]), slice(left, left + SIZE[1]))


@pytest.mark.parametrize(
    ("place_prev", "place"),
    [((40, 30), (60, 200)), ((0, 0), (90, 230)), ((90, 230), (0, 0))],  # corners of the image too
)
def test_a_far_jump_is_found(place_prev, place):
    uv_prev, uv = match_masks(*scene(*place_prev), *scene(*place, seed=1))
    assert len(uv) > 15
    jump = np.array([place[1] - place_prev[1], place[0] - place_prev[0]])
    right = np.linalg.norm(uv - uv_prev - jump, axis=1) < 2.0
    assert right.mean() > 0.8
    assert (uv[:, 0] >= place[1]).all() and (uv[:, 0] < place[1] + SIZE[1]).all()


def test_only_pixels_of_the_mask_are_matched():
    gray, mask, window = scene(40, 30)
    half = mask.copy()
    half[:, 45:] = False
    uv_prev, uv = match_masks(gray, half, window, gray, mask, window)
    assert len(uv) > 3 and uv_prev[:, 0].max() < 30 + 45
    assert (np.abs(uv - uv_prev).max(1) < 1.0).mean() > 0.9


def test_nothing_to_find():
    gray, mask, window = scene(40, 30)
    flat = np.full_like(gray, 128)
    tiny = np.ones((2, 2), bool), (slice(0, 2), slice(W - 2, W))
    for other in ((flat, mask, window), (gray, *tiny), (gray, np.zeros_like(mask), window)):
        uv_prev, uv = match_masks(gray, mask, window, *other)
        assert uv_prev.shape == uv.shape == (0, 2)
