"""Words against a descent by hand, bags of words against plain dictionaries, and bad trees."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np
import pytest

from pipelines.backend.vocabulary import BowVector, Vocabulary, score_places


def random_bytes(rng: np.random.Generator, n: int) -> np.ndarray:
    return rng.integers(0, 256, (n, 32), dtype=np.uint8)


def make_vocabulary(n_children: list[int], seed: int = 0) -> Vocabulary:
    rng = np.random.default_rng(seed)
    idf = rng.uniform(0.5, 3.0, n_children.count(0)).astype(np.float32)
    return Vocabulary(random_bytes(rng, len(n_children)), np.array(n_children, np.int32), idf)


EVEN = [3, 3, 3, 3] + [0] * 9
UNEVEN = [4, 2, 0, 3, 0, 0, 2, 0, 0, 0, 0, 0]  # words at levels 1, 2 and 3


def descend_by_hand(vocabulary: Vocabulary, descriptor: np.ndarray) -> list[int]:
    """Nodes from the root to the leaf, one bit after another."""
    n_children = vocabulary.n_children.tolist()
    path = [0]
    while n_children[path[-1]]:
        first = 1 + sum(n_children[: path[-1]])
        children = range(first, first + n_children[path[-1]])

        def bits(node: int) -> int:
            return sum(
                (int(x) ^ int(y)).bit_count()
                for x, y in zip(vocabulary.centroids[node], descriptor, strict=True)
            )

        path.append(min(children, key=bits))
    return path


@pytest.mark.parametrize("n_children", [EVEN, UNEVEN])
def test_words_are_those_of_a_descent_by_hand(n_children: list[int]) -> None:
    vocabulary = make_vocabulary(n_children)
    descriptors = random_bytes(np.random.default_rng(1), 200)
    paths = [descend_by_hand(vocabulary, descriptor) for descriptor in descriptors]
    leaves = [node for node, n in enumerate(n_children) if n == 0]
    expected = [leaves.index(path[-1]) for path in paths]
    assert vocabulary.words(descriptors).tolist() == expected
    assert set(expected) == set(range(vocabulary.n_words))


def test_many_descriptors_get_the_words_that_each_gets_alone() -> None:
    vocabulary = make_vocabulary(UNEVEN)
    descriptors = random_bytes(np.random.default_rng(2), 5000)
    together = vocabulary.words(descriptors)
    for k in (0, 2047, 2048, 4999):
        assert vocabulary.words(descriptors[k : k + 1]) == together[k]
    assert len(vocabulary.words(descriptors[:0])) == 0


def test_a_tree_knows_its_shape() -> None:
    found = [(v.n_words, v.branching, v.depth) for v in map(make_vocabulary, (EVEN, UNEVEN))]
    assert found == [(9, 3, 2), (8, 4, 3)]


def test_a_bag_holds_term_frequency_times_idf() -> None:
    vocabulary = make_vocabulary(EVEN)
    vocabulary.idf[4] = 0.0
    words = np.array([7, 2, 2, 4, 7, 7, 0])
    bow = vocabulary.describe(words)
    weight = {w: n * float(vocabulary.idf[w]) for w, n in Counter(words.tolist()).items()}
    del weight[4]
    total = sum(weight.values())
    assert bow.words.tolist() == sorted(weight)
    assert bow.weights == pytest.approx([weight[w] / total for w in sorted(weight)], rel=1e-6)


def test_no_words_make_an_empty_bag_that_is_like_nothing() -> None:
    vocabulary = make_vocabulary(EVEN)
    empty = vocabulary.describe(np.empty(0, np.int64))
    assert len(empty) == 0
    assert score_places(empty, vocabulary.describe(np.array([1, 2]))) == 0.0


def plain_score(a: BowVector, b: BowVector) -> float:
    """DBoW2's L1 score of two dictionaries, from the difference of all words of both."""
    in_a = dict(zip(a.words.tolist(), a.weights.tolist(), strict=True))
    in_b = dict(zip(b.words.tolist(), b.weights.tolist(), strict=True))
    words = in_a.keys() | in_b.keys()
    return 1.0 - 0.5 * sum(abs(in_a.get(w, 0.0) - in_b.get(w, 0.0)) for w in words)


def test_the_score_is_that_of_two_dictionaries() -> None:
    vocabulary = make_vocabulary([30] + [0] * 30)
    rng = np.random.default_rng(3)
    bags = [vocabulary.describe(rng.integers(0, 30, 25)) for _ in range(12)]
    scores = [score_places(a, b) for a in bags for b in bags]
    assert scores == pytest.approx([plain_score(a, b) for a in bags for b in bags], abs=1e-6)
    assert 0.2 < min(scores) < 0.8
    assert max(scores) == pytest.approx(1.0, abs=1e-6)
    assert all(math.isclose(score_places(a, b), score_places(b, a)) for a in bags for b in bags)


@pytest.mark.parametrize(
    ("n_children", "words"),
    [
        ([2, 0], "expected a tree of 2 nodes"),
        ([2, 0, 0, 0], "found 2 children"),
        ([2, -1, 1], "expected a tree"),
        ([1, 0, 2, 0], "children after their parents"),
        ([0, 1], "children after their parents"),
    ],
)
def test_numbers_that_make_no_tree_are_refused(n_children: list[int], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make_vocabulary(n_children)


@pytest.mark.parametrize("idf", [[1.0, np.nan], [1.0, -1.0], [1.0]])
def test_weights_that_are_none_are_refused(idf: list[float]) -> None:
    centroids = np.zeros((3, 32), np.uint8)
    with pytest.raises(ValueError, match=r"Vocabulary\.idf: expected"):
        Vocabulary(centroids, np.array([2, 0, 0], np.int32), np.array(idf, np.float32))


def test_descriptors_of_another_length_are_refused() -> None:
    with pytest.raises(ValueError, match="any, 32"):
        make_vocabulary(EVEN).words(np.zeros((4, 61), np.uint8))
