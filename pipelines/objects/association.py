"""Which detection is which object: flow-carried points vote, filters gate, one assignment decides.

Owns the costs and the Hungarian assignment; step 7. Knows no images.

Deviation: the paper's vote of flow-carried labels forgets an object that is missed once. Objects
out of sight are looked for where their filter expects them, by place, class and colour.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from pipelines.object_types import UNNAMED_CLASS
from pipelines.types import Array

_MIN_VOTES = 0.3  # share of an object's points that a detection must hold
_FEW_POINTS = 5  # fewer votes say little, boxes then count as well
_MIN_OVERLAP = 0.2  # intersection over union with the last box, where points are few
_GATE = 16.3  # chi-square, 3 degrees of freedom, 99.9 %
_UNLIKELY = 20.0  # of distance2 + log_spread, where only the colour still counts
_MAX_COLOR_DISTANCE = 0.6  # Hellinger, of something found again
_NO_MATCH = 2.0  # what it costs to leave an object without a detection: more than any match
_GROUPS = (
    frozenset({"car", "truck", "bus", "train", "van", "tram"}),
    frozenset({"person", "bicycle", "motorcycle"}),
)


@dataclass(frozen=True, slots=True)
class Candidates:
    """What speaks for each pair of J objects and M detections.

    votes: (J, M) how far the object's tracked points and the detection are the same, 0 without
    points; see `count_votes`. n_points: (J,) tracked points. overlap: (J, M) of the object's last
    box with the detection's, intersection over union, 0 where it has none.
    distance2: (J, M) squared Mahalanobis distance of the centres, inf where unknown. log_spread:
    (J, M) logarithm of the determinant of its covariance: who may be anywhere is likely nowhere.
    color_distance: (J, M) Hellinger distance 0..1. same_kind: (J, M) whether classes agree.
    """

    votes: Array
    n_points: NDArray[np.int64]
    overlap: Array
    distance2: Array
    log_spread: Array
    color_distance: Array
    same_kind: NDArray[np.bool_]


def assign(candidates: Candidates) -> NDArray[np.int64]:
    """(J,) row of the detection of each object, -1 where it has none. One Hungarian assignment.

    Votes cost 0 to 0.7, boxes 0.5 to 1.3 and the filter's gate 1.5 to 2, so that what a vote would
    lose by going elsewhere is always more than what finding another object again would gain: an
    object in sight never loses its detection to one that is found again.
    """
    c = candidates
    cost = np.full(c.votes.shape, _NO_MATCH)
    if cost.size == 0:
        return np.full(len(cost), -1, np.int64)
    again = (c.distance2 <= _GATE) & c.same_kind & (c.color_distance <= _MAX_COLOR_DISTANCE)
    unlikely = np.clip((c.distance2 + c.log_spread) / _UNLIKELY, 0.0, 0.99)
    cost[again] = 1.5 + 0.3 * unlikely[again] + 0.2 * c.color_distance[again]
    near = (c.n_points[:, None] < _FEW_POINTS) & (c.overlap >= _MIN_OVERLAP) & c.same_kind
    cost = np.where(near, np.minimum(cost, 1.5 - c.overlap), cost)
    voted = (c.votes >= _MIN_VOTES) & (c.n_points[:, None] > 0)
    cost = np.where(voted, np.minimum(cost, 1.0 - c.votes), cost)
    rows, columns = linear_sum_assignment(cost)
    found = np.full(len(cost), -1, np.int64)
    matched = cost[rows, columns] < _NO_MATCH
    found[rows[matched]] = columns[matched]
    return found


def count_votes(
    object_rows: NDArray[np.int64],
    labels: NDArray[np.int32],
    uv_px: Array,
    areas_px: Array,
    n_detections: int,
) -> tuple[Array, NDArray[np.int64]]:
    """Votes (J, M) of tracked points for detections, and how many points (J,) each object has.

    object_rows: (N,) row of the object of each point. labels: (H, W), 0 or row + 1 of a detection.
    uv_px: (N, 2) where the points are now, inside the image. areas_px: (J,) of the objects' last
    masks. A vote is the geometric mean of the share of the object that lies in the detection, and
    of the share that the object has among all that lies in it: something far that vanishes behind
    something near lies wholly in its mask, too.
    """
    n_objects = len(areas_px)
    label = labels[np.rint(uv_px[:, 1]).astype(int), np.rint(uv_px[:, 0]).astype(int)]
    flat = object_rows * (n_detections + 1) + label
    counts = np.bincount(flat, minlength=n_objects * (n_detections + 1))
    counts = counts.reshape(n_objects, n_detections + 1)
    total = counts.sum(1)
    share = counts[:, 1:] / np.maximum(total, 1)[:, None]
    area = share * areas_px[:, None]
    purity = area / np.maximum(area.sum(0), 1e-9)
    return np.sqrt(share * purity), total


def box_overlap(a_px: Array, b_px: Array) -> Array:
    """Intersection over union (J, M) of boxes (J, 4) and (M, 4) x1 y1 x2 y2; 0 for NaN."""
    a, b = a_px[:, None], b_px[None]
    low = np.maximum(a[..., :2], b[..., :2])
    high = np.minimum(a[..., 2:], b[..., 2:])
    inner = np.clip(high - low + 1.0, 0.0, None).prod(-1)
    area_a = (a[..., 2:] - a[..., :2] + 1.0).prod(-1)
    area_b = (b[..., 2:] - b[..., :2] + 1.0).prod(-1)
    return np.nan_to_num(inner / (area_a + area_b - inner))


def color_distance(a: Array, b: Array) -> Array:
    """Hellinger distances (J, M) of histograms (J, K) and (M, K)."""
    return np.sqrt(np.clip(1.0 - np.sqrt(a) @ np.sqrt(b).T, 0.0, 1.0))


def same_kind(a: list[str], b: list[str]) -> NDArray[np.bool_]:
    """(J, M) whether two class names may be of one thing: networks take a van for a car."""

    def kind(name: str) -> str | int:
        return next((i for i, group in enumerate(_GROUPS) if name in group), name)

    known_a, known_b = [kind(x) for x in a], [kind(x) for x in b]
    pairs = [[x == y or UNNAMED_CLASS in (x, y) for y in known_b] for x in known_a]
    return np.array(pairs, bool).reshape(len(a), len(b))
