"""No detector at all: moving things are left to multi-view geometry.

That step looks at a frame once the camera's pose is known, and needs no masks before it. This class
keeps its place in the table, so that nothing else has to ask whether there is a detector.
"""

from __future__ import annotations

from pipelines.config import DetectorConfig
from pipelines.object_types import Detections
from pipelines.types import Frame


class MotionDetector:
    """`detect` finds nothing, by design."""

    def __init__(self, config: DetectorConfig) -> None:
        del config  # every detector gets its settings; this one has none

    def detect(self, frame: Frame) -> Detections:
        """No instance, on an image of the frame's size; see `pipelines.detection.Detector`."""
        return Detections.empty(frame.image.shape)
