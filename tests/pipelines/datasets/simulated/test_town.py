"""The drives through a town: two rounds alike but not the same, and streets that differ."""

from itertools import combinations

import cv2
import numpy as np
import pytest

from pipelines.datasets.simulated import SimulatedSequence
from pipelines.datasets.simulated.kitti_motion import outline, overlapping
from pipelines.datasets.simulated.quarters import quarter_textures
from pipelines.datasets.simulated.renderer import Renderer
from pipelines.datasets.simulated.route import block_route
from pipelines.datasets.simulated.scenes import SCENES, scaled_camera
from pipelines.datasets.simulated.town import make_long, make_loop

FRAMES = SCENES["loop"].frames
CAMERA = scaled_camera(SCENES["loop"].camera, 0.4)


@pytest.fixture(scope="module")
def loop():
    return make_loop(FRAMES, 0, CAMERA)


@pytest.fixture(scope="module")
def long():
    return make_long(80, 0, CAMERA)


@pytest.fixture(scope="module")
def views(loop):
    """Function (frame) -> rendered view, once each."""
    renderer, seen = Renderer(loop), {}

    def view(k):
        if k not in seen:
            seen[k] = renderer.render(k)
        return seen[k]

    return view


def again(world, k):
    """The frame of the second round that is nearest in place to frame `k` of the first."""
    p = world.Ts_scene_camera[:, :3, 3]
    later = np.arange(k + 150, min(k + 350, len(p)))
    return int(later[np.linalg.norm(p[later] - p[k], axis=1).argmin()])


def test_the_camera_goes_round_twice_and_a_little_more(loop):
    assert FRAMES >= 400
    heading = np.unwrap(np.arctan2(loop.Ts_scene_camera[:, 0, 2], loop.Ts_scene_camera[:, 2, 2]))
    assert heading[-1] == pytest.approx(4 * np.pi, abs=0.05)
    p = loop.Ts_scene_camera[:, :3, 3]
    assert np.linalg.norm(p[again(loop, 0)] - p[0]) < 1.0


def test_rounds_differ_sideways_by_some_tens_of_centimetres(loop):
    Ts = loop.Ts_scene_camera
    sideways = []
    for k in range(5, 200, 5):
        other = again(loop, k)
        step = Ts[other, :3, 3] - Ts[k, :3, 3]
        sideways.append(-float(step @ Ts[k, :3, 0]))  # to the left
        assert Ts[k, :3, 2] @ Ts[other, :3, 2] > np.cos(np.radians(6))
    assert min(sideways) > 0.15
    assert max(sideways) < 0.55


def test_every_round_meets_others(loop):
    half = again(loop, 0)
    rounds = range(10, half - 45), range(half + 45, FRAMES - 10)
    met = [
        {a.object_id for a in loop.actors if a.moving and any(map(a.is_present, frames))}
        for frames in rounds
    ]
    assert len(met[0]) >= 5
    assert len(met[1]) >= 5
    assert len(met[0] & met[1]) <= 1  # someone may be met last before and first after
    assert sum(not a.moving for a in loop.actors) >= 10


@pytest.mark.parametrize("name", ["loop", "long"])
def test_nobody_jumps_slides_or_touches_anybody(name, request, stuck_in_walls):
    world = request.getfixturevalue(name)
    frames = range(0, world.n_frames, 4)
    assert stuck_in_walls(world, frames) == set()
    plans = []
    for a in world.actors:
        Ts = a.Ts_scene_object
        there = np.array([a.is_present(k) for k in range(len(Ts))])
        low, high = a.mesh.bounds()
        size = high - low
        yaw = np.arctan2(Ts[:, 0, 2], Ts[:, 2, 2])
        plan = outline(Ts[:, 0, 3], Ts[:, 2, 3], yaw, size[0], size[2])
        plans.append(np.where(there[:, None, None], plan, np.nan))
        if a.moving and a.class_name == "car":
            both = there[1:] & there[:-1]
            v = np.diff(Ts[:, :3, 3], axis=0)[both] * world.fps
            middle = (Ts[1:] + Ts[:-1])[both] / 2
            assert np.abs((v * middle[:, :3, 0]).sum(1)).max() < 0.25  # m/s to the side
            along = (v * middle[:, :3, 2]).sum(1)
            assert along.min() > 3
            assert along.max() < 13
    for i, j in combinations(range(len(plans)), 2):
        if world.actors[i].moving or world.actors[j].moving:
            assert not overlapping(plans[i], plans[j]).any(), (i + 1, j + 1)
    ego = world.Ts_scene_camera
    car = outline(ego[:, 0, 3], ego[:, 2, 3], np.arctan2(ego[:, 0, 2], ego[:, 2, 2]), 1.7, 2.0)
    assert not any(overlapping(car, plan).any() for plan in plans)


