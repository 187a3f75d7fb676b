"""Calibration of the Oxford Multimotion Dataset: Kalibr's yaml of its cameras, Vicon's of the rig.

Owns these files: which camera is whose, and where each sits on the rig.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.datasets.files import Size
from pipelines.errors import DatasetError
from pipelines.geometry import invert_T
from pipelines.types import Array


@dataclass(frozen=True, slots=True)
class OmdCamera:
    """One camera of a Kalibr file.

    number: its place in the chain of `T_cn_cnm1`. size: width, height in px. intrinsics: (4,) fx,
    fy, cx, cy in px. distortion: (D,) coefficients, empty where the file states none.
    T_camera_previous: (4, 4), from the camera before it in the chain; None for the first.
    """

    name: str
    number: int
    size: Size
    intrinsics: Array
    distortion: Array
    T_camera_previous: Array | None


def read_omd_cameras(path: Path) -> list[OmdCamera]:
    """The cameras of a Kalibr (or manufacturer's) yaml in their order. Raises DatasetError."""
    cameras = []
    for name, entry in _read_yaml(path).items():
        match = re.match(r"cam(\d+)", str(name))
        if not match or not isinstance(entry, dict):
            continue
        try:
            width, height = (int(value) for value in entry["resolution"])
            intrinsics = np.array(entry["intrinsics"], np.float64).reshape(4)
            distortion = np.array(entry.get("distortion_coeffs") or [], np.float64).ravel()
            T = entry.get("T_cn_cnm1")
            T = None if T is None else np.array(T, np.float64).reshape(4, 4)
        except (KeyError, TypeError, ValueError) as error:
            raise DatasetError(
                f"{path}: expected resolution, intrinsics (fx fy cx cy) and T_cn_cnm1 (4 x 4) of "
                f"{name}, found another form ({error}); copy the calibration again."
            ) from error
        number = int(match.group(1))
        cameras.append(OmdCamera(str(name), number, (width, height), intrinsics, distortion, T))
    return sorted(cameras, key=lambda camera: (camera.number, camera.name))


def camera_of_size(cameras: list[OmdCamera], size: Size, path: Path) -> OmdCamera:
    """The camera whose images have `size`; of several the last, which is the undistorted one."""
    found = [camera for camera in cameras if camera.size == size]
    if not found:
        sizes = ", ".join(f"{c.name} of {c.size[0]} x {c.size[1]}" for c in cameras) or "no camera"
        raise DatasetError(
            f"{path}: missing calibration, expected a camera of {size[0]} x {size[1]} pixels as "
            f"the images have, found {sizes}; take the calibration of this data set's own day."
        )
    return found[-1]


def T_left_camera(cameras: list[OmdCamera], camera: OmdCamera, path: Path) -> Array:
    """Pose (4, 4) of `camera` in the first camera of the chain, the left one of the stereo pair."""
    T_camera_left = np.eye(4)
    for number in range(1, camera.number + 1):
        links = [c for c in cameras if c.number == number]
        link = camera if number == camera.number else next(iter(links), None)
        if link is None or link.T_camera_previous is None:
            raise DatasetError(
                f"{path}: missing calibration, expected T_cn_cnm1 of cam{number}, found none; "
                "copy kalibr.yaml of the data set."
            )
        T_camera_left = link.T_camera_previous @ T_camera_left
    return invert_T(T_camera_left)


def read_T_apparatus_left(path: Path) -> Array:
    """Pose (4, 4) of the left camera on the rig that Vicon tracks, from vicon.yaml."""
    try:
        return np.array(_read_yaml(path)["T_apparatus_left"], np.float64).reshape(4, 4)
    except (KeyError, TypeError, ValueError) as error:
        raise DatasetError(
            f"{path}: expected T_apparatus_left (4 x 4), found another form; copy vicon.yaml of "
            "the data set."
        ) from error


def _read_yaml(path: Path) -> dict[Any, Any]:
    import yaml

    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise DatasetError(f"{path}: expected YAML, found other text ({reason}).") from error
    return content if isinstance(content, dict) else {}
