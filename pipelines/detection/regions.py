"""Regions of moving cells: connected in depth, moving alike, grown to the whole of a thing.

Owns connectedness and the motion of a region. What evidence a cell has is decided elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.detection.cells import Bools, CellGrid, Floats
from pipelines.types import Array

_ROUNDS = 3  # of reweighting; more change little
_MAX_FIT_CELLS = 250  # a sample of a large region says as much

Labels = NDArray[np.int32]


@dataclass(frozen=True, slots=True)
class RegionMotion:
    """How the cells of a region move since the previous frame, as one translation.

    translation_m: (3,) in the present camera. covariance_m2: (3, 3). agreement: share of the cells
    that move so, 0 to 1.
    """

    translation_m: Array
    covariance_m2: Array
    agreement: float


def connect(
    members: Bools, disparity_px: Floats, sigma_px: float, gap_share: float
) -> tuple[Labels, int]:
    """Components (h, w), numbered from 1, of member cells that touch and lie at one depth.

    Neighbours are of one thing where their disparities differ by less than a share of them plus
    noise; a cell of unknown disparity connects to nothing. Returns also how many there are.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    members = members & np.isfinite(disparity_px)
    index = np.full(members.shape, -1, np.int32)
    n = int(members.sum())
    index[members] = np.arange(n)
    links = []
    for a, b in (
        (np.s_[:, :-1], np.s_[:, 1:]),
        (np.s_[:-1], np.s_[1:]),
        (np.s_[:-1, :-1], np.s_[1:, 1:]),
        (np.s_[:-1, 1:], np.s_[1:, :-1]),
    ):
        both = members[a] & members[b]
        da, db = disparity_px[a][both], disparity_px[b][both]
        near = np.abs(da - db) < gap_share * np.maximum(da, db) + 4 * sigma_px
        links.append((index[a][both][near], index[b][both][near]))
    i, j = (np.concatenate(part) for part in zip(*links, strict=True))
    graph = coo_array((np.ones(len(i), np.int8), (i, j)), shape=(n, n))
    count, found = connected_components(graph, directed=False)
    labels = np.zeros(members.shape, np.int32)
    labels[members] = found + 1
    return labels, int(count)


def image_motion(grid: CellGrid, which: NDArray, disparity_px: Floats) -> Array:
    """d(u, v, disparity before) / d(translation), (n, 3, 3) px / m, of cells `which` (indices).

    Of matter that moved by a translation to where the cell sees it now: before, it was that much
    back, so the signs are those of the errors of the flow test.
    """
    x, y = grid.rays[0][which], grid.rays[1][which]
    d = disparity_px.ravel()[which]
    camera = grid.camera
    inverse = d / camera.bf
    J = np.zeros((len(x), 3, 3))
    J[:, 0, 0], J[:, 0, 2] = -camera.fx * inverse, camera.fx * x * inverse
    J[:, 1, 1], J[:, 1, 2] = -camera.fy * inverse, camera.fy * y * inverse
    J[:, 2, 2] = d * inverse
    return J


def fit_motion(
    grid: CellGrid, which: NDArray, disparity_px: Floats, error_px: Floats, sigma_px: Floats
) -> RegionMotion | None:
    """The translation that explains most of the errors of cells `which` (flat indices).

    disparity_px: (h, w). error_px, sigma_px: (3, h, w) of the flow test. Cauchy weights on top of
    the noise; None where too few cells have a flow. A small turn of the thing is left over.
    """
    errors = error_px.reshape(3, -1)
    which = which[np.isfinite(errors[:, which]).all(axis=0)]
    if len(which) < 4:
        return None
    which = which[:: max(1, len(which) // _MAX_FIT_CELLS)]
    e = errors[:, which].T.astype(np.float64)
    sigma = sigma_px.reshape(3, -1)[:, which].T.astype(np.float64)
    J = image_motion(grid, which, disparity_px) / sigma[..., None]
    r = e / sigma
    weight = np.ones(len(r))
    size = np.linalg.norm(r, axis=1)
    scale = max(3.0, 0.3 * float(np.median(size)))
    translation, information = np.zeros(3), np.eye(3)
    for _ in range(_ROUNDS):
        weighted = J * weight[:, None, None]
        information = np.einsum("nij,nik->jk", weighted, J) + 1e-6 * np.eye(3)
        translation = np.linalg.solve(information, np.einsum("nij,ni->j", weighted, r))
        left = np.linalg.norm(r - J @ translation, axis=1)
        weight = 1 / (1 + (left / scale) ** 2)
    agrees = left < np.maximum(3.5, 0.5 * size)
    # Neighbours err alike: a patch of the flow is about four cells
    covariance = 4 * np.linalg.inv(information)
    return RegionMotion(translation, covariance, float(agrees.mean()))


def favours_motion(
    grid: CellGrid,
    which: NDArray,
    disparity_px: Floats,
    error_px: Floats,
    sigma_px: Floats,
    translation_m: Array,
) -> Array:
    """By how much cells `which` fit the translation better than standing still, (n,), chi-square.

    Positive: it moves so. NaN where there is no flow.
    """
    e = error_px.reshape(3, -1)[:, which].T
    sigma = sigma_px.reshape(3, -1)[:, which].T
    moved = (e - image_motion(grid, which, disparity_px) @ translation_m) / sigma
    still = e / sigma
    return np.sum(still**2 - moved**2, axis=1)
