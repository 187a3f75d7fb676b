"""The places that a map's keyframes have seen: asked when the camera is lost, and for loops.

Owns the vocabulary's loading, at the first keyframe and once a program, and which keyframe has
which words. Whether a candidate is the same place is for geometry to say.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

import numpy as np

from pipelines.backend.place_database import PlaceCandidates, PlaceDatabase
from pipelines.backend.vocabulary import BowVector, Descriptors, Vocabulary
from pipelines.backend.vocabulary_files import load_vocabulary
from pipelines.config import PlacesConfig
from pipelines.mapping.sparse_map import SparseMap


class SeenPlaces:
    """Keyframes by how they look; rows are positions in `SparseMap.keyframes`."""

    def __init__(self, config: PlacesConfig) -> None:
        self.config = config
        self._database: PlaceDatabase | None = None
        self._latest: BowVector | None = None

    def __len__(self) -> int:
        return 0 if self._database is None else len(self._database)

    def add(self, row: int, descriptors: Descriptors) -> None:
        """Remember a keyframe by its ORB descriptors (N, 32).

        Raises FormatError where the vocabulary is missing or damaged.
        """
        vocabulary = self._vocabulary()
        if self._database is None:
            self._database = PlaceDatabase(vocabulary.n_words)
        self._latest = vocabulary.describe(vocabulary.words(descriptors))
        self._database.add(row, self._latest)

    def add_map(self, sparse_map: SparseMap) -> None:
        """Remember all keyframes of a map, by the points that they see and their free features."""
        for row, keyframe in enumerate(sparse_map.keyframes):
            seen = sparse_map.descriptor[keyframe.tracks.point_ids]
            self.add(row, np.concatenate([seen, keyframe.free_features.descriptors]))

    def alike(self, descriptors: Descriptors) -> list[int]:
        """Rows of the keyframes most like an image with these ORB descriptors, the best first."""
        if self._database is None:
            return []
        vocabulary = self._vocabulary()
        bow = vocabulary.describe(vocabulary.words(descriptors))
        found = self._database.query(bow, n_best=self.config.relocalise_among)
        return [int(row) for row in found.keyframes]

    def like_latest(self, exclude: Iterable[int], n_best: int) -> PlaceCandidates:
        """The keyframes most like the one last added, the best first, but for some rows.

        Raises ValueError before any was added.
        """
        if self._database is None or self._latest is None:
            raise ValueError("SeenPlaces: expected a keyframe to ask about, found none added")
        return self._database.query(self._latest, exclude, n_best=n_best)

    def _vocabulary(self) -> Vocabulary:
        return _load_once(self.config.vocabulary)


@lru_cache(maxsize=1)
def _load_once(path: str) -> Vocabulary:
    return load_vocabulary(path)
