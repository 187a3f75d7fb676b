"""Association of ORB descriptors: within a radius of predicted places, or of all with all.

Owns Hamming distances and uniqueness. Knows no poses: places come in, pairs of indices go out.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.types import Array

Indices = NDArray[np.int64]
Descriptors = NDArray[np.uint8]


def hamming_distance(a: Descriptors, b: Descriptors) -> NDArray[np.int64]:
    """Differing bits (N,) of descriptor pairs (N, 32) and (N, 32)."""
    words_a = np.ascontiguousarray(a).view(np.uint64)
    words_b = np.ascontiguousarray(b).view(np.uint64)
    return np.bitwise_count(words_a ^ words_b).sum(1, dtype=np.int64)


def match_in_radius(
    predicted_px: Array,
    descriptors_a: Descriptors,
    uv_px: Array,
    descriptors_b: Descriptors,
    radius_px: float,
    max_distance: int,
) -> tuple[Indices, Indices]:
    """One-to-one matches of points at predicted places with the features of an image.

    predicted_px: (N, 2) and descriptors_a: (N, 32) of the points; uv_px: (M, 2) and descriptors_b:
    (M, 32) of the features. A pair is kept when each is the other's nearest by Hamming distance
    among those within `radius_px`, and the distance is at most `max_distance` bits.
    Returns indices into the points and into the features, equally long.
    """
    none = np.empty(0, np.int64)
    if len(predicted_px) == 0 or len(uv_px) == 0:
        return none, none
    pairs = cKDTree(predicted_px).sparse_distance_matrix(
        cKDTree(uv_px), radius_px, output_type="coo_matrix"
    )
    a, b = pairs.row.astype(np.int64), pairs.col.astype(np.int64)
    distance = hamming_distance(descriptors_a[a], descriptors_b[b])
    return mutual_best(a, b, distance, max_distance)


def mutual_best(
    a: Indices, b: Indices, distance: NDArray[np.int64], max_distance: int
) -> tuple[Indices, Indices]:
    """Of candidate pairs (N,) those in which each is the other's nearest, within `max_distance`.

    Returns indices of both, equally long, in the order of the candidates; the first wins a tie.
    """
    near = distance <= max_distance
    a, b, distance = a[near], b[near], distance[near]
    mutual = _first_per_group(a, distance) & _first_per_group(b, distance)
    return a[mutual], b[mutual]


def _first_per_group(group: Indices, distance: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Marks, for each value of `group` (N,), its entry with the least distance."""
    order = np.lexsort((distance, group))
    first = np.zeros(len(group), bool)
    if len(group):
        sorted_group = group[order]
        first[order[np.r_[True, sorted_group[1:] != sorted_group[:-1]]]] = True
    return first


def match_all(
    descriptors_a: Descriptors, descriptors_b: Descriptors, max_distance: int, ratio: float
) -> tuple[Indices, Indices]:
    """One-to-one nearest matches of all with all, where the second best is clearly worse (Lowe).

    Descriptors (N, 32) and (M, 32). A match has at most `max_distance` bits and less than `ratio`
    times the distance of the second best. Returns indices into both, equally long.
    """
    none = np.empty(0, np.int64)
    if len(descriptors_a) < 2 or len(descriptors_b) < 2:
        return none, none
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    forward = matcher.knnMatch(descriptors_a, descriptors_b, k=2)
    table = np.array(
        [(m.queryIdx, m.trainIdx, m.distance, n.distance) for m, n in forward], dtype=np.int64
    )
    good = (table[:, 2] <= max_distance) & (table[:, 2] < ratio * table[:, 3])
    a, b, distance = table[good, 0], table[good, 1], table[good, 2]
    unique = _first_per_group(b, distance)
    return a[unique], b[unique]
