"""The system: a frame goes in, a result comes out.

Owns the order of the steps and the state between frames. Each step is a function or a small class
in `depth`, `perception`, `frontend`, `objects` and `mapping`; ground truth never comes near.

Steps have numbers by which all modules call them: 0 depth, 1 masks, 2 flow, 3 ORB features,
4 camera pose, 5 what moves, 6 multi-view geometry, 7 association of objects, 8 their motion,
9 their filters, 10 map, 11 places and bundle adjustment beside tracking, 12 batches of a whole run.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.backend.back_end import BackEnd
from pipelines.backend.seen_places import SeenPlaces
from pipelines.camera_tracking import CameraTracking
from pipelines.config import Config
from pipelines.depth import StereoDepth
from pipelines.detection.geometry import MultiViewGeometry
from pipelines.detection.geometry_view import GeometryView
from pipelines.frame_observations import FrameObservations, Sightings
from pipelines.frontend.orb import OrbExtractor
from pipelines.frontend.sensor import Sensor
from pipelines.frontend.tracking import TrackedFrame, Tracker
from pipelines.frontend.view import (
    PreparedFrame,
    View,
    check_size,
    complete_view,
    prepare_frame,
)
from pipelines.mapping.correction import FrameAnchors, MapCorrection, correct_map
from pipelines.mapping.local_mapping import LocalMapping
from pipelines.mapping.sightings import static_sightings
from pipelines.mapping.sparse_map import SparseMap
from pipelines.object_types import ObjectEstimates
from pipelines.objects.frame import ObjectFrame
from pipelines.objects.landmarks import StandingObjects
from pipelines.objects.tracking import ObjectTracker
from pipelines.observations import Tracks
from pipelines.paged_arrays import PagedArrays
from pipelines.perception import FILES, DenseFlow, Segmentation
from pipelines.types import Array, Frame, FrameResult, StaticMap, StereoCamera, TrackingStatus

_LANDMARK_MARGIN = 0.2  # features and pixels lie off objects in shares that differ by less
_log = logging.getLogger("dyob.slam")


class DyObSlam:
    """Dynamic-object SLAM of one camera, frame by frame.

    >>> slam = DyObSlam(sequence.camera)
    >>> for index in range(len(sequence)):
    ...     result = slam.process(sequence.read(index))
    ...     result.T_world_camera, result.objects.object_id, result.objects.speed_mps
    >>> slam.static_map().points_m
    >>> slam.close()

    It knows no files and no ground truth; `run` adds them, and the global batch at the end.
    """

    def __init__(
        self,
        camera: StereoCamera,
        config: Config | None = None,
        known_map: SparseMap | None = None,
        localize: bool = False,
        arrays: PagedArrays | None = None,
    ) -> None:
        """A system that has seen nothing yet.

        camera: of all frames to come, as `sequence.camera`. config: all settings; the default ones
        where None. known_map: of an earlier run, whose world holds; it is continued, and so it
        changes. Every frame is LOST then until one is recognised in it. localize: the map is only
        read. arrays: where the map is kept; in memory where None.
        Raises ValueError for localize without a map, FormatError for a damaged vocabulary.
        """
        if localize and known_map is None:
            raise ValueError("DyObSlam: localize needs a known_map to find the camera in")
        self.camera = camera
        self.config = config or Config()
        self.map = SparseMap(camera, self.config.mapping) if known_map is None else known_map
        if known_map is not None and not localize:
            known_map.detach_offset()
        self.localize = localize
        self.arrays = arrays or PagedArrays()
        self.map.move_into(self.arrays)
        self.places = SeenPlaces(self.config.places)
        self.places.add_map(self.map)
        self._orb = OrbExtractor(self.config.orb)
        self._stereo: StereoDepth | None = None
        self.sensor = Sensor(camera, self.config.depth)
        self._tracker = Tracker(self.sensor, self.config.tracking, self.places.alike)
        self._mapping = LocalMapping(self.sensor, self.config.mapping, self.config.orb)
        # The world of a known map has its origin elsewhere
        self._camera_tracking = CameraTracking(
            self._tracker, self._mapping, knows_the_world=known_map is not None, localize=localize
        )
        self._segmentation = Segmentation(self.config.detector)
        self._flow = DenseFlow(self.config.flow)
        self._objects = ObjectTracker(self.sensor, self.config.objects, self.config.tracking.seed)
        self._geometry = MultiViewGeometry(camera, self.config.geometry)
        self._backend = BackEnd(self.sensor, self.config.backend, self.places)
        self._anchors = FrameAnchors()
        self._standing = StandingObjects(self.config.objects, self.config.orb.mask_dilation_px)
        self._static_tracks = Tracks.empty()  # of the last frame
        self._timings_ms: dict[str, float] = {}
        self._perception = (self._segmentation.__getstate__(), self._flow.__getstate__())

    def process(self, frame: Frame | PreparedFrame) -> FrameResult:
        """Track one frame: camera, objects, map. Frames must come in order of time.

        A frame that `prepare` has had before, in another thread say, is not prepared again. Losing
        track is no error but the result's status. Raises as `prepare`.
        """
        prepared = self.prepare(frame) if isinstance(frame, Frame) else frame
        self._timings_ms, self._perception = dict(prepared.timings_ms), prepared.perception
        # 11. What local bundle adjustment made better; never while a frame is under way
        with self._stage("backend"):
            self._take_correction()
        # The noise and offset learned by now: `prepare` ran ahead and could not know them
        with self._stage("view"):
            sigma, offset = self.sensor.noise.sigma_disparity_px, self.sensor.offset.offset_px
            view = complete_view(self.camera, prepared, sigma, offset)
        # 7. Which detection is which object; masks that are missed are carried on
        with self._stage("objects"):
            objects = self._objects.associate(view, prepared.detections, self._predict(view))
            view = self._hide_what_may_move(view, objects)
        # 4. Camera pose
        tracked = self._camera_tracking.track(view, self.map, self._stage)
        # Across a jump no motion can be told, of objects neither: as after a LOST frame
        covariance = np.full((6, 6), np.nan) if tracked.is_jump else tracked.covariance
        # 6. Multi-view geometry repairs masks, and finds what no detector knows
        with self._stage("geometry"):
            view = self._apply_geometry(prepared, view, tracked, objects)
        # 8, 9 and 5. Object motion, Kalman filters, what moves
        with self._stage("objects"):
            estimates = self._objects.estimate(view, objects, tracked.T_world_camera, covariance)
            view, tracked = self._forget_landmarks(view, tracked, objects)
        # 10. Sparse map
        with self._stage("mapping"):
            is_keyframe = self._grow_map(view, tracked)
            if is_keyframe:
                self._geometry.add_keyframe()
            seen = self._observations(view, tracked, offset)
        with self._stage("backend"):
            self._anchors.add(self.map, view.frame_index, tracked.T_world_camera)
            if is_keyframe:
                self._backend.after_keyframe(self.map, view.features)
        self._timings_ms["total"] = sum(self._timings_ms.values())
        result = self._result(prepared.frame, tracked, is_keyframe, estimates, objects)
        return replace(result, observations=seen)

    def prepare(self, frame: Frame) -> PreparedFrame:
        """The part of a frame's work that needs images alone; it may run ahead of `process`.

        Frames are prepared in their order, perhaps in one thread while another processes; the
        answers are the same. Raises FrameError for an image that is not of the camera's size,
        ModelError where a network's file is missing or damaged.
        """
        check_size(self.camera, frame)
        spent: dict[str, float] = {}
        # 0. Depth, given or by stereo
        with timed(spent, "depth"):
            depth_m = self._depth(frame)
        # 1. Masks of movable things
        with timed(spent, "detection"):
            detections = self._segmentation.detect(frame)
        # 2. Dense flow from the frame before
        with timed(spent, "flow"):
            flow_px = self._flow.compute(frame)
        # 3. ORB features
        with timed(spent, "features"):
            movable_below = self.config.objects.landmarks_below + _LANDMARK_MARGIN
            prepared = prepare_frame(
                self.camera, frame, depth_m, self._orb, detections, movable_below
            )
        return replace(
            prepared,
            flow_prev_to_curr_px=flow_px,
            flow_is_given=self._flow.is_given,
            timings_ms=spent,
            perception=(self._segmentation.__getstate__(), self._flow.__getstate__()),
        )

    # ------------------------------------------------------------------ state

    def fixed_parts(self) -> dict[str, object]:
        """By name, what is the same in another system of this camera and these settings."""
        parts = {f"config.{f.name}": getattr(self.config, f.name) for f in fields(self.config)}
        parts |= {"config": self.config, "camera": self.camera}
        return parts | {"orb": self._orb, "worker": self._backend.worker, "arrays": self.arrays}

    def state(self) -> dict[str, Any]:
        """All that the next frames depend on besides `fixed_parts`, for `restore`; not a copy.

        To be asked between two frames; one may be in preparation then.
        """
        segmentation, flow = self._perception
        own = {k: v for k, v in vars(self).items() if k not in ("_segmentation", "_flow")}
        return {"system": {**own, "_stereo": None}, "segmentation": segmentation, "flow": flow}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on as the system of this `state`, which had the same `fixed_parts`, would have."""
        vars(self).update(state["system"])
        self._segmentation.__setstate__(state["segmentation"])
        self._flow.__setstate__(state["flow"])
        self.map.move_into(self.arrays)

    def static_map(self) -> StaticMap:
        """The sparse static map as it stands, copied."""
        return self.map.snapshot()

    @property
    def n_corrections(self) -> int:
        """How often the back-end has moved the map so far."""
        return self._backend.n_applied

    def keyframe_poses(self) -> tuple[NDArray[np.int64], Array]:
        """Frame indices (K,) and T_world_camera (K, 4, 4) of all keyframes, as they are now."""
        keyframes = self.map.keyframes
        Ts = np.array([k.T_world_camera for k in keyframes]).reshape(-1, 4, 4)
        return np.array([k.frame_index for k in keyframes], np.int64), Ts

    def revise(self, results: Sequence[FrameResult]) -> list[FrameResult]:
        """Results of `process`, in their order, as the map's corrections since then have them."""
        if not self._backend.n_applied:
            return list(results)
        return self._anchors.revise(self.map, results)

    def settle(self) -> None:
        """Wait for what the back-end has under way, and let the map follow it: after the end."""
        while self._backend.is_busy(self.map):
            self._follow(self._backend.settle(self.map))

    def close(self) -> None:
        """End the back-end's process; frames may still come, and start it again."""
        self._backend.close()

    # ------------------------------------------------------------------ steps

    def _take_correction(self) -> None:
        """Let the map, and all that is remembered in the world, follow an answer that is due."""
        self._follow(self._backend.take())

    def _follow(self, correction: MapCorrection | None) -> None:
        if correction is None:
            return
        C = correct_map(self.map, correction)
        self._tracker.move_world(C)
        pairs = correction.duplicates
        self._tracker.rename_points(pairs[self.map.alive[pairs[:, 0]]])
        self._objects.move_world(C)
        self._geometry.move_world(C)

    def _depth(self, frame: Frame) -> NDArray[np.float32] | None:
        """(H, W) depth in m, given or by stereo; None where the frame has neither."""
        if frame.depth_m is not None or frame.image_right is None:
            return frame.depth_m
        if self._stereo is None:
            self._stereo = StereoDepth(self.config.depth, self.camera)
        return self._stereo.compute(frame.image, frame.image_right)

    def _predict(self, view: View) -> Array:
        """T_world_camera (4, 4) as expected for a view."""
        motion = self._tracker.motion
        return np.eye(4) if motion is None else motion.predict(view.timestamp_s)

    def _hide_what_may_move(self, view: View, objects: ObjectFrame) -> View:
        standing = self._objects.landmark_ids(view.timestamp_s)
        return self._standing.hide_others(view, objects.labels, standing)

    @property
    def _uses_geometry(self) -> bool:
        use = self.config.geometry.use if self.config.objects.enabled else "never"
        return use == "always" or (use == "auto" and self._segmentation.name != FILES)

    def _apply_geometry(
        self, prepared: PreparedFrame, view: View, tracked: TrackedFrame, objects: ObjectFrame
    ) -> View:
        """Step 6 on the frame's objects, which change; the view without what moves after all."""
        if not self._uses_geometry or tracked.status is not TrackingStatus.OK or tracked.is_jump:
            return view
        noise = self.sensor.noise
        seen = GeometryView(
            view.frame_index,
            view.timestamp_s,
            view.gray,
            prepared.disparity_px,
            tracked.T_world_camera,
            tracked.covariance,
            view.flow_prev_to_curr_px,
            noise.sigma_disparity_px,
            noise.sigma_uv_px["flow" if view.flow_is_given else "object_flow"],
            self.sensor.offset.offset_px,
        )
        found = self._geometry.segment(seen, objects.detections(self._objects.class_names()))
        names = self._objects.revise(view, objects, found, tracked.T_world_camera)
        self._geometry.rename(names)
        return self._hide_what_may_move(view, objects)

    def _forget_landmarks(
        self, view: View, tracked: TrackedFrame, objects: ObjectFrame
    ) -> tuple[View, TrackedFrame]:
        """Parked cars that drive off take their points of the map with them.

        What is left of the view and its tracks, so that nothing on them is mapped again.
        """
        gone = self._standing.driven_off(self._objects.landmark_ids(view.timestamp_s))
        gone &= set(objects.windows)
        if not gone or self.localize or tracked.status is not TrackingStatus.OK:
            return view, tracked
        left_by = np.where(np.isin(objects.labels, list(gone)), objects.labels, 0)
        left = self._standing.forget_points(self.map, view, tracked, left_by.astype(np.int32))
        return self._hide_what_may_move(view, objects), left

    def _grow_map(self, view: View, tracked: TrackedFrame) -> bool:
        """Whether the frame became a keyframe; LOST ones leave the map alone."""
        if tracked.status is not TrackingStatus.OK:
            self._static_tracks = Tracks.empty()
            return False
        if self.localize:
            tracks, is_keyframe = self._mapping.localize(self.map, tracked), False
        else:
            tracks, is_keyframe = self._mapping.integrate(self.map, view, tracked)
        if is_keyframe:
            self.places.add(len(self.map.keyframes) - 1, view.features.descriptors)
        self._tracker.remember(view, tracked.T_world_camera, tracks, self.map)
        self._static_tracks = tracks
        return is_keyframe

    # ---------------------------------------------------------------- answers

    def _observations(
        self, view: View, tracked: TrackedFrame, disparity_offset_px: float
    ) -> FrameObservations:
        """What this frame saw, for the batch."""
        T, sigma = tracked.T_world_camera, self.sensor.noise.sigma_disparity_px
        static = static_sightings(self.map, self._static_tracks, view.frame_index, T, sigma)
        return FrameObservations(
            view.frame_index,
            view.timestamp_s,
            tracked.status is TrackingStatus.OK,
            T,
            Sightings.concatenate(static, self._objects.sightings),
            disparity_offset_px,
        )

    def _result(
        self,
        frame: Frame,
        tracked: TrackedFrame,
        is_keyframe: bool,
        estimates: ObjectEstimates,
        objects: ObjectFrame,
    ) -> FrameResult:
        return FrameResult(
            frame.index,
            frame.timestamp_s,
            tracked.status,
            tracked.T_world_camera,
            tracked.covariance,
            tracked.hypothesis,
            is_keyframe,
            tracked.tracks.uv_px,
            tracked.tracks.point_ids,
            tracked.inliers,
            tracked.rmse_px,
            estimates,
            objects.labels if len(estimates) else None,
            self._timings_ms,
        )

    def _stage(self, name: str) -> AbstractContextManager[None]:
        return timed(self._timings_ms, name)


@contextmanager
def timed(spent_ms: dict[str, float], name: str) -> Iterator[None]:
    """Add the time of the block, in ms, to what was spent under its name."""
    begin = time.perf_counter()
    try:
        yield
    finally:
        spent_ms[name] = spent_ms.get(name, 0.0) + 1e3 * (time.perf_counter() - begin)
