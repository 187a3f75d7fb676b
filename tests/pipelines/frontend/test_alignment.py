"""Patch alignment on images shifted by known parts of a pixel, and fusion with flow."""

import numpy as np
import pytest

from pipelines.frontend.alignment import align_patches, fuse_measurements

H, W = 200, 300
SHIFT = np.array([2.37, -1.62])


def textured(shift=(0.0, 0.0), seed=0):
    """A smooth random image; with a shift, what was at p is then at p + shift, exactly.

    Made and shifted by its Fourier series: interpolation would add errors of its own.
    """
    noise = np.fft.fft2(np.random.default_rng(seed).normal(size=(H, W)))
    fy, fx = np.fft.fftfreq(H)[:, None], np.fft.fftfreq(W)[None]
    smooth = noise * np.exp(-2 * (2.0 * np.pi) ** 2 * (fx**2 + fy**2))  # blurred by 2 px
    moved = np.fft.ifft2(smooth * np.exp(-2j * np.pi * (fx * shift[0] + fy * shift[1]))).real
    return np.clip(128 + 45 * moved / moved.std(), 0, 255).round().astype(np.uint8)


def places(n=150, margin=30, seed=1):
    return np.random.default_rng(seed).uniform([margin] * 2, [W - margin, H - margin], (n, 2))


def test_a_known_shift_is_found_to_a_hundredth_of_a_pixel():
    uv = places()
    rng = np.random.default_rng(2)
    predicted = uv + SHIFT + rng.uniform(-3, 3, uv.shape)
    found, ok = align_patches(textured(), textured(SHIFT), uv, predicted, 10.0)
    error = found - uv - SHIFT
    assert ok.mean() > 0.97
    assert 1e-3 < np.std(error[ok]) < 0.02
    assert np.abs(error[ok].mean(0)).max() < 0.004  # no pull towards whole pixels


def test_no_shift_is_found_as_none():
    uv = places()
    found, ok = align_patches(textured(), textured(), uv, uv, 5.0)
    assert ok.all()
    assert np.abs(found - uv).max() < 0.01


def test_a_place_too_far_from_its_prediction_is_refused():
    uv = places()
    _, near = align_patches(textured(), textured(SHIFT), uv, uv, 4.0)  # the shift is 2.87 px
    _, far = align_patches(textured(), textured(SHIFT), uv, uv, 2.5)
    assert near.mean() > 0.9
    assert far.mean() < 0.05


def test_unknown_predictions_are_not_ok():
    uv = places(10)
    predicted = uv + SHIFT
    predicted[3] = np.nan
    predicted[5, 1] = np.inf
    found, ok = align_patches(textured(), textured(SHIFT), uv, predicted, 5.0)
    assert np.flatnonzero(~ok).tolist() == [3, 5]
    assert found.shape == (10, 2)


def test_flat_patches_and_places_outside_are_not_ok():
    flat = np.full((H, W), 90, np.uint8)
    _, ok = align_patches(flat, flat, places(20), places(20), 5.0)
    assert not ok.any()
    outside = np.array([[-40.0, 20.0], [W + 40.0, 20.0], [50.0, H + 40.0]])
    _, ok = align_patches(textured(), textured(), outside, outside, 5.0)
    assert not ok.any()


def test_nothing_to_align():
    found, ok = align_patches(textured(), textured(), np.empty((0, 2)), np.empty((0, 2)), 5.0)
    assert found.shape == (0, 2) and ok.shape == (0,)


def test_fusion_weighs_by_inverse_variance():
    a, b = np.array([[10.0, 20.0]]), np.array([[10.4, 19.8]])
    yes = np.ones(1, bool)
    uv, valid, sigma = fuse_measurements(a, yes, 0.1, b, yes, 0.2)
    np.testing.assert_allclose(uv, (4 * a + b) / 5)
    assert valid.all()
    assert sigma[0] == pytest.approx(1 / np.sqrt(1 / 0.1**2 + 1 / 0.2**2))


def test_fusion_is_as_precise_as_it_says():
    rng = np.random.default_rng(3)
    n, sigma_a, sigma_b = 4000, 0.3, 0.2
    truth = rng.uniform(0, 100, (n, 2))
    a, b = (truth + rng.normal(0, s, (n, 2)) for s in (sigma_a, sigma_b))
    yes = np.ones(n, bool)
    uv, _, sigma = fuse_measurements(a, yes, sigma_a, b, yes, sigma_b)
    assert np.unique(sigma.round(6)).size <= 2  # fused, or alone where they disagree by chance
    assert np.std(uv - truth) == pytest.approx(np.sqrt(np.mean(sigma**2)), rel=0.05)
    assert np.std(uv - truth) < 0.95 * sigma_b


@pytest.mark.parametrize(("sigma_a", "sigma_b"), [(0.1, 0.4), (0.4, 0.1)])
def test_disagreement_believes_the_more_precise_source(sigma_a, sigma_b):
    a, b = np.array([[10.0, 20.0]]), np.array([[15.0, 20.0]])
    yes = np.ones(1, bool)
    uv, valid, sigma = fuse_measurements(a, yes, sigma_a, b, yes, sigma_b)
    np.testing.assert_array_equal(uv, a if sigma_a < sigma_b else b)
    assert valid.all() and sigma[0] == pytest.approx(0.1)


def test_a_source_stands_alone_where_the_other_is_missing():
    a = np.array([[1.0, 1.0], [np.nan, np.nan], [3.0, 3.0], [np.nan, np.nan]])
    b = np.array([[np.nan, np.nan], [2.0, 2.0], [9.0, 9.0], [5.0, 5.0]])
    ok_a, ok_b = np.array([1, 0, 1, 0], bool), np.array([0, 1, 0, 0], bool)
    uv, valid, sigma = fuse_measurements(a, ok_a, 0.1, b, ok_b, 0.2)
    np.testing.assert_array_equal(uv[:3], [[1, 1], [2, 2], [3, 3]])
    assert valid.tolist() == [True, True, True, False]
    np.testing.assert_allclose(sigma[:3], [0.1, 0.2, 0.1])
