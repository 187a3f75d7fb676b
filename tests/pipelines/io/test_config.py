"""Settings from files and the command line, and errors that say what to write instead."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from pipelines.config import Config
from pipelines.errors import ConfigError
from pipelines.io.config import config_to_dict, load_config
from pipelines.io.files import write_yaml


def test_nothing_given_is_the_defaults() -> None:
    assert load_config() == Config()


def test_saved_settings_load_to_an_equal_config(tmp_path: Path) -> None:
    config = load_config(overrides=["orb.n_features=1234", "orb.scale_factor=1.5"])
    write_yaml(tmp_path / "config.yaml", config_to_dict(config))
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
