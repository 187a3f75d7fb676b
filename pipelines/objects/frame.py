"""What the object tracker keeps from one frame for the next, and one frame on its way through it.

Owns two nouns and what they can say of masks. Computes no motion.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pipelines.frontend.view import View
from pipelines.object_types import UNNAMED_CLASS, Detections
from pipelines.objects.following import Followed
from pipelines.objects.points import ObjectPoints, Window
from pipelines.types import Array


@dataclass(frozen=True, slots=True)
class LastObjects:
    """What a frame starts from: the one before.

    T_world_camera: (4, 4). is_tracked: whether that pose was measured; no motion in the world can
    be told from one that was not. labels: (H, W) int32 by lasting id. windows: id -> where its
    pixels are. points: on all objects in sight.
    """

    view: View
    T_world_camera: Array
    is_tracked: bool
    labels: NDArray[np.int32]
    windows: Mapping[int, Window]
    points: ObjectPoints

    def mask(self, object_id: int) -> tuple[NDArray[np.bool_], Window] | None:
        """The object's pixels (h, w) and their window, or None where it was not in sight."""
        window = self.windows.get(object_id)
        return None if window is None else (self.labels[window] == object_id, window)


@dataclass(slots=True)
class ObjectFrame:
    """One frame on its way through the tracker, from `associate` to `estimate`.

    labels: (H, W) int32 by lasting id. answered: whether there were detections at all. points,
    followed: tracked points of objects in sight, with where they are now. noise_was_learned:
    whether their noise was known by then. windows: id -> where its pixels are. scores: id -> of its
    detection, 0 where there is none. new_ids: objects without points in the frame before.
    carried_ids: objects without a detection, whose masks were carried.
    """

    labels: NDArray[np.int32]
    answered: bool
    points: ObjectPoints
    followed: Followed
    noise_was_learned: bool
    windows: dict[int, Window] = field(default_factory=dict)
    scores: dict[int, float] = field(default_factory=dict)
    new_ids: list[int] = field(default_factory=list)
    carried_ids: set[int] = field(default_factory=set)

    def mask(self, object_id: int) -> NDArray[np.bool_]:
        """The object's pixels (h, w) inside its window."""
        return self.labels[self.windows[object_id]] == object_id

    def remove(self, object_id: int) -> None:
        """Take an object out of the picture."""
        window = self.windows.pop(object_id)
        self.labels[window][self.labels[window] == object_id] = 0
        del self.scores[object_id]
        self.carried_ids.discard(object_id)

    def box_px(self, object_id: int) -> Array:
        """(4,) x1 y1 x2 y2, its first and last columns and rows."""
        rows, columns = self.windows[object_id]
        return np.array([columns.start, rows.start, columns.stop - 1, rows.stop - 1], float)

    def detections(self, class_names: Mapping[int, str]) -> Detections:
        """The objects in sight as detections whose labels are lasting ids."""
        ids = sorted(self.windows)
        names = [class_names.get(i, UNNAMED_CLASS) for i in ids]
        return Detections(
            self.labels,
            np.array(ids, np.int32),
            np.array(names, str) if names else np.empty(0, "U16"),
            np.array([self.scores[i] for i in ids], float),
        )
