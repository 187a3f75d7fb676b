"""The static map and the frames of a run that goes on, as they are known by now.

Owns how both follow when the back-end moves keyframes: frames hang on the last keyframe of their
time, and each point on the frame that last saw it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.frame_observations import STATIC, FrameObservations
from pipelines.geometry import invert_T
from pipelines.types import Array, FrameResult, Image, TrackingStatus
from viz.boxes import ObjectBox, frame_boxes
from viz.scene import near_path

_MOVED = 1e-6  # of a pose's numbers; less is no correction


@dataclass(slots=True)
class LiveFrame:
    """A frame as it came. keyframe: how many of the run's keyframes there were by then."""

    index: int
    timestamp_s: float
    is_tracked: bool
    T_world_camera: Array
    boxes: list[ObjectBox]
    keyframe: int


class LiveFrames:
    """All frames so far, and where they are now."""

    def __init__(self) -> None:
        self.list: list[LiveFrame] = []
        self.position: dict[int, int] = {}  # of a frame in the list, by its index
        self._keyframes: list[int] = []  # their frames' indices
        self._keyframe_Ts: list[Array] = []

    def add(self, result: FrameResult) -> LiveFrame:
        """Take one more; where it is LOST, the camera stays where it was last measured."""
        is_tracked = result.status is TrackingStatus.OK
        T = result.T_world_camera
        if not is_tracked and self.list:
            T = self.list[-1].T_world_camera
        if result.is_keyframe:
            self._keyframes.append(result.frame_index)
            self._keyframe_Ts.append(T)
        frame = LiveFrame(
            result.frame_index,
            result.timestamp_s,
            is_tracked,
            T,
            frame_boxes(result.objects),
            len(self._keyframe_Ts),
        )
        self.position[frame.index] = len(self.list)
        self.list.append(frame)
        return frame

    def follow(self, frame_index: NDArray[np.int64], Ts_world_camera: Array) -> bool:
        """Move frames and boxes with the keyframes: (K,) their frames, (K, 4, 4) where they are.

        Those of a loaded map come first and are passed over, as is one of a frame yet to come.
        False where none has moved by anything worth telling.
        """
        n, end = len(self._keyframes), len(frame_index)
        while n and end and frame_index[end - 1] != self._keyframes[-1]:
            end -= 1
        if n == 0 or end < n:
            return False
        now = Ts_world_camera[end - n : end]
        Cs = now @ invert_T(np.array(self._keyframe_Ts))
        if np.abs(Cs - np.eye(4)).max() < _MOVED:
            return False
        for frame in self.list:
            C = Cs[max(frame.keyframe - 1, 0)]
            frame.T_world_camera = C @ frame.T_world_camera
            frame.boxes = [replace(b, T_world_box=C @ b.T_world_box) for b in frame.boxes]
        self._keyframe_Ts = list(now)
        return True

    @property
    def Ts_world_camera(self) -> Array:
        """(F, 4, 4) of all frames."""
        return np.array([f.T_world_camera for f in self.list]).reshape(-1, 4, 4)


class LiveMap:
    """Static points by their lasting numbers, each in the camera of the frame that last saw it."""

    def __init__(self, min_sightings: int) -> None:
        self.min_sightings = min_sightings
        self.changed = False
        self._in_camera_m = np.empty((0, 3))
        self._frame = np.empty(0, np.int64)  # position in the frames
        self._color = np.empty((0, 3), np.uint8)
        self._n_seen = np.empty(0, np.int64)

    def add(self, seen: FrameObservations, frames: LiveFrames, image: Image) -> None:
        """Take what a frame saw of the static world; the colours come from its image."""
        sights = seen.sightings
        at = np.array([frames.position.get(int(i), -1) for i in sights.frame_index], np.int64)
        good = (sights.object_id == STATIC) & np.isfinite(sights.position_m).all(1) & (at >= 0)
        ids = sights.track_id[good]
        if len(ids) == 0:
            return
        self._grow(int(ids.max()) + 1)
        self._in_camera_m[ids] = sights.position_m[good]
        self._frame[ids] = at[good]
        self._n_seen[ids] += 1
        here = good & (sights.frame_index == seen.frame_index)
        self._color[sights.track_id[here]] = _colors(image, sights.uv_px[here])
        self.changed = True

    def cloud(self, Ts_world_camera: Array) -> tuple[Array, NDArray[np.uint8]]:
        """Points (N, 3) in the world and colours of those seen often enough and no strays."""
        self.changed = False
        ids = np.flatnonzero(self._n_seen >= self.min_sightings)
        if len(ids) == 0:
            return np.empty((0, 3)), np.empty((0, 3), np.uint8)
        Ts = Ts_world_camera[self._frame[ids]]
        points = np.einsum("nij,nj->ni", Ts[:, :3, :3], self._in_camera_m[ids]) + Ts[:, :3, 3]
        keep = near_path(points, Ts_world_camera[:, :3, 3])
        return points[keep], self._color[ids[keep]]

    def _grow(self, size: int) -> None:
        if size <= len(self._n_seen):
            return
        more = max(size - len(self._n_seen), len(self._n_seen))
        self._in_camera_m = np.vstack([self._in_camera_m, np.zeros((more, 3))])
        self._frame = np.append(self._frame, np.zeros(more, np.int64))
        self._color = np.vstack([self._color, np.full((more, 3), 128, np.uint8)])
        self._n_seen = np.append(self._n_seen, np.zeros(more, np.int64))


def _colors(image: Image, uv_px: Array) -> NDArray[np.uint8]:
    """(N, 3) of the nearest pixels."""
    u = np.clip(np.rint(uv_px[:, 0]).astype(np.int64), 0, image.shape[1] - 1)
    v = np.clip(np.rint(uv_px[:, 1]).astype(np.int64), 0, image.shape[0] - 1)
    values = image[v, u]
    return np.repeat(values[:, None], 3, 1) if values.ndim == 1 else values
