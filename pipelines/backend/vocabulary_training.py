"""Training of a vocabulary: hierarchical k-majority on the descriptors of many images.

Owns the clustering and the words' weights. Where images come from is `training_images`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.vocabulary import Descriptors, Indices, Vocabulary
from pipelines.errors import ConfigError, DyObError

_MOST_ITERATIONS = 12  # of k-majority; later ones move few descriptors
_MOST_LEARNED_FROM = 20_000  # descriptors that the centroids of one node's children are made of
_MOST_SEEDED_FROM = 2_000  # of which the first centroids are drawn
_CHUNK = 4096

Progress = Callable[[int, int], None]


def train_vocabulary(
    images: Sequence[Descriptors],
    branching: int = 32,
    depth: int = 3,
    seed: int = 0,
    progress: Progress | None = None,
) -> Vocabulary:
    """A vocabulary from the descriptors (N, 32) uint8 of each training image.

    Each node's descriptors are parted into at most `branching` clusters by k-majority, k-means of
    bits (Grana et al., A fast approach for integrating ORB descriptors in the bag of words model,
    2013), down to `depth` levels; a node of one descriptor is not parted. A word's weight is
    ln(images / images that have it). The same input and seed give the same bytes.
    progress: called with (done, total) descriptors parted on the last level.
    Raises ConfigError for a tree that cannot be, DyObError where there are too few images or
    descriptors to tell words apart.
    """
    check_tree(branching, depth)
    descriptors = np.concatenate(images) if images else np.empty((0, 32), np.uint8)
    if len(images) < 2 or len(descriptors) < branching:
        raise DyObError(
            f"a vocabulary needs at least two images and {branching} descriptors, found "
            f"{len(images)} and {len(descriptors)}; give more images"
        )
    rng = np.random.default_rng(seed)
    level_members: list[Indices] = [np.arange(len(descriptors))]
    centroids, n_children = [np.zeros((1, 32), np.uint8)], []
    for level in range(depth):
        next_members: list[Indices] = []
        done = 0
        for members in level_members:
            found, label = part(descriptors[members], branching, rng)
            n_children.append(len(found))
            centroids.append(found)
            next_members += [members[label == j] for j in range(len(found))]
            done += len(members)
            if progress is not None and level == depth - 1:
                progress(done, len(descriptors))
        level_members = next_members
    n_children += [0] * len(level_members)
    tree = Vocabulary(
        np.concatenate(centroids),
        np.array(n_children, np.int32),
        np.ones(n_children.count(0), np.float32),
    )
    return Vocabulary(tree.centroids, tree.n_children, inverse_document_frequency(tree, images))


def check_tree(branching: int, depth: int) -> None:
    """Raise ConfigError where a tree of such numbers tells nothing apart."""
    if branching < 2 or depth < 1:
        raise ConfigError(
            "a vocabulary needs a branching of 2 or more and a depth of 1 or more, found "
            f"{branching} and {depth}"
        )


def inverse_document_frequency(
    vocabulary: Vocabulary, images: Sequence[Descriptors]
) -> NDArray[np.float32]:
    """Weight (W,) of each word: ln(images / images that have it).

    A word that no image has counts as one that a single image has.
    """
    n_images = np.zeros(vocabulary.n_words)
    for descriptors in images:
        n_images[np.unique(vocabulary.words(descriptors))] += 1
    return np.log(len(images) / np.maximum(n_images, 1)).astype(np.float32)


def part(
    descriptors: Descriptors, branching: int, rng: np.random.Generator
) -> tuple[Descriptors, Indices]:
    """Centroids (k, 32) of at most `branching` clusters, and the nearest one (N,) of each member.

    No cluster is empty; descriptors that are all alike make no clusters, and get label 0.
    """
    bits = np.ascontiguousarray(descriptors).view(np.uint64)
    sample = bits
    if len(bits) > _MOST_LEARNED_FROM:
        sample = bits[np.sort(rng.choice(len(bits), _MOST_LEARNED_FROM, replace=False))]
    centroids = _spread_seeds(sample, branching, rng)
    if len(centroids) < 2:
        return np.empty((0, 32), np.uint8), np.zeros(len(bits), np.int64)
    label = nearest(sample, centroids)
    for _ in range(_MOST_ITERATIONS):
        centroids = _majorities(sample, label)
        before, label = label, nearest(sample, centroids)
        if np.array_equal(before, label):
            break
    label = nearest(bits, centroids)
    used, label = np.unique(label, return_inverse=True)
    if len(used) < 2:
        return np.empty((0, 32), np.uint8), label
    return centroids[used].view(np.uint8), label


def nearest(bits: NDArray[np.uint64], centroids: NDArray[np.uint64]) -> Indices:
    """Index (N,) of the nearest centroid (k, 4) of each descriptor (N, 4); the first wins a tie."""
    label = np.empty(len(bits), np.int64)
    for start in range(0, len(bits), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        label[chunk] = _distances(bits[chunk], centroids).argmin(1)
    return label


def _distances(bits: NDArray[np.uint64], centroids: NDArray[np.uint64]) -> NDArray[np.uint16]:
    """Hamming distances (N, k) of (N, 4) to (k, 4)."""
    distance = np.zeros((len(bits), len(centroids)), np.uint16)
    for p in range(4):
        distance += np.bitwise_count(bits[:, p, None] ^ centroids[:, p])
    return distance


def _spread_seeds(
    bits: NDArray[np.uint64], branching: int, rng: np.random.Generator
) -> NDArray[np.uint64]:
    """First centroids, drawn far apart (k-means++); fewer where fewer are different."""
    if len(bits) > _MOST_SEEDED_FROM:
        bits = bits[np.sort(rng.choice(len(bits), _MOST_SEEDED_FROM, replace=False))]
    chosen = [int(rng.integers(len(bits)))]
    squared = _distances(bits, bits[chosen]).astype(np.float64)[:, 0] ** 2
    while len(chosen) < branching and squared.max() > 0:
        chosen.append(int(rng.choice(len(bits), p=squared / squared.sum())))
        distance = _distances(bits, bits[chosen[-1:]]).astype(np.float64)[:, 0]
        squared = np.minimum(squared, distance**2)
    return bits[chosen]


def _majorities(bits: NDArray[np.uint64], label: Indices) -> NDArray[np.uint64]:
    """Centroids (k, 4): each bit as most descriptors of the cluster have it; empty ones vanish."""
    order = np.argsort(label, kind="stable")
    starts = np.flatnonzero(np.diff(label[order], prepend=-1))
    sizes = np.diff(np.r_[starts, len(label)])
    ones = np.unpackbits(np.ascontiguousarray(bits[order]).view(np.uint8), axis=1)
    sums = np.add.reduceat(ones, starts, axis=0, dtype=np.uint32)
    majority = 2 * sums > sizes[:, None]
    return np.packbits(majority, axis=1).view(np.uint64)
