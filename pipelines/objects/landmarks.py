"""What stands still as a landmark of the camera: when it may be one, and what it leaves behind.

Owns which objects the camera must not rely on, and the points of the map that go with a parked car
which drives off. Whether a thing stands still is told by its track.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipelines.config import ObjectsConfig
from pipelines.frontend.tracking import TrackedFrame
from pipelines.frontend.view import View
from pipelines.mapping.sparse_map import SparseMap


class StandingObjects:
    """Objects that have long stood still: they may drive off, so they serve only where needed."""

    def __init__(self, config: ObjectsConfig, dilation_px: int) -> None:
        """dilation_px: by which masks grow, as in `View.masked`."""
        self.config, self.dilation_px = config, dilation_px
        self.ids: set[int] = set()  # that stood still when the last frame was done

    def hide_others(self, view: View, labels: NDArray[np.int32], standing: Iterable[int]) -> View:
        """The view without the objects that the camera must not rely on.

        labels: (H, W) ids of all objects, 0 where there is none. standing: ids of those that stand
        still by now.
        """
        column, row = np.rint(view.features.uv_px).astype(np.int64).T
        off_objects = np.mean(labels[row, column] == 0) if len(row) else 1.0
        if off_objects < self.config.landmarks_below:
            labels = np.where(np.isin(labels, list(standing)), 0, labels).astype(np.int32)
        return view.masked(labels, self.dilation_px)

    def driven_off(self, standing: Iterable[int]) -> set[int]:
        """Those that have stood still until now; `standing` are the ones that still do."""
        before, self.ids = self.ids, set(standing)
        return before - self.ids

    def forget_points(
        self,
        sparse_map: SparseMap,
        view: View,
        tracked: TrackedFrame,
        left_by: NDArray[np.int32],
    ) -> TrackedFrame:
        """Remove the points of the map where something has driven off; what is left of the tracks.

        left_by: (H, W), 0 but on what has driven off. Its mask is widened, as the points lie where
        the thing stood until now.
        """
        without = view.masked(left_by, self.dilation_px)
        ids, uv = sparse_map.local_points(tracked.T_world_camera, tracked.tracks.point_ids)
        ids = np.concatenate([ids, tracked.tracks.point_ids])
        uv = np.vstack([uv, tracked.tracks.uv_px])
        sparse_map.remove_points(ids[~without.is_static(uv)])
        alive = sparse_map.alive[tracked.tracks.point_ids]
        return replace(
            tracked,
            tracks=tracked.tracks[alive],
            inliers=tracked.inliers[alive],
            visible_ids=tracked.visible_ids[sparse_map.alive[tracked.visible_ids]],
        )
