"""Rendered frames on disk: a folder appears whole or not at all, and a damaged one is remade.

Owns files and their check. Each frame is one uncompressed .npz, whose checksum reading verifies.
"""

from __future__ import annotations

import json
import os
import shutil
import uuid
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import DatasetError, FrameError

_MANIFEST = "complete.json"
_DAMAGE = (zipfile.BadZipFile, ValueError, KeyError, OSError, EOFError)


def cache_root() -> Path:
    """Folder of all simulated sequences: below $DYOB_CACHE, or `.cache/` of the checkout."""
    chosen = os.environ.get("DYOB_CACHE")
    base = Path(chosen) if chosen else Path(__file__).resolve().parents[3] / ".cache"
    return base / "simulated"


def ensure_folder(folder: Path, key: dict[str, Any], make: Callable[[Path], None]) -> Path:
    """`folder` filled by `make`, unless it is there, whole and of the same `key`.

    `make` writes into a temporary folder beside it, which is renamed when done: an interrupted
    run leaves nothing that a later one would take for a sequence.
    """
    if is_whole(folder, key):
        return folder
    part = folder.with_name(f"{folder.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        part.mkdir(parents=True)
        make(part)
        sizes = {p.name: p.stat().st_size for p in sorted(part.iterdir())}
        (part / _MANIFEST).write_text(json.dumps({"key": key, "sizes": sizes}))
        if not is_whole(folder, key):  # another process may have been faster
            if folder.exists():
                shutil.rmtree(folder)
            part.rename(folder)
    except OSError as error:
        if is_whole(folder, key):
            return folder
        raise DatasetError(
            f"the simulated sequence could not be written to {folder} ({error}): free some space, "
            "or set DYOB_CACHE to a folder with room"
        ) from error
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return folder


def forget(folder: Path) -> None:
    """Remove a cached sequence; degraded inputs take half a gigabyte and are made in a minute."""
    if (folder / _MANIFEST).is_file():  # nothing but what was made here
        shutil.rmtree(folder, ignore_errors=True)


def is_whole(folder: Path, key: dict[str, Any]) -> bool:
    """Whether the folder was finished for this `key` and has every file in its full size."""
    try:
        manifest = json.loads((folder / _MANIFEST).read_text())
        if manifest["key"] != json.loads(json.dumps(key)):
            return False
        return all((folder / n).stat().st_size == size for n, size in manifest["sizes"].items())
    except (OSError, ValueError, KeyError, TypeError):
        return False


def frame_file(folder: Path, index: int) -> Path:
    return folder / f"{index:06d}.npz"


def write_arrays(file: Path, **arrays: NDArray) -> None:
    """Write arrays to `file` so that it appears whole or not at all."""
    part = file.with_name(f"{file.stem}.{uuid.uuid4().hex[:8]}.part.npz")
    np.savez(part, **arrays)  # type: ignore[arg-type]
    part.replace(file)


def read_arrays(file: Path) -> dict[str, NDArray]:
    """All arrays of `file`; FrameError where it is missing or damaged."""
    try:
        with np.load(file, allow_pickle=False) as content:
            return {name: content[name] for name in content.files}
    except _DAMAGE as error:
        raise FrameError(
            f"{file}: expected a frame of a simulated sequence, found {error or 'nothing'}: "
            "it will be made again"
        ) from error
