"""Where objects' motions lead, and their points followed there though the flow says otherwise."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.config import DepthConfig, ObjectsConfig
from pipelines.frontend.sensor import Sensor
from pipelines.geometry import invert_T, make_T
from pipelines.objects.expectation import Expectation
from pipelines.objects.frame import LastObjects
from pipelines.objects.points import ObjectPoints, choose_pixels, tight_window
from pipelines.objects.solver import MotionSolver
from pipelines.objects.track import ObjectTrack

STEP_M = np.array([0.5, 0.0, 0.2])  # of object 1 a frame; object 2 goes as fast, but nobody knows


@pytest.fixture(scope="module")
def drive(board, street_of):
    return street_of(
        (
            board(lambda t: (-1.5 + 5.0 * t, 0.0, 9.0 + 2.0 * t)),
            board(lambda t: (1.5 + 5.0 * t, 0.0, 9.0 + 2.0 * t), seed=2),
        ),
        lambda t: (0.0, 0.0, 4.0 * t),
    )


@pytest.fixture
def expectation(drive):
    """From frame 0 to frame 1, with points on both objects."""
    sensor, config = Sensor(drive.camera, DepthConfig()), ObjectsConfig()
    view, found = drive.view(0)
    windows = {i: tight_window(found.labels == i) for i in (1, 2)}
    uv = [
        choose_pixels(view.gray, (found.labels == i)[w], w, 40, np.empty((0, 2)))
        for i, w in windows.items()
    ]
    ids = np.repeat([1, 2], [len(pixels) for pixels in uv])
    points = MotionSolver(sensor, config, 0).create_points(
        view.disparity_px, ids, np.concatenate(uv)
    )
    last = LastObjects(view, drive.T_world_camera(0), True, found.labels, windows, points)
    tracks = {i: ObjectTrack(i, config) for i in (1, 2)}
    H = make_T(np.eye(3), STEP_M)
    tracks[1].take_motion(H, 1e-6 * np.eye(6), np.array([-1.5, 0.0, 9.0]), 0.1)
    tracks[1].predict(0.1)
    return Expectation(sensor, tracks, last, drive.view(1)[0], drive.T_world_camera(1))


def off_px(expectation, followed, object_id):
    """How far from their true places the points of an object were found."""
    points = expectation.last.points
    own = (points.object_id == object_id) & followed.valid
    true_m = points.position_m[own] + STEP_M - [0.0, 0.0, 0.4]
    camera = expectation.sensor.camera
    true_uv = camera.fx * true_m[:, :2] / true_m[:, 2:] + [camera.cx, camera.cy]
    return np.linalg.norm(followed.uv_px[own] - true_uv, axis=1)


def test_motions_lead_from_camera_to_camera(expectation, drive) -> None:
    first, unknown = expectation.motions(np.array([1, 2]))
    T0, T1 = drive.T_world_camera(0), drive.T_world_camera(1)
    np.testing.assert_allclose(first, invert_T(T1) @ make_T(np.eye(3), STEP_M) @ T0, atol=1e-9)
    np.testing.assert_allclose(unknown, invert_T(T1) @ T0, atol=1e-12)


def test_a_known_motion_leads_where_the_flow_does_not(expectation) -> None:
    lies = np.zeros_like(expectation.view.flow_prev_to_curr_px)
    lost = replace(expectation, view=replace(expectation.view, flow_prev_to_curr_px=lies))
    off = off_px(lost, lost.follow(lost.last.points), 1)
    assert len(off) > 20
    assert 1e-6 < np.median(off) < 0.3  # the step is 25 px
    astray = off_px(lost, lost.follow(lost.last.points), 2)
    assert len(astray) == 0 or astray.min() > 5.0


def test_what_nobody_knows_follows_the_flow(expectation) -> None:
    off = off_px(expectation, expectation.follow(expectation.last.points), 2)
    assert len(off) > 20
    assert 1e-6 < np.median(off) < 0.3


def test_a_motion_that_was_found_otherwise_leads_as_well(expectation, drive) -> None:
    lies = np.zeros_like(expectation.view.flow_prev_to_curr_px)
    lost = replace(expectation, view=replace(expectation.view, flow_prev_to_curr_px=lies))
    G = invert_T(drive.T_world_camera(1)) @ make_T(np.eye(3), STEP_M) @ drive.T_world_camera(0)
    followed = lost.follow_by(lost.last.points, np.stack([G, G]), np.ones(2, bool))
    off = off_px(lost, followed, 2)
    assert len(off) > 20
    assert 1e-6 < np.median(off) < 0.3


def test_without_any_flow_what_nobody_knows_is_taken_to_stand(expectation, drive) -> None:
    view = replace(drive.view(0)[0], timestamp_s=0.1, flow_prev_to_curr_px=None)
    still = replace(expectation, view=view, T_world_camera=drive.T_world_camera(0))
    points, followed = still.last.points, still.follow(still.last.points)
    own = points.object_id == 2
    assert followed.valid[own].mean() > 0.9
    away = np.linalg.norm(followed.uv_px - points.uv_px, axis=1)[own & followed.valid]
    assert away.max() < 0.1


def test_no_points_lead_nowhere(expectation) -> None:
    assert len(expectation.follow(ObjectPoints.empty()).uv_px) == 0
