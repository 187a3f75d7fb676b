"""Where settings come from: YAML files and the command line; and the plain form they are kept in.

What they mean is in `pipelines.config`; each result keeps them as config.yaml, see `io.result`.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, cast

from pipelines.config import Config
from pipelines.errors import ConfigError
from pipelines.settings import build, describe, merge, to_plain


def load_config(path: str | Path | None = None, overrides: Iterable[str] = ()) -> Config:
    """The defaults, changed by a partial YAML file and then by `a.b=c` overrides, in this order.

    Raises ConfigError for a file that cannot be read, an unknown key (naming the nearest valid
    one), a value of the wrong type, or one that a section rejects.
    """
    changes = _read_settings(Path(path)) if path is not None else {}
    for override in overrides:
        merge(changes, _parse_override(override))
    return cast(Config, build(Config, changes))


def config_to_dict(config: Config) -> dict[str, Any]:
    """Nested dicts of plain values (numbers, strings, lists), as YAML and JSON hold them.

    `load_config` reads a YAML file of them back to an equal `Config`.
    """
    return cast(dict[str, Any], to_plain(config))


def _read_settings(path: Path) -> dict[str, Any]:
    import yaml

    try:
        loaded = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(
            f"cannot read the settings file {path}: {error.strerror}; "
            "give --config a YAML file such as `python3 -m app config` prints"
        ) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        first_line = " ".join(str(error).split())
        raise ConfigError(f"{path} is not a YAML file: {first_line}") from error
    if loaded is None:
        return {}
    if not isinstance(loaded, dict):
        raise ConfigError(
            f"{path}: expected sections with settings, such as `orb: {{n_features: 1500}}`, "
            f"found {describe(loaded)}"
        )
    return loaded


def _parse_override(override: str) -> dict[str, Any]:
    """Nested dict of one `a.b=c`; the value is read as YAML, so that 3, true and [1, 2] work."""
    import yaml

    key, equals, text = override.partition("=")
    names = key.strip().split(".")
    if not equals or not all(names):
        raise ConfigError(
            f"--set {override}: expected section.name=value, as in orb.n_features=1500"
        )
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(f"--set {override}: the value {text!r} cannot be read as YAML") from error
    for name in reversed(names):
        value = {name: value}
    return value
