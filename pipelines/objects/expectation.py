"""Where objects are expected in a view if all goes on as before, and their points followed there.

Owns the motions that tracks and the camera lead to between two views. Keeps nothing; how a point
is measured is in `following`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.frontend.sensor import Sensor
from pipelines.frontend.view import View
from pipelines.geometry import MIN_DEPTH_M, invert_T, project_stereo
from pipelines.objects.following import Followed, follow_points
from pipelines.objects.frame import LastObjects
from pipelines.objects.motion import move_points
from pipelines.objects.points import ObjectPoints
from pipelines.objects.track import ObjectTrack
from pipelines.types import Array

_SURE_SPEED_MPS = 1.0  # m/s, standard deviation of a speed by which points may be expected


@dataclass(frozen=True, slots=True)
class Expectation:
    """What leads from the last frame to a view.

    tracks: of all objects, by id. T_world_camera: (4, 4) of the view, as expected or known.
    """

    sensor: Sensor
    tracks: Mapping[int, ObjectTrack]
    last: LastObjects
    view: View
    T_world_camera: Array

    def motions(self, ids: NDArray[np.int64]) -> Array:
        """(J, 4, 4) motions G of objects from the last camera to this one."""
        dt_s = self.view.timestamp_s - self.last.view.timestamp_s
        T_curr_world = invert_T(self.T_world_camera)
        Hs = [self.tracks[int(i)].predicted_motion(dt_s) for i in ids]
        return np.stack([T_curr_world @ H @ self.last.T_world_camera for H in Hs])

    def follow(self, points: ObjectPoints) -> Followed:
        """Where points of the last view are now, expected where their objects' motion leads."""
        if len(points) == 0:
            return Followed.empty()
        ids, _ = points.groups()
        known = np.array([_is_predictable(self.tracks[int(i)]) for i in ids])
        known |= self.view.flow_prev_to_curr_px is None
        return self.follow_by(points, self.motions(ids), known)

    def follow_by(self, points: ObjectPoints, Gs: Array, known: NDArray[np.bool_]) -> Followed:
        """The same by motions Gs (J, 4, 4); `known` (J,) says of which objects they are."""
        _, sizes = points.groups()
        moved = move_points(Gs, points.position_m, sizes)
        front = (moved[:, 2] > MIN_DEPTH_M) & np.repeat(known, sizes)
        expected = np.full((len(points), 2), np.nan)
        expected[front] = project_stereo(self.sensor.camera, moved[front])[:, :2]
        return follow_points(self.last.view, self.view, points.uv_px, expected, self.sensor.noise)


def _is_predictable(track: ObjectTrack) -> bool:
    if track.H_world_curr_prev is not None:
        return True
    return track.filter is not None and track.filter.speed_std_mps < _SURE_SPEED_MPS
