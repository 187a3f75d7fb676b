"""The json beside a mask that names its instances: label -> class, and score where one is known.

Owns this small format: {"3": {"class": "car", "score": 0.93}}. Knows no pixels.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pipelines.datasets.files import DamagedFileError
from pipelines.errors import FrameError


def read_mask_classes(path: Path) -> dict[int, str]:
    """Class name of each label that the file names; its score may be missing or there.

    Raises FrameError where the file is not of this form, DamagedFileError where it is no json.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DamagedFileError(
            f"{path}: expected json that names the classes of a mask, found none ({error}); "
            "write it again or remove it."
        ) from error
    try:
        return {int(label): _class_of(entry) for label, entry in content.items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise FrameError(
            f'{path}: expected {{"label": {{"class": "car", "score": 0.9}}}}, found another form; '
            "correct it or remove it."
        ) from error


def mask_classes_text(entries: dict[int, tuple[str, float | None]]) -> str:
    """The file's text of label -> (class, score or None)."""
    content: dict[str, dict[str, Any]] = {}
    for label, (name, score) in sorted(entries.items()):
        content[str(label)] = {"class": name} | ({} if score is None else {"score": score})
    return json.dumps(content, indent=1, allow_nan=False) + "\n"


def _class_of(entry: Any) -> str:
    name = entry if isinstance(entry, str) else entry["class"]
    if not isinstance(name, str):
        raise TypeError(name)
    return name
