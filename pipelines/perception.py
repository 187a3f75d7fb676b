"""Steps 1 and 2 of a frame: instance masks and dense flow, by the methods that the settings name.

Owns their choice, when the network runs, and what happens when it is late or fails: then a frame
has no answer, and the object tracker carries the masks on. Knows no poses and no objects.
"""

from __future__ import annotations

import logging
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures import TimeoutError as LateError
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.config import DetectorConfig, FlowConfig
from pipelines.detection import AUTO, Detector, choose_detector, load_detector
from pipelines.errors import ConfigError, ModelError
from pipelines.flow import Flow, choose_flow, load_flow
from pipelines.object_types import Detections
from pipelines.types import Frame

MOTION = "motion"  # the detector that is no network
FILES = "files"
_log = logging.getLogger("dyob.perception")


class Segmentation:
    """Asks the detector for the masks of frames; step 1.

    name: of the method in use, known after the first frame: `auto` depends on what frames bring.
    """

    def __init__(self, config: DetectorConfig) -> None:
        self.config = config
        self.name = ""
        self._detector: Detector | None = None
        self._n_seen = 0
        self._pool: ThreadPoolExecutor | None = None
        self._late: tuple[int, Future[Detections]] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """All but the network; a late answer would be of no use."""
        return {**vars(self), "_detector": None, "_pool": None, "_late": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        if self.name:
            self._detector = load_detector(replace(self.config, name=self.name))

    def detect(self, frame: Frame) -> Detections | None:
        """Masks of a frame, or None where there is no answer for it.

        None: not its turn, late, failed, or a sequence's masks lack this frame.

        Raises ModelError where the network's file is missing or damaged; other failures of a
        network are a warning, as one bad frame must not end a run.
        """
        detector = self._choose(frame)
        if self.name == MOTION:  # no network: geometry does all the work, once the pose is known
            return None
        turn = self._n_seen % self.config.every_n == 0
        self._n_seen += 1
        if not turn or (self.name == FILES and frame.instance_labels is None):
            return None  # a mask file that is missing does not say that nothing is there
        try:
            return self._ask(detector, frame)
        except (ModelError, ConfigError):
            raise
        except Exception as error:  # whatever a network may throw at one image
            _warn_of_failure(frame.index, error)
            return None

    def _choose(self, frame: Frame) -> Detector:
        """By the first frame, and once more if it was one whose masks the sequence lacks."""
        has_masks = frame.instance_labels is not None
        is_auto = self.config.name == AUTO and not self.config.model
        if self._detector is None or (has_masks and is_auto and self.name != FILES):
            self.name = choose_detector(self.config, has_masks)
            self._detector = load_detector(replace(self.config, name=self.name))
        return self._detector

    def _ask(self, detector: Detector, frame: Frame) -> Detections | None:
        if self.config.timeout_ms <= 0:
            return detector.detect(frame)
        if self._late is not None:
            index, pending = self._late
            if not pending.done():
                return None  # still busy with an earlier frame
            self._late = None  # an answer to a frame that has passed is of no use, an error is
            error = pending.exception()
            if isinstance(error, ModelError | ConfigError):
                raise error
            if error is not None:
                _warn_of_failure(index, error)
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, thread_name_prefix="detector")
        pending = self._pool.submit(detector.detect, frame)
        try:
            return pending.result(self.config.timeout_ms / 1e3)
        except LateError:
            self._late = frame.index, pending
            return None


def _warn_of_failure(index: int, error: BaseException) -> None:
    kind = type(error).__name__
    _log.warning(
        "frame %d: the detector failed (%s: %s); masks are carried on by flow", index, kind, error
    )


class DenseFlow:
    """Dense optical flow from each frame to the next; step 2.

    is_given: whether the last flow came with the sequence rather than being computed here.
    """

    def __init__(self, config: FlowConfig) -> None:
        self.config = config
        self.is_given = False
        self._method: Flow | None = None
        self._name = ""
        self._fallback: Flow | None = None
        self._previous: Frame | None = None

    def __getstate__(self) -> dict[str, Any]:
        """All but the methods, which remember nothing."""
        return {**vars(self), "_method": None, "_fallback": None}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        if self._name:
            self._method = load_flow(replace(self.config, name=self._name))

    def compute(self, frame: Frame) -> NDArray[np.float32] | None:
        """Flow (H, W, 2) from the frame before, on its grid; None for the first frame.

        A flow that comes with the sequence starts at the frame with the index before; where that
        is not the frame that was seen before, or the file is missing, `auto` computes it.
        """
        previous, self._previous = self._previous, frame
        if previous is None:
            return None
        given = frame.flow_prev_to_curr_px if frame.index == previous.index + 1 else None
        has_flow = frame.flow_prev_to_curr_px is not None
        late = has_flow and self.config.name == AUTO and self._name != FILES  # first file missing
        if self._method is None or late:
            self._name = choose_flow(self.config, has_flow)
            self._method = load_flow(replace(self.config, name=self._name), given is not None)
        self.is_given = self._name == FILES and given is not None
        if self._name == FILES and given is None:
            if self.config.name == FILES:
                return None
            if self._fallback is None:
                self._fallback = load_flow(replace(self.config, name="dis"))
            return self._fallback.compute(previous.image, frame.image)
        return self._method.compute(previous.image, frame.image, given)
