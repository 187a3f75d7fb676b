"""What `config` prints must read back to the same settings, with a meaning for each."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import dataclass
from pathlib import Path

import pytest

from app import listings
from pipelines.errors import DatasetError
from pipelines.io.config import load_config
from pipelines.settings import setting_names


@dataclass
class Example:
    """What it is for."""

    count: int = 3  # px, how many
    # Two lines of meaning
    # above the field.
    share: float = 0.5
    bare: tuple[int, int] = (1, 2)
    text: str = "# no comment"  # a sign


def test_comments_are_read_from_behind_and_above() -> None:
    assert listings.field_comments(Example) == {
        "count": "px, how many",
        "share": "Two lines of meaning above the field.",
        "bare": "",
        "text": "a sign",
    }


def test_a_section_becomes_commented_yaml() -> None:
    lines = listings.section_lines("example", Example())
    assert lines[:2] == ["# What it is for.", "example:"]
    assert lines[2].split("#") == [f"{'  count: 3':<36}  ", " px, how many"]
    assert lines[4].strip() == "bare: [1, 2]"


def test_what_config_prints_is_a_config_file(tmp_path: Path, capsys) -> None:
    overrides = ["orb.n_features=1234"]
    assert listings.config(Namespace(config=None, overrides=overrides)) == 0
    file = tmp_path / "my.yaml"
    file.write_text(capsys.readouterr().out)
    assert load_config(file) == load_config(overrides=overrides)


def test_config_prints_every_setting_with_a_comment(capsys) -> None:
    listings.config(Namespace(config=None, overrides=[]))
    lines = capsys.readouterr().out.splitlines()
    for name in setting_names(type(load_config())):
        leaf = name.rpartition(".")[2]
        shown = [line for line in lines if line.strip().startswith(f"{leaf}:")]
        assert shown, name
        assert all("#" in line for line in shown), f"{name} has no comment in config.py"


def test_datasets_lists_each_layout(capsys) -> None:
    from pipelines.datasets import DATASETS

    assert listings.datasets(Namespace(name=None)) == 0
    text = capsys.readouterr().out
    assert [line.partition(":")[0] for line in text.splitlines() if line[0] != " "] == list(
        DATASETS
    )


def test_one_layout_can_be_asked_for(capsys) -> None:
    listings.datasets(Namespace(name="vdo"))
    assert "semantic" in capsys.readouterr().out
    with pytest.raises(DatasetError, match="did you mean 'vdo'"):
        listings.datasets(Namespace(name="vdos"))
