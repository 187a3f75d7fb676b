"""Matches under one node: planted pairs come back, twins and odd rotations do not."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.backend.word_matching import match_by_words, turns_alike
from pipelines.types import Features


def make_features(descriptors: np.ndarray, angle_deg: np.ndarray) -> Features:
    N = len(descriptors)
    return Features(
        np.zeros((N, 2)),
        np.zeros(N, np.int32),
        np.asarray(angle_deg, np.float32),
        np.ones(N, np.float32),
        descriptors,
        np.full(N, np.nan),
    )


def flip(descriptors: np.ndarray, n_bits: int, rng: np.random.Generator) -> np.ndarray:
    bits = np.unpackbits(descriptors, axis=1)
    for row in bits:
        row[rng.choice(256, n_bits, replace=False)] ^= 1
    return np.packbits(bits, axis=1)


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def pair(rng) -> tuple[Features, Features, np.ndarray, np.ndarray]:
    """60 features and, in another order, what they look like turned by 350 degrees."""
    descriptors = rng.integers(0, 256, (60, 32), dtype=np.uint8)
    angle_deg = rng.uniform(0, 360, 60)
    shuffled = rng.permutation(60)
    turned = (angle_deg + 350.0 + rng.normal(0, 3, 60)) % 360
    a = make_features(descriptors, angle_deg)
    b = make_features(flip(descriptors, 25, rng), turned)[shuffled]
    return a, b, rng.integers(0, 5, 60), shuffled


def test_what_belongs_together_is_found(pair) -> None:
    a, b, nodes, shuffled = pair
    in_a, in_b = match_by_words(a, b, nodes, nodes[shuffled])
    assert in_a.tolist() == list(range(60))
    assert shuffled[in_b].tolist() == in_a.tolist()


def test_only_features_of_the_same_node_are_matched(pair) -> None:
    a, b, nodes, shuffled = pair
    moved = np.where(np.arange(60) < 10, 7, nodes)
    in_a, _ = match_by_words(a, b, moved, nodes[shuffled])
    assert in_a.tolist() == list(range(10, 60))


def test_odd_rotations_are_dropped(pair) -> None:
    a, b, nodes, shuffled = pair
    b.angle_deg[:8] += 90.0
    _, in_b = match_by_words(a, b, nodes, nodes[shuffled])
    assert sorted(in_b) == list(range(8, 60))
    assert len(match_by_words(a, b, nodes, nodes[shuffled], max_rotation_deg=180)[0]) == 60


def test_a_match_with_a_near_twin_is_dropped(pair, rng) -> None:
    a, b, nodes, shuffled = pair
    twin = make_features(flip(a.descriptors[:1], 26, rng), a.angle_deg[:1] - 10)
    merged = make_features(
        np.concatenate([b.descriptors, twin.descriptors]), np.r_[b.angle_deg, twin.angle_deg]
    )
    in_a, _ = match_by_words(a, merged, nodes, np.r_[nodes[shuffled], nodes[0]])
    assert in_a.tolist() == list(range(1, 60))


def test_of_two_that_want_the_same_the_nearer_gets_it(rng) -> None:
    target = rng.integers(0, 256, (1, 32), dtype=np.uint8)
    a = make_features(np.concatenate([flip(target, n, rng) for n in (30, 10)]), np.zeros(2))
    b = make_features(target, np.zeros(1))
    found = match_by_words(a, b, np.zeros(2, int), np.zeros(1, int))
    assert [indices.tolist() for indices in found] == [[1], [0]]


@pytest.mark.parametrize(("n_bits", "n_found"), [(64, 1), (65, 0)])
def test_the_limit_of_bits_holds(rng, n_bits: int, n_found: int) -> None:
    descriptors = rng.integers(0, 256, (1, 32), dtype=np.uint8)
    a, b = (make_features(d, np.zeros(1)) for d in (descriptors, flip(descriptors, n_bits, rng)))
    node = np.zeros(1, int)
    assert len(match_by_words(a, b, node, node, max_hamming=64)[0]) == n_found


def test_nothing_matches_nothing(pair) -> None:
    a, _, nodes, _ = pair
    none = np.empty(0, np.int64)
    for x, y, nx, ny in ((a, Features.empty(), nodes, none), (Features.empty(), a, none, nodes)):
        in_a, in_b = match_by_words(x, y, nx, ny)
        assert len(in_a) == len(in_b) == 0
    assert len(match_by_words(a, a, nodes, nodes + 10)[0]) == 0


def test_turns_are_compared_round_the_circle() -> None:
    turn_deg = np.array([355.0, 2.0, -4.0, 6.0, 359.0, 721.0, 180.0, 45.0])
    assert turns_alike(turn_deg, 20.0).tolist() == [True] * 6 + [False] * 2
    assert turns_alike(turn_deg[4:], 20.0).all()  # too few to tell
