"""Scaling and padding to a network's size, and boxes on their way back."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.detection.letterbox import PAD_VALUE, Letterbox, to_tensor

KITTI = (375, 1242, 3)


@pytest.mark.parametrize(
    ("width_px", "size", "inner"),
    [(1242, (1248, 384), (1242, 375)), (640, (640, 224), (640, 193)), (96, (96, 32), (96, 29))],
)
def test_flexible_sides_are_multiples_that_just_hold_the_image(width_px, size, inner) -> None:
    box = Letterbox.flexible(KITTI, width_px, 32)
    assert box.size == size
    assert (box.scale_xy[0] * 1242, box.scale_xy[1] * 375) == pytest.approx(inner)


def test_fixed_size_holds_the_whole_image_in_its_middle() -> None:
    box = Letterbox.fixed(KITTI, (640, 640))
    image = np.random.default_rng(0).integers(120, 255, KITTI, dtype=np.uint8)
    network = box.apply(image)
    assert network.shape == (640, 640, 3)
    rows = np.flatnonzero((network != PAD_VALUE).any(axis=(1, 2)))
    assert (rows[0], rows[-1]) == (223, 415)
    assert (network != PAD_VALUE).any(axis=2)[rows].all()


def test_an_image_that_fits_is_copied_as_it_is() -> None:
    image = np.random.default_rng(0).integers(0, 255, KITTI, dtype=np.uint8)
    network = Letterbox.flexible(KITTI, 1242, 32).apply(image)
    np.testing.assert_array_equal(network[4:379, 3:1245], image)


def test_boxes_come_back_to_where_they_were() -> None:
    box = Letterbox.fixed(KITTI, (640, 640))
    in_image = np.array([[0, 0, 1242, 375], [100, 50, 220, 80]], np.float32)
    scale, offset = np.tile(box.scale_xy, 2), np.tile(box.offset_xy, 2)
    np.testing.assert_allclose(box.to_image(in_image * scale + offset), in_image, atol=1e-3)


def test_tensor_is_rgb_in_planes() -> None:
    image = np.zeros((2, 3, 3), np.uint8)
    image[1, 2] = (255, 51, 0)
    tensor = to_tensor(image)
    assert (tensor.shape, tensor.dtype) == ((3, 2, 3), np.float32)
    assert tensor.flags.c_contiguous
    np.testing.assert_allclose(tensor[:, 1, 2], (1.0, 0.2, 0.0), atol=1e-6)
