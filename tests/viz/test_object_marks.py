"""Objects on frames: labels that find room, what moves stands out, and what each state says."""

from dataclasses import replace

import numpy as np
import pytest

from pipelines.object_types import ObjectEstimates
from pipelines.types import Frame, FrameResult, MotionHypothesis, TrackingStatus
from viz import style
from viz.object_marks import label_text, object_counts, overlaps, place_labels
from viz.overlay import draw_frame

SIZES = [(1242, 375), (640, 480), (621, 188)]


def make_objects(boxes: np.ndarray, states: list[str], ids: np.ndarray | None = None):
    M = len(boxes)
    unknown = np.full(M, np.nan)
    return ObjectEstimates(
        np.zeros(M, np.int64), np.zeros(M), np.arange(1, M + 1) if ids is None else ids,
        np.full(M, "car"), np.ones(M), np.array(states), np.asarray(boxes, float),
        np.full(M, 99), np.full((M, 4, 4), np.nan), np.full((M, 4, 4), np.nan),
        np.full((M, 6, 6), np.nan), np.full((M, 3), np.nan), np.full(M, 12.0), unknown,
        np.tile([3.0, 0.0, 4.0], (M, 1)), unknown, np.full((M, 3), np.nan),
    )  # fmt: skip


def crowd(size: tuple[int, int], n: int, seed: int) -> ObjectEstimates:
    """Random boxes, many of them over each other or at the image's edge."""
    rng = np.random.default_rng(seed)
    W, H = size
    corner = rng.uniform([-20, 0], [W - 10, H - 10], (n, 2))
    far = corner + rng.uniform(8, [0.3 * W, 0.4 * H], (n, 2))
    boxes = np.clip(np.concatenate([corner, far], 1), 0, [W - 1, H - 1, W - 1, H - 1])
    return make_objects(boxes, rng.choice(["moving", "stopped", "unknown", "coasting"], n).tolist())


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("seed", range(4))
def test_labels_stay_inside_and_off_each_other(size, seed):
    W, H = size
    objects = crowd(size, 24, seed)
    labels = place_labels(objects, None, (H, W), 28)
    for n, label in enumerate(labels):
        u0, v0, u1, v1 = label.box
        assert 0 <= u0 < u1 <= W
        assert 28 <= v0 < v1 <= H
        assert label.size_px >= 11
        assert u1 - u0 >= style.text_size(label.text, label.size_px)[0]
        assert not overlaps(label.box, [other.box for other in labels[:n]])
    moving = set(objects.object_id[objects.state == "moving"].tolist())
    assert moving <= {label.object_id for label in labels}  # none of these is left out


def test_a_label_is_near_its_object_where_there_is_room():
    boxes = [[300, 150, 400, 220], [0, 29, 80, 374], [1200, 30, 1241, 374], [500, 360, 560, 374]]
    objects = make_objects(np.array(boxes), ["moving"] * 4)
    for label in place_labels(objects, None, (375, 1242), 28):
        u0, v0, u1, v1 = boxes[label.object_id - 1]
        a0, b0, a1, b1 = label.box
        assert a0 <= u1 + 3 and a1 >= u0 - 3
        assert b0 <= v1 + 3 and b1 >= v0 - 3


def test_what_labels_say():
    objects = make_objects(np.zeros((4, 4)), ["moving", "stopped", "unknown", "coasting"])
    texts = [label_text(objects, row) for row in range(4)]
    # Eq. (6) says 12 m/s, the filter 5 m/s.
    assert texts == ["1 car 43 km/h", "2 car stopped", "3 car ?", "4 car ~18 km/h"]
    slow = replace(objects, speed_mps=np.array([1.4, 0, 0, 0]))
    assert label_text(slow, 0) == "1 car 5.0 km/h"
    assert label_text(replace(objects, speed_mps=np.full(4, np.nan)), 0) == "1 car 18 km/h"
    lost = replace(objects, velocities_mps=np.full((4, 3), np.nan))
    assert label_text(lost, 3) == "4 car ?"
    assert object_counts(objects) == "1 moving, 1 stopped"
    assert object_counts(ObjectEstimates.empty()) == ""


def draw(objects: ObjectEstimates, labels: np.ndarray) -> np.ndarray:
    frame = Frame(0, 0.0, np.full((*labels.shape, 3), 90, np.uint8))
    nothing = np.empty(0, np.int64)
    result = FrameResult(
        0, 0.0, TrackingStatus.OK, np.eye(4), np.eye(6), MotionHypothesis.NONE, False,
        np.empty((0, 2)), nothing, np.empty(0, bool), np.nan, objects, labels,
    )  # fmt: skip
    return draw_frame(frame, result)


def test_states_look_different():
    labels = np.zeros((375, 800), np.int32)
    boxes = [[50, 150, 149, 249], [250, 150, 349, 249], [450, 150, 549, 249], [650, 150, 749, 249]]
    for object_id, (u0, v0, u1, v1) in enumerate(boxes[:3], 1):
        labels[v0 + 10 : v1 - 9, u0 + 10 : u1 - 9] = object_id
    objects = make_objects(np.array(boxes), ["moving", "stopped", "unknown", "coasting"])
    picture = draw(objects, labels).astype(int)
    tint = [np.abs(picture[200, u] - 90).sum() for u in (100, 300, 500)]
    share = [t / np.abs(np.array(style.object_color(j)) - 90).sum() for j, t in enumerate(tint, 1)]
    assert share[0] > 1.5 * share[2] > 1.5 * 0.7 * share[1] > 0.1
    for n, (u0, _, u1, v1) in enumerate(boxes):
        color = style.object_color(n + 1)
        edge = np.abs(picture[v1, u0 : u1 + 1] - color).sum(1) < 30
        drawn = {0: edge.mean() > 0.95, 1: not edge.any(), 2: not edge.any()}
        assert drawn.get(n, 0.4 < edge.mean() < 0.85), n  # the last one is dashed


def test_an_id_has_its_color_in_every_frame():
    labels = np.zeros((375, 800), np.int32)
    labels[150:250, 50:150] = 7
    ids = np.array([7])
    first = draw(make_objects(np.array([[50, 150, 149, 249]]), ["moving"], ids), labels)
    second = draw(
        make_objects(np.array([[450, 150, 549, 249]]), ["moving"], ids), np.roll(labels, 400, 1)
    )
    np.testing.assert_array_equal(first[200, 100], second[200, 500])
    np.testing.assert_array_equal(first[249, 100], style.object_color(7))


def test_without_a_box_the_mask_says_where():
    labels = np.zeros((375, 800), np.int32)
    labels[150:250, 50:150] = 1
    objects = make_objects(np.full((2, 4), np.nan), ["moving", "coasting"])
    placed = place_labels(objects, labels, labels.shape, 28)
    assert [label.object_id for label in placed] == [1]  # the other is nowhere to be seen
    assert (draw(objects, labels)[249, 60] == style.object_color(1)).all()
