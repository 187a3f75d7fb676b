"""The camera's way through good stretches and lost ones: the first frame, going on, starting anew.

Owns when a new piece of map may begin, and what a pose tells the motion model. How one frame is
tracked is `frontend.tracking`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import AbstractContextManager

import numpy as np

from pipelines.frontend.tracking import TrackedFrame, Tracker
from pipelines.frontend.view import View
from pipelines.mapping.local_mapping import LocalMapping
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.types import Array, MotionHypothesis, TrackingStatus

_log = logging.getLogger("dyob.slam")


class CameraTracking:
    """Tracks frame after frame, and begins again where the camera has long been lost."""

    def __init__(
        self, tracker: Tracker, mapping: LocalMapping, *, knows_the_world: bool, localize: bool
    ) -> None:
        """knows_the_world: there is a loaded map; localize: which is only read."""
        self._tracker, self._mapping = tracker, mapping
        self._knows_the_world, self._localize = knows_the_world, localize
        self._lost_frames = 0

    def track(
        self,
        view: View,
        sparse_map: SparseMap,
        stage: Callable[[str], AbstractContextManager[None]],
    ) -> TrackedFrame:
        """The camera's pose in a view, by step 4; LOST where nothing bears it out.

        stage: times its parts, by name.
        """
        if self._tracker.motion is None and not self._knows_the_world:
            return self._start(view, np.eye(4))
        motion = self._tracker.motion or self._tracker.start(view, np.eye(4))
        tracked = self._tracker.track(view, sparse_map, stage)
        if tracked.status is TrackingStatus.OK:
            motion.update(
                tracked.T_world_camera,
                view.timestamp_s,
                continuous=self._lost_frames == 0 and not tracked.is_jump,
            )
            self._lost_frames = 0
            return tracked
        self._tracker.forget_flow()
        if self._n_mappable(view):
            self._lost_frames += 1
        restart_after = self._tracker.config.restart_after_frames
        if self._lost_frames >= restart_after:
            if self._may_start_anew:
                return self._start(view, tracked.T_world_camera)
            if self._lost_frames == restart_after:
                _log.warning(
                    "frame %d: the place is not recognised in the loaded map after %d frames; "
                    "frames stay LOST until one is",
                    view.frame_index,
                    self._lost_frames,
                )
        return tracked

    @property
    def _may_start_anew(self) -> bool:
        """Whether a new piece of map may begin where the motion led.

        Not before a loaded map was recognised: nothing would tie the piece to that map's world.
        """
        return not self._localize and (self._tracker.remembers or not self._knows_the_world)

    def _start(self, view: View, T_world_camera: Array) -> TrackedFrame:
        """First frame, or a new start at the predicted pose after a lost stretch.

        LOST while too few features have a depth: the next frame tries again.
        """
        enough = self._n_mappable(view) >= self._tracker.config.min_inliers
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

    def _n_mappable(self, view: View) -> int:
        return len(self._mapping.mappable_features(view, Tracks.empty()))
