"""The tracker in a small hall whose textured walls have exact depth and flow in closed form."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pipelines.config import Config, OrbConfig, TrackingConfig
from pipelines.frontend.orb import OrbExtractor
from pipelines.frontend.rgbd_odometry import estimate_rgbd_odometry
from pipelines.frontend.sensor import Sensor
from pipelines.frontend.tracking import TrackedFrame, Tracker
from pipelines.frontend.view import complete_view, prepare_frame
from pipelines.geometry import exp_se3, invert_T, rotation_angle_deg
from pipelines.mapping.local_mapping import LocalMapping
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.types import Frame, MotionHypothesis, StereoCamera, TrackingStatus

CAMERA = StereoCamera(400, 240, 260.0, 260.0, 199.5, 119.5, 78.0)
# Walls n . p = d in the world, and the two world axes that their texture runs along.
WALLS = np.array(
    [
        [0.1, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.1], [-1.0, 0.0, 0.05], [0.0, 1.0, 0.0],
        [0.0, -1.0, 0.1],
    ]
)  # fmt: skip
DISTANCES = np.array([8.0, 3.0, 3.0, 3.5, 1.8, 2.2])
AXES = ([0, 1], [0, 1], [1, 2], [1, 2], [0, 2], [0, 2])
PIXELS_PER_M = 45.0


def paint(seed):
    """A tile of texture that repeats without seam."""
    noise = np.random.default_rng(seed).normal(size=(512, 512)).astype(np.float32)
    tiled = np.tile(noise, (3, 3))
    smooth = cv2.GaussianBlur(tiled, (0, 0), 1.2) + 2 * cv2.GaussianBlur(tiled, (0, 0), 4)
    smooth = smooth[512:1024, 512:1024]
    return 128 + 45 * smooth / smooth.std()


PAINTS = [paint(seed) for seed in range(len(WALLS))]
V, U = np.mgrid[: CAMERA.height, : CAMERA.width].astype(np.float64)
RAYS = np.stack([(U - CAMERA.cx) / CAMERA.fx, (V - CAMERA.cy) / CAMERA.fy, np.ones(U.shape)], -1)


def look(T):
    """Grey image, depth (H, W) and places in the world (H, W, 3) seen at T."""
    direction = RAYS @ T[:3, :3].T
    with np.errstate(divide="ignore"):
        z = (DISTANCES - WALLS @ T[:3, 3]) / (direction @ WALLS.T)
    z[z <= 0] = np.inf
    wall, depth = z.argmin(-1), z.min(-1)
    world = T[:3, 3] + direction * depth[..., None]
    gray = np.zeros(U.shape, np.float32)
    for index, (texture, axes) in enumerate(zip(PAINTS, AXES, strict=True)):
        place = (world[..., axes] * PIXELS_PER_M) % 510
        seen = cv2.remap(texture, *place.astype(np.float32).transpose(2, 0, 1), cv2.INTER_LINEAR)
        gray = np.where(wall == index, seen, gray)
    return np.clip(gray, 0, 255).astype(np.uint8), depth.astype(np.float32), world


def path(k):
    """A gentle curve through the hall, 10 cm and 0.6 degrees a frame."""
    return exp_se3(np.array([0.0, 0.01, 0.002, 0.02, 0.0, 0.1]) * k)


class Run:
    """Tracker, map and mapping in the order the system uses them."""

    def __init__(self, **settings):
        config = Config(orb=OrbConfig(n_features=500), tracking=TrackingConfig(**settings))
        self.sensor = Sensor(CAMERA, config.depth)
        self.tracker = Tracker(self.sensor, config.tracking)
        self.map = SparseMap(CAMERA, config.mapping)
        self.mapping = LocalMapping(self.sensor, config.mapping, config.orb)
        self.orb = OrbExtractor(config.orb)
        self.last_world = None

    def view(self, T, index, with_flow=False, black=False, flow_is_given=True):
        gray, depth, world = look(T)
        flow = None
        if with_flow and self.last_world is not None:
            in_camera = (self.last_world - T[:3, 3]) @ T[:3, :3]
            x, y, z = in_camera.transpose(2, 0, 1)
            u, v = CAMERA.fx * x / z + CAMERA.cx, CAMERA.fy * y / z + CAMERA.cy
            flow = np.stack([u - U, v - V], -1).astype(np.float32)
        self.last_world = world
        if black:
            gray = np.zeros_like(gray)
        frame = Frame(index, 0.1 * index, gray, depth_m=depth)
        prepared = replace(
            prepare_frame(CAMERA, frame, depth, self.orb),
            flow_prev_to_curr_px=flow,
            flow_is_given=with_flow and flow_is_given,
        )
        return complete_view(CAMERA, prepared, self.sensor.noise.sigma_disparity_px, 0.0)

    def begin(self, T):
        view = self.view(T, 0)
        self.tracker.start(view, T)
        nothing = Tracks.empty()
        first = TrackedFrame(
            TrackingStatus.OK, MotionHypothesis.FIRST_FRAME, T, np.zeros((6, 6)), nothing,
            np.zeros(0, bool), np.nan, nothing.point_ids,
        )  # fmt: skip
        self.tracker.remember(view, T, self.mapping.integrate(self.map, view, first)[0], self.map)
        return self

    def track(self, T, index, **how):
        view = self.view(T, index, **how)
        tracked = self.tracker.track(view, self.map)
        if tracked.status is TrackingStatus.OK:
            self.tracker.motion.update(tracked.T_world_camera, view.timestamp_s)
            tracks, _ = self.mapping.integrate(self.map, view, tracked)
            self.tracker.remember(view, tracked.T_world_camera, tracks, self.map)
        else:
            self.tracker.forget_flow()
        return tracked


def error_m_deg(T, T_true):
    E = invert_T(T_true) @ T
    return np.linalg.norm(E[:3, 3]), float(rotation_angle_deg(E))


@pytest.mark.parametrize("with_flow", [False, True])
def test_a_short_drive_is_tracked_to_millimetres(with_flow):
    run = Run().begin(path(0))
    for k in range(1, 8):
        tracked = run.track(path(k), k, with_flow=with_flow)
        assert tracked.status is TrackingStatus.OK
        assert tracked.hypothesis in ("constant_velocity", "pnp_ransac")
        metres, degrees = error_m_deg(tracked.T_world_camera, path(k))
        assert 1e-7 < metres < 0.006
        assert degrees < 0.05
        assert tracked.inliers.mean() > 0.7 and tracked.inliers.sum() > 150
        assert 1e-4 < tracked.rmse_px < 0.6
        sigma_m = np.sqrt(np.diag(tracked.covariance)[3:])
        assert (sigma_m > 1e-6).all() and (sigma_m < 0.01).all()


def test_given_flow_makes_pixels_sharper_than_alignment_alone():
    sigma = {}
    for with_flow in (False, True):
        run = Run().begin(path(0))
        for k in range(1, 5):
            run.track(path(k), k, with_flow=with_flow)
        sigma[with_flow] = run.sensor.noise.sigma_uv_px["flow" if with_flow else "alignment"]
    assert sigma[True] < 0.5 * sigma[False] < 0.25


def test_flow_that_was_computed_is_no_measurement_of_the_camera():
    """It is smooth across edges, and serves objects alone; sharp patches are the camera's."""
    runs = {}
    for how in ("none", "computed", "given"):
        run = runs[how] = Run().begin(path(0))
        more = {"with_flow": how != "none", "flow_is_given": how == "given"}
        run.last = [run.track(path(k), k, **more) for k in range(1, 4)][-1]
    poses = {how: run.last.T_world_camera for how, run in runs.items()}
    np.testing.assert_array_equal(poses["computed"], poses["none"])
    assert (poses["given"] != poses["none"]).any()
    untouched = Run().sensor.noise.sigma_uv_px["flow"]
    assert runs["computed"].sensor.noise.sigma_uv_px["flow"] == untouched
    assert runs["given"].sensor.noise.sigma_uv_px["flow"] != untouched


