"""`test`: linters, type checker and tests in one command, which is what CI runs.

Owns the list of checks and the closing line.
"""

from __future__ import annotations

import subprocess
import sys
import time
from argparse import Namespace
from collections.abc import Sequence

from app.environment import ROOT

CHECKS = {
    "ruff check": ["ruff", "check", "."],
    "ruff format": ["ruff", "format", "--check", "."],
    "mypy": ["mypy"],
}


def test(arguments: Namespace) -> int:
    """All checks, even after one failed; 0 when all passed. pytest comes last."""
    started = time.monotonic()
    checks = {**CHECKS, "pytest": ["pytest", *arguments.pytest_arguments]}
    failed = [name for name, command in checks.items() if not _passes(name, command)]
    verdict = f"FAILED: {', '.join(failed)}" if failed else "all checks passed"
    print(f"dyob-slam: {verdict} in {time.monotonic() - started:.0f} s", flush=True)
    return 1 if failed else 0


def _passes(name: str, command: Sequence[str]) -> bool:
    print(f"== {name}", flush=True)
    finished = subprocess.run([sys.executable, "-m", *command], cwd=ROOT, check=False)
    return finished.returncode == 0
