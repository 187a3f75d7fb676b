"""Where the points of the last frame are in a view.

Owns the search for them by flow, by ORB descriptors and by patch alignment. Estimates no pose; the
points of the local map are for `map_search`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.config import TrackingConfig
from pipelines.frontend.alignment import align_patches, fuse_measurements, is_precise
from pipelines.frontend.matching import match_in_radius
from pipelines.frontend.sampling import sample_bilinear
from pipelines.frontend.sensor import Sensor
from pipelines.frontend.view import View
from pipelines.geometry import MIN_DEPTH_M, invert_T, project_stereo, transform_points
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.patches import Patches
from pipelines.types import Array, StereoCamera

_ALIGNMENT_TOLERANCE_PX = 10.0  # alignment may move a point this far from an ORB match
_DRIFT_PX = 2.0  # a place this far from where the start, or the last frame, has it is another one
_NEIGHBOURS = 5  # matched points that predict the place of an unmatched one


@dataclass(frozen=True, slots=True)
class LastFrame:
    """What the next frame is tracked from.

    view: the last one that was tracked. tracks: the points seen in it. flow_starts_here: whether
    the next frame's flow begins at it. patches: how the tracks' points looked at first.
    """

    view: View
    tracks: Tracks
    flow_starts_here: bool = True
    patches: Patches = field(default_factory=Patches.empty)


@dataclass(frozen=True, slots=True)
class Measurement:
    """Where the last frame's points are now, with each source's own say for learning its noise.

    sources_px: name of the source -> (N, 2) places, NaN where it had nothing to say.
    """

    tracks: Tracks
    sources_px: dict[str, Array]


def measure_points(
    last: LastFrame,
    view: View,
    sparse_map: SparseMap,
    T_world_camera: Array,
    sensor: Sensor,
    config: TrackingConfig,
) -> Measurement:
    """Where the points of the last frame are in this view.

    The start is the given flow where there is one, else ORB matches around the places that the
    predicted `T_world_camera` (4, 4) says. Alignment to each point's first sight makes it
    sub-pixel, and is fused with the flow by their learned noise.
    """
    flow_uv = _places_by_flow(last, view)
    start = _places_to_start(last, view, sparse_map, T_world_camera, flow_uv, config)
    by_flow = np.asarray(np.isfinite(flow_uv).all(axis=1))
    tolerance = config.flow_tolerance_px if by_flow.any() else _ALIGNMENT_TOLERANCE_PX
    tracks, sigma = last.tracks, sensor.noise.sigma_uv_px
    aligned, ok = np.full_like(flow_uv, np.nan), np.zeros(len(tracks), bool)
    do = np.flatnonzero(~(by_flow & is_precise(sigma["flow"], sigma["alignment"])))
    aligned[do], ok[do] = _align(
        replace(last, tracks=tracks[do]),
        view,
        start[do],
        by_flow[do],
        T_world_camera,
        sensor.camera,
        tolerance,
    )
    uv, valid, sigma_px = fuse_measurements(
        flow_uv, by_flow, sigma["flow"], aligned, ok, sigma["alignment"]
    )
    aligned[~ok] = np.nan
    valid &= view.is_static(uv) & np.isfinite(uv).all(axis=1)
    uv = uv[valid]
    return Measurement(
        Tracks(tracks.point_ids[valid], uv, sensor.read_close_disparity(view, uv), sigma_px[valid]),
        {"flow": flow_uv[valid], "alignment": aligned[valid]},
    )


def _align(
    last: LastFrame,
    view: View,
    start: Array,
    by_flow: NDArray[np.bool_],
    T_world_camera: Array,
    camera: StereoCamera,
    tolerance_px: float,
) -> tuple[Array, NDArray[np.bool_]]:
    """Places (N, 2) by the looks of the points when they were first seen, and which are valid.

    Where flow does not say to a pixel or two where to begin, or there is no such picture, they are
    aligned to the last frame before, or instead.
    """
    uv, rows = start.copy(), last.patches.rows(last.tracks.point_ids)
    ok = np.zeros(len(rows), bool)
    other = np.flatnonzero(~by_flow | (rows < 0))
    if len(other):
        uv_from = last.tracks.uv_px[other]
        placed, ok[other] = align_patches(
            last.view.gray, view.gray, uv_from, start[other], tolerance_px, by_flow[other]
        )
        uv[other[ok[other]]] = placed[ok[other]]
    which = np.flatnonzero((rows >= 0) & (ok | by_flow))
    Hs = last.patches.homographies(camera, rows[which], T_world_camera)
    use = last.patches.are_of_use(rows[which], Hs)
    which, Hs = which[use], Hs[use]
    for part, sheet, places in last.patches.sheets(rows[which], Hs, view.gray.shape):
        own = which[part]
        sure = np.ones(len(own), bool)
        placed, found = align_patches(sheet, view.gray, places, uv[own], _DRIFT_PX, sure)
        uv[own[found]], ok[own[found]] = placed[found], True
    return uv, ok


def _places_by_flow(last: LastFrame, view: View) -> Array:
    """Places (N, 2) that the given flow says, NaN where there is none."""
    uv = last.tracks.uv_px
    flow = view.flow_prev_to_curr_px if view.flow_is_given else None
    if flow is None or not last.flow_starts_here or len(uv) == 0:
        return np.full((len(uv), 2), np.nan)
    return uv + sample_bilinear(flow, uv)


def _places_to_start(
    last: LastFrame,
    view: View,
    sparse_map: SparseMap,
    T_world_camera: Array,
    flow_uv: Array,
    config: TrackingConfig,
) -> Array:
    """Start (N, 2) of the alignment: flow, else ORB matches, else as matched neighbours go."""
    start = flow_uv.copy()
    missing = np.flatnonzero(~np.isfinite(flow_uv).all(axis=1))
    if len(missing) == 0:
        return start
    ids = last.tracks.point_ids[missing]
    points = transform_points(invert_T(T_world_camera), sparse_map.position_m[ids])
    front = points[:, 2] > MIN_DEPTH_M
    missing, ids, points = missing[front], ids[front], points[front]
    predicted = project_stereo(sparse_map.camera, points)[:, :2]
    start[missing] = predicted
    matched, features = match_in_radius(
        predicted,
        sparse_map.descriptor[ids],
        view.features.uv_px,
        view.features.descriptors,
        config.search_radius_px,
        config.max_hamming,
    )
    if len(matched) < 2 * _NEIGHBOURS:
        return start
    shift = view.features.uv_px[features] - predicted[matched]
    unmatched = np.setdiff1d(np.arange(len(missing)), matched)
    if len(unmatched):
        _, nearest = cKDTree(predicted[matched]).query(predicted[unmatched], k=_NEIGHBOURS)
        start[missing[unmatched]] += np.median(shift[nearest], axis=1)
    start[missing[matched]] += shift
    return start
