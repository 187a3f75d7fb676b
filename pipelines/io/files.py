"""Whole-file writing that leaves either the old file or the new one, never half of one.

Owns atomic replacement, JSON and YAML on disk and the wording of disk errors. Knows no content.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.errors import DyObError, FormatError


@contextmanager
def replacing(path: Path | str, *, sync: bool = True) -> Iterator[Path]:
    """A fresh path beside `path` to write to; it takes the place of `path` when the block succeeds.

    The suffix is kept, since some writers choose the format by it. If the block fails, the new file
    is removed and the old one stays. With `sync` the bytes are on the disk before the rename, so
    that a machine that crashes leaves no empty file; pictures by the hundred do without.

    Raises DyObError where the disk refuses.
    """
    path = Path(path)
    fresh = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}{path.suffix}")
    try:
        yield fresh
        if sync:
            with fresh.open("rb+") as file:
                os.fsync(file.fileno())
        fresh.replace(path)
    except OSError as error:
        raise DyObError(disk_error(path, error)) from error
    finally:
        fresh.unlink(missing_ok=True)


@contextmanager
def replacing_folder(folder: Path | str) -> Iterator[Path]:
    """A fresh folder beside `folder` to fill; it takes its place when the block succeeds.

    Whoever looks finds the old folder or the new one, whole. If the block fails, the old one stays.
    Raises DyObError where the disk refuses.
    """
    folder = Path(folder).resolve()  # a link stays a link
    mark = uuid.uuid4().hex[:8]
    fresh, old = (folder.with_name(f".{folder.name}.{mark}.{word}") for word in ("new", "old"))
    try:
        fresh.mkdir(parents=True)
        yield fresh
        for path in fresh.iterdir():
            with path.open("rb+") as file:
                os.fsync(file.fileno())
        if folder.exists():
            folder.rename(old)
        try:
            fresh.rename(folder)
        except OSError:
            if old.exists():
                old.rename(folder)
            raise
    except OSError as error:
        raise DyObError(disk_error(folder, error)) from error
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
        if folder.exists():
            shutil.rmtree(old, ignore_errors=True)


def disk_error(path: Path, error: OSError) -> str:
    """The sentence for a file that could not be written."""
    try:
        free = f"{shutil.disk_usage(path.parent).free / 1e6:.0f} MB free"
    except OSError:
        free = "its folder cannot be read"
    reason = error.strerror or str(error)
    return (
        f"{path}: expected to write this file, found '{reason}' ({free}); "
        "make room or choose another --output and try again. What was there before is kept."
    )


def write_text(path: Path | str, text: str) -> None:
    """Replace `path` by `text` (UTF-8) in one step. Raises DyObError where the disk refuses."""
    with replacing(path) as fresh:
        fresh.write_text(text, encoding="utf-8")


def write_json(path: Path | str, content: dict[str, Any]) -> None:
    """Write strict JSON: numpy values become plain ones, and NaN and infinity become null."""
    write_text(path, json.dumps(plain(content), indent=1, allow_nan=False) + "\n")


def read_json(path: Path | str) -> dict[str, Any]:
    """The object in a JSON file. Raises FormatError where it is missing, damaged or no object."""
    path = Path(path)
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except json.JSONDecodeError as error:
        raise FormatError(
            f"{path}: expected JSON, found a damaged line {error.lineno} ({error.msg}); "
            "run the sequence again or restore the file"
        ) from error
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(
            f"{path}: expected a JSON file, found it unreadable ({error}); run the sequence again"
        ) from error
    if not isinstance(content, dict):
        raise FormatError(
            f"{path}: expected a JSON object, found {type(content).__name__}; "
            "run the sequence again or restore the file"
        )
    return content


def write_yaml(path: Path | str, content: dict[str, Any]) -> None:
    """Write a YAML file with the keys in their order."""
    import yaml

    write_text(path, yaml.safe_dump(plain(content), sort_keys=False, allow_unicode=True))


def read_yaml(path: Path | str) -> dict[str, Any]:
    """The mapping in a YAML file. Raises FormatError where it is missing, damaged or no mapping."""
    import yaml

    path = Path(path)
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        reason = " ".join(str(error).split())
        raise FormatError(
            f"{path}: expected a YAML file, found it unreadable ({reason}); repair or remove it"
        ) from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise FormatError(
            f"{path}: expected a YAML mapping, found {type(content).__name__}; repair or remove it"
        )
    return content


def plain(value: Any) -> Any:
    """`value` with numpy, paths and tuples turned into what JSON and YAML know; NaN into None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, (str, Path)):
        return str(value)  # a StrEnum becomes the plain string
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
