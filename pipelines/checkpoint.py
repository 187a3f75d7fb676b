"""Checkpoints: all that a run needs to go on as if it had never been interrupted.

Owns the folder `checkpoint/` of a result: what is in it, when it is written and when believed. Its
form is `io.object_graph`: arrays of bytes and JSON, read without pickle; the classes that may be
made of it are listed here.

state.npz
    Replaced at every checkpoint in one step: a head of JSON (version, origin of the run, size and
    SHA-256 of the files below), and all of the estimator's state that changes.
000000.npz ...
    What never changes again, keyframes and results of frames, written once each. So a checkpoint
    costs the same late in a run as early, but for the map's points.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.config import Config
from pipelines.datasets.sequence import Sequence
from pipelines.errors import DyObError, FormatError
from pipelines.io.config import config_to_dict
from pipelines.io.files import disk_error, plain, replacing
from pipelines.io.object_graph import GraphDecoder, GraphEncoder
from pipelines.types import Frame

VERSION = 1
STATE = "state.npz"
_HEAD = "head"
_ANEW = "run it again without --resume"
_MANY = 3  # differences that are named
_CLASSES = {
    "backend.back_end": ("BackEnd",),
    "backend.bundle_adjustment": ("BundleProblem",),
    "backend.keyframe_sightings": ("KeyframeSightings",),
    "backend.local_window": ("BundleWindow",),
    "backend.loop_adjustment": ("LoopQuestion",),
    "backend.loop_detection": ("LoopClosure", "LoopDetector"),
    "backend.place_database": ("PlaceDatabase",),
    "backend.point_tracks": ("PointTracks",),
    "backend.pose_graph": ("PoseGraph",),
    "backend.questions": ("ClosingQuestion", "SettlingQuestion", "WindowQuestion"),
    "backend.seen_places": ("SeenPlaces",),
    "backend.vocabulary": ("BowVector",),
    "camera_tracking": ("CameraTracking",),
    "detection.cells": ("CellGrid", "DepthCells"),
    "detection.depth_test": ("Reference", "ViewMemory"),
    "detection.geometry": ("MultiViewGeometry",),
    "detection.geometry_view": ("GeometryView",),
    "frame_observations": ("FrameObservations", "Sightings"),
    "frontend.disparity_offset": ("DisparityOffset",),
    "frontend.hypotheses": ("ConstantVelocity",),
    "frontend.measurement": ("LastFrame",),
    "frontend.noise": ("NoiseModel",),
    "frontend.sensor": ("Sensor",),
    "frontend.tracking": ("Tracker",),
    "frontend.view": ("View",),
    "mapping.correction": ("FrameAnchors",),
    "mapping.keyframe": ("Keyframe",),
    "mapping.local_mapping": ("LocalMapping",),
    "mapping.patch_album": ("PatchAlbum",),
    "mapping.sparse_map": ("SparseMap",),
    "object_types": ("ObjectEstimates", "ObjectState"),
    "objects.frame": ("LastObjects",),
    "objects.kalman": ("ObjectFilter",),
    "objects.landmarks": ("StandingObjects",),
    "objects.points": ("ObjectPoints",),
    "objects.solver": ("MotionSolver",),
    "objects.track": ("ObjectTrack",),
    "objects.tracking": ("ObjectTracker",),
    "observations": ("Tracks",),
    "patches": ("Patches",),
    "types": ("Features", "Frame", "FrameResult", "MotionHypothesis", "TrackingStatus"),
}
_LASTING = ("mapping.keyframe.Keyframe", "types.FrameResult")
_log = logging.getLogger("dyob.run")


class Checkpoints:
    """Writes the checkpoints of one run; a disk that refuses costs the checkpoint, not the run.

    folder: of the checkpoints. origin: see `run_origin`. given: `DyObSlam.fixed_parts`.
    """

    def __init__(
        self, folder: Path, origin: Mapping[str, Any], given: Mapping[str, object]
    ) -> None:
        self.folder, self._origin, self._given = folder, origin, given
        self._files: dict[str, dict[str, Any]] = {}
        self._encoder: GraphEncoder | None = None
        self._warned = False

    def write(self, state: Mapping[str, Any]) -> None:
        """Replace the checkpoint by one of this state."""
        try:
            self._write(dict(state))
        except (DyObError, OSError, TypeError) as error:
            level = logging.INFO if self._warned else logging.WARNING
            _log.log(level, "no checkpoint, the run goes on: %s", error)
            self._warned = True

    def _write(self, state: dict[str, Any]) -> None:
        try:
            self.folder.mkdir(exist_ok=True)
        except OSError as error:
            raise DyObError(disk_error(self.folder, error)) from error
        encoder, self._encoder = self._encoder, None  # unless all goes well
        if encoder is None:
            self._files = {}
            lasting = [_classes()[name] for name in _LASTING]
            first = 1 + max((int(path.stem) for path in self._stores()), default=-1)
            encoder = GraphEncoder(_classes(), self._given, lasting, first)
        changing, root, fresh, number = encoder.encode(state)
        if len(fresh):
            content = _npz(fresh.arrays())
            name = f"{number:06d}.npz"
            with replacing(self.folder / name) as path:
                path.write_bytes(content)
            self._files[name] = {"bytes": len(content), "sha256": _digest(content)}
        head = {"version": VERSION, "origin": self._origin, "files": self._files}
        text = np.frombuffer(json.dumps(head).encode(), np.uint8)
        with replacing(self.folder / STATE) as path:
            changing.save(path, root, **{_HEAD: text})
        for path in self._stores():
            if path.name not in self._files:
                path.unlink(missing_ok=True)
        self._encoder = encoder

    def _stores(self) -> list[Path]:
        return sorted(self.folder.glob("[0-9]*.npz"))

    def remove(self) -> None:
        """Leave nothing behind: the run is finished."""
        remove_checkpoint(self.folder)


def has_checkpoint(folder: Path) -> bool:
    """Whether there is a checkpoint in a folder of them, damaged or not."""
    return (folder / STATE).is_file()


def remove_checkpoint(folder: Path) -> None:
    """Remove all files of a checkpoint. Raises DyObError where the disk refuses."""
    if not folder.is_dir():
        return
    try:
        for path in [folder / STATE, *folder.glob("[0-9]*.npz")]:  # the state first: others hang on
            path.unlink(missing_ok=True)
    except OSError as error:
        raise DyObError(disk_error(folder, error)) from error
    with suppress(OSError):  # somebody's file is in it
        folder.rmdir()


def read_checkpoint(
    folder: Path, origin: Mapping[str, Any], given: Mapping[str, object]
) -> dict[str, Any]:
    """The state that was written last, made anew.

    Raises FormatError, in a sentence, where there is none, it is damaged, or it is of a run of
    another origin.
    """
    if not has_checkpoint(folder):
        raise FormatError(
            f"{folder}: expected the checkpoint of an interrupted run, found none; {_ANEW}"
        )
    arrays = _read_npz(folder / STATE, (folder / STATE).read_bytes())
    try:
        head = json.loads(arrays[_HEAD].tobytes())
        version, made_with, files = head["version"], head["origin"], head["files"]
    except (KeyError, ValueError, TypeError) as error:
        raise _damaged(folder / STATE, error) from error
    if version != VERSION:
        raise FormatError(
            f"{folder / STATE}: expected a checkpoint of version {VERSION}, found {version}; "
            f"{_ANEW}"
        )
    _check_origin(folder.parent, made_with, origin)
    stores = {int(Path(name).stem): _read_store(folder / name, files[name]) for name in files}
    try:
        state: dict[str, Any] = GraphDecoder(_classes(), given, stores).decode(arrays)
    except (ValueError, KeyError) as error:
        raise _damaged(folder / STATE, error) from error
    return state


def run_origin(
    sequence: Sequence, config: Config, indices: range, lasting_map: Mapping[str, Any]
) -> dict[str, Any]:
    """What a run is made of and with, as JSON knows it: only with the same it can go on."""
    origin = {
        "program": _program(),
        "data": {
            "name": sequence.name,
            "layout": sequence.dataset,
            "camera": asdict(sequence.camera),
            "timestamps": _digest(np.asarray(sequence.timestamps_s, float).tobytes()),
        },
        "frames": {"start": indices.start, "stop": indices.stop, "stride": indices.step},
        "settings": config_to_dict(config),
        "map": dict(lasting_map),
    }
    content: dict[str, Any] = json.loads(json.dumps(plain(origin)))
    return content


def frame_digest(frame: Frame) -> str:
    """Of all that a frame brings, so that other data of the same shape are told apart."""
    digest = hashlib.sha256(repr((frame.index, frame.timestamp_s)).encode())
    for part in (
        frame.image, frame.image_right, frame.depth_m, frame.flow_prev_to_curr_px,
        frame.instance_labels,
    ):  # fmt: skip
        digest.update(b"none" if part is None else np.ascontiguousarray(part).tobytes())
    return digest.hexdigest()


def _check_origin(folder: Path, then: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise FormatError, saying what differs, unless both are the same."""
    if then == now:
        return
    if then.get("program") != now["program"]:
        raise FormatError(
            f"{folder}: expected a run that was interrupted in this version of the program, found "
            f"one of another, whose numbers may differ; {_ANEW}"
        )
    before, after = _flat(then), _flat(now)
    other = [key for key in after if before.get(key) != after[key]]
    named = [f"{key} {before.get(key)} then and {after[key]} now" for key in other[:_MANY]]
    more = f" and {len(other) - _MANY} more" if len(other) > _MANY else ""
    raise FormatError(
        f"{folder}: expected the data and settings of the interrupted run, found "
        f"{', '.join(named)}{more}; give --resume the same ones, or {_ANEW}"
    )


