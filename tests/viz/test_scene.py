"""Scenes and views: strays, gaps, frustums, and views that hold the whole path."""

from pathlib import Path

import numpy as np
import pytest

from pipelines.geometry import exp_se3, transform_points
from pipelines.io.result import Result
from viz import style
from viz.scene import build_scene, frustums, near_path, split_at_gaps
from viz.views import VIEW_NAMES, choose_view


def drive(n: int = 60, turn_rad: float = 0.01) -> np.ndarray:
    step = exp_se3(np.array([0.0, turn_rad, 0.0, 0.0, 0.0, 1.0]))
    return np.array([np.linalg.matrix_power(step, k) for k in range(n)])


def make_result(Ts: np.ndarray, n_points: int = 2000, **changes) -> Result:
    rng = np.random.default_rng(4)
    near = Ts[rng.integers(0, max(len(Ts), 1), n_points), :3, 3] if len(Ts) else np.zeros((0, 3))
    points = near + rng.uniform(-1.0, 1.0, near.shape) * [12.0, 3.0, 4.0]
    values = {
        "folder": Path("a-run"),
        "timestamps_s": np.arange(len(Ts)) * 0.1,
        "Ts_world_camera": Ts,
        "gt_timestamps_s": np.arange(len(Ts)) * 0.1,
        "gt_Ts_world_camera": Ts,
        "static_points_m": points,
        "static_colors": np.full(points.shape, 120, np.uint8),
    }
    return Result(**(values | changes))


def test_strays_are_left_out():
    Ts = drive()
    points = make_result(Ts).static_points_m
    strays = np.array([[0.0, -5000.0, 0.0], [np.nan, 0.0, 1.0], [0.0, 0.0, np.inf], [900.0, 0, 0]])
    keep = near_path(np.concatenate([points, strays]), Ts[:, :3, 3])
    assert not keep[-4:].any()
    assert keep[:-4].mean() > 0.97


def test_gaps_in_time_break_the_path():
    stamps = np.array([0.0, 0.1, 0.2, 0.6, 0.7, 0.8, 0.9])
    pieces = split_at_gaps(stamps, np.arange(21.0).reshape(7, 3))
    assert [len(piece) for piece in pieces] == [3, 4]
    assert split_at_gaps(np.empty(0), np.empty((0, 3))) == []


def test_frustums_open_the_way_the_camera_looks():
    T = exp_se3(np.array([0.2, 0.5, -0.1, 1.0, 2.0, 3.0]))
    outline = frustums(T[None], 0.5)[0]
    local = transform_points(np.linalg.inv(T), outline)
    apex = np.linalg.norm(local, axis=1) < 1e-12
    assert apex.any()
    np.testing.assert_allclose(local[~apex, 2], 0.5, atol=1e-12)


@pytest.mark.parametrize("name", VIEW_NAMES)
@pytest.mark.parametrize("size", [(1280, 720), (600, 900)])
@pytest.mark.parametrize(
    "Ts",
    [
        drive(),
        drive(turn_rad=0.0),
        drive(turn_rad=2 * np.pi / 60),
        exp_se3(np.array([1.1, 0.4, 2.0, 5.0, 6.0, 7.0])) @ drive(),
    ],
    ids=["bend", "straight", "loop", "anywhere"],
)
def test_views_hold_the_whole_path(Ts, size, name):
    scene = build_scene(make_result(Ts))
    view = choose_view(name, scene, size)
    uv, depth = view.project(scene.path_m)
    assert (depth > 0).all()
    assert (uv >= 0).all()
    assert (uv <= np.array(size) - 1).all()
    R = view.T_view_world[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(R) == pytest.approx(1.0)  # not mirrored
    assert np.linalg.norm(np.ptp(uv, axis=0)) > 0.2 * min(size)  # and not lost in a corner


def test_top_view_is_a_map_to_scale_along_the_picture():
    scene = build_scene(make_result(drive(turn_rad=0.0)))
    view = choose_view("top", scene, (1280, 720))
    uv, _ = view.project(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 10.0], [10.0, 0.0, 0.0]]))
    assert view.px_per_m is not None
    np.testing.assert_allclose(uv[1] - uv[0], [10 * view.px_per_m, 0.0], atol=1.5)
    # Ahead is to the right of the picture, so what is right of the camera is towards the bottom.
    np.testing.assert_allclose(uv[2] - uv[0], [0.0, 10 * view.px_per_m], atol=1.5)
    high, _ = view.project(np.array([[0.0, -3.0, 0.0]]))
    assert np.linalg.norm(high[0] - uv[0]) < 6.0  # heights hardly shift anything


