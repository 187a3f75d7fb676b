"""Places by their looks: the vocabulary comes once, and the right keyframe first."""

import numpy as np
import pytest

from pipelines.backend import seen_places
from pipelines.backend.seen_places import SeenPlaces
from pipelines.config import PlacesConfig
from pipelines.errors import FormatError


def images(n, rng):
    return [rng.integers(0, 256, (200, 32)).astype(np.uint8) for _ in range(n)]


def test_the_keyframe_that_looks_alike_comes_first():
    rng = np.random.default_rng(0)
    places = SeenPlaces(PlacesConfig(relocalise_among=3))
    seen = images(8, rng)
    for row, descriptors in enumerate(seen):
        places.add(row, descriptors)
    again = np.concatenate([seen[5][:120], images(1, rng)[0][:80]])
    found = places.alike(again)
    assert len(places) == 8
    assert found[0] == 5
    assert 1 <= len(found) <= 3


def test_nothing_is_alike_before_anything_was_seen():
    assert SeenPlaces(PlacesConfig()).alike(images(1, np.random.default_rng(1))[0]) == []


def test_the_vocabulary_is_read_once_and_not_before_it_is_needed(monkeypatch):
    read = []
    original = seen_places.load_vocabulary
    monkeypatch.setattr(
        seen_places, "load_vocabulary", lambda path: read.append(path) or original(path)
    )
    seen_places._load_once.cache_clear()
    first, second = SeenPlaces(PlacesConfig()), SeenPlaces(PlacesConfig())
    assert read == []
    for places in (first, second):
        for row, descriptors in enumerate(images(2, np.random.default_rng(2))):
            places.add(row, descriptors)
    assert read == [""]


def test_a_vocabulary_that_is_not_there_is_one_sentence():
    places = SeenPlaces(PlacesConfig(vocabulary="no/such_words.npz"))
    with pytest.raises(FormatError, match=r"no/such_words\.npz"):
        places.add(0, images(1, np.random.default_rng(3))[0])


def test_the_latest_is_compared_with_all_but_some() -> None:
    places = SeenPlaces(PlacesConfig())
    with pytest.raises(ValueError, match="none added"):
        places.like_latest([], 1)
    seen = images(3, np.random.default_rng(4))
    for row, descriptors in enumerate([*seen, seen[1]]):
        places.add(row, descriptors)
    assert places.like_latest([3], 1).keyframes.tolist() == [1]
    assert 1 not in places.like_latest([1, 3], 4).keyframes
