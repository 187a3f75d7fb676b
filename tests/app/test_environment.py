"""Reading environment.txt, and comparing it with what is installed."""

from __future__ import annotations

import importlib.metadata
from pathlib import Path

import pytest

from app.environment import (
    CORE,
    DEVELOPMENT,
    NOTEBOOK,
    TORCH,
    Environment,
    SetupError,
    has_packages,
    missing_packages,
    parse_sections,
)

TEXT = """\
# [core]
numpy==2.4.6   # a comment
# not a heading
scipy==1.17.1

# [torch]
torch==2.15.0
"""


def test_sections_are_split_by_their_headings() -> None:
    assert parse_sections(TEXT) == {
        "core": ["numpy==2.4.6", "scipy==1.17.1"],
        "torch": ["torch==2.15.0"],
    }


@pytest.mark.parametrize("line", ["numpy", "numpy>=2", "numpy==2.4.6; x", "-r other.txt"])
def test_what_is_no_pin_is_refused_with_its_line(line: str) -> None:
    with pytest.raises(SetupError, match=r"environment.txt, line 2: expected name==version"):
        parse_sections(f"# [core]\n{line}\n")


def test_the_projects_own_file_pins_every_section(repository: Path) -> None:
    sections = Environment.read(repository).sections
    assert list(sections) == [CORE, DEVELOPMENT, NOTEBOOK, TORCH]
    for pins in sections.values():
        assert len(pins) == len(set(pins))
    # A package that two sections need is pinned to one version.
    all_pins = {pin for pins in sections.values() for pin in pins}
    assert len(all_pins) == len({pin.partition("==")[0] for pin in all_pins})
    core = {pin.partition("==")[0] for pin in sections[CORE]}
    assert {"open3d-cpu", "gtsam", "meshcat", "filterpy", "onnxruntime"} <= core
    assert [pin for pin in sections[TORCH] if pin == "torch==2.15.0"]


def test_a_missing_file_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(SetupError, match="complete clone"):
        Environment.read(tmp_path)


def test_installed_versions_are_compared() -> None:
    version = importlib.metadata.version("pytest")
    assert has_packages([f"pytest=={version}"])
    assert missing_packages(["pytest==0.1", "no-such-package==1"]) == {
        "pytest==0.1": version,
        "no-such-package==1": "nothing",
    }


def test_a_local_build_of_a_version_counts_as_it(monkeypatch) -> None:
    monkeypatch.setattr(importlib.metadata, "version", lambda name: "2.15.0+cpu")
    assert has_packages(["torch==2.15.0"])
    assert not has_packages(["torch==2.15.1"])


def test_a_digest_follows_the_pins_alone() -> None:
    first = Environment(Path(), parse_sections(TEXT))
    commented = Environment(Path(), parse_sections(TEXT.replace("a comment", "another")))
    changed = Environment(Path(), parse_sections(TEXT.replace("1.17.1", "1.17.2")))
    assert first.digest(CORE) == commented.digest(CORE)
    assert first.digest(CORE) != changed.digest(CORE)
    assert first.digest(TORCH) == changed.digest(TORCH)


@pytest.mark.parametrize("content", ["", "{", "[1]", "3"])
def test_a_damaged_stamp_is_no_stamp(tmp_path: Path, content: str) -> None:
    environment = Environment(tmp_path, parse_sections(TEXT))
    environment.folder.mkdir()
    environment.stamp.write_text(content)
    assert environment.stamped() == {}
    assert not environment.is_ready([CORE])
