"""Folders of a sequence: finding numbered files in them, and saying what is missing.

Owns names of files and the sentences about trees. Reads no pixels.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from pipelines.datasets.files import IMAGE_SUFFIXES
from pipelines.errors import DatasetError

SHOWN_ENTRIES = 8  # of a folder, in messages


def list_files(folder: Path, suffixes: Iterable[str] = IMAGE_SUFFIXES) -> dict[str, Path]:
    """Files of `folder` with one of `suffixes` by stem, in order of their numbers, then names.

    An absent folder has no files. Two files of one stem: the first suffix wins.
    """
    if not folder.is_dir():
        return {}
    rank = {suffix: i for i, suffix in enumerate(suffixes)}
    found = [p for p in folder.iterdir() if p.suffix.lower() in rank and not p.name.startswith(".")]
    found.sort(key=lambda p: (natural_key(p.stem), rank[p.suffix.lower()]))
    files: dict[str, Path] = {}
    for path in found:
        files.setdefault(path.stem, path)
    return files


def natural_key(stem: str) -> list[tuple[int, int, str]]:
    """Sorting key with which frame 9 comes before frame 10, zero-padded or not."""
    parts = re.split(r"(\d+)", stem)
    return [(0, int(p), "") if p.isdigit() else (1, 0, p) for p in parts if p]


def frame_numbers(stems: Iterable[str]) -> list[int]:
    """The number in each stem, or 0, 1, 2, ... where any stem has none or two have the same."""
    stems = list(stems)
    found = [re.search(r"(\d+)$", stem) for stem in stems]
    numbers = [int(match.group(1)) for match in found if match]
    distinct = len(numbers) == len(stems) and len(set(numbers)) == len(numbers)
    return numbers if distinct else list(range(len(stems)))


def first_folder(root: Path, names: Iterable[str]) -> Path | None:
    """The first of `names` that is a folder of `root` with something in it."""
    for name in names:
        folder = root / name
        if folder.is_dir() and any(folder.iterdir()):
            return folder
    return None


def first_file(root: Path, names: Iterable[str]) -> Path | None:
    """The first of `names` (patterns allowed) that is a file of `root`."""
    if not root.is_dir():
        return None
    for name in names:
        for path in sorted(root.glob(name)):
            if path.is_file():
                return path
    return None


def describe_folder(folder: Path) -> str:
    """What a message says of a folder: its first entries, or that it is empty or missing."""
    if not folder.exists():
        return "no such folder"
    if not folder.is_dir():
        return "a file, not a folder"
    entries = sorted(p.name + ("/" if p.is_dir() else "") for p in folder.iterdir())
    if not entries:
        return "an empty folder"
    more = len(entries) - SHOWN_ENTRIES
    return ", ".join(entries[:SHOWN_ENTRIES]) + (f" and {more} more" if more > 0 else "")


def tree_error(dataset: str, layout: str, root: Path, missing: str, advice: str) -> DatasetError:
    """The error of a layout that lacks something: `missing`, `advice`, the tree, what is there."""
    return DatasetError(
        f"{root} as {dataset}: {missing}. {advice} "
        f"Expected: {layout}. Found: {describe_folder(root)}."
    )
