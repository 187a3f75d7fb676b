"""The settings' own ranges."""

from __future__ import annotations

from dataclasses import fields, replace

import pytest

from pipelines.config import Config

NUMBERS = [
    (section.name, setting.name)
    for section in fields(Config)
    for setting in fields(getattr(Config(), section.name))
    if type(getattr(getattr(Config(), section.name), setting.name)) in (int, float)
]


@pytest.mark.parametrize(("section", "name"), NUMBERS)
def test_every_number_has_a_range_that_its_error_names(section: str, name: str) -> None:
    with pytest.raises(ValueError, match=rf"^{name}: expected (at least )?\S+.*, found -1e\+09$"):
        replace(getattr(Config(), section), **{name: -1e9})
