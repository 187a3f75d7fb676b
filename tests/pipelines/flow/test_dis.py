"""Dense inverse search on images whose motion is known."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipelines.config import FlowConfig
from pipelines.errors import ConfigError
from pipelines.flow import load_flow
from pipelines.flow.dis import DisFlow

WIDTH, HEIGHT = 320, 200


def texture() -> np.ndarray:
    noise = np.random.default_rng(7).normal(size=(HEIGHT, WIDTH)).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 1.5) + 2 * cv2.GaussianBlur(noise, (0, 0), 6)
    return np.clip(120 + 45 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def moved(image: np.ndarray, A: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`image` under the affine motion A (2, 3), and the true flow (H, W, 2)."""
    v, u = np.mgrid[:HEIGHT, :WIDTH].astype(np.float64)
    there = np.stack([u, v, np.ones_like(u)], -1) @ A.T
    flow = there - np.stack([u, v], -1)
    return cv2.warpAffine(image, A, (WIDTH, HEIGHT), flags=cv2.INTER_CUBIC), flow


MOTIONS = {
    "shift": np.array([[1.0, 0, 3.3], [0, 1, -1.2]]),
    "turn": cv2.getRotationMatrix2D((160, 100), 2.0, 1.01),
}


@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize(("preset", "bound_px"), [("medium", 0.12), ("fast", 0.3)])
def test_known_motion(motion: str, preset: str, bound_px: float) -> None:
    before = texture()
    after, truth = moved(before, MOTIONS[motion])
    flow = DisFlow(preset).compute(before, after)
    error = np.linalg.norm(flow - truth, axis=2)[20:-20, 20:-20]
    assert 0.0 < np.median(error) < bound_px


def test_check_empties_what_left_the_image_or_was_covered() -> None:
    before = texture()
    after, _ = moved(before, np.array([[1.0, 0, 24], [0, 1, 0]]))
    after[80:140, 60:120] = 128  # a board that was not there before
    flow = load_flow(FlowConfig(name="dis", check=True)).compute(before, after)
    unknown = np.isnan(flow).any(axis=2)
    assert unknown[20:-20, -20:].mean() > 0.9  # left the image
    assert unknown[90:130, 46:86].mean() > 0.3  # is under the board, which has no texture
    assert unknown[20:70, 40:250].mean() < 0.02
    unchecked = DisFlow().compute(before, after)
    assert np.isfinite(unchecked).all()
    np.testing.assert_array_equal(flow[~unknown], unchecked[~unknown])


def test_black_images_have_no_motion() -> None:
    black = np.zeros((HEIGHT, WIDTH), np.uint8)
    np.testing.assert_allclose(DisFlow().compute(black, black), 0.0, atol=1e-6)


def test_parts_of_larger_images_are_taken() -> None:
    big = np.dstack([texture()] * 3)
    part = big[10:-10, 10:-10, 1]
    assert not part.flags.c_contiguous
    assert np.abs(DisFlow().compute(part, part)).max() < 0.05


def test_colour_images_count_by_their_grey_values() -> None:
    rgb = np.dstack([texture(), texture()[::-1], texture()[:, ::-1]])
    after = np.roll(rgb, 2, axis=1)
    flow = DisFlow().compute(rgb, after)
    grey = [cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) for image in (rgb, after)]
    np.testing.assert_array_equal(flow, DisFlow().compute(*grey))
    assert abs(np.median(flow[20:-20, 20:-20, 0]) - 2) < 0.1


def test_unknown_presets_are_refused() -> None:
    with pytest.raises(ConfigError, match="expected ultrafast, fast, medium, found 'slow'"):
        DisFlow("slow")
