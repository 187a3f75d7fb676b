"""Step 6: what moves, by multi-view geometry alone, and the repair of masks by it.

Owns the order of the tests and what they add up to; the tests themselves are in `depth_test` and
`flow_test`, the grid in `cells`, regions in `regions`. Knows no network and no tracks.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from pipelines.config import GeometryConfig
from pipelines.detection.cells import (
    Bools,
    CellGrid,
    DepthCells,
    Floats,
    reduce_disparity,
    sample,
    static_places,
)
from pipelines.detection.depth_test import (
    Comparison,
    Reference,
    ViewMemory,
    compare,
    make_reference,
)
from pipelines.detection.evidence import Evidence
from pipelines.detection.flow_test import flow_residuals
from pipelines.detection.geometry_view import GeometryView
from pipelines.detection.ground import fit_ground, heights_above
from pipelines.detection.masks import labels_of_cells, paint, pixels_of_cells
from pipelines.detection.regions import RegionMotion
from pipelines.geometry import invert_T
from pipelines.object_types import UNNAMED_CLASS, Detections
from pipelines.shapes import check_shape
from pipelines.types import Array, Image, StereoCamera

_MIN_KEPT = 0.4  # share of a mask that a repair must keep to be believed
_FIRST_BELIEF = 0.6  # in a nameless instance that another source brings, or a new one


@dataclass(slots=True)
class _Instance:
    """An instance in the making. was: its pixels as given, None for a new one."""

    label: int
    class_name: str
    score: float
    cells: Bools
    motion: RegionMotion | None = None
    was: Bools | None = None
    repaired: bool = False


class MultiViewGeometry:
    """Finds what moves, frame by frame; remembers older views, and what it found of late.

    Sources: DynaSLAM (Bescos et al., RA-L 2018) for the depth test and the growing of regions.
    Deviation: cells are also tested by flow, and regions, not pixels, are judged; the depth test
    has true camera centres and a threshold by the noise (`depth_test`).
    """

    def __init__(self, camera: StereoCamera, config: GeometryConfig) -> None:
        self.camera, self.config = camera, config
        self._grid = CellGrid.of(camera, config.cell_px)
        self._memory = ViewMemory(config)
        self._last: tuple[GeometryView, DepthCells] | None = None
        self._last_smooth = np.zeros((camera.height, camera.width), np.float32)
        self._last_static: Reference | None = None
        self._ground: Array | None = None
        self._found = np.zeros(self._grid.shape, np.float32)  # frames in a row, by cell
        self._belief: dict[int, float] = {}  # in nameless instances, by label
        self._next_label = 1

    def add_keyframe(self) -> None:
        """Remember the view last segmented for long: call it where the map makes a keyframe."""
        if self._last_static is not None:
            self._memory.add_keyframe(self._last_static)

    def move_world(self, C: Array) -> None:
        """Let what is remembered follow a correction of the map: p_new = C (4, 4) @ p_old."""
        self._memory.move_world(C)
        if self._last is not None:
            view, cells = self._last
            self._last = (replace(view, T_world_camera=C @ view.T_world_camera), cells)
        if self._last_static is not None:
            last = self._last_static
            self._last_static = replace(last, T_world_camera=C @ last.T_world_camera)

    def rename(self, names: Mapping[int, int]) -> None:
        """Call instances of the last answer by the labels that they have from now on.

        names: label then -> label now, of all that go on; what is not named is forgotten.
        """
        self._belief = {names[label]: b for label, b in self._belief.items() if label in names}

    def segment(self, view: GeometryView, known: Detections) -> Detections:
        """Instances of the present frame: the known ones, repaired, and new ones that move.

        known: instances on this frame's image by any other source: a network, files, and this
        method's answer to the frame before, carried by the flow with its label ids. They are never
        merged. New ones are nameless, with new label ids; their scores say how sure their motion
        is. Known nameless ones whose evidence fades are dropped.
        Raises ValueError where sizes do not fit the camera.
        """
        size = (self.camera.height, self.camera.width)
        check_shape("GeometryView", "disparity_px", view.disparity_px, size)
        check_shape("Detections", "labels", known.labels, size)
        evidence = self._gather(view)
        instances = self._repair_known(evidence, known)
        instances += self._find_new(evidence, instances)
        answer = self._answer(evidence, view, known, instances)
        self._remember(view, evidence, instances)
        return answer

    # --------------------------------------------------------------- evidence

    def _gather(self, view: GeometryView) -> Evidence:
        """All tests of all cells against the frame before and older views."""
        grid, config = self._grid, self.config
        sigma = view.sigma_disparity_px
        measured = reduce_disparity(grid, view.disparity_px, sigma)
        offset = view.disparity_offset_px
        cells = measured.corrected(self.camera, offset)
        usable = cells.disparity_px > self.camera.bf / config.max_range_m
        self._ground = fit_ground(grid, cells.disparity_px, self._ground, sigma)
        if self._ground is not None:
            height = heights_above(grid, cells.disparity_px, self._ground)
            usable &= height > config.ground_clearance_m
        pose = (view.timestamp_s, view.T_world_camera)
        comparisons: list[Comparison] = [
            compare(grid, cells, reference.corrected(self.camera, offset), pose, sigma, config)
            for reference in self._memory.overlapping(*pose)
        ]
        flow, dt_s = None, 0.1
        smooth, images = _smooth(view.gray), None
        if self._last is not None and view.flow_prev_to_curr_px is not None:
            last, cells_before = self._last
            if view.frame_index - last.frame_index == 1:
                images = (smooth, self._last_smooth)
                dt_s = max(view.timestamp_s - last.timestamp_s, 1e-3)
                T_last_this = invert_T(last.T_world_camera) @ view.T_world_camera
                flow = flow_residuals(
                    grid,
                    cells,
                    cells_before.corrected(self.camera, offset),
                    static_places(grid, cells.disparity_px, T_last_this),
                    view.flow_prev_to_curr_px,
                    (max(view.sigma_flow_px, config.flow_sigma_px), sigma),
                    np.nan_to_num(view.pose_covariance),
                    dt_s,
                    config,
                )
        self._last_smooth = smooth
        return Evidence(
            grid, cells, measured, flow, comparisons, usable, images, dt_s, sigma, config
        )

    def _remember(self, view: GeometryView, evidence: Evidence, instances: list[_Instance]) -> None:
        """Keep the view for later ones; what moves in it is left out, as it will be elsewhere."""
        measured = evidence.measured
        moving = np.zeros(self._grid.shape, np.uint8)
        for instance in instances:
            if instance.motion is not None:
                moving |= instance.cells
        moving = cv2.dilate(moving, np.ones((3, 3), np.uint8))
        still = np.where(moving > 0, np.float32(np.nan), measured.disparity_px)
        reference = make_reference(
            view.timestamp_s, view.T_world_camera, DepthCells(still, measured.edge)
        )
        self._memory.remember(reference)
        self._last, self._last_static = (view, measured), reference

    # -------------------------------------------------------------- instances

    def _repair_known(self, evidence: Evidence, known: Detections) -> list[_Instance]:
        """The known instances with their cells; those that move are fitted to their surfaces."""
        labels = labels_of_cells(self._grid, known.labels)
        instances = []
        for label, name, score in zip(
            known.label_ids, known.class_names, known.scores, strict=True
        ):
            self._next_label = max(self._next_label, int(label) + 1)
            cells = labels == label
            instance = _Instance(
                int(label), str(name), float(score), cells, was=known.labels == label
            )
            motion = evidence.motion_of(cells)
            if motion is not None and evidence.is_moving(cells, motion):
                grown = evidence.grow(cells, motion, labels == 0)
                # Evidence that denies most of a mask, or runs out onto what stands, denies itself
                if grown.sum() >= _MIN_KEPT * cells.sum() and not evidence.is_patch(grown):
                    instance.motion = motion
                    labels[cells & ~grown] = 0
                    labels[grown] = label
                    instance.cells, instance.repaired = grown, True
            if instance.class_name != UNNAMED_CLASS or self._still_believed(evidence, instance):
                instances.append(instance)
        self._belief = {
            i.label: self._belief[i.label] for i in instances if i.label in self._belief
        }
        return instances

    def _still_believed(self, evidence: Evidence, instance: _Instance) -> bool:
        """Whether a nameless instance is worth keeping; updates the belief in it, and its score."""
        belief = self._belief.get(instance.label, _FIRST_BELIEF)
        if instance.motion is not None:
            belief += 0.3 * (evidence.score(instance.motion) - belief)
        elif not instance.cells.any():
            belief *= 0.5
        elif evidence.stood(instance.cells, None):
            belief *= 0.5  # it never moved
        elif evidence.flow is not None:
            # What came to where it is now is a thing that stopped
            belief *= 0.97 if evidence.was_empty_share(instance.cells) > 0.3 else 0.8
        self._belief[instance.label] = instance.score = belief
        return belief >= self.config.min_score

    def _find_new(self, evidence: Evidence, known: list[_Instance]) -> list[_Instance]:
        """Moving regions that no known instance explains, once they were found often enough."""
        taken = np.zeros(self._grid.shape, np.uint8)
        for instance in known:
            taken |= instance.cells
        taken = cv2.dilate(taken, np.ones((3, 3), np.uint8)) > 0
        found: list[_Instance] = []
        for component in evidence.components(evidence.moving_cells() & ~taken):
            candidate = self._judge(evidence, component & ~taken, ~taken)
            if candidate is None:
                continue
            taken |= candidate.cells
            if not self._joins_another(evidence, candidate, known + found):
                found.append(candidate)
        seen_before = self._carry_found(evidence)
        count = np.zeros_like(self._found)
        confirmed = []
        for instance in found:
            before = float(seen_before[instance.cells].mean())
            count[instance.cells] = before + 1
            if before + 1 > self.config.confirm_frames - 0.5:
                instance.label = self._next_label
                self._belief[instance.label] = max(instance.score, _FIRST_BELIEF)
                self._next_label += 1
                confirmed.append(instance)
        self._found = np.maximum(count, np.where(seen_before > 0.6, seen_before * 0.7, 0))
        return confirmed

    def _judge(self, evidence: Evidence, component: Bools, free: Bools) -> _Instance | None:
        """A component as a whole thing, if it is one that moves."""
        config = self.config
        if component.sum() < max(3, config.min_cells // 2):
            return None
        motion = evidence.motion_of(component)
        if motion is None:
            return None  # a place that filled while nobody looked is no motion of now
        if not evidence.is_moving(component, motion) or evidence.looks_still(component):
            return None
        region = evidence.grow(component, motion, free)
        if region.sum() < config.min_cells or evidence.is_rim(region):
            return None
        motion = evidence.motion_of(region)
        if motion is None or not evidence.is_moving(region, motion) or evidence.is_patch(region):
            return None
        return _Instance(0, UNNAMED_CLASS, evidence.score(motion), region, motion)

    def _joins_another(self, evidence: Evidence, part: _Instance, others: list[_Instance]) -> bool:
        """Whether a region is a part of an instance beside it, which then takes it in."""
        near = cv2.dilate(part.cells.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        for other in others:
            if other.motion is None or part.motion is None or not (near & other.cells).any():
                continue
            if evidence.is_part(part.cells, part.motion, other.cells, other.motion):
                other.cells = other.cells | part.cells
                other.repaired = True
                return True
        return False

    def _carry_found(self, evidence: Evidence) -> Floats:
        """How often cells were found of late, (h, w), brought here from the frame before."""
        if evidence.flow is None:
            return np.zeros_like(self._found)
        column, row = self._grid.to_cells(evidence.flow.from_u_px, evidence.flow.from_v_px)
        before = cv2.dilate(self._found, np.ones((3, 3), np.uint8))
        return np.nan_to_num(sample(before, column, row, nearest=True))

    # ----------------------------------------------------------------- answer

    def _answer(
        self,
        evidence: Evidence,
        view: GeometryView,
        known: Detections,
        instances: list[_Instance],
    ) -> Detections:
        """Full masks: what is known keeps its pixels before others take any."""
        labels = np.zeros(known.labels.shape, np.int32)
        for instance in instances:
            if instance.was is not None and not instance.repaired:
                labels[instance.was] = instance.label
        for instance in instances:
            if not instance.repaired and instance.was is not None:
                continue
            window, pixels = paint(
                self._grid,
                instance.cells,
                evidence.measured.disparity_px,
                view.disparity_px,
                self.config.depth_gap_share,
            )
            part = labels[window]
            if instance.was is not None:
                # Its own border is finer than ours where its cells are kept
                pixels |= instance.was[window] & pixels_of_cells(self._grid, instance.cells, window)
            part[pixels & (part == 0)] = instance.label
        return Detections(
            labels,
            np.array([i.label for i in instances], np.int32),
            np.array([i.class_name for i in instances], np.str_)
            if instances
            else np.empty(0, "U16"),
            np.array([i.score for i in instances], np.float64),
        )


def _smooth(gray: Image) -> Floats:
    """Grey levels (H, W) float32 with most of the sensor's noise gone."""
    return np.asarray(cv2.GaussianBlur(gray, (5, 5), 0), np.float32)
