"""Ranking by the inverted file against scoring of each keyframe, through merges and removals."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.backend import place_database
from pipelines.backend.place_database import PlaceDatabase
from pipelines.backend.vocabulary import BowVector, score_places

N_WORDS = 200


def random_bow(rng: np.random.Generator, n: int = 30) -> BowVector:
    words = np.sort(rng.choice(N_WORDS, n, replace=False)).astype(np.int32)
    weights = rng.uniform(0.1, 1.0, n)
    return BowVector(words, (weights / weights.sum()).astype(np.float32))


@pytest.fixture
def merging_often(monkeypatch) -> None:
    monkeypatch.setattr(place_database, "_LEAST_MERGED", 100)


def check_ranking(database: PlaceDatabase, bags: dict[int, BowVector], asked: BowVector) -> None:
    found = database.query(asked)
    expected = {k: score_places(asked, bow) for k, bow in bags.items()}
    assert set(found.keyframes.tolist()) == {k for k, score in expected.items() if score > 0}
    assert found.scores == pytest.approx([expected[k] for k in found.keyframes], abs=1e-6)
    assert (np.diff(found.scores) <= 0).all()


def test_scores_are_those_of_each_keyframe_alone(merging_often) -> None:
    rng = np.random.default_rng(0)
    database, bags = PlaceDatabase(N_WORDS), {}
    for step in range(300):
        if step % 7 == 3:
            gone = int(rng.choice(list(bags)))
            database.remove(gone)
            del bags[gone]
            assert gone not in database
        bags[1000 - step] = random_bow(rng, int(rng.integers(1, 60)))
        database.add(1000 - step, bags[1000 - step])
        if step % 20 == 0:
            check_ranking(database, bags, random_bow(rng))
    assert len(database) == len(bags) > 200


def test_removed_keyframes_leave_no_entries(merging_often) -> None:
    rng = np.random.default_rng(1)
    database = PlaceDatabase(N_WORDS)
    for k in range(400):
        database.add(k, random_bow(rng))
        if k >= 20:
            database.remove(k - 20)
    assert len(database) == 20
    assert len(database._keyframes) < 30
    assert len(database._sorted_slots) + database._n_fresh < 30 * 30


def test_a_keyframe_removed_can_come_back(merging_often) -> None:
    rng = np.random.default_rng(2)
    old, new = random_bow(rng), random_bow(rng)
    for n_between in (0, 10):
        database = PlaceDatabase(N_WORDS)
        database.add(5, old)
        for k in range(n_between):
            database.add(100 + k, random_bow(rng))
        database.remove(5)
        assert 5 not in database.query(old).keyframes
        database.add(5, new)
        found = database.query(new, n_best=1)
        assert found.keyframes.tolist() == [5]
        assert found.scores == pytest.approx([1.0], abs=1e-6)


def test_what_is_left_out() -> None:
    rng = np.random.default_rng(3)
    bags = {k: random_bow(rng) for k in range(50)}
    database = PlaceDatabase(N_WORDS)
    for k, bow in bags.items():
        database.add(k, bow)
    all_of_them = database.query(bags[7])
    assert all_of_them.keyframes[0] == 7
    less = database.query(bags[7], exclude=[7, 8, 99], min_score=0.1, n_best=3)
    expected = [
        (k, s)
        for k, s in zip(all_of_them.keyframes, all_of_them.scores, strict=True)
        if k not in (7, 8) and s >= 0.1
    ][:3]
    assert len(expected) == 3
    assert list(zip(less.keyframes, less.scores, strict=True)) == expected


def test_an_empty_database_and_an_empty_bag_find_nothing() -> None:
    nothing = BowVector(np.empty(0, np.int32), np.empty(0, np.float32))
    database = PlaceDatabase(N_WORDS)
    bow = random_bow(np.random.default_rng(4))
    assert len(database.query(bow)) == len(database.query(nothing)) == 0
    database.add(1, nothing)
    assert len(database.query(bow)) == len(database.query(nothing)) == 0


def test_misuse_is_told() -> None:
    rng = np.random.default_rng(5)
    database = PlaceDatabase(N_WORDS)
    database.add(3, random_bow(rng))
    with pytest.raises(ValueError, match="keyframe 3 is there already"):
        database.add(3, random_bow(rng))
    with pytest.raises(ValueError, match="keyframe 4 is not there"):
        database.remove(4)
    foreign = BowVector(np.array([N_WORDS], np.int32), np.ones(1, np.float32))
    for misuse in (lambda: database.add(9, foreign), lambda: database.query(foreign)):
        with pytest.raises(ValueError, match="another vocabulary"):
            misuse()
    assert len(database) == 1