@pytest.mark.slow
def test_the_camera_never_sees_anyone_come_from_nowhere(loop, views):
    """Whoever begins or ends in mid-drive is out of the picture or hidden then."""
    n_looked = 0
    for a in loop.actors:
        if a.present is None:
            continue
        for k in np.flatnonzero(np.diff(a.present.astype(int))):
            last = int(k if a.present[k] else k + 1)
            if 0 <= last < FRAMES:
                assert (views(last).labels == a.object_id).sum() == 0, (a.object_id, last)
                n_looked += 1
    assert n_looked > 5


@pytest.mark.slow
def test_houses_stand_on_both_sides_all_along(views):
    sides = []
    for k in range(0, 240, 30):
        depth = views(k).depth_m
        H, W = depth.shape
        assert np.isnan(depth).mean() < 0.12
        eye = slice(H // 3, H // 2)
        sides.append([np.nanmedian(depth[eye, : W // 4]), np.nanmedian(depth[eye, -W // 4 :])])
    assert np.max(sides) < 75  # down a side street
    assert np.median(sides, axis=0).max() < 45


@pytest.mark.slow
def test_places_can_be_told_apart_and_found_again(loop, views):
    """The second round's view of a place matches the first one's, and no other place's."""
    orb, matcher = cv2.ORB_create(800), cv2.BFMatcher(cv2.NORM_HAMMING)

    def described(k):
        view = views(k)
        return orb.detectAndCompute(view.image, (view.labels == 0).astype(np.uint8))

    def agreeing(a, b):
        (ka, da), (kb, db) = a, b
        pairs = [m[0] for m in matcher.knnMatch(da, db, 2) if m[0].distance < 0.75 * m[1].distance]
        if len(pairs) < 8:
            return 0
        pa = np.array([ka[m.queryIdx].pt for m in pairs])
        pb = np.array([kb[m.trainIdx].pt for m in pairs])
        _, inliers = cv2.findFundamentalMat(pa, pb, cv2.FM_RANSAC, 1.5, 0.999, 2000)
        return 0 if inliers is None else int(inliers.sum())

    places = [10, 60, 110, 150, 200]
    first = [described(k) for k in places]
    second = [described(again(loop, k)) for k in places]
    found = np.array([[agreeing(a, b) for b in second] for a in first])
    same = np.diag(found)
    others = found[~np.eye(len(places), dtype=bool)]
    assert same.min() > 30
    assert others.max() < 0.7 * same.min()


def test_the_town_does_not_depend_on_how_long_one_drives(loop):
    short = make_loop(2, 0, CAMERA)
    assert (short.static.vertices == loop.static.vertices).all()


def test_quarters_show_other_fronts():
    textures = quarter_textures(3, 2)
    drawn = [
        textures[f"storeys_brick_{k}"](np.random.default_rng([0, k])).rgba.astype(int)
        for k in range(2)
    ]
    assert np.abs(drawn[0] - drawn[1]).mean() > 10
    posters = [textures[f"posters_{k}"](np.random.default_rng([0, k])).rgba for k in range(2)]
    assert np.abs(posters[0].astype(int) - posters[1]).mean() > 20


@pytest.mark.slow
def test_opened_as_a_sequence_with_all_faults(tmp_path):
    sequence = SimulatedSequence(
        "simulated:loop", frames=3, scale=0.2, cache=tmp_path, degrade="all",
        provide=("depth", "flow", "masks", "right"),
    )  # fmt: skip
    frame = sequence.read(2)
    assert frame.image.shape == (75, 248, 3)
    assert frame.flow_prev_to_curr_px is not None
    assert 0.3 < np.isfinite(frame.depth_m).mean() < 0.98
    exact = SimulatedSequence("simulated:loop", frames=3, scale=0.2, cache=tmp_path)
    assert (exact.read(2).image != frame.image).any()
    assert len(exact.ground_truth().Ts_world_camera) == 3


def test_the_round_is_as_long_as_the_drive_says():
    _, round_m = block_route(100.0)
    assert 150 < round_m < 200
