"""What tracked frames do to the map: a known cloud of points, seen without images."""

import numpy as np
import pytest

from pipelines.config import Config, DepthConfig, MappingConfig, OrbConfig
from pipelines.frontend.sensor import Sensor
from pipelines.frontend.tracking import TrackedFrame
from pipelines.frontend.view import View
from pipelines.geometry import (
    backproject,
    exp_se3,
    inside_image,
    invert_T,
    make_T,
    project_stereo,
    transform_points,
)
from pipelines.mapping.local_mapping import LocalMapping, read_colors, triangulation_covariance
from pipelines.mapping.sparse_map import SparseMap
from pipelines.mapping.triangulation import triangulate
from pipelines.observations import Tracks
from pipelines.types import Features, MotionHypothesis, StereoCamera, TrackingStatus

CAMERA = StereoCamera(640, 400, 500.0, 500.0, 320.0, 200.0, 250.0)  # half a metre of baseline
SIGMA_UV_PX, SIGMA_DISPARITY_PX = 0.2, 0.3


def settings(n_features=600, **mapping):
    return Config(
        orb=OrbConfig(n_features=n_features),
        depth=DepthConfig(calibrate_disparity=False),
        mapping=MappingConfig(**mapping),
    )


class World:
    """Points with descriptors on a grid of directions, so that they keep apart in the picture."""

    def __init__(self, config, low_m=5.0, high_m=14.0, seed=0):
        self.rng = np.random.default_rng(seed)
        u, v = np.meshgrid(np.arange(20, 630, 25), np.arange(20, 390, 25))
        uv = np.column_stack([u.ravel(), v.ravel()]) + self.rng.uniform(-5, 5, (u.size, 2))
        self.points = backproject(CAMERA, uv, self.rng.uniform(low_m, high_m, len(uv)))
        n = len(self.points)
        self.descriptors = self.rng.integers(0, 256, (n, 32)).astype(np.uint8)
        self.response = self.rng.permutation(n).astype(np.float32)
        self.sensor = Sensor(CAMERA, config.depth)
        self.sensor.noise.sigma_disparity_px = SIGMA_DISPARITY_PX
        self.mapping = LocalMapping(self.sensor, config.mapping, config.orb)
        self.map = SparseMap(CAMERA, config.mapping)
        self.row_of = np.full(n, -1)

    def look(self, T, frame_index=0, noise=1.0, with_depth=True):
        """A view of the cloud, and which point each feature is."""
        uvr = project_stereo(CAMERA, transform_points(invert_T(T), self.points))
        seen = np.flatnonzero(inside_image(CAMERA, uvr[:, :2], 2.0))
        n, uvr = len(seen), uvr[seen]
        uv = uvr[:, :2] + noise * self.rng.normal(0, SIGMA_UV_PX, (n, 2))
        disparity = uvr[:, 0] - uvr[:, 2] + noise * self.rng.normal(0, SIGMA_DISPARITY_PX, n)
        depth = np.where(with_depth, CAMERA.bf / disparity, np.nan)
        features = Features(
            uv, np.zeros(n, np.int32), np.zeros(n, np.float32), self.response[seen],
            self.descriptors[seen], depth,
        )  # fmt: skip
        v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
        image = np.stack([u % 256, v % 256, (u + v) % 256], -1).astype(np.uint8)
        blank = np.full(u.shape, np.nan, np.float32)
        view = View(
            frame_index, 0.1 * frame_index, image, image[..., 0], blank, np.ones(u.shape, bool),
            features, None,
        )  # fmt: skip
        return view, seen

    def take(self, T, frame_index=0, bad=(), **how):
        """Let the mapping take in a frame tracked exactly at T; `bad` points are its outliers."""
        view, seen = self.look(T, frame_index, **how)
        known = self.row_of[seen] >= 0
        uv, depth = view.features.uv_px[known], view.features.depth_m[known]
        ids = self.row_of[seen[known]]
        tracks = Tracks(ids, uv, CAMERA.bf / depth, np.full(len(ids), SIGMA_UV_PX))
        tracked = TrackedFrame(
            TrackingStatus.OK, MotionHypothesis.CONSTANT_VELOCITY, T, 1e-12 * np.eye(6), tracks,
            ~np.isin(seen[known], bad), 0.1, ids,
        )  # fmt: skip
        kept, is_keyframe = self.mapping.integrate(self.map, view, tracked)
        self.learn_rows(kept, view, seen)
        return kept, is_keyframe

    def learn_rows(self, kept, view, seen):
        """Which true point each row of the map is, by the pixels that the tracks name."""
        distance = np.linalg.norm(kept.uv_px[:, None] - view.features.uv_px[None], axis=-1)
        assert (distance.min(1) < 1e-9).all()
        self.row_of[seen[distance.argmin(1)]] = kept.point_ids

    def errors_m(self):
        known = np.flatnonzero(self.row_of >= 0)
        return np.linalg.norm(self.map.position_m[self.row_of[known]] - self.points[known], axis=1)


