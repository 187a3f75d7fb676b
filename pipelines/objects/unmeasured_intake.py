"""What becomes of objects whose motion a frame does not tell: in sight, coasting, or forgotten.

Owns their states and rows. Those with a motion are taken by `motion_intake`.
"""

from __future__ import annotations

from collections.abc import Set

import numpy as np

from pipelines.config import ObjectsConfig
from pipelines.frontend.sensor import Sensor
from pipelines.frontend.view import View
from pipelines.geometry import transform_points
from pipelines.object_types import ObjectState
from pipelines.objects.frame import ObjectFrame
from pipelines.objects.instances import middle_of_pixels, some_pixels
from pipelines.objects.rows import RowTable
from pipelines.objects.track import ObjectTrack
from pipelines.types import Array

_MOSTLY_SEEN = 0.6  # of its last mask, below which a mask does not say where an object is


class UnmeasuredIntake:
    """Takes what a frame shows of objects without a motion in it."""

    def __init__(
        self,
        sensor: Sensor,
        config: ObjectsConfig,
        view: View,
        frame: ObjectFrame,
        T_world_camera: Array,
    ) -> None:
        self.sensor, self.config, self._view, self._frame = sensor, config, view, frame
        self._T_world_camera = T_world_camera

    def take(
        self,
        tracks: dict[int, ObjectTrack],
        measured_ids: Set[int],
        dt_s: float,
        table: RowTable,
    ) -> None:
        """All tracks but the measured ones, `dt_s` after the last frame; the forgotten are removed.

        Masks that were carried on, and that no motion bears out, leave the frame.
        """
        frame, t = self._frame, self._view.timestamp_s
        for object_id, track in list(tracks.items()):
            carried = object_id in frame.carried_ids
            if carried and frame.answered and object_id not in measured_ids:
                frame.remove(object_id)  # no detection and no motion bears it out
            in_sight = object_id in frame.windows
            if in_sight:
                track.seen_s = t
            if object_id in measured_ids:
                continue
            track.coast(dt_s)
            if in_sight:
                self._see(track, table)
            elif t - track.seen_s > self.config.max_age_s or track.filter is None:
                del tracks[object_id]
            elif track.state in (ObjectState.MOVING, ObjectState.COASTING) or track.surely_moves:
                track.set_state(ObjectState.COASTING, t)
                center = track.filter.center_m + track.middle_offset_m
                table.add(track, np.nan, center_m=center, box_px=np.full(4, np.nan))

    def _see(self, track: ObjectTrack, table: RowTable) -> None:
        """Too small, too far, or too uncertain: where it is may still be known."""
        frame, view = self._frame, self._view
        v, u = some_pixels(frame.labels, track.object_id, frame.windows[track.object_id])
        center = middle_of_pixels(
            self.sensor.camera, view.disparity_px, v, u, self.sensor.min_disparity_px
        )
        center = transform_points(self._T_world_camera, center[None])[0]
        n_pixels = np.count_nonzero(frame.mask(track.object_id))
        if np.isfinite(center).all() and n_pixels >= _MOSTLY_SEEN * track.area_px:
            track.take_center(center)  # else something is passing before it
        if track.state is not ObjectState.STOPPED or not track.is_anchored:
            track.set_state(ObjectState.UNKNOWN, view.timestamp_s)
        table.add(track, frame.scores[track.object_id], center_m=center)
