"""Two points that are one: who sees it afterwards, and who is covisible by it."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.config import MappingConfig
from pipelines.geometry import exp_se3
from pipelines.mapping.fusion import fuse_points, rename_points
from pipelines.mapping.keyframe import Keyframe
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.types import Features, StereoCamera

CAMERA = StereoCamera(640, 480, 500.0, 500.0, 320.0, 240.0, 50.0)
SHARED = 20  # points that both passes mapped


def tracks_of(ids) -> Tracks:
    n = len(ids)
    uv = np.column_stack([10.0 * np.arange(n), np.arange(n)])
    return Tracks(np.asarray(ids, np.int64), uv, np.full(n, 5.0), np.full(n, 0.3))


@pytest.fixture
def passes():
    """Two keyframes of one pass and two of another, with own points; pairs of what is one."""
    sparse_map = SparseMap(CAMERA, MappingConfig())
    ids = [
        sparse_map.add_points(
            np.full((30, 3), float(n)), np.zeros((30, 3, 3)), np.zeros((30, 3)),
            np.zeros((30, 32), np.uint8), np.zeros((30, 3), np.uint8),
        )
        for n in range(2)
    ]  # fmt: skip
    for k in range(4):
        T = exp_se3(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 100.0 * k]))
        seen = tracks_of(ids[k // 2])
        sparse_map.add_keyframe(Keyframe(k, 0.1 * k, T, seen, Features.empty()))
    return sparse_map, np.column_stack([ids[0][:SHARED], ids[1][:SHARED]])


def test_the_older_point_takes_the_place_of_its_double_everywhere(passes) -> None:
    sparse_map, pairs = passes
    assert 0 not in sparse_map.covisible_keyframes(2)
    assert len(fuse_points(sparse_map, pairs)) == SHARED
    for k in (2, 3):
        ids = sparse_map.keyframes[k].tracks.point_ids
        assert ids[:SHARED].tolist() == pairs[:, 0].tolist() and len(np.unique(ids)) == 30
    assert sparse_map.alive[pairs[:, 0]].all() and not sparse_map.alive[pairs[:, 1]].any()
    assert (sparse_map.n_keyframes[pairs[:, 0]] == 4).all()
    assert (sparse_map.n_found[pairs[:, 0]] == 2).all()
    assert (sparse_map.position_m[pairs[:, 0]] == 0.0).all()
    assert {0, 1} <= set(sparse_map.covisible_keyframes(2).tolist())
    assert {2, 3} <= set(sparse_map.covisible_keyframes(0).tolist())
    shared = dict(zip(*(a.tolist() for a in sparse_map.covisibility()[2]), strict=True))
    assert shared == {0: SHARED, 1: SHARED, 3: 30}


def test_a_keyframe_that_saw_both_keeps_the_older_ones_place(passes) -> None:
    _, pairs = passes
    both = tracks_of([pairs[0, 1], pairs[0, 0], pairs[1, 1]])
    named = rename_points(both, pairs)
    assert named.point_ids.tolist() == [pairs[0, 0], pairs[1, 0]]
    np.testing.assert_array_equal(named.uv_px, both.uv_px[1:])
    untouched = tracks_of([pairs[0, 0]])
    assert rename_points(untouched, pairs) is untouched
    assert rename_points(Tracks.empty(), pairs[:0]).point_ids.size == 0


def test_pairs_of_which_one_has_died_meanwhile_are_left_alone(passes) -> None:
    sparse_map, pairs = passes
    sparse_map.remove_points(pairs[:1, 0])
    sparse_map.remove_points(pairs[1:2, 1])
    done = fuse_points(sparse_map, pairs)
    assert done.tolist() == pairs[2:].tolist()
    assert sparse_map.alive[pairs[0, 1]] and sparse_map.alive[pairs[1, 0]]
    assert pairs[0, 1] in sparse_map.keyframes[3].tracks.point_ids
