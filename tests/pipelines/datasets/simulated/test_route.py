"""Ways through a town: a block closes, the way onward never meets itself, nobody skids."""

import numpy as np
import pytest

from pipelines.datasets.simulated.route import CORNER_M, Route, block_route, onward_route

DT = 0.1


def driven(route, seconds):
    """s, x, z and heading at 10 fps."""
    s = route.s_at(np.arange(0, seconds, DT))
    return (s, *route.at(s, 0.0))


def test_a_round_of_the_block_comes_back_to_its_start():
    route, round_m = block_route(500.0)
    s = np.linspace(0, round_m, 400)
    first, second = np.array(route.at(s, 0.0)), np.array(route.at(s + round_m, 0.0))
    assert np.abs(first[:2] - second[:2]).max() < 1e-9
    assert second[2] - first[2] == pytest.approx(2 * np.pi, abs=1e-9)
    assert np.ptp(first[0]) > 35  # it does go round something
    assert route.end_s > 500
    assert 20 < route.time_at(round_m) < 27


@pytest.mark.parametrize("seed", range(4))
def test_the_way_onward_keeps_away_from_where_it_has_been(seed):
    route = onward_route(1200.0, np.random.default_rng(seed))
    assert route.end_s > 1200
    s = np.arange(0, 1200, 2.0)
    p = np.stack(route.at(s, 0.0)[:2], 1)
    apart = np.linalg.norm(p[:, None] - p[None], axis=2)
    later = np.abs(s[:, None] - s[None]) > 80
    assert apart[later].min() > 40
    turns = {corner.turn for corner in route.corners}
    assert turns == {-1, 1}


def test_speed_and_steering_are_those_of_a_careful_driver():
    route = onward_route(900.0, np.random.default_rng(1))
    s, x, z, heading = driven(route, 100)
    speed = np.hypot(np.diff(x), np.diff(z)) / DT
    assert speed.min() == pytest.approx(6.0, abs=0.1)
    assert speed.max() == pytest.approx(9.0, abs=0.1)
    assert np.abs(np.diff(speed)).max() / DT < 2.6  # m/s^2
    yaw_rate_deg = np.degrees(np.abs(np.diff(heading))) / DT
    assert 25 < yaw_rate_deg.max() < 45
    assert np.abs(np.diff(yaw_rate_deg)).max() / DT < 60  # steering is turned, not thrown
    assert np.diff(s).min() > 0


def test_time_and_place_are_each_others_inverse():
    route, _ = block_route(300.0)
    s = np.linspace(-20, 250, 77)
    assert route.s_at(route.time_at(s)) == pytest.approx(s, abs=1e-6)
    assert route.time_at(0.0) == pytest.approx(0.0, abs=1e-9)


def test_going_straight_through_leaves_the_route_along_its_tangent():
    route, _ = block_route(300.0)
    joins, leaves = route.corners[4].end_m, route.corners[5].s_m
    s = np.array([joins - 10, joins, (joins + leaves) / 2, leaves, leaves + 10.0])
    x, z, heading = route.straight_through(s, 0.0, joins, leaves)
    on_x, on_z, on_heading = route.at(s, 0.0)
    away = np.hypot(x - on_x, z - on_z)
    assert away[1:4].max() < 1e-9
    assert away[[0, 4]].min() > 1.5
    assert np.ptp(heading) < 1e-9
    assert np.abs(on_heading - heading)[[0, 4]].min() > 0.3
    steps = np.hypot(np.diff(x), np.diff(z))
    assert steps == pytest.approx(np.diff(s), abs=1e-6)


def test_a_corner_is_a_right_angle():
    route = Route(-10.0, 60.0, [])
    assert np.ptp(route.at(np.linspace(-10, 60, 50), 0.0)[2]) == 0
    route, _ = block_route(100.0)
    corner = route.corners[3]
    before, after = (float(route.at(np.array(s), 0.0)[2]) for s in (corner.s_m, corner.end_m))
    assert after - before == pytest.approx(np.pi / 2, abs=1e-6)
    assert corner.end_m - corner.s_m == CORNER_M
