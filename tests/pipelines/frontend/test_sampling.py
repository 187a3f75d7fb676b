"""Sub-pixel look-ups: exact on planes, silent across edges and beside unknown pixels."""

import numpy as np
import pytest

from pipelines.frontend.sampling import (
    disparity_slopes,
    edge_share,
    sample_bilinear,
    sample_disparity,
)

H, W = 60, 80
V, U = np.mgrid[:H, :W].astype(np.float64)
COEFFICIENTS = [(20.0, 0.0, 0.0), (20.0, 0.05, -0.08), (6.0, 0.02, 0.05)]


def plane(a, b, c):
    return a + b * U + c * V


def random_places(n, margin, seed=0):
    return np.random.default_rng(seed).uniform(
        [margin] * 2, [W - 1 - margin, H - 1 - margin], (n, 2)
    )


@pytest.mark.parametrize("coefficients", COEFFICIENTS)
def test_disparity_of_a_plane_is_exact_between_pixels(coefficients):
    uv = random_places(300, margin=0.0)  # up to the very border
    a, b, c = coefficients
    found = sample_disparity(plane(*coefficients).astype(np.float32), uv, 0.1)
    np.testing.assert_allclose(found, a + uv @ [b, c], atol=1e-3)


@pytest.mark.parametrize("coefficients", COEFFICIENTS)
def test_slopes_of_a_plane_are_exact_where_the_window_is_whole(coefficients):
    uv = random_places(300, margin=5.0)
    found = disparity_slopes(plane(*coefficients).astype(np.float32), uv, 0.1)
    np.testing.assert_allclose(found, np.tile(coefficients[1:], (300, 1)), atol=1e-4)


def test_slopes_average_noise_and_are_none_where_little_is_known():
    rng = np.random.default_rng(3)
    sigma = 0.2
    noisy = (plane(20.0, 0.03, 0.04) + rng.normal(0, sigma, (H, W))).astype(np.float32)
    error = disparity_slopes(noisy, random_places(800, margin=5.0), sigma) - [0.03, 0.04]
    expected = sigma / np.sqrt(25 * 8.0)  # 25 pixels, whose mean square from the middle is 8
    assert 0.8 * expected < np.std(error) < 1.3 * expected
    unknown = np.full((H, W), np.nan, np.float32)
    np.testing.assert_array_equal(disparity_slopes(unknown, random_places(5, 5.0), 0.1), 0.0)
    assert disparity_slopes(noisy, np.empty((0, 2)), 0.1).shape == (0, 2)


def test_disparity_averages_noise():
    rng = np.random.default_rng(1)
    sigma = 0.2
    noisy = (plane(20.0, 0.03, 0.04) + rng.normal(0, sigma, (H, W))).astype(np.float32)
    uv = random_places(800, margin=3.0)
    error = sample_disparity(noisy, uv, sigma) - (20.0 + uv @ [0.03, 0.04])
    assert 0.15 * sigma < np.std(error) < 0.35 * sigma  # a mean of 25 pixels has 0.2 sigma
    assert abs(error.mean()) < 0.05 * sigma


def step_edge(near=30.0, far=10.0, column=40):
    return np.where(column > U, near, far).astype(np.float32)


def test_disparity_never_mixes_the_two_sides_of_an_edge():
    disparity = step_edge()
    u = np.linspace(36, 43, 141)
    found = sample_disparity(disparity, np.column_stack([u, np.full(141, 30.3)]), 0.1)
    answered = np.isfinite(found)
    on_a_side = (np.abs(found - 30) < 1e-3) | (np.abs(found - 10) < 1e-3)
    assert on_a_side[answered].all()
    assert answered[(u < 37) | (u > 42.5)].all()
    assert (found[u < 37] > 29).all() and (found[u > 42.5] < 11).all()


def test_disparity_is_unknown_where_the_surface_is_too_thin():
    """A pole of two columns: fewer than 60 % of the window lie on it."""
    disparity = np.full((H, W), 10.0, np.float32)
    disparity[:, 40:42] = 30.0
    found = sample_disparity(disparity, np.array([[40.5, 30.2], [40.0, 30.0], [60.0, 30.0]]), 0.1)
    assert np.isnan(found[:2]).all()
    assert found[2] == pytest.approx(10.0)


def test_disparity_bridges_few_unknown_pixels_but_not_many():
    few = plane(20.0, 0.05, 0.0).astype(np.float32)
    few[20, 20] = few[22, 21] = np.nan
    uv = np.array([[20.3, 20.6]])
    assert sample_disparity(few, uv, 0.1)[0] == pytest.approx(20 + 0.05 * 20.3, abs=2e-3)
    many = few.copy()
    many[18:23, 18:21] = np.nan  # 15 of 25
    assert np.isnan(sample_disparity(many, uv, 0.1)[0])
    assert np.isnan(sample_disparity(np.full((H, W), np.nan, np.float32), uv, 0.1)[0])


