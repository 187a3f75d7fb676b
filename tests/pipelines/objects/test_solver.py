"""From followed points to believed motions and refined points; the second try by descriptors."""

import numpy as np
import pytest

from pipelines.config import DepthConfig, ObjectsConfig
from pipelines.frontend.sensor import Sensor
from pipelines.geometry import exp_se3, invert_T, project_stereo, transform_points
from pipelines.objects.following import Followed
from pipelines.objects.points import ObjectPoints
from pipelines.objects.solver import MotionSolver, on_one_surface

CONFIG = ObjectsConfig(min_points=12, min_inlier_share=0.4)


@pytest.fixture
def solver(kitti):
    return MotionSolver(Sensor(kitti, DepthConfig()), CONFIG, seed=0)


def plane(kitti, z_m=12.0):
    """Disparities of a wall that faces the camera."""
    return np.full((kitti.height, kitti.width), kitti.bf / z_m, np.float32)


def wall_points(solver, rng, n, object_id=1):
    uv = rng.uniform([400, 100], [700, 250], (n, 2))
    disparity = plane(solver.camera)
    return solver.create_points(disparity, np.full(n, object_id), uv)


def followed_by(kitti, points, G, rng, sigma_px=0.1):
    """As the flow would follow them if their object moved by G."""
    uv = project_stereo(kitti, transform_points(G, points.position_m))[:, :2]
    uv = uv + rng.normal(0, sigma_px, uv.shape)
    n = len(uv)
    return Followed(
        uv, np.ones(n, bool), np.full(n, sigma_px), uv, np.full((n, 2), np.nan), np.zeros(n)
    )


def solve(solver, points, followed, G=None, z_m=12.0):
    guess = np.eye(4) if G is None else G
    J = len(points.groups()[0])
    return solver.solve(
        plane(solver.camera, z_m), points, followed, (np.broadcast_to(guess, (J, 4, 4)),)
    )


G = exp_se3(np.array([0.0, 0.0, 0.0, 0.3, 0.05, -0.5]))


def test_a_motion_is_believed_and_its_points_are_refined(kitti, solver):
    rng = np.random.default_rng(0)
    points = wall_points(solver, rng, 80)
    solution = solve(solver, points, followed_by(kitti, points, G, rng), z_m=11.5)
    assert solution.accepted.tolist() == [True]
    center = points.position_m.mean(0)
    moved = transform_points(solution.motions.Gs_curr_prev[0], center[None])[0]
    np.testing.assert_allclose(moved - center, G[:3, 3], atol=0.02)
    refined = solver.refine(solution)
    assert len(refined) == solution.motions.n_inliers[0] > 60
    assert abs(np.median(refined.position_m[:, 2]) - 11.5) < 0.05
    before, after = (np.trace(p.covariance_m2, axis1=1, axis2=2) for p in (points, refined))
    # A second look at their depths, and 0.3 m of parallax besides
    assert 0.05 < np.median(after) / np.median(before) < 0.5


@pytest.mark.parametrize(("n_agree", "believed"), [(11, False), (30, False), (50, True)])
def test_too_few_that_agree_are_no_proof(kitti, solver, n_agree, believed):
    """Of 100 points, 40 % must; and 12 whatever the share."""
    rng = np.random.default_rng(1)
    points = wall_points(solver, rng, 100)
    followed = followed_by(kitti, points, G, rng)
    stray = followed.uv_px.copy()
    stray[n_agree:] += rng.choice([-1, 1], (100 - n_agree, 2)) * rng.uniform(
        30, 200, (100 - n_agree, 2)
    )
    followed = Followed(
        stray, followed.valid, followed.sigma_px, stray, followed.aligned_px, followed.across
    )
    solution = solve(solver, points, followed, G, z_m=11.5)
    assert solution.accepted.tolist() == [believed]
    assert (len(solver.refine(solution)) > 0) == believed


def test_rows_of_each_object_and_an_object_that_is_not_believed(kitti, solver):
    rng = np.random.default_rng(2)
    points = ObjectPoints.concatenate(
        wall_points(solver, rng, 40, 7), wall_points(solver, rng, 4, 3)
    )
    solution = solve(solver, points, followed_by(kitti, points, G, rng), G, z_m=11.5)
    assert solution.motions.object_id.tolist() == [3, 7]
    assert solution.accepted.tolist() == [False, True]
    assert solution.rows_of(0).tolist() == list(range(4))
    assert solution.rows_of(1).tolist() == list(range(4, 44))
    assert set(solver.refine(solution).object_id) == {7}


