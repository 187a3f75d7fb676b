"""Matches between two images by descriptors alone, among features under the same tree node.

Owns candidates by node and the consistency of rotation. Knows no poses.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.vocabulary import Indices
from pipelines.frontend.matching import hamming_distance, mutual_best
from pipelines.types import Array, Features

_ROTATION_BINS = 36
_LEAST_FOR_ROTATION = 5  # matches, of which fewer tell no common rotation


def match_by_words(
    features_a: Features,
    features_b: Features,
    nodes_a: Indices,
    nodes_b: Indices,
    max_hamming: int = 64,
    ratio: float = 0.85,
    max_rotation_deg: float = 20.0,
) -> tuple[Indices, Indices]:
    """One-to-one matches of two images' features, at most among those of the same tree node.

    nodes_a, nodes_b: (N,), (M,) as `Vocabulary.words_and_nodes` gives them; level 1 finds most.
    A match is the nearest on both sides by Hamming distance, has at most `max_hamming` bits and
    less than `ratio` times those of the second nearest (Lowe), and the angle of its two corners
    differs by no more than `max_rotation_deg` from what most matches turn by (ORB-SLAM's check); at
    180 all rotations pass. Returns indices into both, equally long, those of a increasing.
    """
    a, b = _pairs_of_same_node(nodes_a, nodes_b)
    distance = hamming_distance(features_a.descriptors[a], features_b.descriptors[b])
    near = distance * ratio <= max_hamming  # what is farther makes no second best that counts
    a, b, distance = a[near], b[near], distance[near]
    clear = _is_clear(a, distance, ratio)
    best_a, best_b = mutual_best(a, b, distance, max_hamming)
    kept = clear[best_a] if len(clear) else np.zeros(0, bool)
    best_a, best_b = best_a[kept], best_b[kept]
    turn_deg = features_b.angle_deg[best_b].astype(float) - features_a.angle_deg[best_a]
    alike = turns_alike(turn_deg, max_rotation_deg)
    best_a, best_b = best_a[alike], best_b[alike]
    order = np.argsort(best_a)
    return best_a[order], best_b[order]


def _pairs_of_same_node(nodes_a: Indices, nodes_b: Indices) -> tuple[Indices, Indices]:
    """All pairs of features with the same node, as indices into both, grouped by a."""
    by_node = np.argsort(nodes_b, kind="stable")
    sorted_nodes = nodes_b[by_node]
    starts = np.searchsorted(sorted_nodes, nodes_a, "left")
    sizes = np.searchsorted(sorted_nodes, nodes_a, "right") - starts
    ends = np.cumsum(sizes)
    within = np.arange(ends[-1] if len(ends) else 0) + np.repeat(starts - ends + sizes, sizes)
    return np.repeat(np.arange(len(nodes_a)), sizes), by_node[within]


def _is_clear(a: Indices, distance: NDArray[np.int64], ratio: float) -> NDArray[np.bool_]:
    """Whether each feature's nearest candidate is clearly nearer than its second one.

    a: (P,) not falling, the feature of each candidate; distance: (P,). Returns (max a + 1,).
    """
    if len(a) == 0:
        return np.zeros(0, bool)
    order = np.argsort(a * 512 + distance, kind="stable")
    sorted_a, sorted_distance = a[order], distance[order]
    first = np.flatnonzero(np.r_[True, sorted_a[1:] != sorted_a[:-1]])
    second = np.minimum(first + 1, len(a) - 1)
    has_second = (second > first) & (sorted_a[second] == sorted_a[first])
    clear = np.zeros(int(a.max()) + 1, bool)
    nearer = sorted_distance[first] < ratio * sorted_distance[second]
    clear[sorted_a[first]] = nearer | ~has_second
    return clear


def turns_alike(turn_deg: Array, max_difference_deg: float) -> NDArray[np.bool_]:
    """Which of the angles (N,) in degrees are near the one that most of them are near.

    That one is the mean around the fullest three neighbours of a histogram of ten degrees a bin.
    All pass where there are too few to tell.
    """
    if len(turn_deg) < _LEAST_FOR_ROTATION:
        return np.ones(len(turn_deg), bool)
    width_deg = 360.0 / _ROTATION_BINS
    bins = np.floor(turn_deg / width_deg).astype(np.int64) % _ROTATION_BINS
    counts = np.bincount(bins, minlength=_ROTATION_BINS)
    peak = int((counts + np.roll(counts, 1) + np.roll(counts, -1)).argmax())
    from_peak = _wrapped(turn_deg - (peak + 0.5) * width_deg)
    near = np.abs(from_peak) <= 1.5 * width_deg
    return np.abs(_wrapped(from_peak - from_peak[near].mean())) <= max_difference_deg


def _wrapped(angle_deg: Array) -> Array:
    """Angles brought to -180 up to 180 degrees."""
    return (angle_deg + 180.0) % 360.0 - 180.0
