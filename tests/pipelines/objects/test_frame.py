"""One frame's masks by lasting id: reading, removing, and as detections."""

import numpy as np

from pipelines.object_types import UNNAMED_CLASS
from pipelines.objects.following import Followed
from pipelines.objects.frame import LastObjects, ObjectFrame
from pipelines.objects.points import ObjectPoints


def frame_of(**windows):
    labels = np.zeros((20, 30), np.int32)
    frame = ObjectFrame(labels, True, ObjectPoints.empty(), Followed.empty(), False)
    for name, window in windows.items():
        labels[window] = int(name[1:])
        frame.windows[int(name[1:])] = window
        frame.scores[int(name[1:])] = 0.5
    return frame


ONE, TWO = (slice(2, 8), slice(3, 10)), (slice(5, 15), slice(8, 20))


def test_masks_are_those_of_one_object_where_windows_overlap():
    frame = frame_of(_1=ONE, _2=TWO)
    assert frame.mask(1).sum() == 6 * 7 - 3 * 2 and frame.mask(2).all()
    np.testing.assert_array_equal(frame.box_px(2), [8, 5, 19, 14])


def test_what_is_removed_leaves_the_others():
    frame = frame_of(_1=ONE, _2=TWO)
    frame.remove(1)
    assert list(frame.windows) == list(frame.scores) == [2]
    assert set(np.unique(frame.labels)) == {0, 2} and (frame.labels == 2).sum() == 120


def test_as_detections_by_lasting_id():
    found = frame_of(_7=ONE, _2=TWO).detections({2: "car"})
    assert found.label_ids.tolist() == [2, 7]
    assert found.class_names.tolist() == ["car", UNNAMED_CLASS]
    assert found.scores.tolist() == [0.5, 0.5]
    none = frame_of().detections({})
    assert len(none) == 0 and none.class_names.dtype.kind == "U"


def test_the_last_frame_knows_masks_of_what_was_in_sight():
    frame = frame_of(_1=ONE)
    last = LastObjects(None, np.eye(4), True, frame.labels, frame.windows, ObjectPoints.empty())
    mask, window = last.mask(1)
    assert mask.all() and window == ONE
    assert last.mask(2) is None
