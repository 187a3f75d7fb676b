"""What the project's environment asks for, and what is there: environment.txt, `.venv`, its stamp.

Owns the names and the reading of these files; installs nothing. Standard library only.

    .venv/dyob-stamp.json   what the finished set-up holds; written last, so no stamp = not finished
    .venv.unfinished        there while packages are being written; found later = start over
    .venv.lock              held by the set-up at work (and by its pip, should only that survive)
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from pipelines.errors import DyObError

ROOT = Path(__file__).resolve().parent.parent
CORE, DEVELOPMENT, NOTEBOOK, TORCH = "core", "development", "notebook", "torch"


class SetupError(DyObError):
    """The machine lacks something that the set-up cannot bring."""


@dataclass(frozen=True)
class Environment:
    """Where a set-up lives, and what its environment.txt asks for."""

    root: Path = ROOT
    sections: dict[str, list[str]] = field(default_factory=dict)

    @classmethod
    def read(cls, root: Path = ROOT) -> Environment:
        """Raises SetupError where environment.txt is missing or a line is no pin."""
        try:
            text = (root / "environment.txt").read_text(encoding="utf-8")
        except OSError as error:
            raise SetupError(
                f"cannot read {root / 'environment.txt'} ({error.strerror}): run from a complete "
                "clone of the repository"
            ) from error
        return cls(root, parse_sections(text))

    @property
    def folder(self) -> Path:
        return self.root / ".venv"

    @property
    def python(self) -> Path:
        return self.folder / "bin" / "python"

    @property
    def stamp(self) -> Path:
        return self.folder / "dyob-stamp.json"

    @property
    def unfinished(self) -> Path:
        return self.root / ".venv.unfinished"

    @property
    def lock(self) -> Path:
        return self.root / ".venv.lock"

    @property
    def log(self) -> Path:
        """What pip said."""
        return self.folder / "setup.log"

    @property
    def system_log(self) -> Path:
        """What apt-get said, before there is a `.venv`."""
        return self.root / ".venv.system.log"

    def pins(self, sections: Sequence[str]) -> list[str]:
        return [pin for section in sections for pin in self.sections.get(section, [])]

    def digest(self, section: str) -> str:
        return hashlib.sha256("\n".join(self.pins([section])).encode()).hexdigest()

    def stamped(self) -> dict[str, str]:
        """What the finished set-up holds: section -> digest, and "python" -> its version."""
        try:
            held = json.loads(self.stamp.read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return {}
        return held if isinstance(held, dict) else {}

    def is_ready(self, sections: Sequence[str]) -> bool:
        """Whether `.venv` is finished and holds what environment.txt asks for today."""
        held = self.stamped()
        return (
            all(held.get(section) == self.digest(section) for section in sections)
            and os.access(self.python, os.X_OK)  # a link to a Python that is gone is not
            and not self.unfinished.exists()
        )

    def is_current(self) -> bool:
        """Whether this very process runs in `.venv`."""
        return self.folder.is_dir() and Path(sys.prefix).resolve() == self.folder.resolve()


def parse_sections(text: str) -> dict[str, list[str]]:
    """Pins `name==version` by the heading `# [section]` above them, in order."""
    sections: dict[str, list[str]] = {}
    name = CORE
    for number, raw in enumerate(text.splitlines(), 1):
        heading = re.fullmatch(r"#\s*\[(\w+)\]\s*", raw)
        line = raw.partition("#")[0].strip()
        if heading:
            name = heading[1]
        elif line:
            if not re.fullmatch(r"[\w.-]+==[\w.+!]+", line):
                raise SetupError(
                    f"environment.txt, line {number}: expected name==version, found '{line}'"
                )
            sections.setdefault(name, []).append(line)
    return sections


def has_packages(pins: Sequence[str]) -> bool:
    """Whether the running interpreter has every pinned package in that very version."""
    return not missing_packages(pins)


def missing_packages(pins: Sequence[str]) -> dict[str, str]:
    """Pin -> what this interpreter has instead ("nothing" or a version)."""
    missing = {}
    for pin in pins:
        name, _, wanted = pin.partition("==")
        try:
            found = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found = "nothing"
        if found.partition("+")[0] != wanted:  # 2.15.0+cpu is a build of 2.15.0
            missing[pin] = found
    return missing
