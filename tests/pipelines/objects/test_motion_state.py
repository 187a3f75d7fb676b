"""Who moves: the rule in m/s with its hysteresis, and the paper's by scene flow."""

from itertools import pairwise

import numpy as np
import pytest

from pipelines.config import ObjectsConfig
from pipelines.object_types import ObjectState
from pipelines.objects.motion_state import decide_by_scene_flow, decide_by_speed

CONFIG = ObjectsConfig(min_speed_mps=0.3, significance=3.0)
MOVING, STOPPED, UNKNOWN = ObjectState.MOVING, ObjectState.STOPPED, ObjectState.UNKNOWN


@pytest.mark.parametrize(
    ("before", "speed_mps", "std_mps", "after"),
    [
        (UNKNOWN, 1.0, 0.2, MOVING),  # 3 sigma above the limit
        (UNKNOWN, 1.0, 0.25, UNKNOWN),  # not quite
        (UNKNOWN, 0.1, 0.05, STOPPED),
        (UNKNOWN, 0.1, 0.15, UNKNOWN),
        (MOVING, 0.25, 0.05, MOVING),  # slower than the limit, faster than half of it
        (STOPPED, 0.25, 0.05, STOPPED),
        (MOVING, 0.14, 0.02, STOPPED),
        (MOVING, 0.4, 0.5, UNKNOWN),  # it may move, and may not
        (STOPPED, 0.4, 0.5, STOPPED),  # nothing proves that it drove off
        (STOPPED, 2.0, 0.4, MOVING),
        (ObjectState.COASTING, 0.5, 0.2, UNKNOWN),
        (UNKNOWN, np.nan, np.nan, UNKNOWN),
    ],
)
def test_state_by_speed_and_by_what_was(before, speed_mps, std_mps, after):
    assert decide_by_speed(CONFIG, before, speed_mps, std_mps) is after


def test_a_noisy_speed_near_the_limit_does_not_flicker():
    rng = np.random.default_rng(0)
    for start in (MOVING, STOPPED):
        state, states = start, []
        for speed in np.abs(0.27 + rng.normal(0, 0.02, 200)):
            state = decide_by_speed(CONFIG, state, speed, 0.02)
            states.append(state)
        assert set(states) == {start}


def test_a_car_that_brakes_and_starts_changes_state_twice():
    speeds = np.r_[np.linspace(5, 0, 50), np.zeros(10), np.linspace(0, 5, 50)]
    state, states = UNKNOWN, []
    for speed in speeds:
        state = decide_by_speed(CONFIG, state, speed, 0.05)
        states.append(state)
    changes = [(a, b) for a, b in pairwise(states) if a is not b]
    assert changes == [(MOVING, STOPPED), (STOPPED, MOVING)]


@pytest.mark.parametrize(
    ("n_still", "state"), [(0, MOVING), (3, MOVING), (4, STOPPED), (10, STOPPED)]
)
def test_scene_flow_rule_of_the_paper(n_still, state):
    """Still where more than 30 % of the points have less than 0.12 m of scene flow."""
    flow = np.tile([0.0, 0.0, 0.121], (10, 1))
    flow[:n_still] = [0.0, 0.1, 0.06]  # 0.117 m long
    assert decide_by_scene_flow(ObjectsConfig(), flow) is state


def test_scene_flow_of_no_points_says_nothing():
    assert decide_by_scene_flow(ObjectsConfig(), np.empty((0, 3))) is UNKNOWN
