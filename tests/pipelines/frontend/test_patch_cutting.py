"""Patches are kept while they fit, and cut anew where they do not."""

from dataclasses import fields

import cv2
import numpy as np
import pytest

from pipelines.geometry import exp_se3
from pipelines.patches import Patches
from tests.pipelines.slanted_floor import (
    CLOSER,
    DISTANCE_M,
    NORMAL,
    H,
    W,
    cut,
    some_points,
    true_pixels,
    view_from,
)


def test_patches_are_kept_while_they_fit_and_cut_anew_when_they_have_grown():
    uv, depth = some_points(40)
    first = cut(view_from(np.eye(4)), uv, depth)
    near = exp_se3(np.array([0, 0, 0, 0, 0, 0.4]))
    kept = cut(view_from(near), uv + 1.0, depth - 0.4, old=first, T=near)
    for field in fields(Patches):
        np.testing.assert_array_equal(getattr(kept, field.name), getattr(first, field.name))
    nearer = exp_se3(np.array([0, 0, 0, 0, 0, 0.6 * float(depth.min())]))
    at = true_pixels(uv, depth, nearer)
    inside = (at > 30).all(1) & (at < [W - 30, H - 30]).all(1)
    ids = np.flatnonzero(inside)
    z = depth[inside] - nearer[2, 3]
    renewed = cut(view_from(nearer), at[inside], z, old=first, T=nearer, ids=ids)
    anew = (renewed.T_world_camera == nearer).all(axis=(1, 2))
    assert anew.any()
    flatter = (DISTANCE_M + NORMAL @ nearer[:3, 3]) / DISTANCE_M  # seen more from the side
    growth = (depth[inside] / z) ** 1.5 * flatter**0.5
    np.testing.assert_array_equal(anew, growth > 2.0)


def test_points_come_and_go_in_any_order():
    uv, depth = some_points(6)
    view = view_from(np.eye(4))
    first = cut(view, uv[:4], depth[:4], ids=np.array([9, 3, 7, 1]))
    assert first.point_ids.tolist() == [1, 3, 7, 9]
    np.testing.assert_array_equal(first.uv_px, uv[[3, 1, 2, 0]])
    assert first.rows(np.array([7, 2, 1, 11])).tolist() == [2, -1, 0, -1]
    moved = first.moved(CLOSER)
    again = cut(view, uv[3:], depth[3:], old=moved, T=CLOSER, ids=np.array([1, 8, 2]))
    assert again.point_ids.tolist() == [1, 2, 8]
    np.testing.assert_allclose(again.T_world_camera, np.tile(CLOSER, (3, 1, 1)))
    assert Patches.empty().rows(np.array([4, 5])).tolist() == [-1, -1]


def test_behind_the_camera_no_patch_is_kept():
    uv, depth = some_points(5)
    first = cut(view_from(np.eye(4)), uv, depth)
    beyond = exp_se3(np.array([0, 0, 0, 0, 0, float(depth.max()) + 1.0]))
    renewed = cut(view_from(np.eye(4)), uv, depth, old=first, T=beyond)
    np.testing.assert_array_equal(renewed.T_world_camera, np.tile(beyond, (5, 1, 1)))


@pytest.mark.parametrize("place", [(1.2, 2.7), (W - 1.5, H - 1.1)])
def test_at_the_border_the_image_goes_on_as_it_ends(place):
    view = view_from(np.eye(4))
    patches = cut(view, np.array([place]), np.array([3.0]))
    padded = cv2.copyMakeBorder(view.gray, 10, 10, 10, 10, cv2.BORDER_REPLICATE)
    x, y = np.floor(place).astype(int)
    np.testing.assert_array_equal(patches.pixels[0], padded[y : y + 21, x : x + 21])
