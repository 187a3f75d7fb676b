"""Votes, gates and the one assignment: who is who, and who had better be nobody."""

import numpy as np
import pytest

from pipelines.objects.association import (
    Candidates,
    assign,
    box_overlap,
    color_distance,
    count_votes,
    same_kind,
)


def candidates(votes, **changes):
    """Nothing speaks for any pair but the votes, of 50 points each."""
    votes = np.array(votes, float)
    J, M = votes.shape
    rest = {
        "n_points": np.full(J, 50),
        "overlap": np.zeros((J, M)),
        "distance2": np.full((J, M), np.inf),
        "log_spread": np.zeros((J, M)),
        "color_distance": np.zeros((J, M)),
        "same_kind": np.ones((J, M), bool),
    }
    return Candidates(votes, **(rest | {k: np.array(v) for k, v in changes.items()}))


def test_votes_decide_even_against_class_and_colour():
    c = candidates(
        [[0.1, 0.9], [0.8, 0.2]], same_kind=np.zeros((2, 2), bool), color_distance=np.ones((2, 2))
    )
    np.testing.assert_array_equal(assign(c), [1, 0])


def test_an_object_is_rather_left_alone_than_given_a_wrong_match():
    np.testing.assert_array_equal(assign(candidates([[0.9, 0.0], [0.25, 0.1]])), [0, -1])
    far = candidates([[0.0]], n_points=[0], distance2=[[30.0]])
    other_color = candidates([[0.0]], n_points=[0], distance2=[[1.0]], color_distance=[[0.8]])
    other_kind = candidates([[0.0]], n_points=[0], distance2=[[1.0]], same_kind=[[False]])
    for c in (far, other_color, other_kind):
        np.testing.assert_array_equal(assign(c), [-1])


def test_a_lost_object_is_found_again_within_its_gate():
    c = candidates([[0.0, 0.0]], n_points=[0], distance2=[[9.0, 2.0]])
    np.testing.assert_array_equal(assign(c), [1])
    # At the same distance the one of its colour is it
    c = candidates([[0.0, 0.0]], n_points=[0], distance2=[[3.0, 3.0]], color_distance=[[0.1, 0.5]])
    np.testing.assert_array_equal(assign(c), [0])


def test_who_may_be_anywhere_is_likely_nowhere():
    c = candidates(
        [[0.0], [0.0]], n_points=[0, 0], distance2=[[4.0], [2.0]], log_spread=[[0.5], [9.0]]
    )
    np.testing.assert_array_equal(assign(c), [0, -1])


def test_a_vote_never_gives_way_to_finding_another_again():
    """Object 0 could go to detection 1 by its gate, so that object 1 might be found again at 0."""
    c = candidates(
        [[0.31, 0.0], [0.0, 0.0]],
        n_points=[50, 0],
        distance2=[[np.inf, 0.0], [0.0, np.inf]],
    )
    np.testing.assert_array_equal(assign(c), [0, -1])


def test_boxes_count_where_points_are_few():
    overlap = [[0.5, 0.1]]
    few = candidates([[0.0, 0.0]], n_points=[2], overlap=overlap)
    many = candidates([[0.0, 0.0]], n_points=[50], overlap=overlap)
    np.testing.assert_array_equal(assign(few), [0])
    np.testing.assert_array_equal(assign(many), [-1])


@pytest.mark.parametrize(("J", "M"), [(0, 0), (0, 3), (2, 0)])
def test_nothing_to_assign(J, M):
    np.testing.assert_array_equal(assign(candidates(np.zeros((J, M)))), np.full(J, -1))


def test_two_objects_that_cross_keep_their_names():
    """Half of the near one's points see the other's place: the sums still tell them apart."""
    labels = np.zeros((40, 80), np.int32)
    labels[10:30, 10:40], labels[10:30, 40:70] = 1, 2
    rng = np.random.default_rng(0)
    left = rng.uniform([10, 10], [39, 29], (30, 2))
    right = rng.uniform([40, 10], [69, 29], (30, 2))
    stray = rng.uniform([40, 10], [69, 29], (10, 2))
    rows = np.repeat([1, 0, 1], [30, 30, 10])
    uv = np.concatenate([left, right, stray])
    votes, n_points = count_votes(rows, labels, uv, np.array([600.0, 600.0]), 2)
    np.testing.assert_array_equal(n_points, [30, 40])
    np.testing.assert_array_equal(assign(candidates(votes, n_points=n_points)), [1, 0])


def test_a_far_object_that_vanishes_behind_a_near_one_does_not_take_its_mask():
    labels = np.ones((40, 80), np.int32)
    rows = np.repeat([0, 1], [100, 12])
    uv = np.random.default_rng(1).uniform([0, 0], [79, 39], (112, 2))
    votes, n_points = count_votes(rows, labels, uv, np.array([3000.0, 150.0]), 1)
    assert votes[0, 0] > 0.95 and 0.1 < votes[1, 0] < 0.3
    np.testing.assert_array_equal(assign(candidates(votes, n_points=n_points)), [0, -1])
    # Not even where the near one had no points of its own and may be found by its gate alone
    votes, n_points = count_votes(rows[100:], labels, uv[100:] * 0, np.array([3e3, 150.0]), 1)
    assert votes[0, 0] == 0.0 and n_points[0] == 0


def test_votes_without_points_detections_or_objects_are_none():
    none = np.empty(0, np.int64)
    labels = np.zeros((4, 4), np.int32)
    for J, M in ((0, 0), (2, 0), (0, 2), (2, 2)):
        votes, n = count_votes(none, labels, np.empty((0, 2)), np.full(J, 9.0), M)
        assert votes.shape == (J, M) and not votes.any() and not n.any()


def test_points_are_counted_to_the_very_edge_of_the_image():
    labels = np.ones((4, 6), np.int32)
    votes, _ = count_votes(
        np.array([0, 0]), labels, np.array([[5.0, 3.0], [0.0, 0.0]]), np.array([24.0]), 1
    )
    assert votes[0, 0] == 1.0


def test_overlap_of_boxes_counts_whole_pixels():
    a = np.array([[0, 0, 9, 9], [np.nan] * 4, [0, 0, 0, 0]], float)
    b = np.array([[0, 0, 9, 9], [5, 0, 14, 9], [10, 0, 19, 9]], float)
    expected = [[1.0, 50 / 150, 0.0], [0, 0, 0], [1 / 100, 0, 0]]
    np.testing.assert_allclose(box_overlap(a, b), expected)
    assert box_overlap(a, np.empty((0, 4))).shape == (3, 0)


def test_colour_distance_runs_from_alike_to_disjoint():
    a = np.array([[1.0, 0, 0], [0.5, 0.5, 0]])
    np.testing.assert_allclose(
        color_distance(a, a), [[0, np.sqrt(1 - 0.5**0.5)], [np.sqrt(1 - 0.5**0.5), 0]], atol=1e-7
    )
    assert color_distance(a[:1], np.array([[0, 0, 1.0]]))[0, 0] == 1.0


def test_kinds_that_networks_mix_up():
    kinds = same_kind(["car", "person", "chair", "object"], ["van", "bicycle", "chair", "dog"])
    expected = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [1, 1, 1, 1]]
    np.testing.assert_array_equal(kinds, np.array(expected, bool))
    np.testing.assert_array_equal(same_kind(["dog"], ["object"]), [[True]])
    assert same_kind([], ["car"]).shape == (0, 1) and same_kind(["car"], []).shape == (1, 0)
