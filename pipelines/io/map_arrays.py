"""The sparse map as the plain arrays of a map folder, and back.

Owns names, shapes and types of the arrays, and what must fit in them. Their meaning and the files
are in `map_folder`.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import FormatError
from pipelines.mapping.keyframe import Keyframe
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.types import Array, Features

AGAIN = "save the map again with --save-map or restore the file"
Arrays = dict[str, NDArray]
Shapes = dict[str, tuple[tuple[int, ...], type]]
Pairs = list[tuple[NDArray[np.int64], NDArray[np.int64]]]

# Inner shape and type of what a file holds; the first side is counted (N, T, F or C above).
_POINT_ARRAYS: Shapes = {
    "position_m": ((3,), np.float64), "covariance_m2": ((3, 3), np.float64),
    "offset_slope": ((3,), np.float64), "descriptor": ((32,), np.uint8), "color": ((3,), np.uint8),
    "n_found": ((), np.int32), "n_visible": ((), np.int32), "n_keyframes": ((), np.int32),
    "first_keyframe": ((), np.int64), "alive": ((), np.bool_), "serial": ((), np.int64),
}  # fmt: skip
_KEYFRAME_ARRAYS: Shapes = {
    "frame_index": ((), np.int64), "timestamp_s": ((), np.float64),
    "T_world_camera": ((4, 4), np.float64),
}  # fmt: skip
_TRACK_ARRAYS: Shapes = {
    "point_id": ((), np.int64), "uv_px": ((2,), np.float64), "disparity_px": ((), np.float64),
    "sigma_uv_px": ((), np.float64),
}  # fmt: skip
_FEATURE_ARRAYS: Shapes = {
    "uv_px": ((2,), np.float64), "octave": ((), np.int32), "angle_deg": ((), np.float32),
    "response": ((), np.float32), "descriptor": ((32,), np.uint8), "depth_m": ((), np.float64),
}  # fmt: skip
_COVISIBLE_ARRAYS: Shapes = {"keyframe": ((), np.int64), "shared": ((), np.int64)}


def point_arrays(sparse_map: SparseMap) -> Arrays:
    """All arrays of points.npz, as views of the map's."""
    columns = sparse_map.columns()
    return {name: columns[name] for name in _POINT_ARRAYS}


def check_points(path: Path, arrays: Arrays) -> None:
    """Raise FormatError where an array of points.npz is missing, of another type or length."""
    _check_arrays(path, arrays, _POINT_ARRAYS)


def keyframes_of(path: Path, arrays: Arrays) -> tuple[list[Keyframe], Pairs]:
    """Keyframes and their covisibility, as `SparseMap.from_arrays` takes them.

    arrays: of keyframes.npz, which `path` names in errors. Raises FormatError where one is missing,
    of another type or length, or a pose is no rigid motion.
    """
    _check_arrays(path, arrays, _KEYFRAME_ARRAYS)
    K = len(arrays["frame_index"])
    tracks = _split(path, arrays, "track", _TRACK_ARRAYS, K)
    features = _split(path, arrays, "feature", _FEATURE_ARRAYS, K)
    covisible = _split(path, arrays, "covisible", _COVISIBLE_ARRAYS, K)
    _check_poses(path, arrays["T_world_camera"])
    rows = zip(arrays["frame_index"], arrays["timestamp_s"], arrays["T_world_camera"], strict=True)
    keyframes = [
        Keyframe(int(index), float(stamp), T.copy(), Tracks(**_named(track)),
                 Features(**_named(feature)))
        for (index, stamp, T), track, feature in zip(rows, tracks, features, strict=True)
    ]  # fmt: skip
    return keyframes, [(pair["keyframe"], pair["shared"]) for pair in covisible]


