"""The map's message: what meshcat reads back is what was put in, and the same each time."""

from __future__ import annotations

import numpy as np
import pytest
import umsgpack

from viz.browser.cloud import build_cloud

UP, FORWARD = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
PATH = np.column_stack([np.zeros(20), np.zeros(20), np.arange(20.0)])


def street(n: int = 4000) -> tuple[np.ndarray, np.ndarray]:
    """Houses 6 m to each side of the path, and a road 1.6 m below it."""
    rng = np.random.default_rng(1)
    side = np.column_stack(
        [rng.choice([-6.0, 6.0], n), rng.uniform(-5, 1.6, n), rng.uniform(0, 19, n)]
    )
    road = np.column_stack(
        [rng.uniform(-6, 6, n // 4), np.full(n // 4, 1.6), rng.uniform(0, 19, n // 4)]
    )
    points = np.vstack([side, road])
    return points, rng.integers(0, 256, (len(points), 3)).astype(np.uint8)


def attributes(message: bytes) -> dict[str, np.ndarray]:
    told = umsgpack.unpackb(message)
    assert (told["type"], told["path"]) == ("set_object", "/dyob/map")
    (geometry,) = told["object"]["geometries"]
    found = {}
    for name, kind in (("position", np.float32), ("color", np.uint8)):
        values = geometry["data"]["attributes"][name]
        assert values["itemSize"] == 3
        assert values["normalized"] is (name == "color")
        found[name] = np.frombuffer(values["array"].data, kind).reshape(-1, 3)
    return found


def test_points_and_colours_come_back():
    points, colors = street()
    cloud = build_cloud(points, colors, PATH, (UP, FORWARD))
    read = attributes(cloud.message)
    np.testing.assert_allclose(read["position"], points, atol=1e-5)
    np.testing.assert_array_equal(read["color"], colors)
    assert cloud.n_points == cloud.n_all == len(points)


def test_the_same_map_gives_the_same_bytes():
    points, colors = street(500)
    first, second = (build_cloud(points, colors, PATH, (UP, FORWARD)) for _ in range(2))
    assert first == second


def test_a_large_map_is_thinned_evenly():
    points, colors = street()
    cloud = build_cloud(points, colors, PATH, (UP, FORWARD), max_points=1000)
    read = attributes(cloud.message)["position"]
    assert (cloud.n_points, cloud.n_all, len(read)) == (1000, len(points), 1000)
    assert (read[:, 0] < 0).mean() == pytest.approx((points[:, 0] < 0).mean(), abs=0.05)


def test_sizes_and_ground_are_those_of_the_street():
    facts = build_cloud(*street(), PATH, (UP, FORWARD)).facts
    assert 3.0 < facts["scale_m"] < 6.5
    assert facts["ground_m"] == pytest.approx(-1.6, abs=0.1)  # along up
    (left, near, low), (right, far, high) = facts["extent_m"]
    assert (left, right) == (-6.0, 6.0)
    assert near < 1.5 and far > 17.5
    assert low == pytest.approx(-1.6, abs=0.1) and high == pytest.approx(4.6, abs=0.4)


def test_no_map_at_all_is_still_a_message():
    cloud = build_cloud(np.empty((0, 3)), np.empty((0, 3), np.uint8), PATH, (UP, FORWARD))
    assert len(attributes(cloud.message)["position"]) == 0
    assert cloud.facts["extent_m"] == []
