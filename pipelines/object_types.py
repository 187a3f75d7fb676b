"""The nouns of moving objects: what a detector sees, and what the tracker says of each object.

Owns shapes, units and frames, as `types` does for the camera. Imports numpy alone.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.shapes import check_shape

Array = NDArray[np.floating[Any]]
UNNAMED_CLASS = "object"  # of an instance whose class nobody knows


class ObjectState(StrEnum):
    """What is known of an object's motion in a frame."""

    MOVING = "moving"
    STOPPED = "stopped"  # measured, and slow enough to be still
    UNKNOWN = "unknown"  # too few points, too far, or too uncertain to say
    COASTING = "coasting"  # not seen: predicted by its filter


@dataclass(frozen=True, slots=True)
class Detections:
    """Instances of movable classes in one image (M instances on an image of H x W).

    labels: (H, W) int32, 0 = background, else one of `label_ids`; a pixel belongs to one instance.
    label_ids: (M,) int32, > 0, each once; one of them may have no pixel left. class_names: (M,)
    str. scores: (M,) float64, 0 to 1.
    """

    labels: NDArray[np.int32]
    label_ids: NDArray[np.int32]
    class_names: NDArray[np.str_]
    scores: Array

    def __post_init__(self) -> None:
        M = len(self.label_ids)
        check_shape("Detections", "labels", self.labels, (None, None))
        for name in ("label_ids", "class_names", "scores"):
            check_shape("Detections", name, getattr(self, name), (M,))

    def __len__(self) -> int:
        return len(self.label_ids)

    @classmethod
    def empty(cls, shape: tuple[int, ...]) -> Detections:
        """No instance on an image of (H, W) = shape[:2]."""
        none = np.empty(0, np.int32)
        labels = np.zeros(shape[:2], np.int32)
        return cls(labels, none, np.empty(0, "U16"), np.empty(0))


@dataclass(frozen=True, slots=True)
class ObjectEstimates:
    """Objects in one frame or in many, one row per object and frame (parallel arrays of length M).

    frame_index: (M,) int64. timestamp_s: (M,). object_id: (M,) int64, lasting. class_name: (M,)
    str. score: (M,) of the detection, 0 where the mask was carried by flow, NaN where coasting.
    state: (M,) str, values of `ObjectState`.
    boxes_px: (M, 4) x1 y1 x2 y2, first and last pixel columns and rows; NaN where not seen.
    n_points: (M,) int64, points that agree with the motion.
    Ts_world_object: (M, 4, 4), L: begins with the world's axes at the centre of the
        object's points, and then moves with it; its x axis lies along its motion where it moves
        from the start; NaN where unknown.
    Hs_world_curr_prev: (M, 4, 4), p_world_curr = H @ p_world_prev for matter of the object, since
        the frame before; NaN where there is none.
    motion_covariances: (M, 6, 6) of [omega rad, v m], a left perturbation of H about the object's
        centre, in world axes; NaN where there is no H.
    centers_m: (M, 3) the object's centre in the world. speed_mps, speed_std_mps: (M,) of that
        centre by eq. (6) of the paper from this frame's H alone; NaN where there is none.
    velocities_mps: (M, 3) and velocity_std_mps: (M,), along the velocity, of the Kalman filter;
        NaN before a motion of the object was measured.
    extents_m: (M, 3) size of the box around the object's points, along the object's axes.
    """

    frame_index: NDArray[np.int64]
    timestamp_s: Array
    object_id: NDArray[np.int64]
    class_name: NDArray[np.str_]
    score: Array
    state: NDArray[np.str_]
    boxes_px: Array
    n_points: NDArray[np.int64]
    Ts_world_object: Array
    Hs_world_curr_prev: Array
    motion_covariances: Array
    centers_m: Array
    speed_mps: Array
    speed_std_mps: Array
    velocities_mps: Array
    velocity_std_mps: Array
    extents_m: Array

    def __post_init__(self) -> None:
        M = len(self.frame_index)
        inner = {
            "boxes_px": (4,),
            "Ts_world_object": (4, 4),
            "Hs_world_curr_prev": (4, 4),
            "motion_covariances": (6, 6),
            "centers_m": (3,),
            "velocities_mps": (3,),
            "extents_m": (3,),
        }
        for field in fields(self):
            shape = (M, *inner.get(field.name, ()))
            check_shape("ObjectEstimates", field.name, getattr(self, field.name), shape)

    def __len__(self) -> int:
        return len(self.frame_index)

    def __getitem__(self, which: NDArray) -> ObjectEstimates:
        """The rows chosen by a boolean mask or an index array."""
        return ObjectEstimates(*(getattr(self, f.name)[which] for f in fields(self)))

    @property
    def smoothed_speed_mps(self) -> Array:
        """(M,) length of the filter's velocity."""
        return np.linalg.norm(self.velocities_mps, axis=1)

    @classmethod
    def empty(cls) -> ObjectEstimates:
        """No object at all."""
        none = np.empty(0)
        whole, text = np.empty(0, np.int64), np.empty(0, "U16")
        T, three = np.empty((0, 4, 4)), np.empty((0, 3))
        return cls(
            whole, none, whole, text, none, text, np.empty((0, 4)), whole, T, T,
            np.empty((0, 6, 6)), three, none, none, three, none, three,
        )  # fmt: skip

    @classmethod
    def concatenate(cls, *parts: ObjectEstimates) -> ObjectEstimates:
        """All rows, in their order."""
        if not parts:
            return cls.empty()
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))
