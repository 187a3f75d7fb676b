"""The software renderer: points at their pixels, nearer ones in front, white stays white."""

import numpy as np
import pytest

from viz.scene import View
from viz.splat import disc_radius_px, splat_points

K = np.array([[100.0, 0.0, 79.5], [0.0, 100.0, 59.5], [0.0, 0.0, 1.0]])
VIEW = View("test", (160, 120), K, np.eye(4))
WHITE = (255, 255, 255)


def splat(points, colors, radius_m=0.05):
    return splat_points(VIEW, np.array(points, float), np.array(colors, np.uint8), radius_m, WHITE)


def test_a_point_is_at_its_pixel():
    picture = splat([[0.3, -0.2, 1.0]], [[200, 0, 0]], radius_m=0.005)
    assert picture.shape == (120, 160, 3)
    v, u = np.nonzero((picture != 255).any(2))
    weights = 255.0 - picture[v, u, 1]
    assert np.average(u, weights=weights) == pytest.approx(109.5, abs=0.3)
    assert np.average(v, weights=weights) == pytest.approx(39.5, abs=0.3)
    assert len(u) < 16
    assert (picture[60:] == 255).all()


def test_the_nearer_point_is_in_front():
    points, colors = [[0.0, 0.0, 2.0], [0.0, 0.0, 1.0]], [[0, 0, 250], [0, 250, 0]]
    for order in (slice(None), slice(None, None, -1)):
        picture = splat(points[order], colors[order])
        assert picture[60, 80].tolist() == [0, 250, 0]


def test_discs_are_round_and_grow_with_nearness():
    areas = []
    large = View("test", (1280, 960), np.diag([8.0, 8.0, 1.0]) @ K, np.eye(4))
    black = np.zeros((1, 3), np.uint8)
    for z in (1.0, 2.0):
        picture = splat_points(large, np.array([[0.0, 0.0, z]]), black, 0.007, WHITE)
        painted = (picture < 128).any(2)
        rows, columns = np.nonzero(painted)
        assert np.ptp(rows) == np.ptp(columns)
        assert painted.sum() == pytest.approx(np.pi * (0.007 * 800 / z) ** 2, rel=0.2)
        areas.append(painted.sum())
    assert areas[0] > areas[1] > 0
    radii = disc_radius_px(large, np.array([0.01, 1.0, 1e6]), 0.01)
    assert (np.diff(radii) <= 0).all()
    assert radii[-1] >= 1.0


def test_nothing_to_draw_is_pure_white():
    assert (splat(np.empty((0, 3)), np.empty((0, 3))) == 255).all()
    assert (splat([[0.0, 0.0, -1.0], [50.0, 0.0, 1.0]], [[0, 0, 0]] * 2) == 255).all()


def test_points_at_the_edge_are_cut_not_wrapped():
    picture = splat([[0.795, 0.0, 1.0]], [[0, 0, 0]], radius_m=0.2)
    assert (picture[:, 140:] < 255).any()
    assert (picture[:, :100] == 255).all()


def test_a_disc_that_reaches_into_the_picture_is_drawn_so_far():
    large = View("test", (1280, 960), np.diag([8.0, 8.0, 1.0]) @ K, np.eye(4))
    black = np.zeros((1, 3), np.uint8)
    x = (-3.0 - large.K[0, 2]) / large.K[0, 0]  # its middle is 3 pixels beyond the left side
    picture = splat_points(large, np.array([[x, 0.0, 1.0]]), black, 0.05, WHITE)
    columns = np.nonzero((picture < 128).any(2))[1]
    assert columns.min() == 0 and columns.max() in (3, 4)


def test_far_points_fade_and_near_ones_are_left_out():
    view = View("test", (160, 120), K, np.eye(4), near_m=0.5, haze=(2.0, 6.0, 0.5))
    for z, shown in ((0.4, 255), (1.0, 0), (4.0, 64), (9.0, 128)):
        picture = splat_points(view, np.array([[0.0, 0.0, z]]), np.uint8([[0, 0, 0]]), 0.05, WHITE)
        assert picture[59:61, 79:81].min() == pytest.approx(shown, abs=2)
