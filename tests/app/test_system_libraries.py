"""Finding shared libraries, and installing them with an apt-get that only takes notes."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from app import system_libraries

APT_GET = """\
#!/bin/sh
echo "$DEBIAN_FRONTEND: $*" >> "{calls}"
case "$*" in *" install "*) test -e "{updated}" ;; *) touch "{updated}" ;; esac
"""


@pytest.fixture
def apt_get(tmp_path: Path, monkeypatch):
    """An apt-get that can install only after an update; a function that gives its calls."""
    calls = tmp_path / "calls.txt"
    script = tmp_path / "apt-get"
    script.write_text(APT_GET.format(calls=calls, updated=tmp_path / "updated"))
    script.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    return lambda: [line.partition("300 ")[2] for line in calls.read_text().splitlines()]


def test_libraries_are_found_as_the_loader_finds_them() -> None:
    assert system_libraries.is_loadable("libc.so.6")
    assert not system_libraries.is_loadable("libthere-is-no-such.so.9")


def test_only_what_is_missing_is_named(monkeypatch) -> None:
    monkeypatch.setattr(system_libraries, "is_loadable", lambda file: file != "libGL.so.1")
    assert system_libraries.missing_required() == {"libGL.so.1": "libgl1"}


def test_rendering_needs_the_loader_and_a_driver(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.delenv("VK_ICD_FILENAMES", raising=False)
    driver = tmp_path / "lvp_icd.json"
    monkeypatch.setenv("VK_DRIVER_FILES", str(driver))
    monkeypatch.setattr(system_libraries, "is_loadable", lambda file: True)
    assert list(system_libraries.missing_rendering().values()) == ["mesa-vulkan-drivers"]
    driver.write_text("{}")
    assert system_libraries.vulkan_drivers() == [driver]
    assert system_libraries.missing_rendering() == {}
    monkeypatch.setattr(system_libraries, "is_loadable", lambda file: False)
    assert system_libraries.missing_rendering() == {"libvulkan.so.1": "libvulkan1"}


@pytest.mark.parametrize(("user", "sudo"), [(0, ""), (1000, "sudo ")])
def test_the_command_fits_the_user(monkeypatch, user: int, sudo: str) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: user)
    command = system_libraries.install_command(["a", "b"])
    assert command == (
        f"{sudo}apt-get update && {sudo}apt-get install -y --no-install-recommends a b"
    )


INSTALL = "install -y --no-install-recommends libegl1"


@pytest.mark.parametrize(
    ("lists", "calls"), [(True, [INSTALL, "update", INSTALL]), (False, ["update", INSTALL])]
)
def test_lists_are_updated_where_needed(tmp_path, monkeypatch, apt_get, lists, calls) -> None:
    monkeypatch.setattr(system_libraries, "_lists_are_there", lambda: lists)
    log = tmp_path / "log.txt"
    assert system_libraries.install(["libegl1"], log)
    assert apt_get() == calls
    assert f"apt-get -o DPkg::Lock::Timeout=300 {INSTALL}" in log.read_text()


def test_a_failure_is_told(tmp_path, monkeypatch, apt_get) -> None:
    (tmp_path / "apt-get").write_text("#!/bin/sh\necho 'E: no such package'; exit 100\n")
    assert not system_libraries.install(["libegl1"], tmp_path / "log.txt")
    assert "E: no such package" in (tmp_path / "log.txt").read_text()
