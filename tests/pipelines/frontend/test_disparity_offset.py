"""Self-calibration of disparities: simulated drives through a cloud of points, no images.

The drive runs the same steps as the system: pose by bundle adjustment, offset, point filter.
"""

import numpy as np
import pytest

from pipelines.config import MappingConfig
from pipelines.frame_observations import FrameObservations, Sightings
from pipelines.frontend.disparity_offset import (
    DisparityOffset,
    follow_camera,
    offset_share,
    with_last_offset,
)
from pipelines.frontend.motion_only_ba import estimate_camera_pose
from pipelines.geometry import exp_se3, inside_image, invert_T, project_stereo, transform_points
from pipelines.mapping.point_filter import make_points, refine_points
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.types import StereoCamera

CAMERA = StereoCamera(1242, 375, 721.5, 721.5, 609.6, 172.9, 387.6)
SIGMA_UV_PX, SIGMA_DISPARITY_PX = 0.15, 0.2
STEP_M = 1.0


class Drive:
    """A straight drive whose measured disparities are wrong by `-error_px`, less where near.

    None of the error is left at ten baselines, where such rigs are calibrated.
    """

    def __init__(self, error_px, seed=0, n_points=1200):
        self.rng = np.random.default_rng(seed)
        low, high = [-25, -6, 5], [25, 1.6, 90]
        self.points = self.rng.uniform(low, high, (n_points, 3))
        self.error_px = error_px
        self.offset = DisparityOffset()
        self.map = SparseMap(CAMERA, MappingConfig())
        self.row_of = np.full(n_points, -1)  # of each true point in the map
        self.Ts = []

    def see(self, index):
        """Which true points are in view, their pixels and corrected disparities."""
        in_camera = self.points - [0, 0, STEP_M * index]
        seen = np.flatnonzero(in_camera[:, 2] > 4)
        uvr = project_stereo(CAMERA, in_camera[seen])
        inside = inside_image(CAMERA, uvr[:, :2], 5.0)
        seen, uvr = seen[inside], uvr[inside]
        n = len(seen)
        uv = uvr[:, :2] + self.rng.normal(0, SIGMA_UV_PX, (n, 2))
        true = uvr[:, 0] - uvr[:, 2]
        measured = (true - self.error_px) / (1 - 10 / CAMERA.fx * self.error_px)
        disparity = measured + self.offset.offset_px * offset_share(CAMERA, measured)
        return seen, uv, disparity + self.rng.normal(0, SIGMA_DISPARITY_PX, n)

    def run(self, n_frames):
        T = np.eye(4)
        for index in range(n_frames):
            seen, uv, disparity = self.see(index)
            known = self.row_of[seen] >= 0
            if index > 0:
                T = self.follow(T, self.row_of[seen[known]], uv[known], disparity[known])
            self.add(T, seen[~known], uv[~known], disparity[~known])
            self.map.shift_offset(np.flatnonzero(self.map.alive), self.offset.step())
            self.Ts.append(T)
        return self

    def follow(self, T, rows, uv, disparity):
        tracks = Tracks(rows, uv, disparity, np.full(len(rows), SIGMA_UV_PX))
        observations = self.map.observe(tracks, SIGMA_DISPARITY_PX)
        guess = T @ exp_se3(np.array([0, 0, 0, 0, 0, STEP_M]))
        estimate = estimate_camera_pose(CAMERA, guess, observations)
        T, kept = estimate.T_world_camera, estimate.inliers
        rows, slopes = rows[kept], self.map.offset_slope[rows[kept]]
        pose_slope = self.offset.learn(CAMERA, T, observations[kept], slopes)
        self.map.offset_slope[rows] += follow_camera(T, self.map.position_m[rows], pose_slope)
        observations = self.map.observe(tracks[kept], SIGMA_DISPARITY_PX)
        points, covariances, slopes = refine_points(
            CAMERA, T, estimate.covariance, observations, self.map.offset_slope[rows]
        )
        self.map.position_m[rows] = points
        self.map.covariance_m2[rows] = covariances
        self.map.offset_slope[rows] = slopes
        return T

    def add(self, T, which, uv, disparity):
        positive = disparity > 1.0
        which, uv, disparity = which[positive], uv[positive], disparity[positive]
        sigma = np.full(len(which), SIGMA_DISPARITY_PX)
        points, covariances = make_points(CAMERA, T, uv, disparity, SIGMA_UV_PX, sigma)
        slopes = (T[:3, 3] - points) / disparity[:, None]
        slopes *= offset_share(CAMERA, disparity)[:, None]
        blank = np.zeros((len(which), 32), np.uint8)
        self.row_of[which] = self.map.add_points(points, covariances, slopes, blank, blank[:, :3])

    @property
    def step_lengths_m(self):
        return np.linalg.norm(np.diff([T[:3, 3] for T in self.Ts], axis=0), axis=1)