def test_objects_teach_the_noise_of_their_flow(kitti, solver):
    rng = np.random.default_rng(3)
    points = wall_points(solver, rng, 200)
    noise = solver.sensor.noise
    learned = ("object_flow", "object_interior")
    others = {k: v for k, v in noise.sigma_uv_px.items() if k not in learned}
    for _ in range(8):
        solve(solver, points, followed_by(kitti, points, G, rng, 0.12), G, z_m=11.5)
    for source in learned:
        assert noise.sigma_uv_px[source] == pytest.approx(0.12, rel=0.2)
    assert {k: v for k, v in noise.sigma_uv_px.items() if k not in learned} == others


def test_depth_that_says_nothing_is_not_used(kitti, solver):
    rng = np.random.default_rng(4)
    points = wall_points(solver, rng, 60)
    for z_m in (400.0, np.nan):  # 1 px of disparity, and none
        solution = solve(solver, points, followed_by(kitti, points, G, rng), G, z_m=z_m)
        assert np.isnan(solution.observations.uvr_px[:, 2]).all()
        assert solution.accepted[0]


def test_points_of_others_in_a_worn_mask_are_left_out(kitti, solver):
    rng = np.random.default_rng(5)
    uv = rng.uniform([400, 100], [700, 250], (80, 2))
    disparity = plane(kitti)
    disparity[:, :460] = kitti.bf / 40.0  # the road behind
    points = solver.create_points(disparity, np.full(80, 1), uv)
    on_it = uv[:, 0] > 465
    assert 0.9 * on_it.sum() < len(points) <= 80
    assert (points.position_m[:, 2] < 14).all()


def test_a_long_object_is_one_surface_and_each_is_judged_alone(kitti):
    rng = np.random.default_rng(6)
    n = 60
    z = np.r_[np.linspace(10, 14, n), np.full(n, 30.0), [10.0]]
    ids = np.r_[np.full(n, 1), np.full(n + 1, 2)]
    position = np.stack([rng.normal(size=len(z)), rng.normal(size=len(z)), z], -1)
    none = np.zeros((len(z), 3, 3)), np.zeros((len(z), 2))
    points = ObjectPoints(ids, position, *none, np.arange(len(z)))
    near = on_one_surface(kitti, points, 0.3)
    assert near[:-1].all() and not near[-1]
    assert on_one_surface(kitti, ObjectPoints.empty(), 0.3).shape == (0,)


@pytest.mark.parametrize(
    ("n", "share", "found"), [(40, 1.0, True), (40, 0.5, True), (40, 0.0, False), (8, 1.0, False)]
)
def test_a_guess_by_matches_needs_their_agreement(kitti, solver, n, share, found):
    rng = np.random.default_rng(7)
    uv_prev = rng.uniform([400, 100], [700, 250], (n, 2))
    disparity = np.tile(np.linspace(25, 40, kitti.width, dtype=np.float32), (kitti.height, 1))
    z = kitti.bf / np.interp(uv_prev[:, 0], np.arange(kitti.width), disparity[0])
    x = (uv_prev[:, 0] - kitti.cx) / kitti.fx * z
    y = (uv_prev[:, 1] - kitti.cy) / kitti.fy * z
    jump = exp_se3(np.array([0.0, 0.1, 0.0, -3.0, 0.0, 2.0]))
    uv = project_stereo(kitti, transform_points(jump, np.stack([x, y, z], -1)))[:, :2]
    wrong = np.arange(n) >= share * n
    uv[wrong] = rng.uniform([0, 0], [kitti.width, kitti.height], (wrong.sum(), 2))
    guess = solver.guess_by_matches(disparity, uv_prev, uv)
    assert (guess is not None) == found
    if found:
        E = invert_T(jump) @ guess
        assert np.linalg.norm(E[:3, 3]) < 0.1


def test_matches_without_depth_are_no_guess(kitti, solver):
    uv = np.random.default_rng(8).uniform(50, 200, (40, 2))
    assert solver.guess_by_matches(plane(kitti) * np.nan, uv, uv) is None
