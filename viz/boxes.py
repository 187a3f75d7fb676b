"""Objects as oriented boxes: where each is in every frame, how large, and the words at it.

Owns the way from rows of objects to boxes in the world, of one frame while a run goes on and of a
whole run afterwards. Draws nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import invert_T, make_T, orthonormalise, rotation_angle_deg
from pipelines.object_types import ObjectEstimates, ObjectState
from pipelines.types import Array
from viz import style
from viz.object_marks import label_text

SMALLEST_SIDE_M = 0.1
# Depth noise draws far points out along the view: no box is shown longer and higher than its kind.
LARGEST_M = {
    "person": (1.2, 2.2), "bicycle": (2.2, 2.2), "motorcycle": (2.6, 2.2), "car": (5.5, 2.4),
    "truck": (12.0, 4.5), "bus": (14.0, 4.5), "train": (40.0, 5.0),
}  # fmt: skip
LARGEST_OF_OTHERS_M = (6.0, 3.0)
_TURNED_DEG = 20.0  # a pose that turns this far against its own motion was set up anew


@dataclass(frozen=True, slots=True)
class ObjectBox:
    """What is drawn of an object in one frame.

    T_world_box: (4, 4), the box's middle and axes, x along the object's motion where it moves.
    size_m: (3,) along these axes. state: a value of `ObjectState`. words: id, class and speed.
    row: of the estimates that it comes from.
    """

    object_id: int
    T_world_box: Array
    size_m: Array
    state: str
    words: str
    row: int

    @property
    def color(self) -> style.Color:
        """The object's lasting colour."""
        return style.object_color(self.object_id)

    @property
    def corners_m(self) -> Array:
        """(8, 3) in the world; bits 0, 1 and 2 of a corner's number choose the side in x, y, z."""
        high = (np.arange(8)[:, None] >> np.arange(3)) & 1
        return (high - 0.5) * self.size_m @ self.T_world_box[:3, :3].T + self.T_world_box[:3, 3]


def frame_boxes(objects: ObjectEstimates) -> list[ObjectBox]:
    """Boxes of one frame by what is known in it, for a view of a run that goes on."""
    return [
        _box(objects, row, _T_world_box(objects, row), objects.extents_m[row])
        for row in np.flatnonzero(_has_box(objects)).tolist()
    ]


def run_boxes(objects: ObjectEstimates) -> list[ObjectBox]:
    """Boxes of all rows of a run, each object's of the size that it has in the end.

    What is seen of an object grows, and with it the box of a frame; hindsight knows the whole, so
    that the box of each stretch of one rigid motion goes back along it without changing.
    """
    boxes: list[ObjectBox] = []
    known = _has_box(objects)
    for object_id in np.unique(objects.object_id[known]):
        rows = np.flatnonzero(known & (objects.object_id == object_id))
        for stretch in _rigid_stretches(objects, rows):
            Ts = objects.Ts_world_object[stretch]
            best = _fullest(objects, stretch)
            T_object_box = invert_T(objects.Ts_world_object[best]) @ _T_world_box(objects, best)
            boxes += [
                _box(objects, row, orthonormalise(T @ T_object_box), objects.extents_m[best])
                for row, T in zip(stretch.tolist(), Ts, strict=True)
            ]
    return boxes


def _has_box(objects: ObjectEstimates) -> NDArray[np.bool_]:
    """Which rows have a place worth showing; where no motion is known, depth is poor as well."""
    return (
        (objects.state != str(ObjectState.UNKNOWN))
        & np.isfinite(objects.Ts_world_object).all((1, 2))
        & np.isfinite(objects.centers_m).all(1)
        & np.isfinite(objects.extents_m).all(1)
    )


def _T_world_box(objects: ObjectEstimates, row: int) -> Array:
    return make_T(objects.Ts_world_object[row, :3, :3], objects.centers_m[row])


def _box(objects: ObjectEstimates, row: int, T_world_box: Array, size_m: Array) -> ObjectBox:
    if objects.class_name[row] in LARGEST_M:  # these stand on the ground, whatever noise says
        T_world_box = make_T(_upright(T_world_box[:3, :3]), T_world_box[:3, 3])
    across_m, high_m = LARGEST_M.get(str(objects.class_name[row]), LARGEST_OF_OTHERS_M)
    size_m = np.clip(size_m, SMALLEST_SIDE_M, (across_m, high_m, across_m))
    return ObjectBox(
        int(objects.object_id[row]), T_world_box, size_m,
        str(objects.state[row]), label_text(objects, row), row,
    )  # fmt: skip


def _upright(R: Array) -> Array:
    """The rotation (3, 3) whose y axis is the world's, and whose x axis is nearest to that of R."""
    level = R * [[1.0], [0.0], [1.0]]
    x = level[:, 0] if np.linalg.norm(level[:, 0]) > 0.5 else np.cross((0.0, 1.0, 0.0), level[:, 2])
    x = x / np.linalg.norm(x)
    return np.column_stack([x, (0.0, 1.0, 0.0), np.cross(x, (0.0, 1.0, 0.0))])


def _rigid_stretches(objects: ObjectEstimates, rows: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """One object's rows in pieces over which its pose only moves with its matter."""
    Ts = objects.Ts_world_object[rows]
    Hs = objects.Hs_world_curr_prev[rows[1:]]
    moved = np.where(np.isfinite(Hs).all((1, 2))[:, None, None], Hs, np.eye(4))
    turned_deg = rotation_angle_deg(invert_T(moved @ Ts[:-1]) @ Ts[1:])
    return np.split(rows, np.flatnonzero(turned_deg > _TURNED_DEG) + 1)


def _fullest(objects: ObjectEstimates, rows: NDArray[np.int64]) -> int:
    """The last row of those at which the object is about as large as it ever was known to be."""
    volume = objects.extents_m[rows].prod(axis=1)
    return int(rows[np.flatnonzero(volume >= 0.9 * volume.max())[-1]])
