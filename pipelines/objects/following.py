"""Where the points of objects are in the next image: by motion, by flow and by alignment.

Owns the measurement of object points, which eq. (3) takes as C_k. Estimates no motion.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from pipelines.frontend.alignment import align_patches, fuse_measurements, is_precise
from pipelines.frontend.noise import NoiseModel
from pipelines.frontend.sampling import edge_share, sample_bilinear
from pipelines.frontend.view import View
from pipelines.types import Array

_TOLERANCE_PX = 6.0  # alignment may move a point this far from where it starts
_SURE_PX = 1.5  # flow and expectation this near to each other say where to start, finely
_NEAR_PX = 3.0  # how far the expected place itself may be off
_AT_EDGE = 0.2  # share of its surroundings across a depth edge, from which on a point is at one
_MEAN_SHARE = 0.35  # of such points
_SURPRISE_PX = 12.0  # flow that leads farther from the expected place is not of the object


@dataclass(frozen=True, slots=True)
class Followed:
    """Where points are in the present image (parallel arrays of length N).

    uv_px: (N, 2). valid: (N,) whether it was found at all. sigma_px: (N,). flow_px, aligned_px:
    (N, 2) what each source said, NaN where nothing. across: (N,) share of the point's surroundings
    that lies across a depth edge.
    """

    uv_px: Array
    valid: NDArray[np.bool_]
    sigma_px: Array
    flow_px: Array
    aligned_px: Array
    across: Array

    def __getitem__(self, which: NDArray) -> Followed:
        """The points chosen by a boolean mask or an index array."""
        return Followed(*(getattr(self, f.name)[which] for f in fields(self)))

    @classmethod
    def empty(cls) -> Followed:
        """No points at all."""
        two = np.empty((0, 2))
        return cls(two, np.empty(0, bool), np.empty(0), two, two, np.empty(0))

    @classmethod
    def concatenate(cls, *parts: Followed) -> Followed:
        """All parts, in their order."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


def follow_points(
    view_prev: View, view: View, uv_prev_px: Array, expected_px: Array, noise: NoiseModel
) -> Followed:
    """Places of points (N, 2) of the previous view in the present one.

    expected_px: (N, 2) where their objects' motion leads, NaN where none is known yet. Alignment
    starts there, else at the dense flow, which is lost where things move fast; both measurements
    are fused by their learned noise. Where they contradict each other, the one nearer to the
    expected place is believed. Deviation: in the paper all flow is alike; here a point beside a
    depth edge counts for less, as what lies across it moves otherwise.
    """
    n, flow_px = len(uv_prev_px), view.flow_prev_to_curr_px
    by_flow = np.full((n, 2), np.nan)
    if flow_px is not None:
        by_flow = uv_prev_px + sample_bilinear(flow_px, uv_prev_px)
    expected = np.asarray(np.isfinite(expected_px).all(axis=1))
    with np.errstate(invalid="ignore"):
        strange = np.linalg.norm(by_flow - expected_px, axis=1) > _SURPRISE_PX
    by_flow[expected & strange] = np.nan
    has_flow = np.asarray(np.isfinite(by_flow).all(axis=1))
    start = np.where(expected[:, None], expected_px, by_flow)
    off_flow = np.linalg.norm(by_flow - expected_px, axis=1)
    with np.errstate(invalid="ignore"):
        sure = has_flow & ~(off_flow > _SURE_PX)
    sigma_flow, sigma_aligned = (
        noise.sigma_uv_px["object_flow"],
        noise.sigma_uv_px["object_alignment"],
    )
    start[has_flow & is_precise(sigma_flow, sigma_aligned)] = np.nan
    aligned, has_alignment = align_patches(
        view_prev.gray, view.gray, uv_prev_px, start, _TOLERANCE_PX, sure
    )
    off_aligned = np.linalg.norm(aligned - expected_px, axis=1)
    apart = np.linalg.norm(by_flow - aligned, axis=1) > 3.0 * np.hypot(sigma_flow, sigma_aligned)
    contradict = has_flow & has_alignment & apart
    with np.errstate(invalid="ignore"):  # near enough to the expected place, the precise one wins
        contradict &= np.fmax(off_flow, off_aligned) > _NEAR_PX
        nearer = off_flow < off_aligned
    uv, valid, sigma_px = fuse_measurements(
        by_flow, has_flow & ~(contradict & expected & ~nearer), sigma_flow,
        aligned, has_alignment & ~(contradict & expected & nearer), sigma_aligned,
    )  # fmt: skip
    across = np.zeros(n)
    across[valid] = edge_share(view.disparity_px, uv[valid], noise.sigma_disparity_px)
    sigma_px *= _beside_edge(across, noise)
    aligned[~has_alignment] = np.nan
    height, width = view.gray.shape
    with np.errstate(invalid="ignore"):
        inside = (uv >= 0).all(1) & (uv[:, 0] <= width - 1) & (uv[:, 1] <= height - 1)
    return Followed(uv, valid & inside, sigma_px, by_flow, aligned, across)


def _beside_edge(across: Array, noise: NoiseModel) -> Array:
    """(N,) how many times less precise points are for shares of their surroundings over an edge."""
    if not (noise.has_learned("object_interior") and noise.has_learned("object_edge")):
        return np.ones(len(across))
    at_edge = noise.sigma_uv_px["object_edge"] / noise.sigma_uv_px["object_interior"]
    return 1.0 + max(at_edge - 1.0, 0.0) * across / _MEAN_SHARE


def learn_edges(residuals_px: Array, across: Array, noise: NoiseModel) -> None:
    """Take in residuals (N, 2) of followed points, with shares (N,) of what is across an edge.

    Windows that reach over an edge are dragged along by what moves there; exact flow is not.
    """
    noise.learn_uv("object_interior", residuals_px[across == 0.0])
    noise.learn_uv("object_edge", residuals_px[across >= _AT_EDGE])
