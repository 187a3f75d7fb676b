"""Pixels of new objects found back by flow, and lost ones by their descriptors."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.config import DepthConfig, ObjectsConfig
from pipelines.frontend.sensor import Sensor
from pipelines.objects.following import Followed
from pipelines.objects.frame import LastObjects, ObjectFrame
from pipelines.objects.looking_back import guess_motions, seed_pixels
from pipelines.objects.points import ObjectPoints
from pipelines.objects.solver import MotionSolver


def frame_of(labels, ids, new_ids):
    windows = {}
    for i in ids:
        v, u = np.nonzero(labels == i)
        windows[i] = (slice(v.min(), v.max() + 1), slice(u.min(), u.max() + 1))
    return ObjectFrame(
        labels, True, ObjectPoints.empty(), Followed.empty(), True, windows,
        dict.fromkeys(ids, 0.9), list(new_ids),
    )  # fmt: skip


def last_of(view, labels):
    frame = frame_of(labels, [int(i) for i in np.unique(labels) if i], [])
    return LastObjects(view, np.eye(4), True, labels, frame.windows, ObjectPoints.empty())


@pytest.fixture(scope="module")
def passing(board, street_of):
    """Two boards in two frames; the far one goes 0.3 m to the right, the near one stands."""
    street = street_of((
        board(lambda t: (-1.0 + 3.0 * t, 0.0, 9.0)),
        board(lambda t: (1.6, 0.0, 7.0), seed=2),
    ))  # fmt: skip
    return [street.view(k) for k in range(2)]


def test_seeds_lie_on_the_new_object_in_the_view_before(passing):
    (view0, seen0), (view1, seen1) = passing
    nothing = np.zeros_like(seen0.labels)
    frame = frame_of(seen1.labels, [1, 2], [1])
    ids, uv = seed_pixels(last_of(view0, nothing), frame, view1.flow_prev_to_curr_px, 100)
    assert set(ids) == {1} and 50 < len(uv) <= 100
    at = uv.astype(int)
    # But for some of the wall, whose flow leads behind the object
    assert (seen0.labels[at[:, 1], at[:, 0]] == 1).mean() > 0.93
    assert uv.dtype == np.float64


def test_seeds_keep_off_objects_that_were_known(passing):
    (view0, seen0), (view1, seen1) = passing
    known = np.where(seen0.labels == 2, 2, 0).astype(np.int32)
    labels = np.where(seen1.labels > 0, 1, 0).astype(np.int32)  # a mask that runs over both
    ids, uv = seed_pixels(
        last_of(view0, known), frame_of(labels, [1], [1]), view1.flow_prev_to_curr_px, 200
    )
    assert len(ids) > 50
    at = uv.astype(int)
    assert not (seen0.labels[at[:, 1], at[:, 0]] == 2).any()


@pytest.mark.parametrize("fill", [np.nan, np.inf, -np.inf, 1e5])
def test_flow_that_leads_nowhere_gives_no_seeds(passing, fill):
    (view0, seen0), (_, seen1) = passing
    flow = np.full((*seen0.labels.shape, 2), fill, np.float32)
    frame = frame_of(seen1.labels, [1, 2], [1, 2])
    ids, uv = seed_pixels(last_of(view0, np.zeros_like(seen0.labels)), frame, flow, 50)
    assert len(ids) == 0 and uv.shape == (0, 2)


def test_a_jump_is_guessed_by_descriptors(board, street_of):
    """Two metres in a frame, far beyond what flow follows."""
    street = street_of((board(lambda t: (-1.2 + 20.0 * t, 0.0, 7.0)),))
    (view0, seen0), (view1, seen1) = street.view(0), street.view(1)
    solver = MotionSolver(Sensor(street.camera, DepthConfig()), ObjectsConfig(), 0)
    frame = frame_of(seen1.labels, [1], [])
    last = last_of(view0, seen0.labels)
    G = guess_motions(solver, last, view1, frame, set())[1]
    center = np.array([-1.2, 0.0, 7.0])
    np.testing.assert_allclose(G[:3, :3] @ center + G[:3, 3] - center, [2.0, 0, 0], atol=0.15)
    assert guess_motions(solver, last, view1, frame, {1}) == {}  # it is solved already
    frame.carried_ids.add(1)  # a mask that was carried shows nothing new
    assert guess_motions(solver, last, view1, frame, set()) == {}


def test_small_and_new_objects_are_not_searched_for(board, street_of):
    street = street_of((board(lambda t: (-1.2 + 20.0 * t, 0.0, 7.0), size_m=(1.0, 0.3)),))
    (view0, seen0), (view1, seen1) = street.view(0), street.view(1)
    assert 0 < (seen1.labels == 1).sum() < 1200
    solver = MotionSolver(Sensor(street.camera, DepthConfig()), ObjectsConfig(), 0)
    small = np.zeros_like(seen1.labels)
    small[100:110, 200:230] = 1
    frame = frame_of(small, [1], [])
    assert guess_motions(solver, last_of(view0, small), view1, frame, set()) == {}
    new = replace(last_of(view0, seen0.labels), windows={})
    frame = frame_of(seen1.labels, [1], [1])
    assert guess_motions(solver, new, view1, frame, set()) == {}
