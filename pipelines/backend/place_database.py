"""Which keyframes look like an image: an inverted file from words to the keyframes that have them.

Owns the ranking by words. Whether a candidate is the same place is for geometry to say.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.vocabulary import BowVector
from pipelines.shapes import check_shape
from pipelines.types import Array

_LEAST_MERGED = 20_000  # fresh entries that are sorted in at the earliest
_MERGED_SHARE = 1 / 16  # of the sorted entries: later, so that sorting stays rare


@dataclass(frozen=True, slots=True)
class PlaceCandidates:
    """Keyframes that share words with an image, the most alike first.

    keyframes: (N,) int64 indices, as they were added. scores: (N,) float64, 0 to 1, falling.
    """

    keyframes: NDArray[np.int64]
    scores: Array

    def __post_init__(self) -> None:
        check_shape("PlaceCandidates", "scores", self.scores, (len(self.keyframes),))

    def __len__(self) -> int:
        return len(self.keyframes)


class PlaceDatabase:
    """The bags of words of all keyframes, to be asked for the most alike.

    Entries (keyframe, word, weight) lie in flat arrays, sorted by word; those of the latest
    keyframes lie unsorted behind until there are enough to be worth sorting in. Of a removed
    keyframe they vanish then. Takes 8 bytes an entry. Not for use by two threads at once.
    """

    def __init__(self, n_words: int) -> None:
        """n_words: of the vocabulary that all bags are made with."""
        self.n_words = n_words
        self._slots: dict[int, int] = {}  # of the keyframes that are there
        self._keyframes: list[int] = []  # of each slot, -1 where removed
        self._starts = np.zeros(n_words + 1, np.int64)
        self._sorted_slots = np.empty(0, np.int32)
        self._sorted_weights = np.empty(0, np.float32)
        self._fresh: list[tuple[int, BowVector]] = []
        self._n_fresh = 0

    def __len__(self) -> int:
        return len(self._slots)

    def __contains__(self, keyframe: int) -> bool:
        return keyframe in self._slots

    def add(self, keyframe: int, bow: BowVector) -> None:
        """Remember a keyframe by its index. Raises ValueError where it is there, or bad words."""
        if keyframe in self._slots:
            raise ValueError(
                f"PlaceDatabase: keyframe {keyframe} is there already; remove it first"
            )
        self._check(bow)
        self._slots[keyframe] = len(self._keyframes)
        self._fresh.append((len(self._keyframes), bow))
        self._keyframes.append(keyframe)
        self._n_fresh += len(bow)
        if self._n_fresh > max(_LEAST_MERGED, _MERGED_SHARE * len(self._sorted_slots)):
            self._merge()

    def remove(self, keyframe: int) -> None:
        """Forget a keyframe. Raises ValueError where it is not there."""
        if keyframe not in self._slots:
            raise ValueError(f"PlaceDatabase: keyframe {keyframe} is not there to be removed")
        self._keyframes[self._slots.pop(keyframe)] = -1

    def query(
        self,
        bow: BowVector,
        exclude: Iterable[int] = (),
        min_score: float = 0.0,
        n_best: int | None = None,
    ) -> PlaceCandidates:
        """The keyframes most like an image, by the score of `score_places`, best first.

        exclude: keyframes that do not count, such as the image's neighbours; others than are there
        do no harm. min_score: lower ones are left out, and so are those without a word in common.
        n_best: no more than these. Of equal scores the first added comes first.
        """
        self._check(bow)
        scores = self._score_sorted(bow) + self._score_fresh(bow)
        keyframes = np.array(self._keyframes, np.int64)
        wanted = (keyframes >= 0) & (scores > 0) & (scores >= min_score)
        wanted[[self._slots[k] for k in exclude if k in self._slots]] = False
        found = np.flatnonzero(wanted)
        ranked = found[np.argsort(-scores[found], kind="stable")][:n_best]
        return PlaceCandidates(keyframes[ranked], scores[ranked])

    def _score_sorted(self, bow: BowVector) -> Array:
        """Scores of all slots (S,) from the sorted entries."""
        starts = self._starts[bow.words]
        sizes = self._starts[bow.words + 1] - starts
        ends = np.cumsum(sizes)
        entries = np.arange(ends[-1] if len(ends) else 0) + np.repeat(starts - ends + sizes, sizes)
        lesser = np.minimum(self._sorted_weights[entries], np.repeat(bow.weights, sizes))
        slots = self._sorted_slots[entries]
        return np.bincount(slots, lesser, len(self._keyframes)).astype(np.float64, copy=False)

    def _score_fresh(self, bow: BowVector) -> Array:
        """Scores of all slots (S,) from the entries not sorted in yet."""
        scores = np.zeros(len(self._keyframes))
        weight_of_word = np.zeros(self.n_words, np.float32)
        weight_of_word[bow.words] = bow.weights
        for slot, other in self._fresh:
            lesser = np.minimum(weight_of_word[other.words], other.weights)
            scores[slot] = lesser.sum(dtype=np.float64)
        return scores

    def _merge(self) -> None:
        """Sort the fresh entries in, and drop those of removed keyframes."""
        words = np.concatenate([bow.words for _, bow in self._fresh])
        weights = np.concatenate([bow.weights for _, bow in self._fresh])
        slots = np.repeat([slot for slot, _ in self._fresh], [len(bow) for _, bow in self._fresh])
        order = np.argsort(words, kind="stable")
        behind = self._starts[words[order] + 1]
        self._sorted_slots = np.insert(self._sorted_slots, behind, slots[order])
        self._sorted_weights = np.insert(self._sorted_weights, behind, weights[order])
        self._starts[1:] += np.cumsum(np.bincount(words, minlength=self.n_words))
        self._fresh, self._n_fresh = [], 0
        if len(self._slots) < len(self._keyframes):
            self._drop_removed()

    def _drop_removed(self) -> None:
        """Take out the entries and slots of removed keyframes."""
        there = np.array(self._keyframes) >= 0
        kept = there[self._sorted_slots]
        self._starts = np.r_[0, np.cumsum(kept)][self._starts]
        new_slots = (np.cumsum(there) - 1).astype(np.int32)
        self._sorted_slots = new_slots[self._sorted_slots[kept]]
        self._sorted_weights = self._sorted_weights[kept]
        self._keyframes = [keyframe for keyframe in self._keyframes if keyframe >= 0]
        self._slots = {keyframe: slot for slot, keyframe in enumerate(self._keyframes)}

    def _check(self, bow: BowVector) -> None:
        if len(bow) and not 0 <= bow.words[0] <= bow.words[-1] < self.n_words:
            raise ValueError(
                f"PlaceDatabase: expected words 0 to {self.n_words - 1}, found {bow.words[0]} to "
                f"{bow.words[-1]}; was the bag made with another vocabulary?"
            )
