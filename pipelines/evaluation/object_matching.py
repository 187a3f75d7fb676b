"""Which estimate shows which true object: by the overlap of boxes, frame by frame.

Owns the matching that every figure on objects rests on. The estimator's own ids play no part in it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from pipelines.object_types import ObjectEstimates, ObjectState
from pipelines.types import Array, ObjectTruth

Rows = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ObjectMatches:
    """What matched, for M estimates and P pairs of an estimate and a truth that overlap enough.

    truth_row: (M,) int64, -1 where none. overlap: (M,) of the match, 0 where none. is_ignored: (M,)
    bool, not matched, but lies over truth that is too small to judge. pairs: (P, 2) int64, rows of
    estimate and truth.
    """

    truth_row: Rows
    overlap: Array
    is_ignored: NDArray[np.bool_]
    pairs: Rows


def box_overlaps(a_px: Array, b_px: Array) -> Array:
    """Intersection over union (N, M) of boxes (N, 4) and (M, 4); 0 where one of them is NaN.

    Boxes name their first and last pixels, so a box of one pixel has an area of 1.
    """
    a, b = a_px[:, None], b_px[None]
    low, high = np.fmax(a[..., :2], b[..., :2]), np.fmin(a[..., 2:], b[..., 2:])
    shared = np.clip(high - low + 1.0, 0.0, None).prod(-1)
    union = box_areas_px(a) + box_areas_px(b) - shared
    return np.divide(shared, union, out=np.zeros_like(shared), where=union > 0)


def box_areas_px(boxes_px: Array) -> Array:
    """Areas (...) of boxes (..., 4) in pixels, NaN where a box is."""
    return (boxes_px[..., 2:] - boxes_px[..., :2] + 1.0).prod(-1)


def match_objects(
    estimates: ObjectEstimates,
    truth: ObjectTruth,
    is_judged: NDArray[np.bool_],
    min_overlap: float,
    min_area_px: float = 0.0,
) -> ObjectMatches:
    """Match the estimates that are seen (not coasting) with the truth rows that are judged.

    A true object keeps its estimate of before while they overlap enough (CLEAR MOT, Bernardin and
    Stiefelhagen 2008); the rest are assigned for the greatest sum of overlaps (Hungarian).
    Estimates that match nothing are ignored where the truth is not judged, and where their box has
    less than `min_area_px`.
    """
    truth_row = np.full(len(estimates), -1, np.int64)
    overlap = np.zeros(len(estimates))
    is_ignored = np.zeros(len(estimates), bool)
    pairs: list[Rows] = []
    last: dict[int, int] = {}  # estimated id of each true object's last match
    for rows, true_rows in _frames(estimates, truth):
        judged = true_rows[is_judged[true_rows]]
        table = box_overlaps(estimates.boxes_px[rows], truth.boxes_px[judged])
        table[table < min_overlap] = 0.0
        at, true_at = np.nonzero(table)
        pairs.append(np.stack([rows[at], judged[true_at]], 1))
        ids, true_ids = estimates.object_id[rows], truth.object_id[judged]
        for i, j in _assign(table, ids, true_ids, last):
            truth_row[rows[i]], overlap[rows[i]] = judged[j], table[i, j]
            last[int(true_ids[j])] = int(ids[i])
        small = truth.boxes_px[true_rows[~is_judged[true_rows]]]
        over_small = (box_overlaps(estimates.boxes_px[rows], small) >= min_overlap).any(1)
        tiny = box_areas_px(estimates.boxes_px[rows]) < min_area_px
        is_ignored[rows] = (over_small | tiny) & (truth_row[rows] < 0)
    all_pairs = np.concatenate(pairs) if pairs else np.empty((0, 2), np.int64)
    return ObjectMatches(truth_row, overlap, is_ignored, all_pairs)


def of_match(flags: NDArray[np.bool_], truth_row: Rows) -> NDArray[np.bool_]:
    """`flags` of the truth rows that estimates (M,) are matched with; False for those with none."""
    return np.append(flags, False)[truth_row]  # the row -1 is the one appended


def is_seen(estimates: ObjectEstimates) -> NDArray[np.bool_]:
    """Which estimates (M,) have a box in the image and are not merely predicted."""
    coasting = estimates.state == str(ObjectState.COASTING)
    return np.isfinite(estimates.boxes_px).all(axis=1) & ~coasting


def _frames(estimates: ObjectEstimates, truth: ObjectTruth) -> Iterator[tuple[Rows, Rows]]:
    """Rows of seen estimates and of truth, frame by frame in order."""
    seen = is_seen(estimates)
    for frame in np.unique(np.concatenate([estimates.frame_index, truth.frame_index])):
        yield (
            np.flatnonzero(seen & (estimates.frame_index == frame)),
            np.flatnonzero(truth.frame_index == frame),
        )


def _assign(
    table: Array, ids: Rows, true_ids: Rows, last: dict[int, int]
) -> Iterator[tuple[int, int]]:
    """Matched (row, column) of one frame's overlaps (N, M), where 0 means too little."""
    free = table.copy()
    for j, true_id in enumerate(true_ids.tolist()):
        for i in np.flatnonzero((ids == last.get(true_id)) & (free[:, j] > 0)):
            free[i], free[:, j] = 0.0, 0.0
            yield int(i), j
    for i, j in zip(*linear_sum_assignment(free, maximize=True), strict=True):
        if free[i, j] > 0:
            yield int(i), int(j)
