"""The words that ORB descriptors are told apart by: a tree of 256-bit centroids.

Owns the descent from descriptors to words, and the bag of words of an image. Training is in
`vocabulary_training`, files are in `vocabulary_files`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from pipelines.shapes import check_shape

Indices = NDArray[np.int64]
Descriptors = NDArray[np.uint8]

_CHUNK = 2048  # descriptors that descend together, so that their distances stay in the cache
_NO_CHILD = 512  # bits: farther than any centroid is


@dataclass(frozen=True, slots=True)
class BowVector:
    """An image as a bag of words: its words in increasing order, and how much each counts.

    words: (N,) int32, increasing. weights: (N,) float32, positive, with sum 1 where N > 0.
    """

    words: NDArray[np.int32]
    weights: NDArray[np.float32]

    def __post_init__(self) -> None:
        check_shape("BowVector", "weights", self.weights, (len(self.words),))

    def __len__(self) -> int:
        return len(self.words)


def score_places(a: BowVector, b: BowVector) -> float:
    """How alike two images are by their words, from 0 (none in common) to 1 (the same).

    1 - |a - b|_1 / 2 (Galvez-Lopez and Tardos, Bags of binary words, 2012, eq. (2)), which for
    weights that add up to one is the sum of the lesser weight of each common word.
    """
    _, in_a, in_b = np.intersect1d(a.words, b.words, assume_unique=True, return_indices=True)
    return float(np.minimum(a.weights[in_a], b.weights[in_b]).sum(dtype=np.float64))


@dataclass(frozen=True, slots=True)
class Vocabulary:
    """A tree of binary words; the leaves are the words.

    Nodes are numbered level by level from the root, which is node 0, in the order of their parents:
    so the numbers of children tell the whole tree. Words are numbered in the order of their leaves.

    centroids: (M, 32) uint8, that of the root is not used. n_children: (M,) int32, 0 for leaves.
    idf: (W,) float32 weight of each word, the rarer the greater.
    Raises ValueError for shapes that do not fit, or numbers of children that make no tree.
    """

    centroids: Descriptors
    n_children: NDArray[np.int32]
    idf: NDArray[np.float32]
    _first_child: Indices = field(init=False, repr=False, compare=False)
    _word_of_node: Indices = field(init=False, repr=False, compare=False)
    _inner_of_node: Indices = field(init=False, repr=False, compare=False)
    _children_bits: NDArray[np.uint64] = field(init=False, repr=False, compare=False)
    _missing_bits: NDArray[np.uint16] | None = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        M = len(self.n_children)
        check_shape("Vocabulary", "n_children", self.n_children, (None,))
        check_shape("Vocabulary", "centroids", self.centroids, (M, 32))
        before = np.cumsum(self.n_children, dtype=np.int64) - self.n_children
        first_child = 1 + before
        if M < 2 or self.n_children.min() < 0 or self.n_children.sum(dtype=np.int64) != M - 1:
            raise ValueError(
                f"Vocabulary.n_children: expected a tree of {M} nodes, two or more, with every one "
                f"but the root a child, found {self.n_children.sum(dtype=np.int64)} children"
            )
        if (first_child <= np.arange(M))[self.n_children > 0].any():
            raise ValueError("Vocabulary.n_children: expected children after their parents")
        leaf = self.n_children == 0
        check_shape("Vocabulary", "idf", self.idf, (int(leaf.sum()),))
        if not np.isfinite(self.idf).all() or self.idf.min() < 0:
            raise ValueError("Vocabulary.idf: expected finite weights of 0 or more")
        put = object.__setattr__
        put(self, "_first_child", first_child)
        put(self, "_word_of_node", np.where(leaf, np.cumsum(leaf) - 1, -1))
        put(self, "_inner_of_node", np.where(leaf, -1, np.cumsum(~leaf) - 1))
        k = int(self.n_children.max())
        inner = np.flatnonzero(~leaf)
        slot = np.arange(k)
        there = slot < self.n_children[inner, None]
        children = np.where(there, first_child[inner, None] + slot, 0)
        bits = np.ascontiguousarray(self.centroids).view(np.uint64)[children]  # (inner, k, 4)
        put(self, "_children_bits", np.ascontiguousarray(bits.transpose(2, 0, 1)))
        missing = np.where(there, 0, _NO_CHILD).astype(np.uint16)
        put(self, "_missing_bits", None if there.all() else missing)

    @property
    def n_words(self) -> int:
        return len(self.idf)

    @property
    def branching(self) -> int:
        """The most children that a node has."""
        return int(self.n_children.max())

    @property
    def depth(self) -> int:
        """Levels below the root."""
        depth, last = 0, 0  # last node of a level: its last child is the last of the next
        while last < len(self.n_children) - 1:
            last = int(self._first_child[last] + self.n_children[last] - 1)
            depth += 1
        return depth

    def words(self, descriptors: Descriptors) -> Indices:
        """Word (N,) int64 of each descriptor (N, 32) uint8.

        A descriptor goes to the nearest child by Hamming distance; the first wins a tie.
        """
        check_shape("Vocabulary", "descriptors", descriptors, (None, 32))
        leaves = np.empty(len(descriptors), np.int64)
        bits = np.ascontiguousarray(descriptors).view(np.uint64)
        for start in range(0, len(descriptors), _CHUNK):
            chunk = slice(start, start + _CHUNK)
            leaves[chunk] = self._descend(bits[chunk])
        return self._word_of_node[leaves]

    def _descend(self, bits: NDArray[np.uint64]) -> Indices:
        """Leaves (N,) of descriptors as (N, 4) uint64."""
        node = np.zeros(len(bits), np.int64)
        going = np.arange(len(bits))
        while len(going):
            inner = self._inner_of_node[node[going]]
            distance = reduce(
                np.add,
                (
                    np.bitwise_count(plane[inner] ^ bits[going, p, None]).astype(np.uint16)
                    for p, plane in enumerate(self._children_bits)
                ),
            )
            if self._missing_bits is not None:
                distance += self._missing_bits[inner]
            node[going] = self._first_child[node[going]] + distance.argmin(1)
            going = going[self.n_children[node[going]] > 0]
        return node

    def describe(self, words: Indices) -> BowVector:
        """The bag of an image's words (N,): term frequency times idf, which add up to one.

        Words of no weight, which every training image had, are left out.
        """
        found, count = np.unique(words, return_counts=True)
        weight = count * self.idf[found].astype(np.float64)
        found, weight = found[weight > 0], weight[weight > 0]
        total = weight.sum()
        return BowVector(found.astype(np.int32), (weight / (total or 1.0)).astype(np.float32))