def test_disparity_rejects_a_wild_pixel():
    disparity = plane(20.0, 0.05, 0.02).astype(np.float32)
    disparity[20, 20] = 60.0
    found = sample_disparity(disparity, np.array([[20.0, 20.0], [21.4, 19.2]]), 0.1)
    np.testing.assert_allclose(found, [21.4, 20 + 0.05 * 21.4 + 0.02 * 19.2], atol=2e-3)


def test_a_slanted_road_is_no_edge():
    """4 % a row at most, as a road has it; noise does not count as an edge either."""
    disparity = (0.2 * (V - 5)).clip(0.5).astype(np.float32)  # horizon at row 5
    uv = np.column_stack([random_places(200, 3.0)[:, 0], np.linspace(40, 55, 200)])
    found = sample_disparity(disparity, uv, 0.05)
    np.testing.assert_allclose(found, 0.2 * (uv[:, 1] - 5), atol=2e-3)


def test_no_places_give_no_disparities():
    assert sample_disparity(np.ones((H, W), np.float32), np.empty((0, 2)), 0.1).shape == (0,)


def test_bilinear_is_exact_on_planes_up_to_the_border():
    image = plane(1.0, 0.3, -0.2).astype(np.float32)
    uv = np.vstack([random_places(200, 0.0), [[0, 0], [W - 1, H - 1], [0, H - 1], [W - 1, 0]]])
    np.testing.assert_allclose(sample_bilinear(image, uv), 1 + uv @ [0.3, -0.2], atol=1e-4)


def test_bilinear_keeps_channels():
    flow = np.stack([plane(0, 1, 0), plane(0, 0, 1)], -1).astype(np.float32)
    uv = random_places(50, 0.0)
    np.testing.assert_allclose(sample_bilinear(flow, uv), uv, atol=1e-4)


def test_bilinear_weights_its_four_neighbours():
    image = np.zeros((H, W), np.float32)
    image[10, 20] = 1.0
    uv = np.array([[20.25, 10.0], [19.5, 10.5], [20.0, 9.1], [21.0, 10.0]])
    np.testing.assert_allclose(sample_bilinear(image, uv), [0.75, 0.25, 0.1, 0.0], atol=1e-6)


@pytest.mark.parametrize(
    "place",
    [(-0.01, 5), (5, -0.01), (W - 0.99, 5), (5, H - 0.99), (np.nan, 5), (5, np.nan), (1e9, -1e9)],
)
def test_bilinear_is_unknown_outside(place):
    image = np.ones((H, W), np.float32)
    found = sample_bilinear(image, np.array([place, (5.0, 5.0)]))
    assert np.isnan(found[0]) and found[1] == 1.0


def test_bilinear_is_unknown_beside_unknown_pixels():
    image = np.ones((H, W, 2), np.float32)
    image[10, 20, 0] = np.nan
    found = sample_bilinear(image, np.array([[19.5, 9.5], [20.5, 10.5], [17.5, 10.0]]))
    assert np.isnan(found[:2, 0]).all() and found[2, 0] == 1.0
    assert (found[:, 1] == 1.0).all()


def test_maps_are_not_changed():
    disparity, uv = step_edge(), random_places(30, 0.0)
    before = disparity.copy(), uv.copy()
    sample_disparity(disparity, uv, 0.1)
    sample_bilinear(disparity, uv)
    np.testing.assert_array_equal(disparity, before[0])
    np.testing.assert_array_equal(uv, before[1])


def test_share_across_a_depth_edge():
    """Beside an edge it is what lies across; slants, noise and unknown pixels are no edges."""
    rng, sigma = np.random.default_rng(1), 0.1
    disparity = np.where(U < 40, 20.0, 8.0) + rng.normal(0.0, sigma, (H, W))
    columns = np.array([20.0, 30.0, 33.0, 37.0, 41.0, 47.0, 60.0])
    uv = np.column_stack([columns, np.full(len(columns), 30.0)])
    np.testing.assert_allclose(
        edge_share(disparity.astype(np.float32), uv, sigma),
        np.array([0, 0, 1, 2, 2, 1, 0]) / 5.0,
    )
    slanted = (plane(20.0, 0.05, -0.08) + rng.normal(0.0, sigma, (H, W))).astype(np.float32)
    assert (edge_share(slanted, random_places(200, 0.0), sigma) == 0.0).all()
    slanted[:, ::3] = np.nan
    assert (edge_share(slanted, random_places(200, 0.0), sigma) == 0.0).all()
    nothing = np.full((H, W), np.nan, np.float32)
    assert (edge_share(nothing, uv, sigma) == 0.0).all()
    assert edge_share(nothing, np.empty((0, 2)), sigma).shape == (0,)
