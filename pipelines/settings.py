"""Nested dataclasses from plain dicts and back, with errors in words.

Owns types, names and conversions; knows no setting of its own. Types are the fields' annotations:
bool, int, float, str, enumerations, `Literal`, tuples, unions of these, and nested dataclasses.
"""

from __future__ import annotations

import math
from dataclasses import fields, is_dataclass
from difflib import get_close_matches
from enum import Enum
from types import UnionType
from typing import Any, Literal, Union, cast, get_args, get_origin, get_type_hints

from pipelines.errors import ConfigError


def merge(into: dict[str, Any], changes: dict[str, Any]) -> None:
    """Put nested `changes` into the dict `into`, which is changed; the later value wins."""
    for key, value in changes.items():
        if isinstance(value, dict) and isinstance(into.get(key), dict):
            merge(into[key], value)
        else:
            into[key] = value


def build(section: type, changes: Any, prefix: str = "", root: type | None = None) -> Any:
    """An instance of the dataclass `section` with its defaults, except for nested `changes`.

    `prefix` and `root` are for the calls on inner sections. Raises ConfigError for an unknown name
    (with the nearest valid one), a wrong type, and a value that the section itself rejects.
    """
    if changes is None:  # a YAML section with every line commented out
        changes = {}
    if not isinstance(changes, dict):
        names = ", ".join(f.name for f in fields(section))
        raise ConfigError(
            f"{prefix.rstrip('.')} is a section with the settings {names}; "
            f"found {describe(changes)} in its place"
        )
    types = get_type_hints(section)
    values = {}
    for key, value in changes.items():
        if key not in types:
            raise ConfigError(_unknown_key(f"{prefix}{key}", root or section))
        if is_dataclass(types[key]):
            values[key] = build(types[key], value, f"{prefix}{key}.", root or section)
        else:
            values[key] = _coerce(value, types[key], f"{prefix}{key}")
    try:
        return section(**values)
    except ValueError as error:
        raise ConfigError(str(error)) from error


def _unknown_key(key: str, root: type) -> str:
    valid = setting_names(root)
    # People more often forget the section than misspell the name: the last part counts too.
    by_leaf = {name.rpartition(".")[2]: name for name in valid}
    near = get_close_matches(key, valid, 1, 0.75)
    near = near or [by_leaf[n] for n in get_close_matches(key.rpartition(".")[2], by_leaf, 1, 0.6)]
    near = near or get_close_matches(key, valid, 1, 0.0)
    return (
        f"unknown setting '{key}'; the nearest valid one is '{near[0]}' "
        "(`python3 -m app config` lists all)"
    )


def setting_names(section: type) -> list[str]:
    """Dotted names of all settings, in order."""
    names = []
    for key, kind in get_type_hints(section).items():
        if is_dataclass(kind):
            names += [f"{key}.{name}" for name in setting_names(cast(type, kind))]
        else:
            names.append(key)
    return names


def _coerce(value: Any, kind: Any, key: str) -> Any:
    """`value` as the annotated type `kind`, where that loses nothing; else ConfigError."""
    try:
        return _convert(value, kind)
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{key}: expected {_expected(kind)}, found {describe(value)}") from error


def _convert(value: Any, kind: Any) -> Any:
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return _convert_union(value, arguments)
    if origin is tuple:
        return _convert_tuple(value, arguments)
    if origin is Literal:
        if value not in arguments:
            raise ValueError
        return value
    return _convert_scalar(value, kind)


def _convert_scalar(value: Any, kind: type) -> Any:
    if isinstance(value, bool) != (kind is bool):  # to Python, True is the number 1
        raise TypeError
    if kind is float and isinstance(value, int | str):  # YAML 1.1 reads 1e-3 as a string
        value = float(value)
    elif issubclass(kind, Enum) and isinstance(value, str):
        value = kind(value)
    if not isinstance(value, kind) or (isinstance(value, float) and math.isnan(value)):
        raise TypeError
    return value


def _convert_union(value: Any, kinds: tuple[Any, ...]) -> Any:
    for kind in sorted(kinds, key=lambda kind: kind is str):  # a string last: 1e-3 is a float
        try:
            return _convert(value, kind)
        except (TypeError, ValueError):
            continue
    raise TypeError


def _convert_tuple(value: Any, kinds: tuple[Any, ...]) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise TypeError
    if len(kinds) == 2 and kinds[1] is Ellipsis:
        kinds = (kinds[0],) * len(value)
    if len(value) != len(kinds):
        raise ValueError
    return tuple(_convert(v, kind) for v, kind in zip(value, kinds, strict=True))


_NAMES = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a text",
    type(None): "null",
}


def _expected(kind: Any) -> str:
    """What a setting of the annotated type `kind` takes, in words."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return " or ".join(_expected(argument) for argument in arguments)
    if origin is Literal:
        return "one of " + ", ".join(str(argument) for argument in arguments)
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return f"a list, each item {_expected(arguments[0])}"
        return f"a list of {len(arguments)}: " + ", ".join(_expected(a) for a in arguments)
    if isinstance(kind, type) and issubclass(kind, Enum):
        return "one of " + ", ".join(str(member.value) for member in kind)
    return _NAMES.get(kind, str(kind))


def describe(value: Any) -> str:
    """A plain value with its type, for messages."""
    if isinstance(value, dict):
        return "a section with " + (", ".join(map(str, value)) or "nothing in it")
    return "nothing" if value is None else f"{type(value).__name__} {value!r}"


def to_plain(value: Any) -> Any:
    """Nested dicts, lists and plain values of a dataclass, as YAML and JSON hold them."""
    if is_dataclass(value):
        return {f.name: to_plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    return value.value if isinstance(value, Enum) else value
