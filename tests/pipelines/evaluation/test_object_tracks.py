"""Identity: an example counted by hand, swapped ids, and motmetrics as an independent witness."""

import numpy as np
import pytest

from pipelines.evaluation.object_matching import box_overlaps, match_objects
from pipelines.evaluation.object_tracks import track_scores
from pipelines.evaluation.objects import evaluate_objects
from pipelines.object_types import ObjectEstimates
from pipelines.types import ObjectTruth


def make_truth(boxes: dict[tuple[int, int], tuple[float, ...]]) -> ObjectTruth:
    keys = sorted(boxes)
    return ObjectTruth(
        np.array([k for k, _ in keys]),
        np.array([j for _, j in keys]),
        np.full(len(keys), "car"),
        np.tile(np.eye(4), (len(keys), 1, 1)),
        np.array([boxes[key] for key in keys], float),
        np.ones(len(keys), bool),
    )


def make_estimates(boxes: dict[tuple[int, int], tuple[float, ...]]) -> ObjectEstimates:
    keys = sorted(boxes)
    M = len(keys)
    blank, one = np.full(M, np.nan), np.ones(M)
    return ObjectEstimates(
        np.array([k for k, _ in keys]), one, np.array([j for _, j in keys]), np.full(M, "car"), one,
        np.full(M, "unknown"), np.array([boxes[key] for key in keys], float), np.ones(M, np.int64),
        np.full((M, 4, 4), np.nan), np.full((M, 4, 4), np.nan), np.full((M, 6, 6), np.nan),
        np.full((M, 3), np.nan), blank, blank, np.full((M, 3), np.nan), blank,
        np.full((M, 3), np.nan),
    )  # fmt: skip


def score(estimates: ObjectEstimates, truth: ObjectTruth) -> dict:
    everything = np.ones(len(truth), bool)
    matches = match_objects(estimates, truth, everything, 0.3)
    return track_scores(estimates, truth, matches, everything)


def test_overlap_counts_first_and_last_pixels():
    a = np.array([[0.0, 0.0, 9.0, 9.0]])
    b = np.array(
        [[0.0, 0.0, 9.0, 9.0], [5.0, 0.0, 14.0, 9.0], [10.0, 0.0, 19.0, 9.0], [np.nan] * 4]
    )
    np.testing.assert_allclose(box_overlaps(a, b), [[1.0, 50 / 150, 0.0, 0.0]])


def test_an_example_counted_by_hand():
    """Two true objects in four frames.

    A: seen by 1 in frames 0 and 1, missed in 2, seen by 3 in 3: one miss, one switch, one return.
    B: seen by 2 in all four. In frame 2 estimate 4 lies over nothing: one false.
    MOTA = 1 - (1 + 1 + 1) / 8. IDTP = 2 (A with 1) + 4 (B with 2), so IDF1 = 2 * 6 / (8 + 8).
    """
    A, B = (0, 0, 19, 19), (100, 0, 119, 19)
    truth = make_truth({(k, j): box for k in range(4) for j, box in ((1, A), (2, B))})
    boxes = {(k, 2): B for k in range(4)} | {(0, 1): A, (1, 1): A, (3, 3): A}
    boxes[2, 4] = (300, 0, 319, 19)
    found = score(make_estimates(boxes), truth)
    assert (found["matched"], found["missed"], found["false"]) == (7, 1, 1)
    assert (found["id_switches"], found["fragmentations"]) == (1, 1)
    assert found["mota"] == pytest.approx(1 - 3 / 8)
    assert found["idf1"] == pytest.approx(12 / 16)
    assert found["motp_overlap"] == pytest.approx(1.0)


def test_a_match_is_kept_while_it_overlaps_enough():
    """In frame 1 estimate 8 fits better, but 7 was the match before and still overlaps."""
    box, shifted = (0, 0, 19, 19), (5, 0, 24, 19)
    truth = make_truth({(0, 1): box, (1, 1): box})
    estimates = make_estimates({(0, 7): box, (1, 7): shifted, (1, 8): box})
    matches = match_objects(estimates, truth, np.ones(2, bool), 0.3)
    assert matches.truth_row.tolist() == [0, 1, -1]
    assert score(estimates, truth)["id_switches"] == 0
    alone = match_objects(estimates[np.array([1, 2])], truth, np.ones(2, bool), 0.3)
    assert alone.truth_row.tolist() == [-1, 1]  # without a past, the better one


def test_swapped_ids_are_switches(world):
    exact = world.estimates()
    ids = exact.object_id.copy()
    late = exact.frame_index >= 12
    ids[late & (exact.object_id == 11)] = 12
    ids[late & (exact.object_id == 12)] = 11
    found = evaluate_objects(world.changed(exact, object_id=ids), world.truth(), world.frames())
    assert found["tracking"]["id_switches"] == 2
    assert found["id_switches_while_moving"] == 2
    assert found["tracking"]["mota"] == pytest.approx(1 - 2 / found["tracking"]["truth"])
    assert 0.6 < found["tracking"]["idf1"] < 0.95
    assert found["per_object"]["1"]["estimated_ids"] == [11, 12]
    assert found["motion"]["trans_max_m"] < 1e-9  # the motions are right all the same


def test_agrees_with_motmetrics():
    """Random tracks that drift, vanish and change their ids."""
    mm = pytest.importorskip("motmetrics")
    rng = np.random.default_rng(11)
    true_boxes, boxes = {}, {}
    accumulator = mm.MOTAccumulator(auto_id=True)
    for k in range(60):
        for j in range(5):
            if rng.random() < 0.85:
                corner = np.array([60.0 * j + 25.0 * np.sin(0.2 * k + j), 10.0 * j])
                true_boxes[k, j] = (*corner, *(corner + 39.0))
                if rng.random() < 0.9:
                    shift = rng.normal(0, 6.0, 2)
                    own = j + 10 * int(rng.random() < 0.15)
                    boxes[k, own] = (*(corner + shift), *(corner + shift + 39.0))
        if rng.random() < 0.3:
            boxes[k, 90] = (500.0, 0.0, 530.0, 30.0)
    truth, estimates = make_truth(true_boxes), make_estimates(boxes)
    for k in range(60):
        own = np.flatnonzero(truth.frame_index == k)
        rows = np.flatnonzero(estimates.frame_index == k)
        overlap = box_overlaps(truth.boxes_px[own], estimates.boxes_px[rows])
        distance = np.where(overlap >= 0.3, 1.0 - overlap, np.nan)
        accumulator.update(truth.object_id[own], estimates.object_id[rows], distance)
    names = ["mota", "motp", "idf1", "num_switches", "num_fragmentations", "num_misses"]
    names += ["num_false_positives"]
    theirs = mm.metrics.create().compute(accumulator, metrics=names, name="run").loc["run"]
    ours = score(estimates, truth)
    assert ours["mota"] == pytest.approx(theirs["mota"], abs=1e-12)
    assert ours["idf1"] == pytest.approx(theirs["idf1"], abs=1e-12)
    assert ours["motp_overlap"] == pytest.approx(1.0 - theirs["motp"], abs=1e-12)
    assert ours["id_switches"] == theirs["num_switches"] > 10
    assert ours["fragmentations"] == theirs["num_fragmentations"] > 5
    assert ours["missed"] == theirs["num_misses"]
    assert ours["false"] == theirs["num_false_positives"]
