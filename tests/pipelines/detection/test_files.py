"""The sequence's own masks, handed on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.config import DetectorConfig
from pipelines.detection.files import FilesDetector
from pipelines.object_types import UNNAMED_CLASS
from pipelines.types import Frame


@pytest.fixture
def files() -> FilesDetector:
    return FilesDetector(DetectorConfig())


def test_labels_keep_their_numbers_and_what_does_not_move_goes(files, frame: Frame) -> None:
    found = files.detect(frame)
    assert dict(zip(found.label_ids, found.class_names, strict=True)) == {
        7: "car",
        9: UNNAMED_CLASS,
    }
    assert (found.scores == 1).all()
    toaster = frame.instance_labels == 4
    assert (found.labels[toaster] == 0).all()
    np.testing.assert_array_equal(found.labels[~toaster], frame.instance_labels[~toaster])


def test_without_class_names_all_are_kept_unnamed(files, frame: Frame) -> None:
    found = files.detect(replace(frame, instance_classes=None))
    assert list(found.label_ids) == [4, 7, 9]
    assert set(found.class_names) == {UNNAMED_CLASS}
    np.testing.assert_array_equal(found.labels, frame.instance_labels)


def test_no_masks_and_empty_masks_are_no_instances(files, frame: Frame) -> None:
    for labels in (None, np.zeros_like(frame.instance_labels)):
        found = files.detect(replace(frame, instance_labels=labels))
        assert len(found) == 0
        assert found.labels.shape == frame.image.shape[:2]
        assert not found.labels.any()