def test_tracks_name_living_points_where_they_are():
    run = Run().begin(path(0))
    for k in range(1, 4):
        tracked = run.track(path(k), k)
    ids = tracked.tracks.point_ids
    assert len(np.unique(ids)) == len(ids)
    truth = run.last_world
    x, y = np.rint(tracked.tracks.uv_px[tracked.inliers]).astype(int).T
    offset = np.linalg.norm(run.map.position_m[ids[tracked.inliers]] - truth[y, x], axis=1)
    assert np.median(offset) < 0.03  # half a pixel at some metres


@pytest.mark.parametrize("with_flow", [False, True])
def test_black_frames_are_lost_and_predicted_and_then_it_goes_on(with_flow):
    """The flow after a lost frame starts at that frame, where nothing is tracked: no use."""
    run = Run().begin(path(0))
    for k in (1, 2, 3):
        last = run.track(path(k), k, with_flow=with_flow)
    for k in (4, 5):
        tracked = run.track(path(k), k, black=True)
        assert tracked.status is TrackingStatus.LOST
        assert tracked.hypothesis is MotionHypothesis.NONE
        assert np.isnan(tracked.covariance).all() and not tracked.inliers.any()
        metres, degrees = error_m_deg(tracked.T_world_camera, path(k))
        assert metres < 0.02 and degrees < 0.2
        assert error_m_deg(tracked.T_world_camera, last.T_world_camera)[0] > 0.05
    tracked = run.track(path(6), 6, with_flow=with_flow)
    assert tracked.status is TrackingStatus.OK
    assert tracked.hypothesis in ("constant_velocity", "pnp_ransac")
    assert error_m_deg(tracked.T_world_camera, path(6))[0] < 0.01


