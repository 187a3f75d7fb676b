"""The masks that come with the sequence.

Owns which of them count as movable, nothing else.
"""

from __future__ import annotations

import numpy as np

from pipelines.config import DetectorConfig
from pipelines.object_types import UNNAMED_CLASS, Detections
from pipelines.types import Frame


class FilesDetector:
    """`detect` returns the frame's own instances, with score 1 and the class that it names."""

    def __init__(self, config: DetectorConfig) -> None:
        self._classes = {*config.classes, UNNAMED_CLASS}

    def detect(self, frame: Frame) -> Detections:
        """The frame's labels, as they are where all are kept; see `pipelines.detection.Detector`.

        An instance whose class the sequence does not say is kept as UNNAMED_CLASS; one of a class
        that is no movable one is background.
        """
        labels = frame.instance_labels
        if labels is None:
            return Detections.empty(frame.image.shape)
        known = frame.instance_classes or {}
        ids = np.unique(labels[labels > 0]).astype(np.int32)
        names = np.array([known.get(int(i), UNNAMED_CLASS) for i in ids], dtype=np.str_)
        kept = np.array([name in self._classes for name in names], bool)
        if not kept.all():
            labels = np.where(np.isin(labels, ids[kept]), labels, 0).astype(np.int32)
        return Detections(labels, ids[kept], names[kept], np.ones(np.count_nonzero(kept)))
