"""`test`: linters, type checker and tests in one command, which is what CI runs.

Owns the list of checks and the closing line.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from argparse import Namespace
from collections.abc import Sequence

from app import system_libraries
from app.environment import ROOT, Environment

CHECKS = {
    "ruff check": ["ruff", "check", "."],
    "ruff format": ["ruff", "format", "--check", "."],
    "mypy": ["mypy"],
}
# A file's tests share what its first one makes, so they stay together.
ALL_TESTS = ["-n", "auto", "--maxprocesses", "4", "--dist", "loadfile"]


def test(arguments: Namespace) -> int:
    """All checks, even after one failed; 0 when all passed. pytest comes last."""
    started = time.monotonic()
    _bring_browser()
    checks = {**CHECKS, "pytest": ["pytest", *(arguments.pytest_arguments or ALL_TESTS)]}
    failed = [name for name, command in checks.items() if not _passes(name, command)]
    verdict = f"FAILED: {', '.join(failed)}" if failed else "all checks passed"
    print(f"dyob-slam: {verdict} in {time.monotonic() - started:.0f} s", flush=True)
    return 1 if failed else 0


def _bring_browser() -> None:
    """Install the browser that tests of pages need, where that is allowed; else they skip."""
    if system_libraries.browser() is not None or os.environ.get("DYOB_NO_SETUP") == "1":
        return
    package = system_libraries.BROWSER
    if system_libraries.can_install():
        print(f"== installing {package}", flush=True)
        system_libraries.install([package], Environment.read().system_log)
    if system_libraries.browser() is None:
        command = system_libraries.install_command([package])
        print(f"without {package} the tests of pages are skipped; type: {command}", flush=True)


def _passes(name: str, command: Sequence[str]) -> bool:
    print(f"== {name}", flush=True)
    finished = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, check=False)
    return finished.returncode == 0
