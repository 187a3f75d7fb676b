"""What is known of each cell in one frame, and what that says of a set of cells.

Owns how the depth test and the flow test add up: whether a region moves, how, and how far it goes.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from pipelines.config import GeometryConfig
from pipelines.detection.cells import Bools, CellGrid, DepthCells, Floats
from pipelines.detection.depth_test import Comparison
from pipelines.detection.flow_test import FlowResiduals
from pipelines.detection.image_test import looks_still
from pipelines.detection.masks import box_of
from pipelines.detection.regions import RegionMotion, connect, favours_motion, fit_motion
from pipelines.types import Array

_HALF_SURE = 0.5  # strength of flow that counts where older views saw the place empty
_MIN_INNER = 0.12  # share of a region's cells that have all neighbours in it: else it is a rim
_LEFT_PLACE = (
    1.5  # of its own length: by then a moving thing, even one that gathers speed, has gone
)
_MIN_LEFT = 0.1  # share of that distance before anything can be said
_MAX_STILL_SHARE = 0.5  # of a region that older views saw in the same place: it stands
_GAP_FACTOR = 1.5  # parts of one thing may lie farther apart in depth than cells of one surface
_STILL = 0.7  # strength of flow below which a cell counts as still
_MAX_COMPONENTS = 12  # the largest of a frame are judged
_AROUND_CELLS = 3  # width of the surroundings that are looked at, but for the first cell
_SAME_SURFACE = 0.6  # share of the gap between things within which a surface goes on
_MAX_GOES_ON = 0.35  # share of the cells around that are still, and of the same surface
_MAX_PART = 0.6  # of the size of the whole
_PART_DEPTH_M = 1.5  # m, parts of one thing are no farther apart
_PART_MOTION = 0.15  # share of a thing's motion that its turning gives parts of it
_SURE_SIGMAS = 2.5  # of a region's motion beyond the least that counts


@dataclass(frozen=True, slots=True)
class Evidence:
    """One frame's cells, all (h, w).

    measured: cells as they were before the learned offset of disparities came in.
    flow: residuals against the frame before, or None. comparisons: with older views. usable:
    near enough, above the ground. images: (H, W) grey, smoothed, of this frame and
    the one before, or None. dt_s: time since the frame before. sigma_px: of a cell's
    disparity.
    """

    grid: CellGrid
    cells: DepthCells
    measured: DepthCells
    flow: FlowResiduals | None
    comparisons: list[Comparison]
    usable: Bools
    images: tuple[Floats, Floats] | None
    dt_s: float
    sigma_px: float
    config: GeometryConfig

    def moving_cells(self) -> Bools:
        """Cells that move by themselves, before any region is looked at."""
        empty = np.zeros(self.grid.shape, np.int32)
        for comparison in self.comparisons:
            empty += comparison.was_empty
        was_empty = empty * 2 > len(self.comparisons) if self.comparisons else empty > 0
        if self.flow is None:
            return self.usable & was_empty
        strength = self.flow.strength
        by_flow = strength > 1
        # Single cells say little: of nine, three at least
        around = cv2.boxFilter(by_flow.astype(np.float32), -1, (3, 3), normalize=False)
        by_flow &= around > 2.5
        # Slow things, and those whose flow cannot be read: only where older views saw through
        by_depth = was_empty & np.where(self.flow.valid, strength > _HALF_SURE, True)
        return self.usable & (by_flow | by_depth)

    def components(self, moving: Bools) -> list[Bools]:
        """Moving cells by connectedness in depth, the largest first; tiny ones left out."""
        gap = self.config.depth_gap_share * _GAP_FACTOR
        labels, count = connect(moving, self.cells.disparity_px, self.sigma_px, gap)
        sizes = np.bincount(labels.ravel(), minlength=count + 1)[1:]
        order = np.argsort(-sizes, kind="stable")
        large = order[sizes[order] >= max(3, self.config.min_cells // 2)]
        return [labels == i + 1 for i in large[:_MAX_COMPONENTS]]

    def motion_of(self, region: Bools) -> RegionMotion | None:
        """How a region moves since the frame before; None without flow in it."""
        if self.flow is None:
            return None
        which = np.flatnonzero(region & self.flow.valid)
        flow = self.flow
        return fit_motion(self.grid, which, self.cells.disparity_px, flow.error_px, flow.sigma_px)

    def certainty(self, motion: RegionMotion) -> float:
        """By how many standard deviations a motion exceeds the least that counts."""
        size = float(np.linalg.norm(motion.translation_m))
        if size < 1e-9:
            return 0.0
        direction = motion.translation_m / size
        # Along the direction of motion, given that the other two are as found
        sigma = 1 / np.sqrt(direction @ np.linalg.inv(motion.covariance_m2) @ direction)
        return float((size - self.config.min_speed_mps * self.dt_s) / sigma)

    def is_moving(self, region: Bools, motion: RegionMotion) -> bool:
        """Whether a region moves as one, surely, and has not been seen to stand."""
        return (
            motion.agreement >= self.config.min_agreement
            and self.certainty(motion) > _SURE_SIGMAS
            and not self.stood(region, motion)
        )

    def score(self, motion: RegionMotion) -> float:
        """How sure a region's motion is, 0 to 1."""
        excess = max(self.certainty(motion), 0.0)
        return motion.agreement * excess / (excess + _SURE_SIGMAS)

    def is_part(
        self, part: Bools, part_motion: RegionMotion, whole: Bools, motion: RegionMotion
    ) -> bool:
        """Whether a region is a smaller part of a thing: as near, and moving alike."""
        if part.sum() > _MAX_PART * whole.sum():
            return False
        d = self.cells.disparity_px
        a, b = float(np.nanmedian(d[part])), float(np.nanmedian(d[whole]))
        bf = self.grid.camera.bf
        if abs(bf / a - bf / b) > max(_PART_DEPTH_M, self.config.depth_gap_share * bf / b):
            return False
        apart = part_motion.translation_m - motion.translation_m
        covariance = part_motion.covariance_m2 + motion.covariance_m2
        slack = (_PART_MOTION * float(np.linalg.norm(motion.translation_m))) ** 2
        return float(apart @ np.linalg.solve(covariance + slack * np.eye(3), apart)) < 9.0

    def stood(self, region: Bools, motion: RegionMotion | None) -> bool:
        """Whether older views saw the region where it is now, so long ago that it cannot move.

        A thing that moved by a part of its length still covers its old place in the rest, and
        depths within the test's gap do not count as different. motion: None where nothing moves.
        """
        away_m, length_m = 0.0, 1.0
        if motion is not None:
            length_m = self._extent_along(region, motion.translation_m) + 0.05
            disparity = float(np.nanmedian(self.cells.disparity_px[region]))
            depth_m = self.grid.camera.bf / disparity
            blur_m = max(
                self.config.depth_gap_m,
                self.config.depth_gap_share * depth_m,
                2 * self.grid.cell_px * depth_m / self.grid.camera.fx,
            )
            length_m += blur_m
        for comparison in self.comparisons:
            limit = _MAX_STILL_SHARE
            if motion is not None:
                away_m = float(np.linalg.norm(motion.translation_m)) * comparison.age_s / self.dt_s
                left = (away_m - blur_m) / (_LEFT_PLACE * length_m)
                if left < _MIN_LEFT:
                    continue
                limit = 1 - (1 - _MAX_STILL_SHARE) * min(left, 1.0)
            agrees = int((comparison.agrees & region).sum())
            seen = agrees + int((comparison.was_empty & region).sum())
            if seen >= 0.3 * region.sum() and agrees > limit * seen:
                return True
        return False

    def _extent_along(self, region: Bools, direction_m: Array) -> float:
        """Length in m of a region along a direction, without its outermost cells."""
        which = np.flatnonzero(region & np.isfinite(self.cells.disparity_px))
        if len(which) == 0:
            return 0.0
        which = which[:: max(1, len(which) // 200)]
        depth = self.grid.camera.bf / self.cells.disparity_px.ravel()[which]
        points = self.grid.rays[:, which] * depth
        along = direction_m @ points / max(float(np.linalg.norm(direction_m)), 1e-9)
        along.sort()
        rest = len(along) // 20
        return float(along[-1 - rest] - along[rest])

    def is_patch(self, region: Bools) -> bool:
        """Whether a region is a piece of a still surface, that goes on beyond its border."""
        if self.flow is None:
            return False
        box = box_of(region, _AROUND_CELLS + 1)
        inner, d, kernel = region[box], self.cells.disparity_px[box], np.ones((3, 3), np.uint8)
        near, far = (
            cv2.dilate(inner.astype(np.uint8), kernel, iterations=n) > 0 for n in (1, _AROUND_CELLS)
        )
        around = far & ~near
        weight = (inner & np.isfinite(d)).astype(np.float32)
        total, summed = (
            cv2.boxFilter(x, -1, (9, 9), normalize=False, borderType=cv2.BORDER_CONSTANT)
            for x in (weight, np.nan_to_num(d) * weight)
        )
        inside = summed / np.maximum(total, np.float32(0.5))
        gap = _SAME_SURFACE * self.config.depth_gap_share * d + 4 * self.sigma_px
        still = self.usable[box] & self.flow.valid[box] & (self.flow.strength[box] < _STILL)
        goes_on = around & still & (np.abs(inside - d) < gap)
        return int(goes_on.sum()) > _MAX_GOES_ON * max(1, int(around.sum()))

    def looks_still(self, region: Bools) -> bool:
        """Whether the image shows no sign that a region moves; False where there is no flow."""
        if self.flow is None or self.images is None:
            return False
        return looks_still(self.grid, self.images, self.flow, region)

    def was_empty_share(self, region: Bools) -> float:
        """Share of a region that any older view saw through."""
        empty = np.zeros(self.grid.shape, bool)
        for comparison in self.comparisons:
            empty |= comparison.was_empty
        return float((empty & region).sum() / max(1, region.sum()))

    def is_rim(self, region: Bools) -> bool:
        """Whether a region is hardly wider than the border of something."""
        inner = cv2.erode(region.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=1)
        return int(inner.sum()) < max(1, int(_MIN_INNER * region.sum()))

    def grow(self, region: Bools, motion: RegionMotion, free: Bools) -> Bools:
        """A region with all cells around that move with it, or may, on the same surface.

        free: cells that it may take. Cells of it that fit standing still better are dropped.
        """
        assert self.flow is not None
        rows, columns = np.nonzero(region)
        box = box_of(region, int(3 + max(np.ptp(rows), np.ptp(columns))))
        inner, flow = region[box], self.flow
        favour = self._favour(box, motion.translation_m)
        trusted = flow.valid[box] & np.isfinite(favour)
        stands = trusted & (favour < 0)
        joins = trusted & (favour > self.config.significance**2)
        near = cv2.dilate((inner | joins).astype(np.uint8), np.ones((3, 3), np.uint8))
        unsure = ~joins & ~stands & (near > 0)
        members = self.usable[box] & (free[box] | inner) & (joins | unsure | (inner & ~stands))
        gap = self.config.depth_gap_share
        labels, count = connect(members, self.cells.disparity_px[box], self.sigma_px, gap)
        touched = np.bincount(labels[inner & members], minlength=count + 1)
        touched[0] = 0
        # The main part, and others that the region itself already held in good part
        kept = touched >= max(3, 0.15 * touched.max(initial=0))
        kept[0] = False
        grown = np.zeros(region.shape, bool)
        grown[box] = kept[labels]
        return grown

    def _favour(self, box: tuple[slice, slice], translation_m: Array) -> Array:
        """By how much each cell of a window fits moving better than standing, chi-square."""
        assert self.flow is not None
        rows, columns = box
        index = np.arange(self.grid.shape[0] * self.grid.shape[1]).reshape(self.grid.shape)
        which = index[box].ravel()
        favour = favours_motion(
            self.grid,
            which,
            self.cells.disparity_px,
            self.flow.error_px,
            self.flow.sigma_px,
            translation_m,
        )
        return favour.reshape(rows.stop - rows.start, columns.stop - columns.start)
