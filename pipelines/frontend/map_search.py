"""Points of the local map found again in a view, which the last frame did not see.

Owns the search around the places where a pose puts them: by how they looked, where that is kept,
else by ORB descriptors. Estimates no pose.

Deviation: the paper has ORB features alone. Aligned patches are several times as precise, and need
no corner that is found twice: a path that returns is held by all that it saw there before.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.config import TrackingConfig
from pipelines.frontend.alignment import align_patches
from pipelines.frontend.matching import match_in_radius
from pipelines.frontend.sensor import Sensor
from pipelines.frontend.view import View
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.types import Array, Image

_TAKEN_PX = 3.0  # a feature this near a tracked point is that point
_NEAR_PX = 3.0  # alignment may move a place this far
_RECENT = 10  # keyframes; what came to sight in these was lost for a reason
_MOST = 600  # points that are looked for by their looks, those found most often first
_HALF = 8  # of the window that is compared
_MAX_LEEWAY_PX = 1.4  # of what is found; errors are about a third of it
_OFFSETS = np.arange(-_HALF, _HALF + 1, dtype=np.float32)


@dataclass(frozen=True, slots=True)
class FoundAgain:
    """Points of the local map in a view.

    tracks: the N that were found. by_looks: (N,) which of these were aligned to how they looked;
    the others are ORB features. visible_ids: (M,) of all that should be in view.
    """

    tracks: Tracks
    by_looks: NDArray[np.bool_]
    visible_ids: NDArray[np.int64]


def search_local_map(
    view: View,
    sparse_map: SparseMap,
    tracks: Tracks,
    T_world_camera: Array,
    sensor: Sensor,
    config: TrackingConfig,
) -> FoundAgain:
    """Points of the local map in this view.

    tracks: points already measured, which are not searched for, nor are their features taken.
    T_world_camera: (4, 4), good to some pixels. Paper, sections ORB Feature Extraction, Sparse Map.
    """
    ids, predicted = sparse_map.local_points(T_world_camera, tracks.point_ids)
    on_static = view.is_static(predicted)
    ids, predicted = ids[on_static], predicted[on_static]
    uv, by_orb = predicted.copy(), np.zeros(len(ids), bool)
    matched, places = _match_features(view, sparse_map, tracks, ids, predicted, config)
    uv[matched], by_orb[matched] = places, True
    has_looks = sparse_map.album.has(ids)
    has_looks &= sparse_map.first_keyframe[ids] < len(sparse_map.keyframes) - _RECENT
    by_looks = np.zeros(len(ids), bool)
    asked = np.flatnonzero(has_looks)
    asked = asked[np.argsort(-sparse_map.n_found[ids[asked]], kind="stable")[:_MOST]]
    if len(asked):
        aligned, alike = _align_to_looks(view, sparse_map, ids[asked], uv[asked], T_world_camera)
        uv[asked[alike]], by_looks[asked[alike]] = aligned[alike], True
    found = np.flatnonzero(by_looks | (by_orb & ~has_looks))
    found = found[view.is_static(uv[found])]
    by_looks, noise = by_looks[found], sensor.noise.sigma_uv_px
    sigma = np.where(by_looks, noise["looks"], noise["orb"])
    disparity = sensor.read_close_disparity(view, uv[found])
    return FoundAgain(Tracks(ids[found], uv[found], disparity, sigma), by_looks, ids)


def _match_features(
    view: View,
    sparse_map: SparseMap,
    tracks: Tracks,
    ids: NDArray[np.int64],
    predicted: Array,
    config: TrackingConfig,
) -> tuple[NDArray[np.int64], Array]:
    """Which of the points match a feature that no track has taken, and the places of these."""
    features = view.features
    if len(ids) == 0 or len(features) == 0:
        return np.empty(0, np.int64), np.empty((0, 2))
    free = np.arange(len(features))
    if len(tracks):
        distance, _ = cKDTree(tracks.uv_px).query(features.uv_px, distance_upper_bound=_TAKEN_PX)
        free = np.flatnonzero(~np.isfinite(distance))
    matched, chosen = match_in_radius(
        predicted,
        sparse_map.descriptor[ids],
        features.uv_px[free],
        features.descriptors[free],
        config.map_radius_px,
        config.max_hamming,
    )
    return matched, features.uv_px[free[chosen]]


def _align_to_looks(
    view: View,
    sparse_map: SparseMap,
    ids: NDArray[np.int64],
    start: Array,
    T_world_camera: Array,
) -> tuple[Array, NDArray[np.bool_]]:
    """Places (N, 2) of points with a patch, from a start (N, 2), and where they look like it."""
    uv, alike = start.copy(), np.zeros(len(ids), bool)
    patches = sparse_map.kept_patches(ids)
    rows = patches.rows(ids)
    Hs = patches.homographies(sparse_map.camera, rows, T_world_camera)
    use = np.flatnonzero(patches.are_of_use(rows, Hs))
    for part, sheet, places in patches.sheets(rows[use], Hs[use], view.gray.shape):
        own = use[part]
        sure = np.ones(len(own), bool)
        placed, found = align_patches(sheet, view.gray, places, start[own], _NEAR_PX, sure)
        good = np.flatnonzero(found)
        if len(good) == 0:
            continue
        patch, there = _windows(sheet, places[found]), _windows(view.gray, placed[found])
        good = good[_leeway_px(patch, there) < _MAX_LEEWAY_PX]
        uv[own[good]], alike[own[good]] = placed[good], True
    return uv, alike


def _windows(gray: Image, uv_px: Array) -> Array:
    """(N, 17, 17) grey values around pixels (N, 2)."""
    x = uv_px[:, 0, None, None].astype(np.float32) + _OFFSETS
    y = uv_px[:, 1, None, None].astype(np.float32) + _OFFSETS[:, None]
    x, y = (np.broadcast_to(a, (len(uv_px), len(_OFFSETS), len(_OFFSETS))) for a in (x, y))
    flat = (len(uv_px) * len(_OFFSETS), len(_OFFSETS))
    values = cv2.remap(gray, x.reshape(flat), y.reshape(flat), cv2.INTER_LINEAR)
    return values.reshape(x.shape).astype(np.float32)


def _leeway_px(a: Array, b: Array) -> Array:
    """(N,) how far windows a (N, H, W) could be shifted before they are less like b than they are.

    What is left between the two, but for brightness and contrast, over the weakest gradient: little
    where they are alike and where the window shows structure across every direction.
    """
    dy, dx = np.gradient(a, axis=(1, 2))
    xx, xy, yy = (np.mean(p * q, axis=(1, 2)) for p, q in ((dx, dx), (dx, dy), (dy, dy)))
    weakest = (xx + yy) / 2 - np.hypot((xx - yy) / 2, xy)
    a, b = (w - w.mean(axis=(1, 2), keepdims=True) for w in (a, b))
    aa, ab, bb = (np.mean(p * q, axis=(1, 2)) for p, q in ((a, a), (a, b), (b, b)))
    left = aa - np.maximum(ab, 0.0) ** 2 / np.maximum(bb, 1e-6)
    return np.sqrt(np.maximum(left, 0.0) / np.maximum(weakest, 1e-6))
