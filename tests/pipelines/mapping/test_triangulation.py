"""Two-view points against truth, and the checks that keep wrong ones out."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.config import MappingConfig, OrbConfig
from pipelines.geometry import (
    backproject,
    exp_se3,
    invert_T,
    make_T,
    project_stereo,
    transform_points,
)
from pipelines.mapping import triangulation
from pipelines.mapping.triangulation import (
    check_triangulated,
    match_along_epipolar_lines,
    triangulate,
)
from pipelines.types import Features, StereoCamera

CAMERA = StereoCamera(640, 480, 500.0, 500.0, 320.0, 240.0, 50.0)
CONFIG = MappingConfig()
SCALE = OrbConfig().scale_factor
T_A = exp_se3(np.array([0.1, -0.2, 0.05, 1.0, 2.0, 3.0]))
T_B = T_A @ exp_se3(np.array([0.02, -0.06, 0.01, 0.9, 0.1, 0.3]))


def features_at(uv_px, octave=0, seed=0):
    """Features with descriptors of their own, the same for the same seed."""
    n = len(uv_px)
    descriptors = np.random.default_rng(seed).integers(0, 256, (n, 32)).astype(np.uint8)
    return replace(
        Features.empty(),
        uv_px=uv_px,
        octave=np.broadcast_to(np.int32(octave), n).astype(np.int32),
        angle_deg=np.zeros(n, np.float32),
        response=np.ones(n, np.float32),
        descriptors=descriptors,
        depth_m=np.full(n, np.nan),
    )


def scene(n=200, sigma_px=0.0, seed=1, low_m=6.0, high_m=25.0):
    """World points and their pixels in both cameras."""
    rng = np.random.default_rng(seed)
    uv = rng.uniform([100, 60], [560, 420], (n, 2))
    points = transform_points(T_A, backproject(CAMERA, uv, rng.uniform(low_m, high_m, n)))
    seen = (pixels(T, points) + rng.normal(0, sigma_px, (n, 2)) for T in (T_A, T_B))
    return points, *seen


def pixels(T, points):
    return project_stereo(CAMERA, transform_points(invert_T(T), points))[:, :2]


def check(points, a, b, T_a=T_A, T_b=T_B):
    return check_triangulated(CAMERA, T_a, T_b, points, a, b, CONFIG, SCALE)


def test_exact_pixels_give_exact_points():
    points, uv_a, uv_b = scene()
    found = triangulate(CAMERA, T_A, T_B, uv_a, uv_b)
    np.testing.assert_allclose(found, points, atol=1e-7)
    assert triangulate(CAMERA, T_A, T_B, uv_a[:0], uv_b[:0]).shape == (0, 3)


def test_depth_error_is_that_of_the_parallax():
    """A baseline of 0.9 m and noise of 0.3 px: sigma_z = z^2 / (f b) * noise * sqrt 2, about."""
    points, uv_a, uv_b = scene(2000, sigma_px=0.3)
    found = triangulate(CAMERA, T_A, T_B, uv_a, uv_b)
    truth_z = transform_points(invert_T(T_A), points)[:, 2]
    error = transform_points(invert_T(T_A), found)[:, 2] - truth_z
    expected = truth_z**2 / (CAMERA.fx * 0.9) * 0.3 * np.sqrt(2)
    assert 0.7 < np.std(error / expected) < 1.4
    assert abs(np.mean(error / expected)) < 0.15


def test_true_points_pass_the_checks():
    _, uv_a, uv_b = scene(sigma_px=0.3)
    found = triangulate(CAMERA, T_A, T_B, uv_a, uv_b)
    assert check(found, features_at(uv_a), features_at(uv_b)).mean() > 0.97


def test_no_parallax_is_refused():
    points, _, _ = scene(low_m=6, high_m=25)
    for sideways, passes in ((0.02, False), (0.9, True)):
        T_b = T_A @ make_T(np.eye(3), np.array([sideways, 0.0, 0.0]))
        a, b = features_at(pixels(T_A, points)), features_at(pixels(T_b, points))
        good = check(points, a, b, T_b=T_b)
        assert good.mean() > 0.95 if passes else not good.any()
    turned = T_A @ exp_se3(np.array([0.0, 0.05, 0.0, 0.0, 0.0, 0.0]))
    a, b = features_at(pixels(T_A, points)), features_at(pixels(turned, points))
    assert not check(points, a, b, T_b=turned).any()


@pytest.mark.parametrize(("shift_px", "passes"), [(1.5, True), (2.5, False), (-40.0, False)])
def test_reprojection_beyond_two_pixels_is_refused(shift_px, passes):
    points, uv_a, uv_b = scene()
    below, beside = np.add(uv_b, [0.0, shift_px]), np.add(uv_a, [shift_px, 0.0])
    for a, b in ((uv_a, below), (beside, uv_b)):
        good = check(points, features_at(a), features_at(b))
        assert good.all() if passes else not good.any()


def test_coarse_features_may_be_less_exact():
    points, uv_a, uv_b = scene()
    shifted = np.add(uv_b, [0.0, 3.5])
    assert not check(points, features_at(uv_a), features_at(shifted)).any()
    assert check(points, features_at(uv_a, octave=4), features_at(shifted, octave=4)).all()


def test_points_behind_a_camera_are_refused():
    points, uv_a, uv_b = scene()
    mirrored = transform_points(T_A, -transform_points(invert_T(T_A), points))
    a, b = features_at(pixels(T_A, mirrored)), features_at(pixels(T_B, mirrored))
    assert not check(mirrored, a, b).any()
    crossed = triangulate(CAMERA, T_A, T_B, uv_b, uv_a)  # rays that meet behind
    assert check(crossed, features_at(uv_b), features_at(uv_a)).mean() < 0.2


def test_a_point_passed_on_the_optical_axis_is_refused():
    """Its pixel is the centre before and behind: only the sign of its depth tells."""
    point = transform_points(T_A, np.array([[0.0, 0.0, 5.0]]))
    centre = features_at(np.array([[CAMERA.cx, CAMERA.cy]]))
    beyond = T_A @ make_T(np.eye(3), np.array([0.0, 0.0, 9.0]))
    assert not check(point, centre, centre, T_b=beyond).any()
    assert not check(point, centre, centre, T_a=beyond, T_b=T_A).any()


@pytest.mark.parametrize(
    ("octave_a", "octave_b", "passes"), [(0, 0, True), (2, 0, True), (0, 6, False), (6, 0, False)]
)
def test_scales_must_agree_with_distances(octave_a, octave_b, passes):
    """Both cameras are about equally far: a feature six levels coarser is another one."""
    points, uv_a, uv_b = scene()
    good = check(points, features_at(uv_a, octave_a), features_at(uv_b, octave_b))
    assert good.mean() > 0.95 if passes else not good.any()


def test_a_near_camera_sees_coarser_features():
    """At half the distance a patch is twice as large: four levels coarser, not four finer."""
    T_b = T_A @ make_T(np.eye(3), np.array([1.0, 0.0, 10.0]))
    points = transform_points(
        T_A, np.random.default_rng(3).uniform([-3, -2, 19], [3, 2, 21], (40, 3))
    )
    a, uv_b = features_at(pixels(T_A, points), octave=2), pixels(T_b, points)
    assert check(points, a, features_at(uv_b, octave=6), T_b=T_b).mean() > 0.95
    assert not check(points, a, features_at(uv_b, octave=0), T_b=T_b).any()


def epipolar_pair(n=150, seed=4):
    _, uv_a, uv_b = scene(n, sigma_px=0.2, seed=seed)
    order = np.random.default_rng(seed).permutation(n)
    a, b = features_at(uv_a, seed=seed), features_at(uv_b, seed=seed)
    return a, b[order], np.argsort(order)


T_A_B = invert_T(T_A) @ T_B


def test_epipolar_matches_are_the_right_ones():
    a, b, truth = epipolar_pair()
    i, j = match_along_epipolar_lines(CAMERA, T_A_B, a, b, 1.5, SCALE)
    assert len(i) > 0.97 * len(a)
    np.testing.assert_array_equal(truth[i], j)


def test_equal_descriptors_off_the_line_do_not_match():
    a, b, truth = epipolar_pair()
    moved = replace(b, uv_px=np.add(b.uv_px, [0.0, 12.0]))
    i, _ = match_along_epipolar_lines(CAMERA, T_A_B, a, moved, 1.5, SCALE)
    assert len(i) < 0.05 * len(a)
    i, j = match_along_epipolar_lines(CAMERA, T_A_B, a, moved, 14.0, SCALE)
    assert len(i) > 0.9 * len(a) and (truth[i] == j).all()


def test_epipolar_matches_are_one_to_one_and_alike():
    a, b, _ = epipolar_pair()
    alike = replace(a, descriptors=np.repeat(a.descriptors[:1], len(a), 0))
    i, j = match_along_epipolar_lines(CAMERA, T_A_B, alike, alike, 1e3, SCALE)
    assert len(i) >= 1
    assert len(np.unique(i)) == len(i) and len(np.unique(j)) == len(j)
    strangers = replace(b, descriptors=features_at(b.uv_px, seed=99).descriptors)
    assert len(match_along_epipolar_lines(CAMERA, T_A_B, a, strangers, 1e3, SCALE)[0]) == 0


def test_epipolar_matches_are_of_about_the_same_scale():
    a, b, _ = epipolar_pair()
    for octave, found in ((1, True), (2, False)):
        coarser = replace(b, octave=np.full(len(b), octave, np.int32))
        i, _ = match_along_epipolar_lines(CAMERA, T_A_B, a, coarser, 1.5, SCALE)
        assert (len(i) > 100) is found


@pytest.mark.parametrize(("n", "m"), [(0, 10), (10, 0), (0, 0)])
def test_nothing_to_match(n, m):
    a, b, _ = epipolar_pair(10)
    i, j = match_along_epipolar_lines(CAMERA, T_A_B, a[np.arange(n)], b[np.arange(m)], 1.5, SCALE)
    assert len(i) == len(j) == 0


def test_more_features_than_fit_in_memory_at_a_time_are_matched_alike(monkeypatch):
    _, uv_a, uv_b = scene(300)
    a, b = features_at(uv_a), features_at(uv_b)
    T_A_B = invert_T(T_A) @ T_B
    whole = match_along_epipolar_lines(CAMERA, T_A_B, a, b, 1.5, SCALE)
    assert len(whole[0]) > 290
    for pairs in (1, 7 * len(b), len(a) * len(b) - 1):
        monkeypatch.setattr(triangulation, "_PAIRS_AT_A_TIME", pairs)
        parts = match_along_epipolar_lines(CAMERA, T_A_B, a, b, 1.5, SCALE)
        np.testing.assert_array_equal(parts, whole)


def test_the_limits_grow_with_the_scale_factor_of_the_pyramid():
    points, uv_a, uv_b = scene()
    a, shifted = features_at(uv_a, octave=2), features_at(np.add(uv_b, [0.0, 3.5]), octave=2)
    for scale_factor, passes in ((1.2, False), (1.5, True)):
        good = check_triangulated(CAMERA, T_A, T_B, points, a, shifted, CONFIG, scale_factor)
        assert good.all() if passes else not good.any()
