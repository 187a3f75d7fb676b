"""Points that the map holds twice, as a place was mapped again before it was recognised.

Owns the search for such pairs around a loop. Changes nothing: see `mapping.fusion`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.backend.keyframe_sightings import KeyframeSightings
from pipelines.backend.point_tracks import Index
from pipelines.frontend.matching import hamming_distance, match_in_radius
from pipelines.geometry import (
    MIN_DEPTH_M,
    inside_image,
    invert_T,
    project_stereo,
    transform_points,
)
from pipelines.types import Array, StereoCamera

_MAX_HAMMING = 64
_SEARCH_PX = 8.0  # around the projection of an old point: the loop is closed to some pixels
_SAME_PX = 3.0  # two points of one keyframe nearer than this may be one, others are two
_SAME_DEPTH = 0.15  # relative difference of the depths of one point

Pairs = NDArray[np.int64]  # (P, 2) of point ids: the old one, and its double


@dataclass(frozen=True, slots=True)
class _View:
    """A recent keyframe: its T_world_camera (4, 4), the points that it sees, and where they are."""

    T: Array
    ids: Index
    uv_px: Array


def find_duplicates(
    seen: KeyframeSightings,
    positions_m: Array,
    descriptors: NDArray[np.uint8],
    recent: Index,
    place: Index,
) -> Pairs:
    """Pairs (P, 2) of an old point and one that recent keyframes took for new; each is in one pair.

    positions_m (N, 3), descriptors (N, 32): of all points by their ids. recent, place: views of
    `seen`, of the keyframes on both sides of the loop. The map must be right there to some pixels.
    """
    old = np.unique(seen.point_ids[np.isin(seen.view, place)])
    found = [np.empty((0, 2), np.int64)]
    for k in recent.tolist():
        rows = np.flatnonzero(seen.view == k)
        view = _View(seen.Ts_world_camera[k], seen.point_ids[rows], seen.uv_px[rows])
        pairs = np.concatenate(
            [
                _by_projection(seen.camera, view, old, positions_m, descriptors),
                _side_by_side(view, old, descriptors),
            ]
        )
        depth_m = (positions_m[pairs] - view.T[:3, 3]) @ view.T[:3, 2]
        off_m = np.abs(depth_m[:, 0] - depth_m[:, 1])
        found.append(pairs[off_m <= _SAME_DEPTH * np.abs(depth_m[:, 0])])
    return _without_contradictions(seen, _most_voted(np.concatenate(found)))


def _by_projection(
    camera: StereoCamera, view: _View, old: Index, positions_m: Array, descriptors: NDArray
) -> Pairs:
    """Old points that a keyframe should see, matched with what it sees there instead."""
    ids = np.setdiff1d(old, view.ids)
    local = transform_points(invert_T(view.T), positions_m[ids])
    front = local[:, 2] > MIN_DEPTH_M
    ids, uv = ids[front], project_stereo(camera, local[front])[:, :2]
    inside = inside_image(camera, uv)
    ids, uv = ids[inside], uv[inside]
    new = np.flatnonzero(~np.isin(view.ids, old))
    if len(ids) == 0 or len(new) == 0:
        return np.empty((0, 2), np.int64)
    a, b = match_in_radius(
        uv,
        descriptors[ids],
        view.uv_px[new],
        descriptors[view.ids[new]],
        _SEARCH_PX,
        _MAX_HAMMING,
    )
    return np.column_stack([ids[a], view.ids[new[b]]])


def _side_by_side(view: _View, old: Index, descriptors: NDArray) -> Pairs:
    """Old points that a keyframe does see, and new ones that it sees in the same place."""
    is_old = np.isin(view.ids, old)
    known, new = np.flatnonzero(is_old), np.flatnonzero(~is_old)
    if len(known) == 0 or len(new) == 0:
        return np.empty((0, 2), np.int64)
    distance, nearest = cKDTree(view.uv_px[known]).query(
        view.uv_px[new], distance_upper_bound=_SAME_PX
    )
    near = np.isfinite(distance)
    a, b = view.ids[known[nearest[near]]], view.ids[new[near]]
    alike = hamming_distance(descriptors[a], descriptors[b]) <= _MAX_HAMMING
    return np.column_stack([a[alike], b[alike]])


def _most_voted(votes: Pairs) -> Pairs:
    """Each point's pair with most votes, where that is both points' choice."""
    pairs, n = np.unique(votes, axis=0, return_counts=True)
    pairs = pairs[np.argsort(-n, kind="stable")]
    first = np.ones(len(pairs), bool)
    for column in pairs.T:
        best = np.zeros(len(pairs), bool)
        best[np.unique(column, return_index=True)[1]] = True
        first &= best
    return pairs[first]


def _without_contradictions(seen: KeyframeSightings, pairs: Pairs) -> Pairs:
    """The pairs that no keyframe sees as two points apart."""
    n = int(max(seen.point_ids.max(initial=0), pairs.max(initial=0))) + 1
    partner = np.full(n, -1)
    partner[pairs[:, 1]] = np.arange(len(pairs))
    rows = np.flatnonzero(partner[seen.point_ids] >= 0)
    pair = partner[seen.point_ids[rows]]
    key = seen.view * n + seen.point_ids
    order = np.argsort(key, kind="stable")
    wanted = seen.view[rows] * n + pairs[pair, 0]
    place = np.minimum(np.searchsorted(key[order], wanted), max(len(key) - 1, 0))
    other = order[place]
    both = key[other] == wanted
    far = np.linalg.norm(seen.uv_px[rows] - seen.uv_px[other], axis=1) > _SAME_PX
    return np.delete(pairs, pair[both & far], axis=0)
