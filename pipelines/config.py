"""The settings of every step: nested frozen dataclasses with the paper's values as defaults.

Each step gets its own section only. Owns the values' meaning; reading and overriding is below.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from pipelines.errors import ConfigError
from pipelines.settings import build, describe, merge, to_plain


@dataclass(frozen=True, slots=True)
class DepthConfig:
    """Step 0: depth from stereo, and which depths count as near."""

    close_baselines: float = 40.0  # a point is close when z < this many baselines (paper, ORB)
    max_depth_m: float = 0.0  # ThDepth: ignore depths beyond this, 0 = the close rule alone
    sgbm_num_disparities: int = 96  # px, search range of the stereo matcher, multiple of 16
    sgbm_block_size: int = 5  # px, odd
    left_right_max_px: float = 1.0  # px, left-right check of disparities


@dataclass(frozen=True, slots=True)
class OrbConfig:
    """Step 3: ORB features on static pixels."""

    n_features: int = 2000  # per image, after even spreading
    n_levels: int = 8  # pyramid levels (paper)
    scale_factor: float = 1.2  # between levels (paper, as ORB-SLAM)
    fast_threshold: int = 12  # grey levels, FAST corner threshold
    mask_dilation_px: int = 7  # px, movable masks grow by this before features are kept off them


@dataclass(frozen=True, slots=True)
class TrackingConfig:
    """Step 4: camera pose."""

    seed: int = 0  # of RANSAC and every other random choice


@dataclass(frozen=True, slots=True)
class MappingConfig:
    """Step 10: sparse map."""


@dataclass(frozen=True, slots=True)
class Config:
    """The whole system's settings."""

    depth: DepthConfig = field(default_factory=DepthConfig)
    orb: OrbConfig = field(default_factory=OrbConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)


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
    """Nested dicts of plain values (numbers, strings, lists), as YAML and JSON hold them."""
    return cast(dict[str, Any], to_plain(config))


def save_config(config: Config, path: str | Path) -> None:
    """Write every setting as YAML; `load_config` reads it back to an equal `Config`."""
    import yaml

    text = yaml.safe_dump(config_to_dict(config), sort_keys=False, allow_unicode=True)
    Path(path).write_text(text, encoding="utf-8")


def _read_settings(path: Path) -> dict[str, Any]:
    import yaml

    try:
        loaded = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ConfigError(
            f"cannot read the settings file {path}: {error.strerror}; "
            "give --config a YAML file such as `python -m app config` prints"
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
