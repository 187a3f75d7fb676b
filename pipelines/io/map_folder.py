"""Maps that last: a documented, versioned folder of plain arrays, JSON and PLY; no pickle.

Owns the format below, its writing in one step and its checks. The map itself is
`mapping.sparse_map`. Read the arrays with `np.load(path, allow_pickle=False)`; nothing else of
this project is needed. Everything is in one world: its origin is the left camera of the mapped
sequence's first frame, x right, y down, z forward, metres. Pixels are of the rectified left image.

map.json
    format "dyob-slam map", version 1; camera: width, height, fx, fy, cx, cy in px, bf in px * m,
    is_rgbd; world: a sentence; counts: points, points_alive, keyframes, tracks, features, objects;
    files: size in bytes and SHA-256 of each file below.

points.npz, N points; a point's id is its row, and dead rows stay because keyframes name ids
    position_m          (N, 3)     float64  in the world, m
    covariance_m2       (N, 3, 3)  float64  of the position, in the world, m^2
    offset_slope        (N, 3)     float64  d position / d disparity offset, m / px
    descriptor          (N, 32)    uint8    ORB, 256 bits
    color               (N, 3)     uint8    RGB
    n_found, n_visible  (N,)       int32    frames that observed the point, and that should have
    n_keyframes         (N,)       int32    keyframes that observe it
    first_keyframe      (N,)       int64    row of the first of these in keyframes.npz, -1 for none
    alive               (N,)       bool     False where the point was culled
    serial              (N,)       int64    lasting number of the point, as rows are used again

keyframes.npz, K keyframes in the order of their frames. What differs in number from keyframe to
keyframe lies end to end: rows start[k] to start[k + 1] are keyframe k's, start having K + 1 rows.
    frame_index         (K,)       int64    in the sequence
    timestamp_s         (K,)       float64  s
    T_world_camera      (K, 4, 4)  float64  p_world = T @ p_camera
    track_start         (K + 1,)   int64    T tracks: which map point is seen where
    track_point_id      (T,)       int64    row of points.npz
    track_uv_px         (T, 2)     float64  px
    track_disparity_px  (T,)       float64  px, NaN where unknown or far
    track_sigma_uv_px   (T,)       float64  px, standard deviation per axis
    feature_start       (K + 1,)   int64    F features that see no map point
    feature_uv_px       (F, 2)     float64  px
    feature_octave      (F,)       int32    pyramid level, 0 the finest
    feature_angle_deg   (F,)       float32  deg
    feature_response    (F,)       float32  strength of the corner
    feature_descriptor  (F, 32)    uint8    ORB
    feature_depth_m     (F,)       float64  m, NaN where unknown
    covisible_start     (K + 1,)   int64    C pairs of covisible keyframes, most shared first
    covisible_keyframe  (C,)       int64    row of the other keyframe
    covisible_shared    (C,)       int64    map points that both see

static_map.ply
    The well-measured points with their colours, float32, for viewers; Open3D reads it. It is
    made from points.npz and not read back.
objects.csv
    Moving objects, a row per object and frame, as in a result folder (`io.objects`).
"""

from __future__ import annotations

import hashlib
import io
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.config import MappingConfig
from pipelines.errors import DyObError, FormatError
from pipelines.io.files import read_json, replacing_folder, write_json
from pipelines.io.map_arrays import (
    AGAIN,
    Arrays,
    check_points,
    counts,
    keyframe_arrays,
    keyframes_of,
    point_arrays,
)
from pipelines.io.objects import read_objects, write_objects
from pipelines.io.ply import write_point_cloud
from pipelines.mapping.sparse_map import SparseMap
from pipelines.object_types import ObjectEstimates
from pipelines.types import StereoCamera

FORMAT, VERSION = "dyob-slam map", 1
MAP_JSON, POINTS, KEYFRAMES = "map.json", "points.npz", "keyframes.npz"
STATIC_MAP, OBJECTS = "static_map.ply", "objects.csv"
_FILES = (MAP_JSON, POINTS, KEYFRAMES, STATIC_MAP, OBJECTS)
_WORLD = (
    "The origin is the left camera of the mapped sequence's first frame; x right, y down, "
    "z forward, in metres."
)
_CAMERA_TOLERANCE = 1e-6  # relative; the numbers pass through JSON unchanged


def save_map(
    folder: Path | str, sparse_map: SparseMap, objects: ObjectEstimates | None = None
) -> None:
    """Write a map folder in one step: it appears whole, or the map that was there before stays.

    objects: trajectories of the moving objects met on the way, in the map's world.
    Raises DyObError where the disk refuses or `folder` holds anything but a map.
    """
    folder = Path(folder)
    _check_target(folder)
    objects = ObjectEstimates.empty() if objects is None else objects
    points, keyframes = point_arrays(sparse_map), keyframe_arrays(sparse_map)
    static = sparse_map.snapshot()
    with replacing_folder(folder) as fresh:
        np.savez(fresh / POINTS, **points)  # type: ignore[arg-type]
        np.savez(fresh / KEYFRAMES, **keyframes)  # type: ignore[arg-type]
        write_point_cloud(fresh / STATIC_MAP, static.points_m, static.colors)
        write_objects(fresh / OBJECTS, objects)
        sums = counts(points, keyframes) | {"objects": len(np.unique(objects.object_id))}
        files = {
            name: {"bytes": (fresh / name).stat().st_size, "sha256": _digest(fresh / name)}
            for name in _FILES
            if name != MAP_JSON
        }
        head = {"format": FORMAT, "version": VERSION, "camera": asdict(sparse_map.camera)}
        write_json(fresh / MAP_JSON, head | {"world": _WORLD, "counts": sums, "files": files})


