"""A finished run frame by frame: where the camera and every object were, and the pictures of it.

Owns what the browser, the self-contained page and the video play. Draws nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.io import folder as names
from pipelines.io.observations import read_camera
from pipelines.io.result import Result
from pipelines.object_types import ObjectState
from pipelines.types import Array, StereoCamera
from viz.boxes import ObjectBox, run_boxes
from viz.object_paths import OBJECT_GAP_S
from viz.scene import Scene, build_scene

_PICTURES = (".png", ".jpg")


@dataclass(frozen=True, slots=True)
class Trail:
    """Where one object went in one go: frames (n,), positions in `Playback`, and (n, 3) middles."""

    object_id: int
    frames: NDArray[np.int64]
    points_m: Array


@dataclass(frozen=True, slots=True)
class Playback:
    """The F processed frames of a run, in order, and the scene that they are played in.

    frame_index, timestamps_s: (F,). Ts_world_camera: (F, 4, 4), the last measured pose where a
    frame was lost. is_tracked: (F,) bool. boxes: for each frame the objects in it. trails: of the
    objects that moved, drawn as far as the frame that is shown. pictures: the annotated frame of
    each, or None. camera: intrinsics, or None where the run recorded none. is_optimised: whether
    poses and speeds are those after the global batch; the pictures show what was known live.
    """

    scene: Scene
    frame_index: NDArray[np.int64]
    timestamps_s: Array
    Ts_world_camera: Array
    is_tracked: NDArray[np.bool_]
    boxes: tuple[tuple[ObjectBox, ...], ...]
    trails: tuple[Trail, ...]
    pictures: tuple[Path | None, ...]
    camera: StereoCamera | None
    is_optimised: bool = False

    def __len__(self) -> int:
        return len(self.frame_index)


def build_playback(result: Result) -> Playback:
    """All frames of a result folder; without any where nothing was tracked."""
    index, stamps = _frames(result)
    nearest = np.searchsorted(result.timestamps_s, stamps + 1e-6) - 1
    has_pose = len(result.timestamps_s) > 0
    kept = np.maximum(nearest, 0)
    Ts = result.Ts_world_camera[kept] if has_pose else np.tile(np.eye(4), (len(index), 1, 1))
    is_tracked = np.zeros(len(index), bool)
    if has_pose:
        is_tracked = (nearest >= 0) & (np.abs(result.timestamps_s[kept] - stamps) < 1e-6)
    position = {int(frame): k for k, frame in enumerate(index)}
    boxes: list[list[ObjectBox]] = [[] for _ in index]
    for box in run_boxes(result.objects):
        k = position.get(int(result.objects.frame_index[box.row]))
        if k is not None:
            boxes[k].append(box)
    return Playback(
        scene=build_scene(result),
        frame_index=index,
        timestamps_s=stamps,
        Ts_world_camera=Ts,
        is_tracked=is_tracked,
        boxes=tuple(tuple(row) for row in boxes),
        trails=tuple(_trails(boxes, stamps)),
        pictures=tuple(_picture(result.folder / names.FRAMES, frame) for frame in index),
        camera=_camera(result),
        is_optimised=bool(result.metrics.get("batch", {}).get("accepted", False)),
    )


def _frames(result: Result) -> tuple[NDArray[np.int64], Array]:
    """Index and stamp of each processed frame; of the tracked ones where timings.json is gone."""
    index = np.array(result.timings.get("frames_index", []), np.int64)
    stamps = np.array(result.timings.get("frames_timestamp_s", []), float)
    if len(index) and len(index) == len(stamps):
        return index, stamps
    return np.arange(len(result.timestamps_s)), np.asarray(result.timestamps_s, float)


def _trails(boxes: list[list[ObjectBox]], stamps: Array) -> list[Trail]:
    """Of each object that moved, its boxes' middles, in pieces where it was gone or set up anew."""
    moved = {b.object_id for row in boxes for b in row if b.state == str(ObjectState.MOVING)}
    seen: dict[int, list[tuple[int, Array]]] = {object_id: [] for object_id in sorted(moved)}
    for k, row in enumerate(boxes):
        for box in row:
            if box.object_id in moved:
                seen[box.object_id].append((k, box.T_world_box[:3, 3]))
    trails = []
    for object_id, places in seen.items():
        frames = np.array([k for k, _ in places], np.int64)
        points = np.array([point for _, point in places]).reshape(-1, 3)
        breaks = np.flatnonzero(np.diff(stamps[frames]) > OBJECT_GAP_S) + 1
        for rows in np.split(np.arange(len(frames)), breaks):
            if len(rows) > 1:
                trails.append(Trail(object_id, frames[rows], points[rows]))
    return trails


def _picture(folder: Path, frame: int) -> Path | None:
    paths = (folder / f"{frame:06d}{suffix}" for suffix in _PICTURES)
    return next((path for path in paths if path.exists()), None)


def _camera(result: Result) -> StereoCamera | None:
    folder = result.folder / names.OBSERVATIONS
    return read_camera(folder) if (folder / "camera.json").exists() else None
