"""Masks at their place, duplicates and overlaps."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from pipelines.detection.instances import compose, place_mask, suppress_duplicates

SHAPE = (40, 60)


def test_a_mask_is_read_between_the_cells_of_its_grid() -> None:
    """A plane 2 x + y - 60 over the image, given on cells of 4 px: the line is where it is zero."""
    rows, columns = np.mgrid[:10, :15].astype(np.float32)
    plane = 2 * (4 * columns + 2) + (4 * rows + 2) - 60
    x, y, mask = place_mask(plane, (4, 4), (0, 0), np.array([10.2, 3.0, 47.6, 36.4]), SHAPE, 0.0)
    assert (x, y, mask.shape) == (10, 3, (33, 38))
    v, u = np.mgrid[3:36, 10:48]
    exact = 2 * (u + 0.5) + (v + 0.5) - 60
    clear = np.abs(exact) > 0.1
    np.testing.assert_array_equal(mask[clear], (exact > 0)[clear])


def test_a_box_beyond_the_image_is_cut_and_one_outside_is_empty() -> None:
    ones = np.ones((4, 4), np.float32)
    x, y, mask = place_mask(ones, (20, 20), (-10, -10), np.array([-5, -9, 500, 500]), SHAPE, 0.5)
    assert (x, y, mask.shape, mask.all()) == (0, 0, SHAPE, True)
    for box in ([70, 5, 90, 20], [5, 5, 5, 20], [-20, -20, -5, -5]):
        assert not place_mask(ones, (20, 20), (0, 0), np.array(box), SHAPE, 0.5)[2].any()


@pytest.mark.slow
def test_masks_are_pasted_as_torchvision_does_to_a_pixel() -> None:
    torch = pytest.importorskip("torch")
    from torchvision.models.detection.roi_heads import paste_masks_in_image

    v, u = np.mgrid[:28, :28]
    grid = 1 / (1 + np.exp((np.hypot(u - 13.5, 1.3 * (v - 15)) - 9) / 2)).astype(np.float32)
    box = np.array([12.3, 5.6, 51.7, 37.9], np.float32)
    theirs = paste_masks_in_image(
        torch.from_numpy(grid)[None, None], torch.from_numpy(box)[None], SHAPE
    )
    theirs = theirs[0, 0].numpy() > 0.5
    cell = tuple((box[2:] - box[:2]) / 28)
    x, y, mask = place_mask(grid, cell, tuple(box[:2]), box, SHAPE, 0.5, beyond=0.0)
    ours = np.zeros(SHAPE, bool)
    ours[y : y + mask.shape[0], x : x + mask.shape[1]] = mask
    assert 300 < ours.sum() < 400
    # Theirs rounds the box to whole pixels, ours does not.
    for one, other in ((ours, theirs), (theirs, ours)):
        assert not (one & (cv2.dilate(other.astype(np.uint8), np.ones((3, 3))) == 0)).any()


BOXES = np.array(
    [
        [0, 0, 20, 20],  # best
        [2, 0, 22, 20],  # the same car
        [0, 0, 20, 21],  # the same thing taken for a truck
        [0, 0, 20, 12],  # a person before it
        [30, 10, 50, 30],
    ],
    np.float32,
)


def test_duplicates_go_and_neighbours_stay() -> None:
    scores = np.array([0.9, 0.8, 0.7, 0.6, 0.95], np.float32)
    classes = np.array([2, 2, 7, 0, 2])
    assert list(suppress_duplicates(BOXES, scores, classes, 0.6)) == [4, 0, 3]
    assert list(suppress_duplicates(BOXES, scores, classes, 0.9)) == [4, 0, 1, 3]


def test_no_boxes_are_no_boxes() -> None:
    none = suppress_duplicates(BOXES[:0], np.empty(0, np.float32), np.empty(0, np.int64), 0.6)
    assert (none.shape, none.dtype) == ((0,), np.int64)


def test_a_pixel_belongs_to_the_best_and_the_covered_are_gone() -> None:
    masks = [
        (5, 5, np.ones((10, 10), bool)),
        (7, 7, np.ones((4, 4), bool)),
        (10, 10, np.eye(20) > 0),
    ]
    names = np.array(["car", "person", "bus"])
    found = compose(SHAPE, names, np.array([0.9, 0.8, 0.7], np.float32), iter(masks))
    assert list(found.label_ids) == [1, 3]
    assert list(found.class_names) == ["car", "bus"]
    assert found.scores == pytest.approx([0.9, 0.7])
    assert (found.labels == 1).sum() == 100
    assert (found.labels == 3).sum() == 15  # of a diagonal of 20, five pixels are the car's


def test_no_masks_are_no_instances() -> None:
    found = compose(SHAPE, np.empty(0, "U3"), np.empty(0, np.float32), iter(()))
    assert len(found) == 0
    assert found.labels.shape == SHAPE
