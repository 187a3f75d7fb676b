"""Detections of a frame given lasting ids, and masks of what was missed carried on; step 7.

Owns the evidence for each pair of object and detection, and the painting of ids. The assignment
itself is in `association`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pipelines.config import ObjectsConfig
from pipelines.geometry import transform_points
from pipelines.objects.association import (
    Candidates,
    assign,
    box_overlap,
    color_distance,
    count_votes,
    same_kind,
)
from pipelines.objects.following import Followed
from pipelines.objects.frame import LastObjects
from pipelines.objects.instances import Instances, carry_mask
from pipelines.objects.points import ObjectPoints, Window, tight_window
from pipelines.objects.track import ObjectTrack
from pipelines.types import Array

_MIN_CARRIED_POINTS = 6  # tracked points without which a mask is not carried on
_MIN_CARRIED_SHARE = 0.3  # of a carried mask that no detection may cover
_COLOR_NOISE = 0.5  # Hellinger distance of like things, times the root of the pixels compared


def identify(
    tracks: Mapping[int, ObjectTrack],
    instances: Instances,
    points: ObjectPoints,
    followed: Followed,
    T_world_camera: Array,
) -> dict[int, int]:
    """Which of the tracks is which instance: object id -> row of `instances`.

    points, followed: tracked points of the objects and where they are now. T_world_camera: (4, 4)
    as expected or known.
    """
    ids = list(tracks)
    row_of = {object_id: row for row, object_id in enumerate(ids)}
    usable = followed.valid & np.isin(points.object_id, ids)
    rows = np.array([row_of[int(i)] for i in points.object_id[usable]], np.int64)
    areas = np.array([tracks[i].area_px for i in ids], float)
    M = len(instances)
    votes, n_points = count_votes(rows, instances.labels, followed.uv_px[usable], areas, M)
    distance2, log_spread = _distances(
        tracks, transform_points(T_world_camera, instances.centers_m)
    )
    boxes = np.array([tracks[i].fresh_box_px for i in ids]).reshape(len(ids), 4)
    colors = np.array([tracks[i].color for i in ids]).reshape(len(ids), instances.colors.shape[1])
    away = color_distance(colors, instances.colors)
    away -= _COLOR_NOISE / np.sqrt(np.maximum(instances.n_colored, 1))  # few pixels differ anyway
    kinds = same_kind([tracks[i].class_name for i in ids], [str(n) for n in instances.class_names])
    found = assign(
        Candidates(
            votes,
            n_points,
            box_overlap(boxes, instances.boxes_px),
            distance2,
            log_spread,
            np.maximum(away, 0.0),
            kinds,
        )
    )
    return {i: int(m) for i, m in zip(ids, found, strict=True) if m >= 0}


def _distances(tracks: Mapping[int, ObjectTrack], centers_m: Array) -> tuple[Array, Array]:
    """Squared Mahalanobis distances (J, M) of centres (M, 3) in the world, and log-determinants."""
    J, M = len(tracks), len(centers_m)
    distance2, log_spread = np.full((J, M), np.inf), np.zeros((J, M))
    known = np.flatnonzero(np.isfinite(centers_m).all(axis=1))
    for j, track in enumerate(tracks.values()):
        if track.filter is None:
            continue
        noise = track.center_sigma_m**2 * np.eye(3)
        distance2[j, known], log_spread[j] = track.filter.distances2(
            centers_m[known], noise, track.middle_offset_m
        )
    return distance2, log_spread


def carry_missed(
    config: ObjectsConfig,
    track: ObjectTrack,
    last: LastObjects,
    followed: Followed,
    labels: NDArray[np.int32],
) -> Window | None:
    """Paint the last mask of an object where its points went and no detection is.

    followed: of all `last.points`. labels: (H, W), changed. Returns the mask's window, or None
    where it cannot be carried: missed for too long, too few points, or hidden by others.
    """
    before = last.mask(track.object_id)
    own = followed.valid & (last.points.object_id == track.object_id)
    if before is None or own.sum() < _MIN_CARRIED_POINTS:
        return None
    if track.missed_s > config.max_carried_s or track.unconfirmed_s > config.max_age_s:
        return None
    carried = carry_mask(*before, last.points.uv_px[own], followed.uv_px[own], labels.shape)
    if carried is None:
        return None
    mask, window = carried
    free = mask & (labels[window] == 0)
    if np.count_nonzero(free) < _MIN_CARRIED_SHARE * np.count_nonzero(mask):
        return None
    labels[window][free] = track.object_id
    rows, columns = tight_window(free)
    top, left = window[0].start, window[1].start
    return (
        slice(top + rows.start, top + rows.stop),
        slice(left + columns.start, left + columns.stop),
    )