def _flat(content: Mapping[str, Any], before: str = "") -> dict[str, Any]:
    """Nested mappings as one, with names such as settings.orb.n_features."""
    flat: dict[str, Any] = {}
    for key, value in content.items():
        inner = isinstance(value, Mapping)
        flat |= _flat(value, f"{before}{key}.") if inner else {f"{before}{key}": value}
    return flat


@cache
def _classes() -> dict[str, type]:
    return {
        f"{module}.{name}": getattr(import_module(f"pipelines.{module}"), name)
        for module, names in _CLASSES.items()
        for name in names
    }


@cache
def _program() -> str:
    """Digest of this program's own text: another one may number, round or remember otherwise."""
    root = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        digest.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    return digest.hexdigest()


def _npz(arrays: Mapping[str, NDArray]) -> bytes:
    content = io.BytesIO()
    np.savez(content, **arrays)  # type: ignore[arg-type]
    return content.getvalue()


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def _read_store(path: Path, promised: Mapping[str, Any]) -> dict[str, NDArray]:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise _damaged(path, error) from error
    if len(content) != promised.get("bytes") or _digest(content) != promised.get("sha256"):
        raise _damaged(path, "it is not what was written")
    return _read_npz(path, content)


def _read_npz(path: Path, content: bytes) -> dict[str, NDArray]:
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise _damaged(path, error) from error


def _damaged(path: Path, reason: object) -> FormatError:
    return FormatError(f"{path}: expected a checkpoint, found it damaged ({reason}); {_ANEW}")
