"""What is read of masks, and how they are carried along by the points in them."""

import numpy as np
import pytest

from pipelines.object_types import Detections
from pipelines.objects.association import color_distance
from pipelines.objects.instances import carry_mask, describe_instances

SHAPE = (120, 200)


def detections(*parts, ids=None):
    labels = np.zeros(SHAPE, np.int32)
    ids = ids or list(range(1, len(parts) + 1))
    for label, (rows, columns) in zip(ids, parts, strict=True):
        labels[rows, columns] = label
    names = np.array(["car"] * len(parts), "U16")
    return Detections(labels, np.array(ids, np.int32), names, np.full(len(parts), 0.5))


def grid(rows, columns, step=6):
    v, u = np.mgrid[rows.start : rows.stop : step, columns.start : columns.stop : step]
    return np.stack([u.ravel(), v.ravel()], -1).astype(float)


def affine(uv, angle=0.0, scale=1.0, shift=(0.0, 0.0), about=(100.0, 60.0)):
    c, s = scale * np.cos(angle), scale * np.sin(angle)
    return (uv - about) @ np.array([[c, s], [-s, c]]) + about + shift


def test_place_size_and_centre_of_each_instance(kitti):
    one, other = (slice(10, 30), slice(20, 60)), (slice(50, 100), slice(100, 110))
    disparity = np.full(SHAPE, np.nan, np.float32)
    disparity[one] = 20.0
    disparity[10:13, 20:60] = 60.0  # something before a part of it
    image = np.zeros((*SHAPE, 3), np.uint8)
    found = describe_instances(kitti, image, disparity, detections(one, other, ids=[7, 3]))
    assert len(found) == 2
    np.testing.assert_array_equal(found.boxes_px, [[20, 10, 59, 29], [100, 50, 109, 99]])
    assert found.windows == [one, other]
    assert (found.labels[one] == 1).all() and (found.labels[other] == 2).all()
    z = kitti.bf / 20.0
    np.testing.assert_allclose(found.centers_m[0, 2], z)
    np.testing.assert_allclose(found.centers_m[0, 0], (39.5 - kitti.cx) / kitti.fx * z, atol=0.05)
    assert np.isnan(found.centers_m[1]).all()  # no depth, no place
    np.testing.assert_allclose(found.colors.sum(1), 1.0)


def test_an_instance_without_a_pixel_and_an_image_without_instances(kitti):
    image, disparity = np.zeros(SHAPE, np.uint8), np.ones(SHAPE, np.float32)
    hidden = describe_instances(
        kitti, image, disparity, detections((slice(0, 9), slice(0, 9)), (slice(5, 5), slice(0, 0)))
    )
    assert hidden.windows[1] is None and hidden.windows[0] is not None
    assert np.isnan(hidden.boxes_px[1]).all() and np.isnan(hidden.centers_m[1]).all()
    empty = describe_instances(kitti, image, disparity, Detections.empty(SHAPE))
    assert len(empty) == 0 and empty.colors.shape == (0, 64) and not empty.labels.any()


def test_labels_that_no_detection_owns_are_background(kitti):
    seen = detections((slice(0, 10), slice(0, 10)), ids=[2])
    labels = seen.labels.copy()
    labels[50:60, 50:60] = 1
    seen = Detections(labels, seen.label_ids, seen.class_names, seen.scores)
    found = describe_instances(kitti, np.zeros(SHAPE, np.uint8), np.ones(SHAPE, np.float32), seen)
    assert not found.labels[50:60, 50:60].any() and (found.labels[:10, :10] == 1).all()


def test_colours_tell_things_apart_whatever_the_exposure(kitti):
    rng = np.random.default_rng(0)
    image = np.zeros((*SHAPE, 3), np.uint8)
    red, dark_red, blue = (np.s_[0:40, 40 * i : 40 * i + 40] for i in range(3))
    base = rng.integers(0, 40, (40, 40, 3))
    image[red], image[blue] = base + np.array([160, 40, 40]), base + np.array([40, 40, 160])
    image[dark_red] = 0.7 * image[red]
    found = describe_instances(
        kitti, image, np.ones(SHAPE, np.float32), detections(red, dark_red, blue)
    )
    distance = color_distance(found.colors, found.colors)
    assert distance[0, 1] < 0.3
    assert distance[0, 2] > 0.6 and distance[1, 2] > 0.6


