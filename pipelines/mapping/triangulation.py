"""New points from two views: far features and features without depth, by triangulation.

Owns the geometry and the checks of a two-view point: epipolar distance, parallax, reprojection
and scale. Pure functions; the map decides which keyframes to pair.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.config import MappingConfig
from pipelines.frontend.matching import hamming_distance
from pipelines.geometry import invert_T, project_stereo, skew, transform_points
from pipelines.types import Array, Features, StereoCamera

_MAX_HAMMING = 50  # bits, stricter than tracking: nothing predicts the place along the line
_CHUNK = 1 << 22  # pairs scored at a time, bounds memory


def match_along_epipolar_lines(
    camera: StereoCamera, T_a_b: Array, a: Features, b: Features, max_epipolar_px: float
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Mutual best matches of features that lie on each other's epipolar lines.

    T_a_b: (4, 4), from camera b to camera a. The distance limit grows with the feature's octave.
    Returns indices into `a` and `b`, equally long.
    """
    none = np.empty(0, np.int64)
    if len(a) == 0 or len(b) == 0 or len(a) * len(b) > _CHUNK:
        return none, none
    K_inv = np.linalg.inv(camera.K)
    F = K_inv.T @ skew(T_a_b[:3, 3]) @ T_a_b[:3, :3] @ K_inv  # x_a^T F x_b = 0
    homogeneous_b = np.column_stack([b.uv_px, np.ones(len(b))])
    lines = homogeneous_b @ F.T  # in image a, one per feature of b
    norm = np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-12)
    distance = np.abs(np.column_stack([a.uv_px, np.ones(len(a))]) @ lines.T) / norm
    limit = max_epipolar_px * 1.2 ** a.octave.astype(float)
    i, j = np.nonzero(distance <= limit[:, None])
    same_scale = np.abs(a.octave[i] - b.octave[j]) <= 1
    i, j = i[same_scale], j[same_scale]
    bits = hamming_distance(a.descriptors[i], b.descriptors[j])
    table = np.full((len(a), len(b)), 256, np.int64)
    table[i, j] = bits
    best_j, best_i = table.argmin(1), table.argmin(0)
    rows = np.arange(len(a))
    good = (best_i[best_j] == rows) & (table[rows, best_j] <= _MAX_HAMMING)
    return rows[good], best_j[good]


def triangulate(
    camera: StereoCamera, T_world_a: Array, T_world_b: Array, uv_a_px: Array, uv_b_px: Array
) -> Array:
    """Points in the world (N, 3) from pixels (N, 2) in two cameras, by the linear method."""
    P_a = camera.K @ invert_T(T_world_a)[:3]
    P_b = camera.K @ invert_T(T_world_b)[:3]
    A = np.stack(
        [
            uv_a_px[:, :1] * P_a[2] - P_a[0],
            uv_a_px[:, 1:] * P_a[2] - P_a[1],
            uv_b_px[:, :1] * P_b[2] - P_b[0],
            uv_b_px[:, 1:] * P_b[2] - P_b[1],
        ],
        axis=1,
    )
    A /= np.linalg.norm(A, axis=2, keepdims=True)
    homogeneous = np.linalg.svd(A)[2][:, -1]
    w = homogeneous[:, 3]
    w = np.where(np.abs(w) < 1e-12, 1e-12, w)
    return homogeneous[:, :3] / w[:, None]


def check_triangulated(
    camera: StereoCamera,
    T_world_a: Array,
    T_world_b: Array,
    points_world_m: Array,
    a: Features,
    b: Features,
    config: MappingConfig,
) -> NDArray[np.bool_]:
    """Which two-view points (N, 3) to believe (paper: parallax, reprojection, scale).

    They must lie in front of both cameras, be seen under at least `min_parallax_deg`, reproject
    within `max_reprojection_px` (times the octave's scale), and the ratio of their distances must
    agree with the ratio of their octaves' scales.
    """
    ray_a = points_world_m - T_world_a[:3, 3]
    ray_b = points_world_m - T_world_b[:3, 3]
    range_a, range_b = np.linalg.norm(ray_a, axis=1), np.linalg.norm(ray_b, axis=1)
    cosine = (ray_a * ray_b).sum(1) / np.maximum(range_a * range_b, 1e-12)
    ok = cosine < np.cos(np.radians(config.min_parallax_deg))
    for T, view in ((T_world_a, a), (T_world_b, b)):
        points = transform_points(invert_T(T), points_world_m)
        front = points[:, 2] > 0.1
        points[~front, 2] = 1.0
        error = np.linalg.norm(project_stereo(camera, points)[:, :2] - view.uv_px, axis=1)
        ok &= front & (error <= config.max_reprojection_px * 1.2 ** view.octave.astype(float))
    scale_ratio = 1.2 ** (b.octave - a.octave).astype(float)
    distance_ratio = range_a / np.maximum(range_b, 1e-12)
    factor = 1.5 * 1.2
    return ok & (distance_ratio < scale_ratio * factor) & (distance_ratio * factor > scale_ratio)