def test_a_short_drive_among_far_things_is_not_lost_in_the_picture():
    Ts = drive(12, turn_rad=0.0)
    far = np.random.default_rng(2).uniform([-60, -8, 90], [20, 0, 140], (400, 3))
    near = np.random.default_rng(3).uniform([-10, -3, 5], [10, 1.5, 30], (1600, 3))
    points = np.concatenate([near, far])
    result = make_result(Ts, static_points_m=points, static_colors=np.zeros(points.shape, np.uint8))
    scene = build_scene(result)
    view = choose_view("top", scene, (1280, 720))
    uv, _ = view.project(scene.path_m[[0, -1]])
    assert uv[1, 0] - uv[0, 0] > 0.25 * 1280  # a quarter of the picture, although the map is 140 m
    assert abs(uv[1, 1] - uv[0, 1]) < 4.0  # a straight way lies level, wherever the rest leads


def test_a_drive_goes_to_the_right_unless_the_map_is_seen_badly_so():
    for turn_rad in (-0.01, 0.0, 0.01):
        scene = build_scene(make_result(drive(turn_rad=turn_rad)))
        uv, depth = choose_view("iso", scene, (1280, 720)).project(scene.path_m)
        assert uv[-1, 0] - uv[0, 0] > 300
        assert depth[-1] > depth[0]


def test_up_survives_a_tilted_first_camera():
    tilt = exp_se3(np.array([0.4, 0.0, 0.0, 0.0, 0.0, 0.0]))
    level = drive()
    Ts = np.linalg.inv(tilt) @ level @ tilt  # all cameras look down by the same angle
    # Only the mean of the cameras is known, and they all agree, so that is what up must be.
    np.testing.assert_allclose(build_scene(make_result(Ts)).up @ Ts[0, :3, 1], -1.0, atol=0.1)


@pytest.mark.parametrize("n", [0, 1, 2])
def test_almost_nothing_to_show(n):
    result = make_result(drive(n), n_points=0, gt_Ts_world_camera=None, gt_timestamps_s=None)
    scene = build_scene(result)
    for name in VIEW_NAMES:
        view = choose_view(name, scene, (320, 240))
        assert np.isfinite(view.T_view_world).all()
        uv, depth = view.project(scene.path_m)
        assert (depth > 0).all()
        assert ((uv >= 0) & (uv < [320, 240])).all()


def test_up_is_what_a_camera_in_a_hand_turns_about():
    down = exp_se3(np.array([-0.5, 0.0, 0.0, 0.0, 0.0, 0.0]))  # it looks at a table all the time
    turned = [exp_se3(np.array([0.0, a, 0, 0, 0, 0])) @ down for a in np.linspace(-0.6, 0.6, 30)]
    Ts = np.linalg.inv(turned[0]) @ np.array(turned)
    level = np.linalg.inv(turned[0])[:3, :3] @ [0.0, -1.0, 0.0]
    up = build_scene(make_result(Ts)).up
    assert up @ level > np.cos(np.radians(3.0))
    assert -Ts[0, :3, 1] @ level < np.cos(np.radians(25.0))  # none of its own axes tells so


def test_a_short_path_has_few_frustums():
    Ts = drive(40)
    Ts[:, :3, 3] *= 0.005
    far = make_result(drive(40)).static_points_m
    scene = build_scene(make_result(Ts, static_points_m=far, static_colors=np.uint8(far * 0)))
    assert 1 <= sum(line.color == style.FRUSTUM for line in scene.polylines) <= 3


def test_unknown_view():
    with pytest.raises(ValueError, match="expected one of top, iso, found 'side'"):
        choose_view("side", build_scene(make_result(drive(5))), (64, 48))
