"""Settings: files, overrides, types, and errors that say what to write instead."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path
from typing import Literal

import pytest
import yaml

from pipelines.config import Config, config_to_dict, load_config, save_config
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


def test_nothing_given_is_the_defaults() -> None:
    assert load_config() == Config()


def test_saved_settings_load_to_an_equal_config(tmp_path: Path) -> None:
    config = load_config(overrides=["orb.n_features=1234", "orb.scale_factor=1.5"])
    save_config(config, tmp_path / "config.yaml")
    assert load_config(tmp_path / "config.yaml") == config
    assert config != Config()


def test_plain_dict_survives_yaml() -> None:
    plain = config_to_dict(Config())
    assert yaml.safe_load(yaml.safe_dump(plain)) == plain
    assert plain["orb"]["n_features"] == Config().orb.n_features


def test_partial_file_changes_only_what_it_names(tmp_path: Path) -> None:
    file = tmp_path / "some.yaml"
    file.write_text("orb:\n  n_features: 900\ntracking:\n")
    config = load_config(file)
    assert config.orb.n_features == 900
    assert config.orb.n_levels == Config().orb.n_levels
    assert config.tracking == Config().tracking


def test_overrides_win_over_the_file_and_the_last_one_wins(tmp_path: Path) -> None:
    file = tmp_path / "some.yaml"
    file.write_text("orb: {n_features: 900, n_levels: 5}")
    config = load_config(file, ["orb.n_features=1000", "orb.n_features=1100"])
    assert (config.orb.n_features, config.orb.n_levels) == (1100, 5)


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("orb.n_featurs=3", "orb.n_features"),
        ("n_features=3", "orb.n_features"),
        ("tracker.seed=3", "tracking.seed"),
        ("orb.n_features=many", "orb.n_features: expected a whole number, found str 'many'"),
        ("orb.n_features=1.5", "expected a whole number, found float 1.5"),
        ("orb.n_features=true", "expected a whole number, found bool True"),
        ("orb.scale_factor=wide", "orb.scale_factor: expected a number"),
        ("orb.scale_factor=nan", "expected a number"),
        ("orb.n_features=", "expected a whole number, found nothing"),
        ("orb=3", "orb is a section with the settings n_features"),
        ("orb.n_features.x=3", "found a section with x"),
        ("orb.n_features", "expected section.name=value"),
        ("=3", "expected section.name=value"),
        ("orb.n_features=[1", "cannot be read as YAML"),
    ],
)
def test_wrong_override_is_one_clear_error(override: str, words: str) -> None:
    with pytest.raises(ConfigError) as raised:
        load_config(overrides=[override])
    assert words in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("- 1\n- 2\n", "expected sections with settings"),
        ("orb: {n_features: [", "is not a YAML file"),
        ("orbs: {n_features: 3}", "'orb"),
        ("3: 4", "unknown setting '3'"),
        ("orb: 3", "orb is a section"),
    ],
)
def test_wrong_file_is_one_clear_error(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "some.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as raised:
        load_config(file)
    assert words in str(raised.value)
    assert "\n" not in str(raised.value)


def test_binary_and_missing_files_are_named(tmp_path: Path) -> None:
    (tmp_path / "image.png").write_bytes(b"\x89PNG\xff\xfe")
    for name, words in (("image.png", "is not a YAML file"), ("absent.yaml", "No such file")):
        with pytest.raises(ConfigError, match=words) as raised:
            load_config(tmp_path / name)
        assert name in str(raised.value)


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
