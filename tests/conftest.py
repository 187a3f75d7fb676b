"""Shared fixtures: where the real sequences lie, with a skip that says so where they do not.

Owns no data. Real sequences are found through `DYOB_DATA`, else in `../shared/data` beside the
repository; tests that need them ask for the `real_data` fixture.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def data_root() -> Path:
    """The folder of the real sequences; it need not exist."""
    return Path(os.environ.get("DYOB_DATA") or ROOT.parent / "shared" / "data")


@pytest.fixture(scope="session")
def real_data() -> Callable[[str], Path]:
    """A function name -> folder of a real sequence, which skips the test where there is none."""

    def find(name: str) -> Path:
        folder = data_root() / name
        if not folder.is_dir():
            pytest.skip(
                f"needs the real sequence '{name}', which is not in {data_root()}; "
                "set DYOB_DATA to the folder that holds it"
            )
        return folder

    return find


@pytest.fixture
def repository() -> Path:
    """The repository's root."""
    return ROOT
