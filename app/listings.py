"""The verbs that list what there is: config and datasets.

Owns how settings and layouts are shown. The settings' meaning is in the comments of
`pipelines/config.py`, read from there so that it is written once.
"""

from __future__ import annotations

import ast
import inspect
import re
from argparse import Namespace
from dataclasses import fields, is_dataclass
from typing import Any

from app import console

_COMMENT_COLUMN = 36


def config(arguments: Namespace) -> int:
    """`config`: the resolved settings as YAML that --config reads back, each with its meaning."""
    from pipelines.io.config import load_config

    resolved = load_config(arguments.config, arguments.overrides)
    for section in fields(resolved):
        for line in section_lines(section.name, getattr(resolved, section.name)):
            console.say(line)
    return 0


def section_lines(name: str, section: Any) -> list[str]:
    """YAML lines of one section of the settings, with comments."""
    from pipelines.settings import to_plain

    if not is_dataclass(section):
        return [_yaml_line("", name, to_plain(section), "")]
    meaning = (inspect.getdoc(section) or "").splitlines()[:1]
    lines = [f"# {line}" for line in meaning] + [f"{name}:" if fields(section) else f"{name}: {{}}"]
    comments = field_comments(type(section))
    for item in fields(section):
        value = to_plain(getattr(section, item.name))
        lines.append(_yaml_line("  ", item.name, value, comments.get(item.name, "")))
    return lines


def _yaml_line(indent: str, name: str, value: Any, comment: str) -> str:
    import yaml

    text = yaml.safe_dump(value, default_flow_style=True, width=1000).removesuffix("...\n").strip()
    line = f"{indent}{name}: {text}"
    return f"{line:<{_COMMENT_COLUMN}}  # {comment}" if comment else line


def field_comments(section: type) -> dict[str, str]:
    """Field -> the comment behind it in the source, or the comment lines above it."""
    source = inspect.getsource(section)
    lines = source.splitlines()
    comments = {}
    for node in ast.parse(source).body[0].body:  # type: ignore[attr-defined]
        if not isinstance(node, ast.AnnAssign) or not isinstance(node.target, ast.Name):
            continue
        behind = re.search(r"#\s*(.*)", lines[node.end_lineno - 1][node.end_col_offset :])
        above = []
        row = node.lineno - 2
        while row >= 0 and (match := re.fullmatch(r"\s*#\s*(.*)", lines[row])):
            above.insert(0, match[1])
            row -= 1
        comments[node.target.id] = " ".join([*above, *([behind[1]] if behind else [])])
    return comments


def datasets(arguments: Namespace) -> int:
    """`datasets`: name, what it is, and the files that are expected."""
    from pipelines.datasets import DATASETS, load_dataset

    for name in [arguments.name] if arguments.name else DATASETS:
        dataset = load_dataset(name)
        console.say(f"{name}: {(inspect.getdoc(dataset) or '').splitlines()[0]}")
        for line in dataset.layout.splitlines():
            console.say(f"    {line}")
    return 0
