"""Training: planted clusters are found, words weigh what they should, twice gives the same."""

from __future__ import annotations

import math

import numpy as np
import pytest

from pipelines.backend.vocabulary_training import part, train_vocabulary
from pipelines.errors import ConfigError, DyObError


def planted(n_prototypes: int, n_each: int, flip_share: float, seed: int = 0) -> tuple:
    """Prototypes (P, 32), noisy copies (P * n, 32) of them, and whose copy each is."""
    rng = np.random.default_rng(seed)
    bits = rng.integers(0, 2, (n_prototypes, 256), dtype=np.uint8)
    whose = np.repeat(np.arange(n_prototypes), n_each)
    flipped = rng.random((len(whose), 256)) < flip_share
    noisy = np.packbits(bits[whose] ^ flipped, axis=1)
    return np.packbits(bits, axis=1), noisy, whose


def test_clusters_are_found_and_their_centroids_are_clean() -> None:
    prototypes, noisy, whose = planted(6, 101, 0.1)
    centroids, label = part(noisy, 6, np.random.default_rng(4))
    assert sorted(map(bytes, centroids)) == sorted(map(bytes, prototypes))
    assert (centroids[label] == prototypes[whose]).all()


def test_what_is_all_alike_is_not_parted() -> None:
    centroids, label = part(np.full((9, 32), 7, np.uint8), 4, np.random.default_rng(0))
    assert len(centroids) == 0
    assert label.tolist() == [0] * 9


def test_copies_of_one_thing_get_one_word() -> None:
    _, noisy, whose = planted(16, 40, 0.05)
    images = [noisy[k::8] for k in range(8)]
    words = train_vocabulary(images, 4, 3, seed=1).words(noisy)
    # Prototypes part at the upper levels, and their copies among themselves below.
    for a in range(16):
        for b in range(a):
            assert not set(words[whose == a]) & set(words[whose == b])


def test_the_same_seed_gives_the_same_bytes_and_another_one_others() -> None:
    rng = np.random.default_rng(5)
    images = [rng.integers(0, 256, (150, 32), dtype=np.uint8) for _ in range(6)]
    first, again, other = (train_vocabulary(images, 5, 3, seed) for seed in (1, 1, 2))
    for name in ("centroids", "n_children", "idf"):
        assert getattr(first, name).tobytes() == getattr(again, name).tobytes()
    assert first.centroids.tobytes() != other.centroids.tobytes()
    assert (first.branching, first.depth) == (5, 3)
    assert 100 < first.n_words <= 125


def test_a_word_weighs_by_the_images_that_have_it() -> None:
    prototypes, _, _ = planted(4, 1, 0.0)
    images = [prototypes[[0, 1]], prototypes[[0, 2]], prototypes[[0, 2]], prototypes[[0, 3]]]
    vocabulary = train_vocabulary(images, 4, 1)
    weight = vocabulary.idf[vocabulary.words(prototypes)]
    assert weight == pytest.approx([0.0, math.log(4), math.log(2), math.log(4)])


def test_progress_reaches_its_end() -> None:
    _, noisy, _ = planted(5, 20, 0.1)
    seen: list[tuple[int, int]] = []
    train_vocabulary([noisy[::2], noisy[1::2]], 3, 2, progress=lambda *step: seen.append(step))
    assert seen[-1] == (100, 100)
    assert [done for done, _ in seen] == sorted(done for done, _ in seen)


def test_too_little_to_learn_from_is_told() -> None:
    _, noisy, _ = planted(5, 20, 0.1)
    with pytest.raises(DyObError, match="at least two images and 4 descriptors, found 1 and 100"):
        train_vocabulary([noisy], 4, 2)
    with pytest.raises(DyObError, match="found 2 and 0; give more images"):
        train_vocabulary([noisy[:0], noisy[:0]], 4, 2)
    for branching, depth in ((1, 3), (4, 0)):
        with pytest.raises(ConfigError, match=f"found {branching} and {depth}"):
            train_vocabulary([noisy, noisy], branching, depth)