@pytest.mark.parametrize("error_px", [0.5, -0.4])
def test_a_constant_error_is_learned_within_a_tenth_of_a_pixel(error_px):
    drive = Drive(error_px).run(24)
    assert drive.offset.offset_px == pytest.approx(error_px, abs=0.1)
    assert 0.001 < drive.offset.sigma_px < 0.1


def test_learning_it_repairs_the_scale_of_the_drive():
    with_error = Drive(0.5).run(24)
    assert np.mean(with_error.step_lengths_m[-8:]) == pytest.approx(STEP_M, rel=0.01)


@pytest.mark.parametrize("seed", range(3))
def test_without_error_the_offset_stays_exactly_zero(seed):
    drive = Drive(0.0, seed=seed).run(20)
    assert drive.offset.offset_px == 0.0
    assert np.mean(drive.step_lengths_m) == pytest.approx(STEP_M, rel=0.004)


def test_a_camera_that_stands_still_learns_nothing():
    drive = Drive(0.5)
    T = np.eye(4)
    drive.add(T, *drive.see(0))
    start = drive.offset.sigma_px
    for _ in range(10):
        seen, uv, disparity = drive.see(0)
        known = drive.row_of[seen] >= 0
        rows, sigma = drive.row_of[seen[known]], np.full(known.sum(), SIGMA_UV_PX)
        tracks = Tracks(rows, uv[known], disparity[known], sigma)
        observations = drive.map.observe(tracks, SIGMA_DISPARITY_PX)
        drive.offset.learn(CAMERA, T, observations, drive.map.offset_slope[rows])
        drive.offset.step()
    assert drive.offset.offset_px == 0.0
    assert drive.offset.sigma_px > 0.5 * start


def test_nothing_learned_is_no_offset():
    offset = DisparityOffset()
    assert (offset.offset_px, offset.step()) == (0.0, 0.0)
    assert 0.1 < offset.sigma_px < 1.0


def test_points_that_follow_the_camera_stay_where_it_sees_them():
    """follow_camera is the slope of points carried along by a perturbed camera."""
    rng = np.random.default_rng(5)
    T = exp_se3(rng.normal(size=6))
    points = transform_points(T, rng.uniform([-5, -2, 3], [5, 2, 40], (20, 3)))
    slope, h = rng.normal(size=6), 1e-6
    # The points as the camera at T sees them, when the one that saw them was at T exp(h slope).
    carried = transform_points(T @ invert_T(T @ exp_se3(h * slope)), points)
    np.testing.assert_allclose(
        follow_camera(T, points, slope), (carried - points) / h, rtol=1e-4, atol=1e-3
    )


def test_a_shift_of_the_camera_is_handed_to_the_points_the_other_way():
    points = np.random.default_rng(5).uniform([-3, -2, 4], [3, 2, 20], (20, 3))
    shift = np.array([0.3, -0.2, 0.5])
    slopes = follow_camera(np.eye(4), points, np.r_[0.0, 0.0, 0.0, shift])
    np.testing.assert_allclose(slopes, np.tile(-shift, (20, 1)))


def test_what_early_frames_saw_is_corrected_by_the_offset_as_it_is_known_at_the_end():
    def entry(k, offset_px):
        true = np.array([4.0, 40.0, np.nan, 0.1 * CAMERA.fx])
        measured = (true - 0.3) / (1 - 10 / CAMERA.fx * 0.3)
        seen = Sightings(
            np.full(4, k), np.zeros(4, np.int64), np.arange(4), np.zeros((4, 2)),
            measured + offset_px * offset_share(CAMERA, measured), np.ones(4), np.ones(4),
            np.zeros((4, 3)),
        )  # fmt: skip
        return true, FrameObservations(k, 0.1 * k, True, np.eye(4), seen, offset_px)

    truths, log = zip(*(entry(k, offset) for k, offset in enumerate([0.0, 0.2, 0.3])), strict=True)
    corrected = with_last_offset(CAMERA, log)
    assert [e.disparity_offset_px for e in corrected] == [0.3] * 3
    for truth, entry_now in zip(truths, corrected, strict=True):
        np.testing.assert_allclose(entry_now.sightings.disparity_px, truth, atol=0.003)
    assert np.nanmax(np.abs(log[0].sightings.disparity_px - truths[0])) > 0.25
    assert with_last_offset(CAMERA, []) == []
