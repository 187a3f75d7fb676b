"""The system: a frame goes in, a result comes out.

Owns the order of the steps and the state between frames. Each step is a function or a small class
in `depth`, `frontend` and `mapping`; ground truth never comes near. The steps have the numbers of
the design: 2 (dense flow) comes with the sequence, 5 to 9 (moving objects) are not here yet.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipelines.config import Config
from pipelines.depth import StereoDepth
from pipelines.errors import FrameError
from pipelines.frontend.orb import OrbExtractor
from pipelines.frontend.sensor import Sensor
from pipelines.frontend.tracking import TrackedFrame, Tracker
from pipelines.frontend.view import PreparedFrame, View, complete_view, prepare_frame
from pipelines.mapping.local_mapping import LocalMapping
from pipelines.mapping.sparse_map import SparseMap
from pipelines.object_types import Detections
from pipelines.objects.tracking import ObjectTracker
from pipelines.observations import Tracks
from pipelines.types import (
    Array,
    Frame,
    FrameResult,
    MotionHypothesis,
    StaticMap,
    StereoCamera,
    TrackingStatus,
)


class DyObSlam:
    """Dynamic-object SLAM of one camera, frame by frame.

    >>> slam = DyObSlam(sequence.camera)
    >>> result = slam.process(sequence.read(0))
    """

    def __init__(self, camera: StereoCamera, config: Config | None = None) -> None:
        self.camera = camera
        self.config = config or Config()
        self.map = SparseMap(camera, self.config.mapping)
        self._orb = OrbExtractor(self.config.orb)
        self._stereo: StereoDepth | None = None
        self.sensor = Sensor(camera, self.config.depth)
        self._tracker = Tracker(self.sensor, self.config.tracking)
        self._mapping = LocalMapping(self.sensor, self.config.mapping, self.config.orb)
        self._objects = ObjectTracker(self.sensor, self.config.objects)
        self._lost_frames = 0
        self._timings_ms: dict[str, float] = {}

    def process(self, frame: Frame | PreparedFrame) -> FrameResult:
        """Track one frame and grow the map. Frames must come in order of time.

        A frame that `prepare` has had before, in another thread say, is not prepared again.
        """
        prepared = self.prepare(frame) if isinstance(frame, Frame) else frame
        self._timings_ms = dict(prepared.timings_ms)
        # The noise and offset learned by now: `prepare` ran ahead and could not know them
        with self._stage("view"):
            sigma, offset = self.sensor.noise.sigma_disparity_px, self.sensor.offset.offset_px
            view = complete_view(self.camera, prepared, sigma, offset)
        objects, frame_objects = self._objects, None
        T_predicted = self._predicted_pose(view.timestamp_s)
        with self._stage("objects"):
            flow = view.flow_prev_to_curr_px
            frame_objects = objects.associate(view, flow, detections(prepared.frame), T_predicted)
        # 4. Camera pose
        tracked = self._track(view)
        with self._stage("objects"):
            estimates = objects.estimate(
                view, flow, frame_objects, tracked.T_world_camera, tracked.covariance
            )
        # 10. Sparse map
        with self._stage("mapping"):
            is_keyframe = self._grow_map(view, tracked)
        self._timings_ms["total"] = sum(self._timings_ms.values())
        return replace(
            self._result(prepared.frame, tracked, is_keyframe),
            objects=estimates,
            object_labels=frame_objects.labels,
        )

    def _predicted_pose(self, timestamp_s):
        motion = self._tracker.motion
        return np.eye(4) if motion is None else motion.predict(timestamp_s)

    def prepare(self, frame: Frame) -> PreparedFrame:
        """The part of a frame's work that depends on no other frame; it may run ahead of `process`.

        Frames may be prepared in one thread while another processes; the answers are the same.
        Raises FrameError for an image that is not of the camera's size.
        """
        _check_size(self.camera, frame)
        begin = time.perf_counter()
        # 0. Depth, given or by stereo
        depth_m = self._depth(frame)
        middle = time.perf_counter()
        # 1 and 3. Movable objects are masked; ORB features on the static part
        prepared = prepare_frame(self.camera, frame, depth_m, self._orb)
        end = time.perf_counter()
        timings_ms = {"depth": 1e3 * (middle - begin), "features": 1e3 * (end - middle)}
        return replace(prepared, timings_ms=timings_ms)

    def static_map(self) -> StaticMap:
        """The sparse static map as it stands, copied."""
        return self.map.snapshot()

    # ------------------------------------------------------------------ steps

    def _depth(self, frame: Frame) -> NDArray[np.float32] | None:
        """(H, W) depth in m, given or by stereo; None where the frame has neither."""
        if frame.depth_m is not None or frame.image_right is None:
            return frame.depth_m
        if self._stereo is None:
            self._stereo = StereoDepth(self.config.depth, self.camera)
        return self._stereo.compute(frame.image, frame.image_right)

    def _track(self, view: View) -> TrackedFrame:
        if self._tracker.motion is None:
            return self._start(view, np.eye(4))
        tracked = self._tracker.track(view, self.map, self._stage)
        if tracked.status is TrackingStatus.OK:
            self._tracker.motion.update(
                tracked.T_world_camera, view.timestamp_s, continuous=self._lost_frames == 0
            )
            self._lost_frames = 0
            return tracked
        self._tracker.forget_flow()
        if len(self._mapping.mappable_features(view, Tracks.empty())):
            self._lost_frames += 1
        if self._lost_frames >= self.config.tracking.restart_after_frames:
            return self._start(view, tracked.T_world_camera)
        return tracked

    def _start(self, view: View, T_world_camera: Array) -> TrackedFrame:
        """First frame, or a new start at the predicted pose after a lost stretch.

        LOST while too few features have a depth: the next frame tries again.
        """
        n_points = len(self._mapping.mappable_features(view, Tracks.empty()))
        enough = n_points >= self.config.tracking.min_inliers
        if enough:
            self._tracker.start(view, T_world_camera)
            self._lost_frames = 0
        return TrackedFrame(
            TrackingStatus.OK if enough else TrackingStatus.LOST,
            MotionHypothesis.FIRST_FRAME if enough else MotionHypothesis.NONE,
            T_world_camera,
            np.zeros((6, 6)) if enough else np.full((6, 6), np.nan),
            Tracks.empty(),
            np.zeros(0, bool),
            np.nan,
            np.empty(0, np.int64),
        )

    def _grow_map(self, view: View, tracked: TrackedFrame) -> bool:
        """Whether the frame became a keyframe; LOST ones leave the map alone."""
        if tracked.status is not TrackingStatus.OK:
            return False
        tracks, is_keyframe = self._mapping.integrate(self.map, view, tracked)
        self._tracker.remember(view, tracks)
        return is_keyframe

    # ---------------------------------------------------------------- answers

    def _result(self, frame: Frame, tracked: TrackedFrame, is_keyframe: bool) -> FrameResult:
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
            timings_ms=self._timings_ms,
        )

    @contextmanager
    def _stage(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        try:
            yield
        finally:
            spent = 1e3 * (time.perf_counter() - begin)
            self._timings_ms[name] = self._timings_ms.get(name, 0.0) + spent


def detections(frame):
    labels = frame.instance_labels
    if labels is None:
        return Detections.empty(frame.image.shape)
    ids = np.flatnonzero(np.bincount(labels.ravel()))
    ids = ids[ids > 0].astype(np.int32)
    return Detections(labels, ids, np.full(len(ids), "object", "U16"), np.ones(len(ids)))


def _check_size(camera: StereoCamera, frame: Frame) -> None:
    height, width = frame.image.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise FrameError(
            f"expected an image of {camera.width} x {camera.height}, found {width} x {height}; "
            "all images of a sequence must have the calibrated size"
        )
