"""How well lasting ids follow true objects: CLEAR MOT (MOTA, MOTP) and identity measures (IDF1).

Owns these definitions (Bernardin and Stiefelhagen 2008; Ristani et al. 2016).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from pipelines.evaluation.object_matching import ObjectMatches, is_seen, of_match
from pipelines.object_types import ObjectEstimates
from pipelines.types import ObjectTruth


def track_scores(
    estimates: ObjectEstimates,
    truth: ObjectTruth,
    matches: ObjectMatches,
    is_scored: NDArray[np.bool_],
) -> dict[str, Any]:
    """Scores over the truth rows `is_scored` (M,) bool; the other rows count neither way.

    So an estimate that matches a row which is not scored, or lies over one too small to judge, is
    no false one. Coasting rows are not seen and take no part. MOTA = 1 - (missed + false +
    switches) / truth; MOTP = mean overlap of the matches; IDF1 from one assignment of whole tracks.
    A switch is a true object's match with another id than its last one; a fragmentation is a
    return of a true object that was missed since its last match. Values without truth are None.
    """
    row, matched = matches.truth_row, matches.truth_row >= 0
    hit = of_match(is_scored, row)
    counts = is_seen(estimates) & ~matches.is_ignored & (hit | ~matched)
    n_truth, n_false = int(is_scored.sum()), int((counts & ~matched).sum())
    n_missed = n_truth - int(hit.sum())
    switches, fragments = _breaks(estimates, truth, row, hit, is_scored)
    pairs = matches.pairs[counts[matches.pairs[:, 0]] & is_scored[matches.pairs[:, 1]]]
    id_hits = _identity_hits(estimates.object_id[pairs[:, 0]], truth.object_id[pairs[:, 1]])
    total = n_truth + int(counts.sum())
    return {
        "truth": n_truth,
        "matched": int(hit.sum()),
        "missed": n_missed,
        "false": n_false,
        "id_switches": switches,
        "fragmentations": fragments,
        "mota": 1.0 - (n_missed + n_false + switches) / n_truth if n_truth else None,
        "motp_overlap": float(matches.overlap[hit].mean()) if hit.any() else None,
        "idf1": 2.0 * id_hits / total if n_truth else None,
    }


def count_switches(
    object_id: NDArray[np.int64], true_id: NDArray[np.int64], frame: NDArray[np.int64]
) -> int:
    """How often a true object's id differs from that of its match before; rows (N,) are matches."""
    order = np.lexsort((frame, true_id))
    same_object = np.diff(true_id[order]) == 0
    return int((same_object & (np.diff(object_id[order]) != 0)).sum())


def _breaks(
    estimates: ObjectEstimates,
    truth: ObjectTruth,
    row: NDArray[np.int64],
    hit: NDArray[np.bool_],
    is_scored: NDArray[np.bool_],
) -> tuple[int, int]:
    """Identity switches and fragmentations."""
    switches = count_switches(
        estimates.object_id[hit], truth.object_id[row[hit]], truth.frame_index[row[hit]]
    )
    is_found = np.zeros(len(truth), bool)
    is_found[row[hit]] = True
    fragments = 0
    for true_id in np.unique(truth.object_id[is_scored]):
        own = np.flatnonzero(is_scored & (truth.object_id == true_id))
        found = is_found[own[np.argsort(truth.frame_index[own])]]
        first = np.argmax(found) if found.any() else len(found)  # being found late is no return
        fragments += int((~found[first:-1] & found[first + 1 :]).sum())
    return switches, fragments


def _identity_hits(object_id: NDArray[np.int64], true_id: NDArray[np.int64]) -> int:
    """Most overlapping pairs that one-to-one identities of whole tracks can explain (IDTP)."""
    ids, i = np.unique(object_id, return_inverse=True)
    true_ids, j = np.unique(true_id, return_inverse=True)
    together = np.zeros((len(ids), len(true_ids)))
    np.add.at(together, (i, j), 1.0)
    return int(together[linear_sum_assignment(together, maximize=True)].sum())
