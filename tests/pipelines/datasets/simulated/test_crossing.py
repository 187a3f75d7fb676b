"""The crossing: its events are as its table says, and nothing touches anything."""

import numpy as np
import pytest

from pipelines.datasets.simulated import SimulatedSequence
from pipelines.datasets.simulated.crossing import (
    EVENTS,
    LEADING_CAR,
    RETURNING_CAR,
    VAN,
    WAITING_CAR,
    driven,
    make_crossing,
)
from pipelines.datasets.simulated.kitti_motion import outline, overlapping
from pipelines.datasets.simulated.renderer import Renderer
from pipelines.datasets.simulated.scenes import SCENES, scaled_camera

FRAMES = SCENES["crossing"].frames


@pytest.fixture(scope="module")
def world():
    return make_crossing(FRAMES, 0, scaled_camera(SCENES["crossing"].camera, 0.25))


@pytest.fixture(scope="module")
def pixels(world):
    """Function (frame) -> labels, rendered once each."""
    renderer, seen = Renderer(world), {}

    def render(k):
        if k not in seen:
            seen[k] = renderer.render(k).labels
        return seen[k]

    return render


def actor(world, object_id):
    return next(a for a in world.actors if a.object_id == object_id)


def place_px(world, object_id, k):
    T = np.linalg.inv(world.Ts_scene_camera[k]) @ actor(world, object_id).Ts_scene_object[k]
    x, y, z = T[:3, 3]
    camera = world.camera
    return round(camera.fx * x / z + camera.cx), round(camera.fy * y / z + camera.cy)


UNSEEN = [e for e in EVENTS if e.kind != "stop"]


@pytest.mark.parametrize("event", UNSEEN, ids=lambda e: f"{e.kind}-{e.object_id}")
def test_objects_vanish_and_return_as_the_table_says(world, pixels, event):
    first, last = event.frames
    for k in {first, (first + last) // 2, last}:
        assert not (pixels(k) == event.object_id).any()
    assert (pixels(first - 4) == event.object_id).sum() > 3
    if last < FRAMES - 5:
        assert (pixels(last + 4) == event.object_id).sum() > 3
    if event.by is not None:
        u, v = place_px(world, event.object_id, (first + last) // 2)
        assert pixels((first + last) // 2)[v, u] == event.by


def test_the_events_are_what_a_tracker_has_to_survive():
    lengths = {(e.kind, e.object_id): e.frames[1] - e.frames[0] + 1 for e in EVENTS}
    assert 8 <= lengths["hidden", LEADING_CAR] <= 15
    assert 8 <= lengths["hidden", WAITING_CAR] <= 15
    assert 10 <= lengths["away", RETURNING_CAR] <= 25
    assert lengths["stop", WAITING_CAR] / SCENES["crossing"].fps == pytest.approx(2.0, abs=0.11)


def test_hidden_ones_and_what_hides_them_move_on(world):
    for event in EVENTS:
        if event.kind == "hidden" and event.object_id != WAITING_CAR:
            for who in (event.object_id, event.by):
                first, last = event.frames
                step = np.diff(actor(world, who).Ts_scene_object[first : last + 1, :3, 3], axis=0)
                assert np.linalg.norm(step, axis=1).min() > 0.1


def test_the_waiting_car_stops_and_starts_again(world):
    path = actor(world, WAITING_CAR).Ts_scene_object[:, :3, 3]
    speed = np.linalg.norm(np.diff(path, axis=0), axis=1) * world.fps
    first, last = next(e.frames for e in EVENTS if e.kind == "stop")
    assert speed[first:last].max() < 1e-6
    assert speed[first - 2] > 0.01
    assert speed[last + 3] > 0.01
    assert speed[:3].min() > 4
    assert speed[-20:].min() > 4


def test_cars_do_not_slide_sideways_or_jump(world):
    for car in world.actors:
        if car.moving and car.class_name == "car":
            Ts = car.Ts_scene_object
            v = np.diff(Ts[:, :3, 3], axis=0) * world.fps
            across = np.abs((v * Ts[:-1, :3, 0]).sum(1))
            assert across.max() < 0.1
            along = (v * Ts[:-1, :3, 2]).sum(1)
            change = np.abs(np.diff(along)) * world.fps
            assert change.max() < 4.0  # m/s^2, less than firm braking


def test_nothing_touches_anything(world, stuck_in_walls):
    frames = range(0, FRAMES, 2)
    assert stuck_in_walls(world, frames) == set()
    plans = []
    for a in world.actors:
        low, high = a.mesh.bounds()
        T = a.Ts_scene_object
        yaw = np.arctan2(T[:, 0, 2], T[:, 2, 2])
        size = high - low
        plans.append(outline(T[:, 0, 3], T[:, 2, 3], yaw, size[0], size[2]))
    for i, a in enumerate(world.actors):
        for j in range(i):
            if a.moving or world.actors[j].moving:
                assert not overlapping(plans[i], plans[j]).any(), (i + 1, j + 1)


def test_stuck_things_would_be_found(world, stuck_in_walls):
    """The check above can fail: a van moved into the houses beside the road is found."""
    from dataclasses import replace

    van = actor(world, VAN)
    Ts = van.Ts_scene_object.copy()
    Ts[:, 0, 3] += 9.0
    Ts[:, 2, 3] += 12.0
    moved = replace(world, actors=(replace(van, Ts_scene_object=Ts),))
    assert stuck_in_walls(moved, range(0, FRAMES, 10)) == {VAN}


def test_driven_is_the_integral_of_the_speed():
    t = np.linspace(0, 6, 61)
    s = driven(t, ((0.0, 2.0), (1.0, 2.0), (3.0, 0.0), (4.0, 0.0)))
    assert s[10] == pytest.approx(2.0, abs=2e-3)
    assert s[30] == pytest.approx(4.0, abs=2e-3)  # a smooth step's mean is its middle
    assert np.ptp(s[30:]) == pytest.approx(0, abs=1e-9)
    assert (np.diff(s) >= -1e-12).all()


def test_two_worlds_of_a_seed_are_the_same_and_of_two_are_not(world):
    again = make_crossing(FRAMES, 0, world.camera)
    other = make_crossing(FRAMES, 1, world.camera)
    assert (again.static.vertices == world.static.vertices).all()
    for a, b in zip(again.actors, world.actors, strict=True):
        assert (a.Ts_scene_object == b.Ts_scene_object).all()
        assert (a.mesh.tint == b.mesh.tint).all()
    assert (
        other.static.vertices.shape != world.static.vertices.shape
        or not (other.static.vertices == world.static.vertices).all()
    )
    assert [a.class_name for a in other.actors[:6]] == ["car"] * 4 + ["person"] * 2


@pytest.mark.slow
def test_the_table_is_exact_at_full_size(cache):
    """Not a pixel within an event's frames, some in the frames beside them."""
    sequence = SimulatedSequence("crossing", cache=cache, provide="masks")
    truth = sequence.ground_truth().objects
    for event in UNSEEN:
        boxes = truth.boxes_px[truth.object_id == event.object_id]
        first, last = event.frames
        assert np.isnan(boxes[first : last + 1]).all()
        assert np.isfinite(boxes[first - 1]).all()
        assert last == FRAMES - 1 or np.isfinite(boxes[last + 1]).all()