def along(k):
    return make_T(np.eye(3), np.array([0.15 * k, 0.0, 0.2 * k]))


def test_the_first_frame_fills_the_map_and_is_a_keyframe():
    world = World(settings())
    kept, is_keyframe = world.take(np.eye(4))
    assert is_keyframe and len(world.map.keyframes) == 1
    assert len(kept) > 300
    assert world.map.alive.sum() == len(kept) == len(np.unique(kept.point_ids))
    assert 0.01 < np.median(world.errors_m()) < 0.2  # z^2 / bf * 0.3 px at 10 m is 0.12 m
    np.testing.assert_array_equal(
        world.map.descriptor[world.row_of[world.row_of >= 0]],
        world.descriptors[world.row_of >= 0],
    )


def test_the_strongest_features_come_first_where_there_is_a_limit():
    world = World(settings(n_features=100))
    kept, _ = world.take(np.eye(4))
    assert len(kept) == 100
    _, seen = world.look(np.eye(4))
    chosen = np.isin(np.arange(len(world.points)), np.flatnonzero(world.row_of >= 0))
    assert world.response[chosen].min() > np.sort(world.response[seen])[-101]


def test_observations_make_points_better_and_surer():
    world = World(settings())
    kept, _ = world.take(np.eye(4))
    before = np.sqrt(np.mean(world.errors_m() ** 2))
    said_before = np.trace(world.map.covariance_m2[kept.point_ids], axis1=1, axis2=2)
    for k in range(1, 9):
        world.take(along(k), frame_index=k)
    after = np.sqrt(np.mean(world.errors_m() ** 2))
    assert after < 0.5 * before
    assert after > 1e-3
    alive = kept.point_ids[world.map.alive[kept.point_ids]]
    said = np.trace(world.map.covariance_m2[alive], axis1=1, axis2=2)
    assert np.median(said) < 0.2 * np.median(said_before)
    assert 0.6 < after / np.sqrt(said.mean()) < 1.5


def test_a_point_is_not_made_twice():
    world = World(settings())
    for k in range(4):
        kept, _ = world.take(along(k), frame_index=k)
        assert len(np.unique(kept.point_ids)) == len(kept)
        apart = np.linalg.norm(kept.uv_px[:, None] - kept.uv_px[None], axis=-1)
        np.fill_diagonal(apart, np.inf)
        assert apart.min() > 1.0
    made = world.map.alive.sum()
    assert made <= len(world.points)


def test_outliers_are_not_refined_and_count_as_not_found():
    world = World(settings())
    kept, _ = world.take(np.eye(4), noise=0.0)
    bad = np.flatnonzero(world.row_of >= 0)[:40]
    rows = world.row_of[bad]
    before = world.map.position_m[rows].copy()
    world.take(along(1), frame_index=1, bad=bad)
    np.testing.assert_array_equal(world.map.position_m[rows], before)
    assert (world.map.n_visible[rows] == 2).all() and (world.map.n_found[rows] == 1).all()
    good = np.setdiff1d(kept.point_ids, rows)
    assert (world.map.n_found[good][world.map.n_visible[good] == 2] == 2).all()


def test_far_points_begin_vague_and_their_disparity_is_not_tracked():
    world = World(settings(), low_m=60.0, high_m=100.0)  # 40 baselines are 20 m
    world.sensor.noise.sigma_disparity_px = 0.5
    kept, _ = world.take(np.eye(4))
    assert len(kept) > 100
    assert np.isnan(kept.disparity_px).all()
    spread = np.sqrt(np.trace(world.map.covariance_m2[kept.point_ids], axis1=1, axis2=2))
    depth = world.map.position_m[kept.point_ids, 2]
    assert (spread / depth > 0.3).all()
    near = World(settings())
    kept, _ = near.take(np.eye(4))
    assert np.isfinite(kept.disparity_px).all()