def test_a_grey_image_and_a_black_one_have_histograms_too(kitti):
    for image in (np.full(SHAPE, 90, np.uint8), np.zeros((*SHAPE, 3), np.uint8)):
        whole = detections((slice(0, 50), slice(0, 50)))
        found = describe_instances(kitti, image, np.ones(SHAPE, np.float32), whole)
        assert found.colors[0].sum() == pytest.approx(1.0)


# -------------------------------------------------------------------- carrying


@pytest.mark.parametrize(
    ("angle", "scale", "shift"), [(0, 1, (0, 0)), (0, 1, (13, -8)), (0.1, 1.1, (4, 3))]
)
def test_a_mask_moves_as_its_points_do(angle, scale, shift):
    window = (slice(40, 80), slice(70, 130))
    mask = np.ones((40, 60), bool)
    mask[:10, :15] = False
    uv = grid(*window)
    carried = carry_mask(mask, window, uv, affine(uv, angle, scale, shift), SHAPE)
    assert carried is not None
    v, u = np.mgrid[0 : SHAPE[0], 0 : SHAPE[1]]
    back = affine(np.stack([u, v], -1).reshape(-1, 2) - shift, 0, 1)
    c, s = np.cos(angle) / scale, np.sin(angle) / scale
    back = (back - (100, 60)) @ np.array([[c, -s], [s, c]]) + (100, 60)
    at = np.rint(back - (70, 40)).astype(int).reshape(*SHAPE, 2)
    inside = (at >= 0).all(-1) & (at[..., 0] < 60) & (at[..., 1] < 40)
    expected = inside & mask[at[..., 1].clip(0, 39), at[..., 0].clip(0, 59)]
    got = np.zeros(SHAPE, bool)
    got[carried[1]] = carried[0]
    assert (got & expected).sum() / (got | expected).sum() > 0.96


@pytest.mark.parametrize("shift", [(-90, 0), (100, 0), (0, -60), (0, 60)])
def test_a_mask_that_leaves_the_image_is_cut_at_its_border(shift):
    window = (slice(40, 80), slice(70, 130))
    uv = grid(*window)
    carried = carry_mask(np.ones((40, 60), bool), window, uv, uv + shift, SHAPE)
    assert carried is not None
    mask, (rows, columns) = carried
    assert mask.shape == (rows.stop - rows.start, columns.stop - columns.start)
    assert 0 <= rows.start < rows.stop <= SHAPE[0]
    assert 0 <= columns.start < columns.stop <= SHAPE[1]
    u = np.clip(np.arange(70, 130) + shift[0], -1, SHAPE[1])
    v = np.clip(np.arange(40, 80) + shift[1], -1, SHAPE[0])
    left = ((u >= 0) & (u < SHAPE[1])).sum() * ((v >= 0) & (v < SHAPE[0])).sum()
    assert mask.sum() == left


def test_a_mask_that_has_left_the_image_is_gone():
    window = (slice(40, 80), slice(70, 130))
    uv = grid(*window)
    for shift in ((-140, 0), (300, 0), (0, 200), (0, -100)):
        assert carry_mask(np.ones((40, 60), bool), window, uv, uv + shift, SHAPE) is None


def test_points_that_do_not_move_together_carry_nothing():
    window = (slice(40, 80), slice(70, 130))
    uv, rng = grid(*window), np.random.default_rng(1)
    mask = np.ones((40, 60), bool)
    assert carry_mask(mask, window, uv, rng.uniform(0, 100, uv.shape), SHAPE) is None
    few_stray = uv + np.array([5.0, 0.0])
    few_stray[::4] += rng.uniform(20, 60, few_stray[::4].shape)
    carried = carry_mask(mask, window, uv, few_stray, SHAPE)
    assert carried is not None and carried[1][1].start == 75


def test_points_at_one_place_carry_nothing():
    window = (slice(40, 80), slice(70, 130))
    uv = np.tile([[100.0, 60.0]], (8, 1))
    assert carry_mask(np.ones((40, 60), bool), window, uv, uv + 3.0, SHAPE) is None
