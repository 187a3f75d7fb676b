"""The rows of one frame's `ObjectEstimates`, added object by object.

Owns the defaults of what is not known. Computes nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from pipelines.object_types import ObjectEstimates, ObjectState
from pipelines.objects.track import ObjectTrack
from pipelines.types import Array


class RowTable:
    """Collects objects of one frame; `estimates` gives them in order of their ids."""

    def __init__(self, frame_index: int, timestamp_s: float) -> None:
        self._frame_index, self._timestamp_s = frame_index, timestamp_s
        self._rows: list[dict[str, Any]] = []

    def add(
        self,
        track: ObjectTrack,
        score: float,
        *,
        center_m: Array,
        n_points: int = 0,
        H_world_curr_prev: Array | None = None,
        motion_covariance: Array | None = None,
        speed_mps: float = np.nan,
        speed_std_mps: float = np.nan,
        box_px: Array | None = None,
        state: ObjectState | None = None,
    ) -> None:
        """One object as it is now. center_m: (3,) in the world, NaN where it has no depth."""
        T = track.T_world_object
        self._rows.append(
            {
                "object_id": track.object_id,
                "class_name": track.class_name,
                "score": score,
                "state": str(state or track.state),
                "box_px": track.box_px if box_px is None else box_px,
                "n_points": n_points,
                "T": np.full((4, 4), np.nan) if T is None else T,
                "H": np.full((4, 4), np.nan) if H_world_curr_prev is None else H_world_curr_prev,
                "covariance": (
                    np.full((6, 6), np.nan) if motion_covariance is None else motion_covariance
                ),
                "center": center_m,
                "speed": speed_mps,
                "speed_std": speed_std_mps,
                "velocity": track.velocity_at(center_m),
                "velocity_std": track.velocity_std_mps,
                "extent": track.extent_m,
            }
        )

    def estimates(self) -> ObjectEstimates:
        """All rows as parallel arrays."""
        rows = sorted(self._rows, key=lambda row: row["object_id"])
        if not rows:
            return ObjectEstimates.empty()
        M = len(rows)

        def column(name: str, dtype: type | None = None) -> Any:
            return np.array([row[name] for row in rows], dtype)

        return ObjectEstimates(
            np.full(M, self._frame_index, np.int64),
            np.full(M, self._timestamp_s),
            column("object_id", np.int64),
            column("class_name", str),
            column("score", float),
            column("state", str),
            column("box_px", float),
            column("n_points", np.int64),
            column("T", float),
            column("H", float),
            column("covariance", float),
            column("center", float),
            column("speed", float),
            column("speed_std", float),
            column("velocity", float),
            column("velocity_std", float),
            column("extent", float),
        )
