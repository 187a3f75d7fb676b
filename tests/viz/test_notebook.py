"""What a cell of a notebook shows: words to the left, numbers to the right, nothing fetched."""

from __future__ import annotations

import pytest

from viz.notebook import show_table


def test_a_table_sets_words_to_the_left_and_numbers_to_the_right(browser):
    table = show_table(("object", "km/h"), [("car", "35.8"), ("a person", "4.7")])
    lab = "<style>.lab td, .lab th {text-align: right; vertical-align: middle}</style>"
    page = browser.new_page()
    page.set_content(f"<!DOCTYPE html><body>{lab}<div class='lab'>{table.data}</div>")
    seen = page.eval_on_selector_all(
        "td", "cells => cells.map((c) => getComputedStyle(c).textAlign)"
    )
    page.close()
    assert seen == ["left", "right"] * 2


def test_a_table_needs_as_many_cells_in_each_row():
    with pytest.raises(ValueError, match="zip"):
        show_table(("object", "km/h"), [("car", "35.8"), ("a person",)])
