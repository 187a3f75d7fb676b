"""Colours last and differ; text and panels land where they are put."""

import itertools

import numpy as np

from viz import style


def test_object_colors_last_and_differ():
    colors = [style.object_color(i) for i in range(1, 65)]
    assert colors == [style.object_color(i) for i in range(1, 65)]
    assert colors[0] == (230, 159, 0)
    distances = [np.abs(np.subtract(a, b)).sum() for a, b in itertools.combinations(colors, 2)]
    assert min(distances) >= 35
    assert min(np.array(colors) @ [0.30, 0.59, 0.11]) > 45  # seen on a dark ground
    assert all(0 <= channel <= 255 for color in colors for channel in color)


def test_text_lies_in_the_box_its_size_tells():
    image = np.full((60, 300, 3), 255, np.uint8)
    width, height = style.text_size("frame 12", 20)
    style.draw_text(image, "frame 12", (10, 40), 20, (200, 0, 0))
    rows, columns = np.nonzero((image < 250).any(2))
    assert 8 <= columns.min() <= 14
    assert abs(columns.max() - (10 + width)) <= 3
    assert 40 - height - 2 <= rows.min() < rows.max() <= 46
    assert image[..., 0].min() > 190  # the ink is red, so the red channel stays high


def test_panel_blends_and_stays_in_the_image():
    image = np.zeros((20, 20, 3), np.uint8)
    style.draw_panel(image, (-5, 10, 8, 99), (200, 100, 50), 0.5)
    assert image[15, 3].tolist() == [100, 50, 25]
    assert image[:10].max() == 0
    assert image[:, 8:].max() == 0
