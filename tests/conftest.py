"""Shared fixtures: where the real sequences and networks lie, with a skip where they do not.

Owns no data. Real sequences are found through `DYOB_DATA`, else in `../shared/data` beside the
repository; tests that need them ask for the `real_data` fixture. Trained networks are found
likewise, through `DYOB_TEST_MODELS`, else in `../shared/models`, by the `real_models` fixture; the
models' folder of whoever runs the tests is out of sight.
"""

from __future__ import annotations

import os
import shutil
import signal
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent


def pytest_configure() -> None:
    """An empty models' folder, in child processes too, before any test looks for one; and Ctrl-C.

    A shell's background job is started deaf to it, and so would be all programs that tests start.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ["DYOB_MODELS"] = tempfile.mkdtemp(prefix="dyob-test-models-")


def pytest_unconfigure() -> None:
    shutil.rmtree(os.environ.pop("DYOB_MODELS"), ignore_errors=True)


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


@pytest.fixture(scope="session")
def real_models() -> Callable[[str], Path]:
    """A function name -> file of a trained network, which skips the test where there is none."""
    root = Path(os.environ.get("DYOB_TEST_MODELS") or ROOT.parent / "shared" / "models")

    def find(name: str) -> Path:
        file = root / name
        if not file.is_file():
            pytest.skip(
                f"needs the network '{name}', which is not in {root}; "
                "set DYOB_TEST_MODELS to the folder that holds it"
            )
        return file

    return find


@pytest.fixture
def repository() -> Path:
    """The repository's root."""
    return ROOT
