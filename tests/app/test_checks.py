"""The test verb: every check runs, the closing line tells, the exit code follows."""

from __future__ import annotations

import subprocess
from argparse import Namespace

import pytest

from app import checks, system_libraries


@pytest.fixture
def commands(monkeypatch):
    """Commands that were run, and the modules whose run fails."""
    seen: list[list[str]] = []
    failing: set[str] = set()

    def run(command, cwd, check):
        seen.append(command[2:])
        return subprocess.CompletedProcess(command, int(command[2] in failing))

    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(system_libraries, "browser", lambda: "/usr/bin/chromium")
    return seen, failing


def test_all_checks_run_with_pytest_last(commands, capsys) -> None:
    seen, _ = commands
    assert checks.test(Namespace(pytest_arguments=["-k", "config"])) == 0
    assert [command[0] for command in seen] == ["ruff", "ruff", "mypy", "pytest"]
    assert seen[-1] == ["pytest", "-k", "config"]
    closing = capsys.readouterr().out.splitlines()[-1]
    assert closing.startswith("dyob-slam: all checks passed in ")


@pytest.mark.parametrize("module", ["ruff", "mypy", "pytest"])
def test_one_failure_fails_the_whole_and_stops_nothing(commands, capsys, module) -> None:
    seen, failing = commands
    failing.add(module)
    assert checks.test(Namespace(pytest_arguments=[])) == 1
    assert len(seen) == 4
    closing = capsys.readouterr().out.splitlines()[-1]
    assert closing.startswith("dyob-slam: FAILED: ")
    assert module in closing


def test_the_whole_suite_uses_all_cores(commands) -> None:
    seen, _ = commands
    assert checks.test(Namespace(pytest_arguments=[])) == 0
    assert seen[-1] == ["pytest", *checks.ALL_TESTS]


def test_the_browser_is_installed_where_it_is_missing(commands, monkeypatch, capsys) -> None:
    installed: list[str] = []
    monkeypatch.delenv("DYOB_NO_SETUP", raising=False)
    monkeypatch.setattr(system_libraries, "browser", lambda: "found" if installed else None)
    monkeypatch.setattr(system_libraries, "can_install", lambda: True)
    monkeypatch.setattr(system_libraries, "install", lambda names, log: installed.extend(names))
    assert checks.test(Namespace(pytest_arguments=[])) == 0
    assert installed == ["chromium"]
    assert "are skipped" not in capsys.readouterr().out


def test_without_a_browser_and_the_right_to_install_one_a_command_is_told(
    commands, monkeypatch, capsys
) -> None:
    monkeypatch.delenv("DYOB_NO_SETUP", raising=False)
    monkeypatch.setattr(system_libraries, "browser", lambda: None)
    monkeypatch.setattr(system_libraries, "can_install", lambda: False)
    assert checks.test(Namespace(pytest_arguments=[])) == 0
    line = next(x for x in capsys.readouterr().out.splitlines() if "are skipped" in x)
    assert "apt-get install -y --no-install-recommends chromium" in line