def test_features_without_depth_wait_for_a_second_keyframe():
    """No depth at all in either: only triangulation can make these points."""
    config = settings(keyframe_max_interval=1)
    world = World(config)
    kept, is_keyframe = world.take(np.eye(4), noise=0.3, with_depth=False)
    assert is_keyframe and len(kept) == 0
    assert len(world.map.keyframes[0].free_features) > 300
    T = make_T(np.eye(3), np.array([0.8, 0.0, 0.2]))
    kept, is_keyframe = world.take(T, frame_index=1, noise=0.3, with_depth=False)
    assert is_keyframe and len(kept) > 200
    assert np.isnan(kept.disparity_px).all()
    error = world.errors_m()
    assert 1e-3 < np.median(error) < 0.1
    assert np.quantile(error, 0.99) < 1.0
    free = world.map.keyframes[1].free_features
    assert len(free) + len(kept) == len(world.look(T)[1])


def test_keyframes_too_near_make_no_points():
    world = World(settings(keyframe_max_interval=1))
    world.take(np.eye(4), with_depth=False)
    kept, _ = world.take(along(0.05), frame_index=1, with_depth=False)
    assert len(kept) == 0 and world.map.alive.sum() == 0


def test_keyframes_are_made_when_the_view_changes_and_not_before():
    world = World(settings(keyframe_max_interval=50))
    made = [world.take(along(0.1 * k), frame_index=k)[1] for k in range(5)]
    assert made == [True, False, False, False, False]
    turned = exp_se3(np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0]))
    far_aside = World(settings(), seed=5)
    far_aside.map, far_aside.mapping = world.map, world.mapping
    _, is_keyframe = far_aside.take(turned, frame_index=6)
    assert is_keyframe
    assert [k.frame_index for k in world.map.keyframes] == [0, 6]


def test_mappable_features_have_depth_and_keep_away_from_tracked_points():
    world = World(settings())
    view, _ = world.look(np.eye(4))
    some = view.features.uv_px[:50]
    tracks = Tracks(np.arange(50), some + 1.0, np.full(50, 9.0), np.full(50, 0.3))
    chosen = world.mapping.mappable_features(view, tracks)
    assert not np.isin(np.arange(50), chosen).any()
    assert len(chosen) == len(view.features) - 50
    assert (np.diff(view.features.response[chosen]) <= 0).all()
    view, _ = world.look(np.eye(4), with_depth=False)
    assert len(world.mapping.mappable_features(view, Tracks.empty())) == 0


def test_triangulation_covariance_is_the_spread_of_noisy_triangulations():
    """One pixel of noise in both images, a baseline of two metres."""
    rng = np.random.default_rng(1)
    T_b = exp_se3(np.array([0.0, -0.1, 0.0, 2.0, 0.0, 0.0]))
    point, n = np.array([[0.5, -0.3, 11.0]]), 4000
    uv_a = project_stereo(CAMERA, point)[:, :2] + rng.normal(0, 1, (n, 2))
    uv_b = project_stereo(CAMERA, transform_points(invert_T(T_b), point))[:, :2]
    uv_b = uv_b + rng.normal(0, 1, (n, 2))
    samples = triangulate(CAMERA, np.eye(4), T_b, uv_a, uv_b)
    said = triangulation_covariance(CAMERA, np.eye(4), T_b, point)[0]
    whitened = np.linalg.solve(np.linalg.cholesky(said), (samples - point).T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(3), atol=0.15)


@pytest.mark.parametrize("grey", [False, True])
def test_colors_are_those_of_the_nearest_pixel(grey):
    view, _ = World(settings()).look(np.eye(4))
    if grey:
        view = View(
            0, 0.0, view.gray, view.gray, view.disparity_px, view.static, view.features, None
        )
    colors = read_colors(view, np.array([[10.4, 20.6], [-3.0, 9.0], [639.4, 900.0]]))
    if grey:
        expected = [[10, 10, 10], [0, 0, 0], [127, 127, 127]]
    else:
        expected = [[10, 21, 31], [0, 9, 9], [127, 143, 14]]
    assert colors.tolist() == expected and colors.dtype == np.uint8