def test_a_wrong_prediction_loses_to_the_points():
    """The camera is said to look 15 px aside: too far for alignment, not for ORB and PnP."""
    run = Run(use_rgbd_odometry=False).begin(path(0))
    for k in (1, 2):
        before = run.track(path(k), k)
    aside = path(2) @ exp_se3(np.array([0.0, -0.06, 0.0, 0.0, 0.0, 0.0]))
    run.tracker.start(run.view(path(2), 2), aside)
    run.map.keyframes.clear()  # nothing to relocalise against
    tracked = run.tracker.track(run.view(path(3), 3), run.map)
    assert tracked.status is TrackingStatus.OK
    assert tracked.hypothesis is MotionHypothesis.PNP_RANSAC
    assert tracked.inliers.sum() > 0.85 * before.inliers.sum()
    assert error_m_deg(tracked.T_world_camera, path(3))[0] < 0.01


def test_a_camera_put_back_where_it_was_is_relocalised():
    """A jump far beyond every search radius, to the first keyframe's place."""
    run = Run(use_rgbd_odometry=False).begin(path(0))
    for k in range(1, 4):
        run.track(path(k), k)
    away = path(3) @ exp_se3(np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0]))
    run.tracker.start(run.view(away, 4), away)
    tracked = run.track(path(1), 5)
    assert tracked.status is TrackingStatus.OK
    assert tracked.hypothesis is MotionHypothesis.RELOCALISATION
    metres, degrees = error_m_deg(tracked.T_world_camera, path(1))
    assert metres < 0.02 and degrees < 0.2


def test_a_strange_place_is_lost():
    run = Run().begin(path(0))
    run.track(path(1), 1)
    turned = exp_se3(np.array([0.0, np.pi, 0.0, 0.0, 0.0, 0.0]))
    assert run.track(turned, 2).status is TrackingStatus.LOST


def test_tracking_repeats_itself_to_the_last_bit():
    poses = []
    for _ in range(2):
        run = Run().begin(path(0))
        poses.append([run.track(path(k), k).T_world_camera for k in range(1, 4)])
    np.testing.assert_array_equal(poses[0], poses[1])


def test_dense_odometry_finds_a_step_whatever_the_far_limit():
    a, b = look(path(2))[:2], look(path(3))[:2]
    for max_depth_m in (10.0, 50.0, 312.0):
        T = estimate_rgbd_odometry(CAMERA, a, b, np.eye(4), max_depth_m)
        assert error_m_deg(path(2) @ T, path(3))[0] < 0.01, max_depth_m


@pytest.mark.parametrize(("scrambled", "status"), [(0.0, "OK"), (0.7, "LOST")])
def test_a_place_counts_as_recognised_where_most_points_agree(scrambled, status):
    """Seven in ten points of the map lie elsewhere: dozens agree still, but too small a share."""
    run = Run(use_rgbd_odometry=False).begin(path(0))
    for k in range(1, 4):
        run.track(path(k), k)
    rng = np.random.default_rng(2)
    ids = np.flatnonzero(run.map.alive)
    wrong = rng.choice(ids, int(scrambled * len(ids)), replace=False)
    run.map.position_m[wrong] = run.map.position_m[rng.permutation(wrong)]
    assert len(ids) - len(wrong) > 100
    asked = []

    def seen_before(descriptors):
        asked.append(descriptors.shape)
        return [0]

    lost = Tracker(run.sensor, run.tracker.config, seen_before)
    view = run.view(path(1), 9)
    lost.start(view, path(1) @ exp_se3(np.array([0.0, 0.5, 0.0, 0.0, 0.0, 3.0])))
    tracked = lost.track(view, run.map)
    assert tracked.status is TrackingStatus[status]
    if status == "OK":
        assert tracked.hypothesis is MotionHypothesis.RELOCALISATION
        assert error_m_deg(tracked.T_world_camera, path(1))[0] < 0.02
    else:
        assert asked == [(len(view.features), 32)]
