"""The depth test: was a cell's place empty, or filled alike, when older views saw it?

Owns the memory of older views and their comparison with the present one. DynaSLAM's test with true
camera centres, a threshold that grows with the depth's uncertainty, and the sign of the
difference: only a place that was seen *through* before and is filled now has something new in it.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipelines.config import GeometryConfig
from pipelines.detection.cells import (
    Bools,
    CellGrid,
    DepthCells,
    Floats,
    StaticPlaces,
    sample,
    static_places,
)
from pipelines.frontend.disparity_offset import corrected
from pipelines.geometry import invert_T, rotation_angle_deg
from pipelines.types import Array, StereoCamera

_MEMORY_KEYFRAMES = 20  # as many as DynaSLAM keeps
_MEMORY_RECENT = 8


@dataclass(frozen=True, slots=True)
class Reference:
    """An older view, remembered, with disparities as measured.

    T_world_camera: (4, 4). nearest_px, farthest_px: (h, w) float32, the largest and smallest
    disparity of each cell and its neighbours; both infinite next to unknown ones, where nothing
    can be said, the latter below zero.
    """

    timestamp_s: float
    T_world_camera: Array
    nearest_px: Floats
    farthest_px: Floats

    def corrected(self, camera: StereoCamera, offset_px: float) -> Reference:
        """The same with disparities as a learned offset has them."""
        return replace(
            self,
            nearest_px=corrected(camera, self.nearest_px, offset_px),
            farthest_px=corrected(camera, self.farthest_px, offset_px),
        )


@dataclass(frozen=True, slots=True)
class Comparison:
    """What one older view says of the present cells, (h, w) bool each.

    was_empty: it saw through the place where the cell's matter is now. agrees: it saw matter there
    at the same depth. age_s: time since.
    """

    was_empty: Bools
    agrees: Bools
    age_s: float


def make_reference(timestamp_s: float, T_world_camera: Array, cells: DepthCells) -> Reference:
    """What is remembered of a view with depth `cells`."""
    kernel = np.ones((3, 3), np.uint8)
    known = np.isfinite(cells.disparity_px)
    near = cv2.dilate(np.where(known, cells.disparity_px, np.float32(np.inf)), kernel)
    far = cv2.erode(np.where(known, cells.disparity_px, np.float32(-np.inf)), kernel)
    return Reference(
        timestamp_s, T_world_camera, np.asarray(near, np.float32), np.asarray(far, np.float32)
    )


class ViewMemory:
    """Older views: recent ones at steady intervals, and keyframes for places seen long ago."""

    def __init__(self, config: GeometryConfig) -> None:
        self._config = config
        self._recent: deque[Reference] = deque(maxlen=_MEMORY_RECENT)
        self._keyframes: deque[Reference] = deque(maxlen=_MEMORY_KEYFRAMES)
        self._skipped = 0

    def remember(self, reference: Reference) -> None:
        """Offer a view of the running sequence; every `reference_every`-th is kept."""
        self._skipped += 1
        if self._skipped >= self._config.reference_every or not self._recent:
            self._recent.append(reference)
            self._skipped = 0

    def add_keyframe(self, reference: Reference) -> None:
        """Keep a view for long."""
        self._keyframes.append(reference)

    def move_world(self, C: Array) -> None:
        """Let all views follow a correction of the map: p_new = C (4, 4) @ p_old."""
        for views in (self._recent, self._keyframes):
            moved = [replace(view, T_world_camera=C @ view.T_world_camera) for view in views]
            views.clear()
            views.extend(moved)

    def overlapping(self, timestamp_s: float, T_world_camera: Array) -> list[Reference]:
        """The views that overlap most with one at this pose: near in place and in direction.

        Those that see it from more than `max_parallax_deg` apart are left out. Of the recent ones
        all that overlap are wanted, since their different ages show slow and fast motion alike.
        """
        config = self._config
        wanted = config.n_references
        recent = [r for r in self._recent if self._overlap(r, T_world_camera) > 0]
        # The oldest first, then evenly towards the present
        picks = np.unique(np.linspace(0, len(recent) - 1, max(1, wanted - 1)).round().astype(int))
        chosen = [recent[i] for i in picks] if recent else []
        known = {r.timestamp_s for r in recent}
        oldest = min(known, default=timestamp_s)
        keyframes = [r for r in self._keyframes if r.timestamp_s < oldest]
        keyframes.sort(key=lambda r: -self._overlap(r, T_world_camera))
        keyframes = [r for r in keyframes if self._overlap(r, T_world_camera) > 0]
        return chosen + keyframes[: max(0, wanted - len(chosen))]

    def _overlap(self, reference: Reference, T_world_camera: Array) -> float:
        """1 for the same pose, falling to 0 at the limits of distance and rotation."""
        T = invert_T(reference.T_world_camera) @ T_world_camera
        distance = float(np.linalg.norm(T[:3, 3])) / self._config.max_reference_distance_m
        angle = float(rotation_angle_deg(T)) / self._config.max_parallax_deg
        return 1.0 - 0.7 * distance - 0.3 * angle if max(distance, angle) < 1 else 0.0


def compare(
    grid: CellGrid,
    cells: DepthCells,
    reference: Reference,
    pose: tuple[float, Array],
    sigma_px: float,
    config: GeometryConfig,
) -> Comparison:
    """What an older view says of the present cells. pose: the present time and T_world_camera."""
    timestamp_s, T_world_camera = pose
    T = invert_T(reference.T_world_camera) @ T_world_camera
    places = static_places(grid, cells.disparity_px, T)
    was_empty, agrees = compare_places(grid, cells, places, reference, sigma_px, config)
    alike = _parallax_cos(grid, places, T) > np.cos(np.deg2rad(config.max_parallax_deg))
    return Comparison(was_empty & alike, agrees & alike, timestamp_s - reference.timestamp_s)


def compare_places(
    grid: CellGrid,
    cells: DepthCells,
    places: StaticPlaces,
    reference: Reference,
    sigma_px: float,
    config: GeometryConfig,
) -> tuple[Bools, Bools]:
    """Whether (h, w) the older view saw through the place of the matter, and whether it agrees."""
    column, row = grid.to_cells(places.u_px, places.v_px)
    nearest = sample(reference.nearest_px, column, row, nearest=True)
    farthest = sample(reference.farthest_px, column, row, nearest=True)
    d = places.disparity_px
    noise = np.float32(config.significance * sigma_px) * np.sqrt(1 + places.dd_dd**2)
    # tau_z of the paper in disparities: d' = d - d^2 tau / bf, and never less than a share of z
    share = np.maximum(
        d * np.float32(config.depth_gap_m / grid.camera.bf), np.float32(config.depth_gap_share)
    )
    gap = noise + d * share / (1 + share)
    was_empty = (nearest < d - gap) & ~cells.edge
    agrees = (nearest > d - gap) & (farthest < d + gap) & np.isfinite(farthest)
    # A neighbourhood that spans both cannot say: only one whose own depths are alike can
    agrees &= np.isfinite(nearest) & (nearest - farthest < 2 * gap)
    return was_empty, agrees


def _parallax_cos(grid: CellGrid, places: StaticPlaces, T: Array) -> Floats:
    """Cosine (h, w) of the angle between two views' rays to a cell's matter."""
    camera = grid.camera
    x, y = (places.u_px - camera.cx) / camera.fx, (places.v_px - camera.cy) / camera.fy
    a, b, c = (T[:3, :3].astype(np.float32) @ grid.rays).reshape(3, *grid.shape)
    return (a * x + b * y + c) / np.sqrt((x * x + y * y + 1) * (a * a + b * b + c * c))