def load_map(folder: Path | str, camera: StereoCamera, config: MappingConfig) -> SparseMap:
    """The map of a folder, for the camera it was made with.

    Raises FormatError, in a sentence, where the folder is no map, a file is missing or damaged,
    the version is newer than this program's, or the camera is another one.
    """
    folder = Path(folder)
    head = read_map_head(folder)
    _check_camera(folder, head, camera)
    points = _read_arrays(folder, head, POINTS)
    arrays = _read_arrays(folder, head, KEYFRAMES)
    check_points(folder / POINTS, points)
    keyframes, pairs = keyframes_of(folder / KEYFRAMES, arrays)
    promised, found = head["counts"], counts(points, arrays)
    for name, count in found.items():
        if promised.get(name) != count:
            raise FormatError(
                f"{folder / MAP_JSON}: expected {promised.get(name)} {name} as it says, found "
                f"{count} in the arrays; {AGAIN}"
            )
    try:
        return SparseMap.from_arrays(camera, config, points, keyframes, pairs)
    except ValueError as error:
        raise FormatError(
            f"{folder}: expected points and keyframes that name each other, found {error}; {AGAIN}"
        ) from error


def load_map_objects(folder: Path | str) -> ObjectEstimates:
    """The trajectories of moving objects in a map folder. Raises FormatError as `load_map`."""
    folder = Path(folder)
    _checked_bytes(folder, read_map_head(folder), OBJECTS)
    return read_objects(folder / OBJECTS)


def read_map_head(folder: Path | str) -> dict[str, Any]:
    """What map.json says, its format and version checked. Raises FormatError as `load_map`."""
    folder = Path(folder)
    path = folder / MAP_JSON
    if not path.is_file():
        found = f"no {MAP_JSON} in it" if folder.is_dir() else "no such folder"
        raise FormatError(
            f"{folder}: expected a map folder, found {found}; name a folder that --save-map wrote"
        )
    head = read_json(path)
    if head.get("format") != FORMAT:
        raise FormatError(
            f"{path}: expected the format '{FORMAT}', found '{head.get('format')}'; "
            "name a folder that --save-map wrote"
        )
    version = head.get("version")
    if not isinstance(version, int) or version < 1:
        raise FormatError(f"{path}: expected a version from 1 on, found {version!r}; {AGAIN}")
    if version > VERSION:
        raise FormatError(
            f"{path}: expected a map of version {VERSION} or older, found version {version}; "
            "update the program, or save the map again with this one"
        )
    for part in ("counts", "files"):
        if not isinstance(head.get(part), dict):
            raise FormatError(
                f"{path}: expected an object '{part}', found {head.get(part)!r}; {AGAIN}"
            )
    return head


def _check_target(folder: Path) -> None:
    """Only a map may be replaced: other folders may hold what is dear."""
    if not folder.exists():
        return
    held = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else None
    strange = None if held is None else [name for name in held if name not in _FILES]
    if strange is None or strange or (held and MAP_JSON not in held):
        found = "a file" if held is None else f"{', '.join((strange or held)[:3])} in it"
        raise DyObError(
            f"{folder}: expected a new or empty folder or an earlier map to write the map to, "
            f"found {found}; choose another folder for --save-map"
        )


def _check_camera(folder: Path, head: dict[str, Any], camera: StereoCamera) -> None:
    saved, own = head.get("camera"), asdict(camera)
    if not isinstance(saved, dict) or not all(
        isinstance(saved.get(name), (int, float)) for name in own
    ):
        raise FormatError(
            f"{folder / MAP_JSON}: expected a camera with {', '.join(own)}, found {saved}; {AGAIN}"
        )
    other = [
        name for name, value in own.items()
        if abs(saved[name] - value) > _CAMERA_TOLERANCE * max(abs(value), 1.0)
    ]  # fmt: skip
    if other:
        ours = ", ".join(f"{name} {own[name]:g}" for name in other)
        theirs = ", ".join(f"{name} {saved[name]:g}" for name in other)
        raise FormatError(
            f"{folder}: expected a map of the sequence's camera with {ours}, found one with "
            f"{theirs}; load a map that was made with this camera"
        )


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _checked_bytes(folder: Path, head: dict[str, Any], name: str) -> bytes:
    """The content of a file, which is what it was when the map was saved."""
    path = folder / name
    try:
        content = path.read_bytes()
    except OSError as error:
        raise FormatError(
            f"{path}: expected a file of the map, found it unreadable ({error.strerror}); {AGAIN}"
        ) from error
    entry = head["files"].get(name)
    if not isinstance(entry, dict):
        raise FormatError(
            f"{folder / MAP_JSON}: expected size and checksum of {name}, found {entry!r}; {AGAIN}"
        )
    if len(content) != entry.get("bytes"):
        raise FormatError(
            f"{path}: expected {entry.get('bytes')} bytes as {MAP_JSON} says, found "
            f"{len(content)}; {AGAIN}"
        )
    if hashlib.sha256(content).hexdigest() != entry.get("sha256"):
        raise FormatError(
            f"{path}: expected the checksum in {MAP_JSON}, found that the file has changed; {AGAIN}"
        )
    return content


def _read_arrays(folder: Path, head: dict[str, Any], name: str) -> Arrays:
    content = _checked_bytes(folder, head, name)
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            return {key: arrays[key] for key in arrays.files}
    except (zipfile.BadZipFile, ValueError, KeyError, OSError, EOFError) as error:
        raise FormatError(
            f"{folder / name}: expected plain arrays, found them unreadable ({error}); {AGAIN}"
        ) from error
