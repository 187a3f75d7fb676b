"""Points of the local map are found again by how they looked, else by ORB."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipelines.config import DepthConfig, MappingConfig, TrackingConfig
from pipelines.frontend import map_search
from pipelines.frontend.alignment import align_patches
from pipelines.frontend.map_search import search_local_map
from pipelines.frontend.sensor import Sensor
from pipelines.geometry import backproject, exp_se3
from pipelines.mapping.keyframe import Keyframe
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.types import Features
from tests.pipelines.slanted_floor import CAMERA, CLOSER, cut, some_points, true_pixels, view_from

SLIGHTLY_OFF = exp_se3(np.array([0.001, 0.002, 0.0, 0.004, 0.0, 0.01]))  # a pixel or so


class Floor:
    """A map of the floor from one place, left long ago; `view` is of it from another place."""

    def __init__(self, n_later=map_search._RECENT):
        self.uv, self.depth = some_points()
        n = len(self.uv)
        self.map = SparseMap(CAMERA, MappingConfig())
        self.descriptors = np.random.default_rng(3).integers(0, 256, (n, 32)).astype(np.uint8)
        self.ids = self.map.add_points(
            backproject(CAMERA, self.uv, self.depth), np.tile(1e-8 * np.eye(3), (n, 1, 1)),
            np.zeros((n, 3)), self.descriptors, np.zeros((n, 3), np.uint8),
        )  # fmt: skip
        tracks = Tracks(self.ids, self.uv, CAMERA.bf / self.depth, np.full(n, 0.1))
        for k in range(3 + n_later):
            seen = tracks if k < 3 else Tracks.empty()
            self.map.add_keyframe(Keyframe(k, 0.1 * k, np.eye(4), seen, Features.empty()))
        self.patches = cut(view_from(np.eye(4)), self.uv, self.depth, ids=self.ids)
        self.view = view_from(CLOSER, 50)
        self.truth = true_pixels(self.uv, self.depth, CLOSER)

    def search(self, view=None):
        T = CLOSER @ SLIGHTLY_OFF
        sensor = Sensor(CAMERA, DepthConfig())
        view = self.view if view is None else view
        return search_local_map(view, self.map, Tracks.empty(), T, sensor, TrackingConfig())

    def errors_px(self, tracks):
        return tracks.uv_px - self.truth[np.searchsorted(self.ids, tracks.point_ids)]


def test_points_are_found_by_their_looks_where_no_corner_is():
    floor = Floor()
    floor.map.keep_patches(floor.patches)
    found = floor.search()
    assert len(found.visible_ids) > 100
    assert found.by_looks.all() and len(found.tracks) > 0.9 * len(found.visible_ids)
    error = np.linalg.norm(floor.errors_px(found.tracks), axis=1)
    assert 1e-3 < np.median(error) < 0.05 and np.percentile(error, 95) < 0.2
    assert np.isfinite(found.tracks.disparity_px).mean() > 0.9


def test_what_something_hides_is_not_found():
    floor = Floor()
    floor.map.keep_patches(floor.patches)
    gray = floor.view.gray.copy()
    hidden = floor.truth[:, 0] < 200
    gray[:, :212] = view_from(exp_se3(np.array([0.0, 0.5, 0.0, 2.0, 0.0, 0.0]))).gray[:, :212]
    found = floor.search(replace(floor.view, gray=gray))
    again = np.isin(floor.ids, found.tracks.point_ids)
    assert hidden.sum() > 20 and again[hidden].mean() < 0.05
    assert again[floor.truth[:, 0] > 225].mean() > 0.8


def test_what_could_as_well_be_a_pixel_aside_is_not_found():
    """Along stripes a patch stays wherever the search began: such places only echo the pose."""
    floor = Floor()
    stripes = [cv2.blur(view_from(T, k).gray, (25, 1)) for k, T in enumerate((np.eye(4), CLOSER))]
    there = replace(view_from(np.eye(4)), gray=stripes[0])
    noise = np.random.default_rng(5).normal(scale=2.0, size=stripes[1].shape)
    gray = np.clip(stripes[1] + noise, 0, 255).astype(np.uint8)
    floor.map.keep_patches(cut(there, floor.uv, floor.depth, ids=floor.ids))
    found = floor.search(replace(floor.view, gray=gray))
    assert len(found.visible_ids) > 100
    assert len(found.tracks) < 0.1 * len(found.visible_ids)


def test_leeway_tells_how_far_a_place_may_be_off():
    rng = np.random.default_rng(6)
    texture = cv2.GaussianBlur(rng.normal(size=(400, 400)), (0, 0), 2.5)
    base = 128 + 20 * texture / texture.std()
    places = rng.uniform(30, 370, (400, 2))
    patch = map_search._windows(base.astype(np.float32), places)
    brighter = map_search._windows((0.6 * base + 50).astype(np.float32), places)
    assert map_search._leeway_px(patch, brighter).max() < 0.02
    assert np.median(map_search._leeway_px(patch, 255 - patch)) > 2.0  # a negative is not alike
    medians = []
    for level in (2.0, 6.0):
        noisy = np.clip(base + level * rng.normal(size=base.shape), 0, 255).astype(np.uint8)
        gray = np.clip(base, 0, 255).astype(np.uint8)
        start = places + rng.normal(scale=0.5, size=places.shape)
        placed, _ = align_patches(gray, noisy, places, start, 3.0, np.ones(len(places), bool))
        leeway = map_search._leeway_px(patch, map_search._windows(noisy, placed))
        error = np.linalg.norm(placed - places, axis=1)
        loose = leeway > np.median(leeway)
        assert np.median(error[~loose]) < np.median(error[loose]) < 0.5 * np.median(leeway)
        medians.append(np.median(leeway))
    assert 2.0 < medians[1] / medians[0] < 4.0  # three times the noise


def test_what_came_to_sight_lately_is_not_looked_for_by_its_looks():
    floor = Floor(n_later=map_search._RECENT - 3)
    floor.map.keep_patches(floor.patches)
    assert len(floor.search().tracks) == 0


@pytest.mark.parametrize("with_looks", [False, True])
def test_corners_serve_those_whose_looks_are_not_known(with_looks):
    floor = Floor()
    n, rng = len(floor.ids), np.random.default_rng(4)
    at = floor.truth + rng.normal(size=(n, 2))
    features = Features(
        at, np.zeros(n, np.int32), np.zeros(n, np.float32), np.ones(n, np.float32),
        floor.descriptors, floor.depth,
    )  # fmt: skip
    view = replace(floor.view, features=features)
    if with_looks:
        floor.map.keep_patches(floor.patches[: n // 2])
    found = floor.search(view)
    first_half = found.tracks.point_ids < floor.ids[n // 2]
    np.testing.assert_array_equal(found.by_looks, first_half if with_looks else False)
    error = np.linalg.norm(floor.errors_px(found.tracks), axis=1)
    assert 0.5 < np.median(error[~found.by_looks]) < 2.0
    if with_looks:  # and the corners' noise does not matter
        assert np.median(error[found.by_looks]) < 0.05
