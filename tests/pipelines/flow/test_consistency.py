"""Flow against flow back: where the answer is known, and against scipy's interpolation."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from pipelines.config import FlowConfig
from pipelines.flow import load_flow
from pipelines.flow.consistency import CheckedFlow, forward_backward_error

H, W = 40, 60


def constant(du: float, dv: float) -> np.ndarray:
    return np.full((H, W, 2), (du, dv), np.float32)


def test_a_shift_there_and_back_comes_home_except_over_the_border() -> None:
    error = forward_backward_error(constant(3, -2), constant(-3, 2))
    assert (error.shape, error.dtype) == ((H, W), np.float32)
    np.testing.assert_allclose(error[2:, :-3], 0.0, atol=1e-6)
    assert np.isposinf(error[:2]).all()
    assert np.isposinf(error[:, -3:]).all()


def test_the_error_is_the_distance_from_home() -> None:
    error = forward_backward_error(constant(3, -2), constant(-3 + 0.6, 2 - 0.8))
    np.testing.assert_allclose(error[2:, :-3], 1.0, atol=1e-5)


def test_no_flow_at_all_comes_home_up_to_the_last_row() -> None:
    assert (forward_backward_error(constant(0, 0), constant(0, 0)) == 0).all()


def test_unknown_flow_has_an_unknown_error() -> None:
    flow, back = constant(0, 0), constant(0, 0)
    flow[10, 20, 1] = np.nan
    back[30, 40, 0] = np.nan
    flow[5, 6] = 40.0  # leaves the image downwards
    error = forward_backward_error(flow, back)
    assert np.isnan(error[[10, 30], [20, 40]]).all()
    assert np.isnan(error).sum() <= 1 + 4  # a bilinear sample reaches four pixels
    assert np.isposinf(error[5, 6])


def test_the_error_against_scipy() -> None:
    rng = np.random.default_rng(3)
    smooth = [gaussian_filter(rng.normal(size=(H, W)), 6) for _ in range(4)]
    flow, back = (np.stack(pair, 2).astype(np.float32) * 20 for pair in (smooth[:2], smooth[2:]))
    v, u = np.mgrid[:H, :W]
    there_u, there_v = u + flow[..., 0], v + flow[..., 1]
    inside = (there_u >= 0) & (there_u <= W - 1) & (there_v >= 0) & (there_v <= H - 1)
    read = [map_coordinates(back[..., i], [there_v, there_u], order=1) for i in (0, 1)]
    expected = np.hypot(flow[..., 0] + read[0], flow[..., 1] + read[1])
    error = forward_backward_error(flow, back)
    np.testing.assert_array_equal(np.isfinite(error), inside)
    assert 0.5 < inside.mean() < 1.0
    # OpenCV may round places to 1 / 32 pixel.
    np.testing.assert_allclose(error[inside], expected[inside], atol=0.02)


def test_flows_of_two_sizes() -> None:
    with pytest.raises(ValueError, match="back"):
        forward_backward_error(constant(0, 0), constant(0, 0)[1:])


class Fixed:
    """A method that always answers the same."""

    def __init__(self, flow: np.ndarray | None) -> None:
        self.flow = flow

    def compute(self, previous, image, given=None):
        return self.flow


def test_what_does_not_return_is_emptied_and_nothing_is_changed_in_place() -> None:
    flow, back = constant(2, 0), constant(-2, 0)
    back[10:20, 30:40] = 0  # misses by 2 pixels
    image = np.zeros((H, W), np.uint8)
    for limit, expected in ((1.0, 10 * 10 + 2 * H), (3.0, 2 * H)):
        checked = CheckedFlow(Fixed(flow), Fixed(back), limit).compute(image, image)
        unknown = np.isnan(checked).all(axis=2)
        assert unknown.sum() == expected
        assert unknown[:, -2:].all()
        np.testing.assert_array_equal(checked[~unknown], flow[~unknown])
    np.testing.assert_array_equal(flow, constant(2, 0))


def test_without_flow_there_is_nothing_to_check() -> None:
    image = np.zeros((H, W), np.uint8)
    assert CheckedFlow(Fixed(None), Fixed(constant(0, 0))).compute(image, image) is None
    unchecked = CheckedFlow(Fixed(constant(1, 1)), Fixed(None)).compute(image, image)
    np.testing.assert_array_equal(unchecked, constant(1, 1))


def test_flow_that_comes_with_the_sequence_is_checked_by_computed_flow() -> None:
    noise = gaussian_filter(np.random.default_rng(7).normal(size=(120, 160)), 1.5)
    before = np.clip(120 + 45 * noise / noise.std(), 0, 255).astype(np.uint8)
    shift = np.array([[1.0, 0, 3], [0, 1, 0]])
    after = cv2.warpAffine(before, shift, (160, 120), borderMode=cv2.BORDER_REFLECT)
    given = np.full((120, 160, 2), (3, 0), np.float32)
    given[40:60, 50:90] = (9, 4)  # wrong
    checked = load_flow(FlowConfig(name="files", check=True)).compute(before, after, given)
    unknown = np.isnan(checked).any(axis=2)
    assert unknown[40:60, 50:90].mean() > 0.95
    inner = unknown[15:-15, 15:-15].copy()
    inner[25:45, 35:75] = False
    assert inner.mean() < 0.02
    np.testing.assert_array_equal(checked[~unknown], given[~unknown])