def keyframe_arrays(sparse_map: SparseMap) -> Arrays:
    """All arrays of keyframes.npz."""
    keyframes = sparse_map.keyframes
    arrays: Arrays = {
        "frame_index": np.array([k.frame_index for k in keyframes], np.int64),
        "timestamp_s": np.array([k.timestamp_s for k in keyframes], np.float64),
        "T_world_camera": np.array([k.T_world_camera for k in keyframes], float).reshape(-1, 4, 4),
    }
    tracks = [k.tracks for k in keyframes]
    arrays |= _joined("track", _TRACK_ARRAYS, tracks, lambda t, name: getattr(t, _long(name)))
    features = [k.free_features for k in keyframes]
    arrays |= _joined("feature", _FEATURE_ARRAYS, features, lambda f, name: getattr(f, _long(name)))
    pairs = sparse_map.covisibility()
    return arrays | _joined("covisible", _COVISIBLE_ARRAYS, pairs,
                            lambda pair, name: pair[name == "shared"])  # fmt: skip


def _joined(
    kind: str, shapes: Shapes, items: list[Any], get: Callable[[Any, str], NDArray]
) -> Arrays:
    """Arrays of many items end to end, and where each item's rows start."""
    out: Arrays = {}
    lengths = [len(get(item, next(iter(shapes)))) for item in items]
    out[f"{kind}_start"] = np.cumsum([0, *lengths], dtype=np.int64)
    for name, (inner, dtype) in shapes.items():
        parts = [np.empty((0, *inner), dtype), *(get(item, name) for item in items)]
        out[f"{kind}_{name}"] = np.concatenate(parts).astype(dtype)
    return out


def _long(name: str) -> str:
    """The attribute of `Tracks` and `Features` that an array of the file holds."""
    return {"point_id": "point_ids", "descriptor": "descriptors"}.get(name, name)


def _named(arrays: Arrays) -> Arrays:
    """A keyframe's arrays by the names of the attributes that they go to."""
    return {_long(name): array for name, array in arrays.items()}


def counts(points: Arrays, keyframes: Arrays) -> dict[str, int]:
    """How many of each the arrays hold."""
    return {
        "points": len(points["alive"]),
        "points_alive": int(points["alive"].sum()),
        "keyframes": len(keyframes["frame_index"]),
        "tracks": len(keyframes["track_point_id"]),
        "features": len(keyframes["feature_uv_px"]),
    }


def _check_arrays(path: Path, arrays: Arrays, shapes: Shapes, prefix: str = "") -> None:
    """Whether all arrays are there, of their type and shape, and equally long."""
    counts = {}
    for name, (inner, dtype) in shapes.items():
        array = arrays.get(prefix + name)
        if array is None:
            raise FormatError(f"{path}: expected the array {prefix}{name}, found none; {AGAIN}")
        if array.dtype != dtype or array.ndim != 1 + len(inner) or array.shape[1:] != inner:
            sides = ", ".join(map(str, inner))
            raise FormatError(
                f"{path}: expected {prefix}{name} as (N, {sides}) {np.dtype(dtype)}, "
                f"found {array.shape} {array.dtype}; {AGAIN}"
            )
        counts[prefix + name] = len(array)
    if len(set(counts.values())) > 1:
        raise FormatError(f"{path}: expected arrays of one length, found {counts}; {AGAIN}")


def _split(path: Path, arrays: Arrays, kind: str, shapes: Shapes, n: int) -> list[Arrays]:
    """Each keyframe's own rows of what lies end to end."""
    _check_arrays(path, arrays, {"start": ((), np.int64)}, f"{kind}_")
    _check_arrays(path, arrays, shapes, f"{kind}_")
    start = arrays[f"{kind}_start"]
    end = len(arrays[f"{kind}_{next(iter(shapes))}"])
    if len(start) != n + 1 or start[0] != 0 or start[-1] != end or (np.diff(start) < 0).any():
        raise FormatError(
            f"{path}: expected {kind}_start to rise from 0 to {end} in {n + 1} steps, found "
            f"{len(start)} numbers that do not; {AGAIN}"
        )
    return [
        {name: arrays[f"{kind}_{name}"][a:b].copy() for name in shapes}
        for a, b in pairwise(start.tolist())
    ]


def _check_poses(path: Path, Ts: Array) -> None:
    R = Ts[:, :3, :3]
    straight = np.abs(R @ R.transpose(0, 2, 1) - np.eye(3)).max(initial=0.0) < 1e-4
    if not (np.isfinite(Ts).all() and straight and (Ts[:, 3] == (0, 0, 0, 1)).all()):
        raise FormatError(
            f"{path}: expected rigid motions in T_world_camera, found others; {AGAIN}"
        )
