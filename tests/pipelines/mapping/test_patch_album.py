"""The album: who is kept, under which id, and what follows the map."""

from dataclasses import fields

import numpy as np

from pipelines.config import MappingConfig
from pipelines.geometry import exp_se3
from pipelines.mapping.keyframe import Keyframe
from pipelines.mapping.patch_album import PatchAlbum
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.patches import SIDE_PX, Patches
from pipelines.types import Features
from tests.pipelines.slanted_floor import CAMERA

ELSEWHERE = exp_se3(np.array([0.1, -0.2, 0.05, 1.0, -2.0, 3.0]))


def patches_of(ids, seed=0):
    ids, rng = np.sort(ids), np.random.default_rng(seed)
    n = len(ids)
    return Patches(
        ids,
        rng.integers(0, 256, (n, SIDE_PX, SIDE_PX)).astype(np.uint8),
        rng.integers(0, 300, (n, 2)),
        rng.uniform(0, 300, (n, 2)),
        rng.uniform(0, 1, (n, 3)),
        exp_se3(rng.normal(size=(n, 6))),
    )


def assert_same(found, expected):
    for field in fields(Patches):
        np.testing.assert_allclose(
            getattr(found, field.name), getattr(expected, field.name), atol=1e-9, err_msg=field.name
        )


def test_patches_come_back_by_ascending_id():
    album, kept = PatchAlbum(), patches_of(np.array([40, 7, 3000, 12]))
    assert len(album) == 0 and not album.has(np.array([7, 10**6])).any()
    assert len(album.of(np.array([7, 10**6]))) == 0
    album.add(kept)
    album.add(Patches.empty())
    assert len(album) == 4
    np.testing.assert_array_equal(
        album.has(np.array([7, 8, 3000, 9000])), [True, False, True, False]
    )
    assert_same(album.of(np.array([3000, 8, 12])), kept[[1, 3]])


def test_what_is_forgotten_makes_room():
    album, many = PatchAlbum(), patches_of(np.arange(5000), seed=1)
    for part in np.split(np.arange(5000), 7 * np.arange(1, 700)):
        album.add(many[part])
    assert_same(album.of(np.arange(5000)), many)
    capacity = len(album._columns["point_ids"])
    for k in range(20):
        gone = np.arange(200 * k, 200 * k + 200)
        album.forget(np.append(gone, 9999))
        assert len(album) == 4800 and not album.has(gone).any()
        album.add(many[gone])
    assert len(album._columns["point_ids"]) == capacity
    assert_same(album.of(np.arange(5000)), many)


def map_seen_by(n_keyframes, n=9):
    """A map of n points that so many keyframes see, and their ids."""
    sparse_map = SparseMap(CAMERA, MappingConfig(min_shared_points=1))
    ids = sparse_map.add_points(
        np.tile([0.0, 0.0, 5.0], (n, 1)), np.zeros((n, 3, 3)), np.zeros((n, 3)),
        np.zeros((n, 32), np.uint8), np.zeros((n, 3), np.uint8),
    )  # fmt: skip
    tracks = Tracks(ids, np.ones((n, 2)), np.full(n, 5.0), np.full(n, 0.3))
    for k in range(n_keyframes):
        sparse_map.add_keyframe(Keyframe(k, 0.1 * k, ELSEWHERE, tracks, Features.empty()))
    return sparse_map, ids


def test_only_what_has_lasted_is_kept_and_stays_as_it_was_first():
    young, ids = map_seen_by(2)
    young.keep_patches(patches_of(ids))
    assert len(young.album) == 0
    old, ids = map_seen_by(3)
    first = patches_of(ids)
    old.keep_patches(first[:4])
    old.keep_patches(patches_of(ids, seed=5))
    assert_same(old.kept_patches(ids)[:4], first[:4])
    assert len(old.album) == 9


def test_patches_follow_their_keyframes_and_die_with_their_points():
    sparse_map, ids = map_seen_by(3)
    kept = patches_of(ids)
    sparse_map.keep_patches(kept)
    C = exp_se3(np.array([0.02, 0.01, -0.03, 0.4, 0.1, -0.2]))
    sparse_map.move_keyframe(0, C @ ELSEWHERE)
    assert_same(sparse_map.kept_patches(ids), kept.moved(C))
    sparse_map.remove_points(ids[2:5])
    assert sparse_map.kept_patches(ids).point_ids.tolist() == ids[[0, 1, 5, 6, 7, 8]].tolist()
