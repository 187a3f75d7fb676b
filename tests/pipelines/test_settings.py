"""Dataclasses from plain dicts and back: every kind of field, and errors in words."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import pytest
import yaml

from pipelines.config import Config
from pipelines.errors import ConfigError
from pipelines.settings import build, setting_names, to_plain


class Colour(StrEnum):
    RED = "red"
    BLUE = "blue"


@dataclass(frozen=True, slots=True)
class Inner:
    share: float = 0.5
    window: tuple[int, int] = (3, 4)
    radii: tuple[float, ...] = (1.0,)
    colour: Colour = Colour.RED
    mode: Literal["fast", "full"] = "fast"
    limit: float | None = None
    enabled: bool = True

    def __post_init__(self) -> None:
        if not 0 <= self.share <= 1:
            raise ValueError(f"inner.share: expected 0 to 1, found {self.share}")


@dataclass(frozen=True, slots=True)
class Outer:
    count: int = 2
    inner: Inner = field(default_factory=Inner)


def test_every_kind_of_field_is_converted() -> None:
    inner = {
        "share": 1,
        "window": [5, 6],
        "radii": [1, "2e-1"],
        "colour": "blue",
        "mode": "full",
        "limit": "1e3",
        "enabled": False,
    }
    built = build(Outer, {"count": 7, "inner": inner}).inner
    assert built == Inner(1.0, (5, 6), (1.0, 0.2), Colour.BLUE, "full", 1000.0, False)
    assert isinstance(built.share, float)
    assert build(Outer, {"inner": {"limit": None}}).inner.limit is None


@pytest.mark.parametrize(
    ("inner", "words"),
    [
        ({"window": [1]}, "inner.window: expected a list of 2: a whole number, a whole number"),
        ({"window": 3}, "expected a list of 2"),
        ({"radii": [1, "x"]}, "expected a list, each item a number"),
        ({"colour": "green"}, "expected one of red, blue"),
        ({"mode": "slow"}, "expected one of fast, full"),
        ({"limit": "x"}, "expected a number or null"),
        ({"enabled": 1}, "expected true or false, found int 1"),
        ({"share": 2}, "inner.share: expected 0 to 1"),
        ({"shares": 2}, "'inner.share'"),
    ],
)
def test_each_wrong_kind_says_what_is_expected(inner: dict, words: str) -> None:
    with pytest.raises(ConfigError) as raised:
        build(Outer, {"inner": inner})
    assert words in str(raised.value)


def test_plain_values_build_an_equal_dataclass() -> None:
    outer = Outer(3, Inner(0.25, (1, 2), (), Colour.BLUE, "full", 2.0, False))
    assert build(Outer, yaml.safe_load(yaml.safe_dump(to_plain(outer)))) == outer


def test_setting_names_are_dotted_and_complete() -> None:
    assert setting_names(Outer)[:2] == ["count", "inner.share"]
    assert "orb.n_features" in setting_names(Config)
