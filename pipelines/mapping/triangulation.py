"""New points from two views: far features and features without depth, by triangulation.

Owns the geometry and the checks of a two-view point: epipolar distance, parallax, reprojection
and scale. Pure functions; the map decides which keyframes to pair.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.config import MappingConfig
from pipelines.frontend.matching import Indices, hamming_distance, mutual_best
from pipelines.geometry import invert_T, reprojection_errors, skew
from pipelines.types import Array, Features, StereoCamera

_MAX_HAMMING = 50  # bits, stricter than tracking: nothing predicts the place along the line
_SCALE_SLACK = 1.5  # ratios of distance and of scale may differ by this and one octave (ORB-SLAM)
_PAIRS_AT_A_TIME = 1 << 22  # bounds the memory of epipolar distances


def match_along_epipolar_lines(
    camera: StereoCamera,
    T_a_b: Array,
    a: Features,
    b: Features,
    max_epipolar_px: float,
    scale_factor: float,
) -> tuple[Indices, Indices]:
    """Mutual best matches of features of `a` with those whose epipolar lines they lie on.

    T_a_b: (4, 4), p_a = T_a_b @ p_b. max_epipolar_px: at octave 0, in image a; it grows by
    `scale_factor` with each octave of the feature. Returns indices into `a` and `b`, equally long.
    """
    none = np.empty(0, np.int64)
    if len(a) == 0 or len(b) == 0:
        return none, none
    K_inv = np.linalg.inv(camera.K)
    F = K_inv.T @ skew(T_a_b[:3, 3]) @ T_a_b[:3, :3] @ K_inv  # x_a^T F x_b = 0
    homogeneous_b = np.column_stack([b.uv_px, np.ones(len(b))])
    lines = homogeneous_b @ F.T  # in image a, one per feature of b
    norm = np.maximum(np.linalg.norm(lines[:, :2], axis=1), 1e-12)
    homogeneous_a = np.column_stack([a.uv_px, np.ones(len(a))])
    limit = max_epipolar_px * scale_factor ** a.octave.astype(float)
    rows = max(1, _PAIRS_AT_A_TIME // len(b))
    pairs = []
    for begin in range(0, len(a), rows):
        distance = np.abs(homogeneous_a[begin : begin + rows] @ lines.T) / norm
        i, j = np.nonzero(distance <= limit[begin : begin + rows, None])
        pairs.append(np.stack([i + begin, j]))
    i, j = np.concatenate(pairs, axis=1)
    same_scale = np.abs(a.octave[i] - b.octave[j]) <= 1
    i, j = i[same_scale], j[same_scale]
    return mutual_best(i, j, hamming_distance(a.descriptors[i], b.descriptors[j]), _MAX_HAMMING)


def triangulate(
    camera: StereoCamera, T_world_a: Array, T_world_b: Array, uv_a_px: Array, uv_b_px: Array
) -> Array:
    """Points in the world (N, 3), in m, from pixels (N, 2) in two cameras, by the linear method.

    The direct linear transform (Hartley and Zisserman, 12.2); no check whether rays meet in front.
    """
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
    scale_factor: float,
) -> NDArray[np.bool_]:
    """Which two-view points (N, 3) of features `a` and `b` (N each) to believe, (N,).

    The checks of the paper's section Sparse Map. Points must lie in front of both cameras, be seen
    under at least `min_parallax_deg`, reproject within `max_reprojection_px` (times the octave's
    scale), and the ratio of their distances must agree with the ratio of their octaves' scales.
    """
    ray_a = points_world_m - T_world_a[:3, 3]
    ray_b = points_world_m - T_world_b[:3, 3]
    range_a, range_b = np.linalg.norm(ray_a, axis=1), np.linalg.norm(ray_b, axis=1)
    cosine = (ray_a * ray_b).sum(1) / np.maximum(range_a * range_b, 1e-12)
    ok = cosine < np.cos(np.radians(config.min_parallax_deg))
    for T, view in ((T_world_a, a), (T_world_b, b)):
        limit = config.max_reprojection_px * scale_factor ** view.octave.astype(float)
        ok &= reprojection_errors(camera, T, points_world_m, view.uv_px) <= limit
    scale_ratio = scale_factor ** (b.octave - a.octave).astype(float)
    distance_ratio = range_a / np.maximum(range_b, 1e-12)
    factor = _SCALE_SLACK * scale_factor
    return ok & (distance_ratio < scale_ratio * factor) & (distance_ratio * factor > scale_ratio)
