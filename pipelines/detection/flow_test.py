"""The flow test: does a cell's matter move, by flow and disparity between two frames?

Owns scene-flow residuals against the ego-motion, in the image: what is measured minus what a still
world would show, in u, v and disparity. Knows no regions and no older views.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from pipelines.config import GeometryConfig
from pipelines.detection.cells import Bools, CellGrid, DepthCells, Floats, StaticPlaces, sample
from pipelines.types import Array

_RETURN_STEPS = 3  # fixed-point steps that turn the flow round; it is smooth inside of things
_SAME_SHARE = 0.05  # of a disparity, that cells side by side on one surface differ by
_MIN_SIGMA_DISPARITY_PX = 0.03  # reading between cells is no more exact
_DISPARITY_ERROR_SHARE = 0.003  # of a disparity, the same for near things
_BLEEDING_CELLS = 2  # so far does computed flow follow the nearer thing beyond its border
_DISPARITY_LEVELS = 32.0  # 1 / px, of the sort by nearness


@dataclass(frozen=True, slots=True)
class FlowResiduals:
    """What the flow test finds, on the cells of the present frame.

    from_u_px, from_v_px: (h, w) float32, where in the previous frame the cell's matter was.
    error_px: (3, h, w) float32, that place minus where still matter would have been, and its
    disparity there minus what still matter would have had; NaN where there is none. sigma_px:
    (3, h, w) float32, its standard deviation. valid: (h, w) bool, whether the flow returned and
    no depth edge is near. strength: (h, w) float32, error in units of what still things may
    show: above 1 the cell moves, NaN where not valid.
    """

    from_u_px: Floats
    from_v_px: Floats
    error_px: Floats
    sigma_px: Floats
    valid: Bools
    strength: Floats


def flow_residuals(
    grid: CellGrid,
    cells: DepthCells,
    previous: DepthCells,
    places: StaticPlaces,
    flow_px: Floats,
    sigmas_px: tuple[float, float],
    pose_covariance: Array,
    dt_s: float,
    config: GeometryConfig,
) -> FlowResiduals:
    """Residuals of every cell.

    cells, previous: depth of the present and the previous frame. places: of the present cells in
    the previous frame. flow_px: (H, W, 2) previous -> current on the previous pixels, NaN unknown.
    sigmas_px: of flow and of cell disparity. pose_covariance: (6, 6) [omega rad, v m] of the
    motion between the frames. dt_s: time between them.
    """
    u, v, miss = _matter_before(grid, previous, places, flow_px)
    column, row = grid.to_cells(u, v)
    before = _disparity_before(previous, column, row)
    edge_before = sample(previous.edge.astype(np.float32), column, row, nearest=True)
    error = np.stack([u - places.u_px, v - places.v_px, before - places.disparity_px])
    valid = (miss < config.max_flow_miss_px) & ~cells.edge & (edge_before < 0.5)
    valid &= np.isfinite(error).all(axis=0)
    # What has come into the image has no flow, but computed flow is everywhere
    valid &= _inside(grid, places.u_px, places.v_px)
    valid &= ~_was_hidden(grid, previous, places, before, config.depth_gap_share)
    # Nothing jumps: such an error is of two things, one before and one behind the other
    fastest = np.float32(config.max_speed_mps * dt_s / grid.camera.bf) * cells.disparity_px**2
    valid &= np.abs(error[2]) < fastest + np.float32(config.significance * sigmas_px[1])
    sigma = _sigmas(grid, cells, places, sigmas_px, pose_covariance, config)
    # What still things may show: noise, and the least motion that counts, seen at this depth
    per_metre = cells.disparity_px * np.float32(grid.camera.fx / grid.camera.bf)
    least_uv = np.float32(config.min_speed_mps * dt_s) * per_metre
    least_d = least_uv * cells.disparity_px / np.float32(grid.camera.fx)
    allowed = np.float32(config.significance) * sigma
    allowed_uv = np.hypot(allowed[0], allowed[1]) * np.float32(np.sqrt(0.5)) + least_uv
    strength = np.maximum(
        np.hypot(error[0], error[1]) / allowed_uv, np.abs(error[2]) / (allowed[2] + least_d)
    )
    strength = np.where(valid, strength, np.float32(np.nan))
    return FlowResiduals(u, v, error, sigma, valid, strength)


def _disparity_before(previous: DepthCells, column: Floats, row: Floats) -> Floats:
    """Disparities at places on the previous grid: between cells, but not between two things."""
    nearest = sample(previous.disparity_px, column, row, nearest=True)
    between = sample(previous.disparity_px, column, row)
    return np.where(np.abs(between - nearest) < _SAME_SHARE * nearest, between, nearest)


def _was_hidden(
    grid: CellGrid, previous: DepthCells, places: StaticPlaces, before: Floats, gap_share: float
) -> Bools:
    """Which cells, if still, were behind something nearer, or beside it, a frame before.

    There is no flow of what was hidden, but computed flow is everywhere, and close by it follows
    what is in front. What was in front may be the thing itself, where its flow comes from.
    """
    size = 2 * _BLEEDING_CELLS + 1
    kernel = np.ones((size, size), np.uint8)
    nearest = cv2.dilate(np.nan_to_num(previous.disparity_px), kernel)
    front = sample(nearest, *grid.to_cells(places.u_px, places.v_px), nearest=True)
    itself = front < before * np.float32(1 + 2 * gap_share)
    return (front > places.disparity_px * np.float32(1 + 2 * gap_share)) & ~itself


def _inside(grid: CellGrid, u_px: Floats, v_px: Floats) -> Bools:
    """Which places lie in the image, a cell off its border."""
    margin, camera = grid.cell_px, grid.camera
    inside = (u_px > margin) & (u_px < camera.width - 1 - margin)
    return inside & (v_px > margin) & (v_px < camera.height - 1 - margin)


def _matter_before(
    grid: CellGrid, previous: DepthCells, places: StaticPlaces, flow_px: Floats
) -> tuple[Floats, Floats, Floats]:
    """Where the matter of each cell was in the previous frame, and by how much the flow misses.

    Solves p + flow(p) = q for every cell centre q by fixed-point steps, from where the previous
    cells were carried to, and elsewhere from where still matter would have been.
    """
    u, v = _first_guess(grid, previous, places, flow_px)
    flow = sample(flow_px, u, v)
    for _ in range(_RETURN_STEPS):
        known = np.isfinite(flow[..., 0])
        u = np.where(known, grid.u_px - flow[..., 0], u)
        v = np.where(known, grid.v_px - flow[..., 1], v)
        flow = sample(flow_px, u, v)
    miss = np.hypot(u + flow[..., 0] - grid.u_px, v + flow[..., 1] - grid.v_px)
    return u, v, np.where(np.isfinite(miss), miss, np.float32(np.inf))


def _first_guess(
    grid: CellGrid, previous: DepthCells, places: StaticPlaces, flow_px: Floats
) -> tuple[Floats, Floats]:
    h, w = grid.shape
    flow = sample(flow_px, grid.u_px, grid.v_px)
    column, row = grid.to_cells(grid.u_px + flow[..., 0], grid.v_px + flow[..., 1])
    arrives = np.isfinite(column) & (column > -0.5) & (row > -0.5)
    arrives &= (column < w - 0.5) & (row < h - 0.5)
    source = np.flatnonzero(arrives)
    nearness = np.nan_to_num(previous.disparity_px.ravel()[source]) * _DISPARITY_LEVELS
    # What is nearest comes last and stays; a stable sort of 16 bits is a quick one
    order = np.argsort(np.clip(nearness, 0, 65535).astype(np.uint16), kind="stable")
    source = source[order]
    target = np.rint(row.ravel()[source]).astype(np.int64) * w
    target += np.rint(column.ravel()[source]).astype(np.int64)
    u, v = places.u_px.ravel().copy(), places.v_px.ravel().copy()
    u[target], v[target] = grid.u_px.ravel()[source], grid.v_px.ravel()[source]
    known = np.isfinite(u) & np.isfinite(v)
    u, v = np.where(known, u, grid.u_px.ravel()), np.where(known, v, grid.v_px.ravel())
    return u.reshape(h, w), v.reshape(h, w)


def _sigmas(
    grid: CellGrid,
    cells: DepthCells,
    places: StaticPlaces,
    sigmas_px: tuple[float, float],
    pose_covariance: Array,
    config: GeometryConfig,
) -> Floats:
    """Standard deviations (3, h, w) of still cells' errors in u, v and disparity."""
    flow, disparity = sigmas_px
    disparity = max(disparity, _MIN_SIGMA_DISPARITY_PX)
    ego = np.hypot(places.u_px - grid.u_px, places.v_px - grid.v_px)
    by_flow = np.float32(flow) ** 2 + (np.float32(config.flow_error_share) * ego) ** 2
    d2 = np.float32(disparity**2) + (np.float32(_DISPARITY_ERROR_SHARE) * cells.disparity_px) ** 2
    pose = _pose_variance(grid, cells.disparity_px, pose_covariance)
    variance = np.stack(
        [
            by_flow + places.du_dd**2 * d2 + pose[0],
            by_flow + places.dv_dd**2 * d2 + pose[1],
            (1 + places.dd_dd**2) * d2 + pose[2],
        ]
    )
    return np.asarray(np.sqrt(variance), np.float32)


def _pose_variance(grid: CellGrid, disparity_px: Floats, covariance: Array) -> Floats:
    """What the uncertainty of the motion adds, (3, h, w) px^2, neglecting its correlations.

    First order at a small motion, right perturbation: of a ray (x, y, 1) at inverse depth i, with
    focal length f and baseline times it bf.
    """
    camera = grid.camera
    x, y = (grid.rays[i].reshape(grid.shape) for i in (0, 1))
    i = disparity_px * np.float32(1 / camera.bf)
    wx, wy, wz, tx, ty, tz = (np.float32(value) for value in np.diag(covariance))
    f2, bf2 = np.float32(camera.fx**2), np.float32(camera.bf**2)
    i2 = i * i
    u = f2 * ((x * y) ** 2 * wx + (1 + x * x) ** 2 * wy + y * y * wz + i2 * (tx + x * x * tz))
    v = f2 * ((1 + y * y) ** 2 * wx + (x * y) ** 2 * wy + x * x * wz + i2 * (ty + y * y * tz))
    d = bf2 * i2 * (y * y * wx + x * x * wy + i2 * tz)
    return np.stack([u, v, d])
