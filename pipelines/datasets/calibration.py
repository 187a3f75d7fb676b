"""Camera settings of a sequence: small YAML files, matrices of text, and what follows from them.

Owns reading `key: value` settings (plain YAML and OpenCV's `%YAML:1.0` alike) and making a
StereoCamera of them. Knows no layout.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from pipelines.datasets.files import DepthCoding, Size
from pipelines.errors import DatasetError
from pipelines.types import StereoCamera

RGBD_BF = 40.0  # px * m, virtual right camera of an RGB-D one: 7.5 cm behind 530 px, as ORB-SLAM2
Settings = Mapping[str, str]
CAMERA_KEYS = (
    *("fx", "fy", "cx", "cy", "width", "height", "bf", "baseline_m"),
    *("fps", "depth_scale", "depth_form", "disparity_scale", "stereo"),
)
CAMERA_YAML = (
    "camera.yaml with one `key: value` a line: fx, fy, cx, cy in pixels; of a stereo pair "
    "baseline_m (or bf, px * m); of depth images depth_scale, the value of 1 m (1000 for "
    "millimetres), or disparity_scale, the value of 1 px; fps unless there is a times.txt; width "
    "and height if you like"
)


def read_settings(path: Path) -> dict[str, str]:
    """Flat `key: value` lines of a settings file as text, comments and nested blocks left out."""
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError as error:
        raise DatasetError(f"Settings {path} cannot be read ({error.strerror}).") from error
    settings = {}
    for line in lines:
        content = line.split("#", 1)[0].rstrip()
        if content.startswith(("%", "-", " ", "\t")) or ":" not in content:
            continue
        key, value = content.split(":", 1)
        settings[key.strip()] = value.strip().strip("\"'")
    return settings


def number(settings: Settings, key: str, source: Path) -> float | None:
    """The value of `key` as a finite number, None where it is not set."""
    if key not in settings:
        return None
    try:
        value = float(settings[key])
    except ValueError:
        value = float("nan")
    if not np.isfinite(value):
        raise DatasetError(
            f"{source}: expected a number for `{key}`, found {settings[key]!r}; correct it."
        )
    return value


def required(settings: Settings, keys: Iterable[str], source: Path) -> list[float]:
    """The numbers of all `keys`; raises DatasetError that names those missing."""
    values = {key: number(settings, key, source) for key in keys}
    missing = [key for key, value in values.items() if value is None]
    if missing:
        raise DatasetError(
            f"{source}: missing calibration, expected {', '.join(values)}, "
            f"found no {', '.join(missing)}; add {'it' if len(missing) == 1 else 'them'}."
        )
    return [value for value in values.values() if value is not None]


def settings_size(settings: Settings, source: Path, prefix: str = "") -> Size | None:
    """Width and height that the settings state, or None where they state none."""
    width, height = (number(settings, prefix + key, source) for key in ("width", "height"))
    return None if width is None or height is None else (int(width), int(height))


def make_camera(
    size: Size,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    bf: float,
    source: Path,
    is_rgbd: bool = False,
) -> StereoCamera:
    """A StereoCamera; raises DatasetError where the numbers cannot be a camera's."""
    width, height = size
    if min(fx, fy, bf) <= 0 or not (0 < cx < width and 0 < cy < height):
        raise DatasetError(
            f"{source}: expected positive fx, fy and bf and a principal point inside the image of "
            f"{width} x {height}, found fx {fx:g}, fy {fy:g}, cx {cx:g}, cy {cy:g}, bf {bf:g}; "
            "correct the calibration."
        )
    fx, fy, cx, cy, bf = (float(value) for value in (fx, fy, cx, cy, bf))
    return StereoCamera(width, height, fx, fy, cx, cy, bf, is_rgbd)


def read_camera_yaml(path: Path) -> dict[str, str]:
    """Settings of this project's own camera.yaml; an unknown key is an error."""
    settings = read_settings(path)
    for key in settings:
        if key not in CAMERA_KEYS:
            nearest = difflib.get_close_matches(key, CAMERA_KEYS, 1)
            hint = (
                f"did you mean `{nearest[0]}`?" if nearest else f"known: {', '.join(CAMERA_KEYS)}"
            )
            raise DatasetError(f"{path}: unknown key `{key}`; {hint}")
    return settings


def bf_of(settings: Settings, source: Path) -> float | None:
    """bf in px * m from `bf`, or `baseline_m` times fx; None where neither is set."""
    bf, baseline_m = number(settings, "bf", source), number(settings, "baseline_m", source)
    if bf is None and baseline_m is not None:
        bf = baseline_m * required(settings, ["fx"], source)[0]
    return bf


def depth_coding_of(
    depths: Iterable[Path], settings: Settings, bf: float, source: Path, scale: float | None = None
) -> DepthCoding | None:
    """How the depth images of a camera.yaml are read; None where there are no `depths`.

    disparity_scale: Z = bf / (value / disparity_scale), and goes first, since it is `prepare` that
    writes it. Else `scale` or depth_scale, with depth_form "metric" or "disparity". bf: px * m.
    """
    depths = list(depths)
    if not depths:
        return None
    disparity_scale = number(settings, "disparity_scale", source)
    if disparity_scale is not None:
        return DepthCoding("disparity", disparity_scale, bf)
    scale = scale or number(settings, "depth_scale", source)
    if scale is None:
        if any(path.suffix.lower() != ".npy" for path in depths):
            raise DatasetError(
                f"{source}: missing calibration, expected depth_scale, the value of 1 m in the "
                "depth images (1000 for millimetres), found none; add it."
            )
        scale = 1.0
    form = settings.get("depth_form", "metric")
    return DepthCoding(form, scale, bf)  # type: ignore[arg-type]  # checks the form itself


def read_matrix(path: Path) -> np.ndarray:
    """A matrix of numbers from text; raises DatasetError where it is none."""
    try:
        return np.loadtxt(path, ndmin=2)
    except (OSError, ValueError) as error:
        raise DatasetError(
            f"{path}: expected rows of numbers, found other text ({error})."
        ) from error
