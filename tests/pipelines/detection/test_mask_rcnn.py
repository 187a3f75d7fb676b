"""Mask R-CNN's outputs in both forms, on small networks that have them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.config import DetectorConfig
from pipelines.detection.coco import COCO_80, COCO_91
from pipelines.detection.mask_rcnn import SIDES_KEY, MaskRcnn
from pipelines.errors import ModelError
from pipelines.types import Frame

PERSON, CAR, TRUCK = 1, 3, 8  # of COCO's own ids
RED = (slice(20, 61), slice(30, 91))
BOX = [20, 10, 100, 80]


def detect(path, frame, **settings):
    return MaskRcnn(DetectorConfig(name="mask_rcnn", model=str(path), **settings)).detect(frame)


def test_small_masks_lie_in_their_boxes(make_mask_rcnn, frame: Frame) -> None:
    found = detect(make_mask_rcnn([BOX], [CAR], [0.8]), frame)
    expected = np.zeros(frame.image.shape[:2], np.int32)
    expected[10:80, 20:60] = 1  # the left half
    corners = np.ix_([10, 79], [20, 59])  # which reading between cells rounds off
    expected[corners] = found.labels[corners]
    np.testing.assert_array_equal(found.labels, expected)
    assert (list(found.class_names), found.scores) == (["car"], pytest.approx([0.8]))


@pytest.mark.parametrize("input_width_px", [0, 128, 64, 192])
def test_pasted_masks_are_cut_to_their_boxes(make_mask_rcnn, frame, input_width_px) -> None:
    scale = input_width_px / 128 or 1.0
    path = make_mask_rcnn([[side * scale for side in BOX]], [CAR], [0.8], pasted=True)
    found = detect(path, frame, input_width_px=input_width_px)
    expected = np.zeros(frame.image.shape[:2], bool)
    expected[RED] = True
    wrong = expected != (found.labels == 1)
    assert wrong.sum() == 0 if scale >= 1 else wrong.sum() < 0.05 * expected.sum()


def test_the_better_one_is_before_the_other(make_mask_rcnn, frame: Frame) -> None:
    boxes = [[20, 10, 100, 80], [40, 30, 120, 90], [20, 10, 100, 81]]
    found = detect(make_mask_rcnn(boxes, [CAR, PERSON, TRUCK], [0.6, 0.9, 0.5]), frame)
    assert list(found.class_names) == ["person", "car"]
    assert (found.labels[40:80, 45:55] == 1).all()
    assert (found.labels[12:25, 25:55] == 2).all()


def test_weak_ones_and_other_classes_are_left_out(make_mask_rcnn, frame: Frame) -> None:
    boxes = [[0, 0, 30, 30], [40, 0, 70, 30], [80, 0, 110, 30], [0, 50, 30, 80]]
    path = make_mask_rcnn(boxes, [CAR, CAR, 10, 12], [0.9, 0.3, 0.9, 0.9])  # 10: traffic light
    assert len(detect(path, frame)) == 1
    assert len(detect(path, frame, min_score=0.2)) == 2
    assert len(detect(path, frame, min_score=0.2, max_instances=1)) == 1


def test_no_instances_are_no_instances(make_mask_rcnn, frame: Frame) -> None:
    for pasted in (False, True):
        path = make_mask_rcnn([[0, 0, 30, 30]], [10], [0.9], pasted)
        assert len(detect(path, frame)) == 0


def test_a_file_that_says_so_gets_images_as_torchvision_scales_them(make_mask_rcnn, frame) -> None:
    onnx = pytest.importorskip("onnx")
    path = make_mask_rcnn([BOX], [CAR], [0.8])
    network = onnx.load(path)
    onnx.helper.set_model_props(network, {SIDES_KEY: "800 1333"})
    onnx.save(network, path)
    detector = MaskRcnn(DetectorConfig(model=str(path)))
    shapes = {(375, 1242): (402, 1333), (480, 640): (800, 1066), (1000, 200): (1333, 266)}
    for shape, scaled in shapes.items():
        assert detector._scaled(np.zeros((*shape, 3), np.uint8)).shape == (3, *scaled)
    narrow = MaskRcnn(DetectorConfig(model=str(path), input_width_px=621))
    assert narrow._scaled(np.zeros((375, 1242), np.uint8)).shape == (3, 187, 621)
    found = detector.detect(frame)  # boxes are in px of 800 x 1066
    u = np.nonzero(found.labels)[1]
    assert (u.max() - u.min() + 1) / 128 == pytest.approx(40 / 1066, abs=0.02)


def test_outputs_of_another_network_are_refused_with_what_was_found(make_mask_rcnn, frame) -> None:
    detector = MaskRcnn(DetectorConfig(model=str(make_mask_rcnn([BOX], [CAR], [0.8]))))
    whole = detector._network.run(np.zeros((3, 96, 128), np.float32))
    lacking = {name: array for name, array in whole.items() if name != "masks"}
    with pytest.raises(ModelError, match=r"found boxes float32 \[1, 4\], labels int64 \[1\]"):
        detector._sorted(lacking)
    with pytest.raises(ModelError, match="expected Mask R-CNN's outputs"):
        detector._sorted({**whole, "scores": np.zeros(2, np.float32)})


def test_the_order_and_names_of_outputs_do_not_matter(make_mask_rcnn, frame: Frame) -> None:
    detector = MaskRcnn(DetectorConfig(model=str(make_mask_rcnn([BOX], [CAR], [0.8]))))
    whole = detector._network.run(np.zeros((3, 96, 128), np.float32))
    renamed = {str(i): whole[name] for i, name in enumerate(("masks", "scores", "boxes", "labels"))}
    for ours, theirs in zip(detector._sorted(renamed), detector._sorted(whole), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_grey_images_are_seen_too(make_mask_rcnn, frame: Frame) -> None:
    grey = replace(frame, image=np.ascontiguousarray(frame.image[..., 0]))
    found = detect(make_mask_rcnn([BOX], [CAR], [0.8], pasted=True), grey)
    assert (found.labels[RED] == 1).all()


def test_both_numberings_of_coco_have_the_same_names() -> None:
    assert len(COCO_80) == len(set(COCO_80)) == 80
    assert list(COCO_91.values()) == list(COCO_80)
    assert [COCO_91[i] for i in (1, 3, 13, 44, 62, 90)] == [
        "person", "car", "stop sign", "bottle", "chair", "toothbrush",
    ]  # fmt: skip


@pytest.mark.slow
def test_names_are_torchvisions() -> None:
    pytest.importorskip("torch")
    from torchvision.models.detection import MaskRCNN_ResNet50_FPN_Weights

    theirs = MaskRCNN_ResNet50_FPN_Weights.COCO_V1.meta["categories"]
    for i, name in enumerate(theirs):
        if name not in ("__background__", "N/A"):
            assert COCO_91[i] == name
    assert len(COCO_91) == sum(name not in ("__background__", "N/A") for name in theirs)
