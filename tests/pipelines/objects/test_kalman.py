"""The filter of one object against simulated paths: consistency, coasting, turning, wild input."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.objects.kalman import ObjectFilter, direction_std

DT_S = 0.1
CENTER_SIGMA_M, VELOCITY_SIGMA_MPS, TURN_SIGMA_RADPS = 0.1, 0.2, 0.03


def path(n, speed_mps, turn_radps):
    """Centres (n, 3) on a circle in the plane y = 0, or on a line."""
    heading = turn_radps * DT_S * np.arange(n)
    if turn_radps == 0.0:
        return np.stack([speed_mps * DT_S * np.arange(n), np.zeros(n), np.zeros(n)], -1)
    radius = speed_mps / turn_radps
    return radius * np.stack([np.sin(heading), np.zeros(n), np.cos(heading) - 1.0], -1)


def feed(rng, centers, turn_radps, acceleration_mps2=3.0):
    """A filter that was shown noisy motions along a path; turn: (3,) rate it is told."""
    P = CENTER_SIGMA_M**2 * np.eye(3)
    V = VELOCITY_SIGMA_MPS**2 * np.eye(3)
    kf = ObjectFilter(centers[0] + rng.normal(size=3) * CENTER_SIGMA_M, P, acceleration_mps2)
    for before, now in pairwise(centers):
        kf.predict(DT_S)
        kf.update_motion(
            now + rng.normal(size=3) * CENTER_SIGMA_M,
            P,
            (now - before) / DT_S + rng.normal(size=3) * VELOCITY_SIGMA_MPS,
            V,
            turn_radps=turn_radps + rng.normal(size=3) * TURN_SIGMA_RADPS * (turn_radps.any()),
            dt_s=DT_S,
        )
    return kf


def test_a_steady_object_is_followed_as_well_as_claimed():
    centers, errors, distances = path(30, 12.0, 0.0), [], []
    for seed in range(60):
        kf = feed(np.random.default_rng(seed), centers, np.zeros(3), acceleration_mps2=0.5)
        error = kf.velocity_mps - [12.0, 0, 0]
        errors.append(error)
        distances.append(error @ np.linalg.solve(kf.velocity_covariance, error))
        assert np.linalg.norm(kf.center_m - centers[-1]) < 0.3
    assert 0.02 < np.std(errors) < VELOCITY_SIGMA_MPS  # smoothed, and not suspiciously well
    assert 1.0 < np.mean(distances) < 4.0  # chi-square of 3 degrees of freedom; noise is overstated


def test_coasting_goes_on_and_its_doubt_grows():
    kf = feed(np.random.default_rng(1), path(30, 12.0, 0.0), np.zeros(3))
    start, std = kf.center_m, [kf.speed_std_mps]
    spread = [kf.distances2(kf.center_m[None], np.zeros((3, 3)))[1]]
    for _ in range(10):
        kf.predict(DT_S)
        std.append(kf.speed_std_mps)
        spread.append(kf.distances2(kf.center_m[None], np.zeros((3, 3)))[1])
    assert kf.center_m[0] - start[0] == pytest.approx(12.0, abs=0.3)
    assert (np.diff(std) > 0).all() and (np.diff(spread) > 0).all()


def test_what_brakes_stands_in_the_end_and_never_turns_round():
    """Seen from 8 m/s down to 3 m/s at 2.5 m/s^2; a filter that goes on at 3 m/s is metres off."""
    speeds = 8.0 - 0.25 * np.arange(21)
    centers = np.stack([np.cumsum(speeds * DT_S), np.zeros(21), np.zeros(21)], -1)
    kf = feed(np.random.default_rng(3), centers, np.zeros(3))
    before, start, ways = kf.speed_std_mps, kf.center_m, []
    for k in range(20):
        kf.coast(DT_S, DT_S * (k + 1))
        ways.append(kf.center_m[0] - start[0])
    assert 1.3 < ways[-1] < 4.5  # braking on takes 1.8 m
    assert (np.diff(ways) > -1e-9).all()
    assert before + 4.0 < kf.speed_std_mps < 8.0  # 3 m/s^2 for two seconds


def test_what_has_no_sure_velocity_stays():
    kf = ObjectFilter(np.array([1.0, 0.0, 30.0]), np.eye(3), 3.0)
    kf.predict(DT_S)
    kf.update_center(np.array([3.0, 0.0, 30.0]), np.eye(3))
    where = kf.center_m
    assert np.linalg.norm(kf.velocity_mps) > 1.0
    spread = [kf.distances2(where[None], np.zeros((3, 3)))[1]]
    for _ in range(10):
        kf.stay(DT_S)
        spread.append(kf.distances2(where[None], np.zeros((3, 3)))[1])
    np.testing.assert_array_equal(kf.center_m, where)
    assert (np.diff(spread) > 0).all() and 5.0 <= kf.speed_std_mps < 6.0


def test_a_wild_centre_does_not_carry_the_filter_away():
    kf = feed(np.random.default_rng(1), path(30, 12.0, 0.0), np.zeros(3))
    kf.predict(DT_S)
    before = kf.center_m
    kf.update_center(before + np.array([0.0, 0.0, 40.0]), np.eye(3))
    assert 0.0 < kf.center_m[2] - before[2] < 1.0


@pytest.mark.parametrize("turn_radps", [0.3, -0.6])
def test_the_turn_rate_helps_a_turning_object(turn_radps):
    """Error of the predicted centre after coasting for half a second, with and without it."""
    centers = path(40, 10.0, turn_radps)
    axis = np.array([0.0, turn_radps, 0.0])
    with_turn, without, ways = [], [], []
    for seed in range(20):
        for told, errors in ((axis, with_turn), (np.zeros(3), without)):
            kf = feed(np.random.default_rng(seed), centers[:-5], told)
            for _ in range(5):
                kf.predict(DT_S)
            errors.append(np.linalg.norm(kf.center_m - centers[-1]))
            if told.any():
                ways.append(Rotation.from_rotvec(axis * DT_S * 39).inv().apply(kf.velocity_mps))
    assert np.mean(with_turn) < 0.5 * np.mean(without)
    assert 0.01 < np.mean(with_turn) < 0.25
    # The velocity is that of now, and not of half a step ago: its direction has no lag
    lag = np.arctan2(np.mean(ways, axis=0)[2], np.mean(ways, axis=0)[0])
    assert abs(lag) < 0.25 * abs(turn_radps) * DT_S


def test_an_exact_circle_is_predicted_without_error():
    """The chord model has no error of its own once speed and turn are known."""
    axis = np.array([0.0, 0.4, 0.0])
    centers = path(60, 8.0, 0.4)
    kf = ObjectFilter(centers[0], 1e-6 * np.eye(3), 3.0)
    tiny = 1e-8 * np.eye(3)
    for before, now in pairwise(centers[:-1]):
        kf.predict(DT_S)
        kf.update_motion(now, tiny, (now - before) / DT_S, tiny, turn_radps=axis, dt_s=DT_S)
    kf.predict(DT_S)
    np.testing.assert_allclose(kf.center_m, centers[-1], atol=1e-3)


def test_a_wild_turn_is_bounded():
    kf = ObjectFilter(np.zeros(3), np.eye(3), 3.0)
    for _ in range(30):
        kf.update_motion(
            np.zeros(3), np.eye(3), np.zeros(3), np.eye(3),
            turn_radps=np.array([0.0, 40.0, 0.0]), dt_s=DT_S,
        )  # fmt: skip
    np.testing.assert_allclose(kf.turn_radps, [0.0, 1.0, 0.0])


def test_one_wild_motion_does_not_carry_it_away_and_several_do():
    kf = feed(np.random.default_rng(2), path(30, 12.0, 0.0), np.zeros(3))
    before = kf.velocity_mps
    sure = 0.05**2 * np.eye(3)
    speeds = []
    for _ in range(12):
        kf.predict(DT_S)
        kf.update_motion(
            kf.center_m, sure, np.array([-12.0, 0, 0]), sure, turn_radps=np.zeros(3), dt_s=DT_S
        )
        speeds.append(kf.velocity_mps[0])
    assert abs(speeds[0] - before[0]) < 3.0
    assert speeds[-1] == pytest.approx(-12.0, abs=0.5)


def test_a_centre_alone_corrects_the_place():
    kf = feed(np.random.default_rng(3), path(10, 0.0, 0.0), np.zeros(3))
    for _ in range(20):
        kf.predict(DT_S)
        kf.update_center(np.array([1.0, 0.0, 0.0]), 0.01 * np.eye(3))
    np.testing.assert_allclose(kf.center_m, [1.0, 0, 0], atol=0.1)


def test_distances_are_in_standard_deviations():
    kf = ObjectFilter(np.array([1.0, 2.0, 3.0]), np.diag([1.0, 4.0, 9.0]), 3.0)
    centers = np.array([[1.0, 2.0, 3.0], [2.0, 2.0, 3.0], [1.0, 2.0, 9.0]])
    distance2, log_spread = kf.distances2(centers, np.zeros((3, 3)))
    np.testing.assert_allclose(distance2, [0.0, 1.0, 4.0], atol=1e-12)
    assert log_spread == pytest.approx(np.log(36.0))
    assert kf.distances2(np.empty((0, 3)), np.eye(3))[0].shape == (0,)


def test_direction_std_is_that_along_the_vector():
    covariance = np.diag([0.04, 1.0, 0.25])
    assert direction_std(np.array([3.0, 0, 0]), covariance) == pytest.approx(0.2)
    assert direction_std(np.array([0, 0, -2.0]), covariance) == pytest.approx(0.5)
    assert direction_std(np.zeros(3), covariance) == pytest.approx(1.0)  # any direction
    assert direction_std(np.ones(3), np.zeros((3, 3))) == 0.0
