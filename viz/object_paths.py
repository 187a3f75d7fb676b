"""Paths in space: lines with gaps where frames are missing, and those of moving objects.

Owns which part of an object's life is a path, and what stands at its end. Draws nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.geometry import invert_T
from pipelines.object_types import ObjectEstimates, ObjectState
from pipelines.types import Array, ObjectTruth
from viz import style
from viz.object_marks import KMH, speed_words

GAP_FACTOR = 1.5  # median frame intervals; a longer one breaks the drawn path
OBJECT_GAP_S = 0.6  # of an object, which may be hidden for some frames
MIN_MOVING_FRAMES = 5  # fewer are no path
MIN_PATH_M = 0.5
LAST_SPEEDS = 5  # frames whose median speed stands at the end of a path


@dataclass(frozen=True, slots=True)
class Polyline:
    """Connected points (N, 3) in metres, drawn `width_px` wide; with a label, in the legend."""

    points_m: Array
    color: style.Color
    width_px: float
    label: str = ""


@dataclass(frozen=True, slots=True)
class Tag:
    """A few words at a point (3,) in metres, beside a disc of that colour."""

    point_m: Array
    text: str
    color: style.Color


def split_at_gaps(timestamps_s: Array, points_m: Array) -> list[Array]:
    """The path (N, 3) in pieces that end where frames are missing in time."""
    if len(points_m) < 2:
        return [points_m] if len(points_m) else []
    steps_s = np.diff(timestamps_s)
    breaks = np.flatnonzero(steps_s > GAP_FACTOR * np.median(steps_s)) + 1
    return np.split(points_m, breaks)


def object_paths(objects: ObjectEstimates) -> tuple[list[Polyline], list[Tag]]:
    """Where the centres of moving objects went, in their lasting colours, with their last speeds.

    A path is drawn where its object was seen moving; it breaks where that was not so for long.
    """
    lines: list[Polyline] = []
    tags: list[Tag] = []
    moving = objects.state == str(ObjectState.MOVING)
    moving &= np.isfinite(objects.centers_m).all(axis=1)
    for object_id in np.unique(objects.object_id[moving]):
        own = objects[np.flatnonzero(moving & (objects.object_id == object_id))]
        spread_m = np.linalg.norm(np.ptp(own.centers_m, axis=0))
        if len(own) < MIN_MOVING_FRAMES or spread_m < MIN_PATH_M:
            continue
        color = style.object_color(int(object_id))
        breaks = np.flatnonzero(np.diff(own.timestamp_s) > OBJECT_GAP_S) + 1
        pieces = [own[rows] for rows in np.split(np.arange(len(own)), breaks) if len(rows) > 1]
        lines += [Polyline(_path_of(piece), color, 2.6, "moving objects") for piece in pieces]
        speeds = KMH * own.speed_mps[-LAST_SPEEDS:]
        words = f"{object_id} {own.class_name[-1]}"
        if np.isfinite(speeds).any():
            words += f" {speed_words(float(np.nanmedian(speeds)))}"
        tags.append(Tag(own.centers_m[-1], words, color))
    return lines, tags


def true_object_paths(truth: ObjectTruth) -> list[Array]:
    """Where the origins of true objects that ever move went, (N, 3) each, in pieces at gaps."""
    paths: list[Array] = []
    for object_id in np.unique(truth.object_id[truth.moving]):
        rows = np.flatnonzero(truth.object_id == object_id)
        rows = rows[np.argsort(truth.frame_index[rows], kind="stable")]
        origins = truth.Ts_world_object[rows, :3, 3]
        known = np.isfinite(origins).all(axis=1)
        pieces = split_at_gaps(truth.frame_index[rows][known].astype(float), origins[known])
        paths += [piece for piece in pieces if len(piece) > 1]
    return paths


def _path_of(rows: ObjectEstimates) -> Array:
    """Where one point of an object's matter went, (N, 3): its centre as it is known in the end.

    The centre of what is seen wanders through the object while more and more of it is seen.
    """
    Ts = rows.Ts_world_object
    if not np.isfinite(Ts).all():
        return rows.centers_m
    return (Ts @ invert_T(Ts[-1]) @ np.append(rows.centers_m[-1], 1.0))[:, :3]
