"""The noise model learns what it is shown, and little from few or wild residuals."""

import numpy as np
import pytest

from pipelines.frontend.noise import NoiseModel, robust_sigma


@pytest.mark.parametrize("sigma", [0.01, 0.3, 1.5])
def test_robust_sigma_of_normal_residuals(sigma):
    residuals = np.random.default_rng(0).normal(0, sigma, (4000, 2))
    assert robust_sigma(residuals) == pytest.approx(sigma, rel=0.04)


def test_robust_sigma_shrugs_off_a_tenth_of_outliers():
    rng = np.random.default_rng(1)
    residuals = np.r_[rng.normal(0, 0.2, 3600), rng.normal(0, 50, 400)]
    assert 0.2 < robust_sigma(residuals) < 0.26


@pytest.mark.parametrize("sigma", [0.03, 0.15, 1.1])
@pytest.mark.parametrize("source", ["flow", "alignment", "orb"])
def test_a_source_converges_to_its_own_sigma(source, sigma):
    rng, noise = np.random.default_rng(2), NoiseModel()
    before = dict(noise.sigma_uv_px)
    for _ in range(25):
        noise.learn_uv(source, rng.normal(0, sigma, (300, 2)))
    assert noise.sigma_uv_px.pop(source) == pytest.approx(sigma, rel=0.06)
    before.pop(source)
    assert noise.sigma_uv_px == before  # the others know nothing of it
    assert noise.sigma_disparity_px == NoiseModel().sigma_disparity_px


def test_disparity_noise_is_learned_apart():
    rng, noise = np.random.default_rng(3), NoiseModel()
    for _ in range(25):
        noise.learn_disparity(rng.normal(0, 0.22, 300))
    assert noise.sigma_disparity_px == pytest.approx(0.22, rel=0.06)
    assert noise.sigma_uv_px == NoiseModel().sigma_uv_px


def test_a_change_is_followed_gradually():
    rng, noise = np.random.default_rng(4), NoiseModel()
    noise.learn_disparity(rng.normal(0, 0.1, 2000))
    path = []
    for _ in range(20):
        noise.learn_disparity(rng.normal(0, 0.5, 2000))
        path.append(noise.sigma_disparity_px)
    assert 0.1 < path[0] < 0.3  # one frame alone does not decide
    assert path[-1] == pytest.approx(0.5, rel=0.05)
    assert (np.diff(path[:8]) > 0).all()


@pytest.mark.parametrize("residuals", [np.empty((0, 2)), np.full((5, 2), 1.9)])
def test_few_residuals_change_nothing(residuals):
    noise = NoiseModel()
    noise.learn_uv("flow", residuals)
    noise.learn_disparity(residuals[:, 0])
    assert noise.sigma_uv_px == NoiseModel().sigma_uv_px
    assert noise.sigma_disparity_px == NoiseModel().sigma_disparity_px


def test_sigmas_stay_between_floor_and_ceiling():
    noise = NoiseModel()
    for _ in range(30):
        noise.learn_uv("flow", np.zeros((100, 2)))
        noise.learn_uv("orb", np.full((100, 2), 40.0))
    assert noise.sigma_uv_px["flow"] == pytest.approx(noise.floor_px, rel=0.2)
    assert noise.floor_px > 0
    assert noise.sigma_uv_px["orb"] == pytest.approx(noise.ceiling_px, rel=0.01)


def test_models_do_not_share_their_tables():
    a, b = NoiseModel(), NoiseModel()
    a.learn_uv("flow", np.full((100, 2), 1.0))
    assert b.sigma_uv_px["flow"] != a.sigma_uv_px["flow"]


def test_a_source_begins_with_what_another_has_learned():
    noise = NoiseModel()
    noise.learn_uv("flow", np.full((100, 2), 0.1))
    noise.borrow("object_flow", "flow")
    assert noise.sigma_uv_px["object_flow"] == noise.sigma_uv_px["flow"] != 0.3
    noise.learn_uv("object_flow", np.full((100, 2), 0.4))  # the first of its own replace it
    assert noise.sigma_uv_px["object_flow"] == pytest.approx(0.4 * 1.4826)


def test_nothing_is_borrowed_from_a_guess_nor_by_who_knows():
    noise = NoiseModel()
    noise.borrow("object_flow", "flow")
    assert noise.sigma_uv_px == NoiseModel().sigma_uv_px
    noise.learn_uv("object_flow", np.full((100, 2), 0.2))
    noise.learn_uv("flow", np.full((100, 2), 0.05))
    own = noise.sigma_uv_px["object_flow"]
    noise.borrow("object_flow", "flow")
    assert noise.sigma_uv_px["object_flow"] == own
