"""The observation log on disk: what every frame saw, in chunks of frames, for the batch.

Owns the layout of the folder `observations/`: `000000.npz` and so on, each with some frames' poses
and sightings, `camera.json`, `map_points.npz`, which point of the saved map is which track, and
`poses.npz`, the cameras as they were at the end of the run.
numpy arrays alone, read without pickle. Knows no result folder.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import DyObError, FormatError
from pipelines.frame_observations import FrameObservations, Sightings
from pipelines.io.files import disk_error, read_json, replacing, write_json
from pipelines.types import Array, StereoCamera

FRAMES_A_CHUNK = 50
VERSION = 2
MAP_POINTS = "map_points.npz"
POSES = "poses.npz"
CAMERA = "camera.json"
_OTHERS = (MAP_POINTS, POSES, CAMERA)
_SINGLE = ("uv_px", "disparity_px", "sigma_uv_px", "sigma_disparity_px", "position_m")  # float32
_FRAMES = (
    "frame_index",
    "timestamp_s",
    "is_tracked",
    "T_world_camera",
    "disparity_offset_px",
    "n_sightings",
)
_PREFIX = "sighting_"


class ObservationRecorder:
    """Spools frames to a folder, so that memory stays flat however long a run is.

    A run that ends early leaves whole chunks; `finish` writes the rest, and may be called again.
    """

    def __init__(self, folder: Path | str, camera: StereoCamera) -> None:
        self.folder = Path(folder)
        self._pending: list[FrameObservations] = []
        self._n_chunks = 0
        clear_observations(self.folder)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise DyObError(disk_error(self.folder, error)) from error
        write_json(self.folder / CAMERA, asdict(camera))

    def state(self) -> tuple[int, list[FrameObservations]]:
        """How many chunks are on the disk, and the frames that are not; for `go_on`."""
        return self._n_chunks, list(self._pending)

    @classmethod
    def go_on(
        cls, folder: Path | str, n_chunks: int, pending: list[FrameObservations]
    ) -> ObservationRecorder:
        """As the recorder of this `state`; what it wrote since then is written again.

        Raises FormatError where a chunk is missing.
        """
        recorder = cls.__new__(cls)
        recorder.folder = Path(folder)
        recorder._pending, recorder._n_chunks = list(pending), n_chunks
        needed = [recorder._chunk(n) for n in range(n_chunks)]
        for path in [*needed, recorder.folder / CAMERA]:
            if not path.is_file():
                raise FormatError(
                    f"{path}: expected what the frames done so far saw, found no such file; run "
                    "it again without --resume"
                )
        later = set(recorder.folder.glob("[0-9]*.npz")) - set(needed)
        for path in [*later, recorder.folder / MAP_POINTS, recorder.folder / POSES]:
            path.unlink(missing_ok=True)
        return recorder

    def add(self, frame: FrameObservations) -> None:
        """Take in one frame."""
        self._pending.append(frame)
        if len(self._pending) >= FRAMES_A_CHUNK:
            self._flush()

    def finish(
        self,
        map_track_ids: NDArray[np.int64] | None = None,
        Ts_world_camera: Mapping[int, Array] | None = None,
    ) -> None:
        """Write what is not on the disk yet, and which track each point of the saved map is.

        Ts_world_camera: frame index -> (4, 4) where frames were corrected since they were added.
        """
        self._flush()
        if map_track_ids is not None:
            write_map_points(self.folder, map_track_ids)
        if Ts_world_camera:
            with replacing(self.folder / POSES) as fresh:
                np.savez_compressed(
                    fresh,
                    version=np.int64(VERSION),
                    frame_index=np.array(list(Ts_world_camera), np.int64),
                    T_world_camera=np.array(list(Ts_world_camera.values()), float),
                )

    def remove(self) -> None:
        """Leave nothing behind: the log was wanted for the run's own batch alone."""
        clear_observations(self.folder)
        with suppress(OSError):  # somebody's file is in it
            self.folder.rmdir()

    def _flush(self) -> None:
        if not self._pending:
            return
        _write_chunk(self._chunk(self._n_chunks), self._pending)
        self._n_chunks += 1
        self._pending = []

    def _chunk(self, n: int) -> Path:
        return self.folder / f"{n:06d}.npz"


def clear_observations(folder: Path | str) -> None:
    """Remove the log of an earlier run. Raises DyObError where the disk refuses."""
    folder = Path(folder)
    try:
        for path in [*folder.glob("[0-9]*.npz"), *(folder / name for name in _OTHERS)]:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise DyObError(disk_error(folder, error)) from error


def _write_chunk(path: Path, frames: list[FrameObservations]) -> None:
    sightings = Sightings.concatenate(*(frame.sightings for frame in frames))
    arrays = {f.name: getattr(sightings, f.name) for f in fields(sightings)}
    arrays |= {name: arrays[name].astype(np.float32) for name in _SINGLE}
    columns = {
        "frame_index": np.array([f.frame_index for f in frames], np.int64),
        "timestamp_s": np.array([f.timestamp_s for f in frames], float),
        "is_tracked": np.array([f.is_tracked for f in frames], bool),
        "T_world_camera": np.array([f.T_world_camera for f in frames], float),
        "disparity_offset_px": np.array([f.disparity_offset_px for f in frames], float),
        "n_sightings": np.array([len(f.sightings) for f in frames], np.int64),
    }
    columns |= {_PREFIX + name: array for name, array in arrays.items()}
    with replacing(path) as fresh:
        np.savez_compressed(fresh, allow_pickle=False, version=np.int64(VERSION), **columns)


def read_observations(folder: Path | str) -> list[FrameObservations]:
    """All frames of a log, in their order; none where there is no log.

    Raises FormatError where a chunk is damaged or of another version.
    """
    frames: list[FrameObservations] = []
    for path in sorted(Path(folder).glob("[0-9]*.npz")):
        frames += _read_chunk(path)
    corrected = _read_poses(Path(folder) / POSES)
    return [
        replace(f, T_world_camera=corrected.get(f.frame_index, f.T_world_camera)) for f in frames
    ]


def _read_poses(path: Path) -> dict[int, Array]:
    """Frame index -> T_world_camera (4, 4), empty where no frame was corrected."""
    if not path.exists():
        return {}
    arrays = _load(path)
    try:
        index, Ts = arrays["frame_index"].tolist(), arrays["T_world_camera"].reshape(-1, 4, 4)
        return dict(zip(index, Ts, strict=True))
    except (KeyError, ValueError, AttributeError) as error:
        raise FormatError(
            f"{path}: expected an index and a pose of each frame, found other arrays ({error}); "
            "run the sequence again"
        ) from error


def read_camera(folder: Path | str) -> StereoCamera:
    """The camera of the recorded run. Raises FormatError where the file is missing or damaged."""
    path = Path(folder) / CAMERA
    try:
        return StereoCamera(**read_json(path))
    except (TypeError, ValueError) as error:
        raise FormatError(
            f"{path}: expected a camera's size and intrinsics, found other values ({error}); "
            "run the sequence again"
        ) from error


def _read_chunk(path: Path) -> list[FrameObservations]:
    arrays = _load(path)
    names = [*_FRAMES, *(_PREFIX + f.name for f in fields(Sightings))]
    missing = [name for name in names if name not in arrays]
    if missing:
        raise FormatError(
            f"{path}: expected the array {missing[0]}, found {len(arrays)} others; run the "
            "sequence again"
        )
    columns = [arrays[name] for name in names]
    columns = [c.astype(np.float64) if c.dtype == np.float32 else c for c in columns]
    try:
        sightings = Sightings(*columns[len(_FRAMES) :])
        ends = np.cumsum(arrays["n_sightings"])
        if len(sightings) != (ends[-1] if len(ends) else 0):
            raise ValueError(f"{len(sightings)} sightings for {len(ends)} frames")
        return [
            FrameObservations(
                int(index),
                float(stamp),
                bool(tracked),
                T,
                sightings[np.arange(end - n, end)],
                float(offset),
            )
            for index, stamp, tracked, T, offset, n, end in zip(*columns[:6], ends, strict=True)
        ]
    except (ValueError, IndexError) as error:
        raise FormatError(
            f"{path}: expected the observations of some frames, found arrays that do not fit "
            f"together ({error}); run the sequence again"
        ) from error


def write_map_points(folder: Path | str, track_ids: NDArray[np.int64]) -> None:
    """Which track (N,) each point of the saved map is, in its order."""
    with replacing(Path(folder) / MAP_POINTS) as fresh:
        np.savez_compressed(fresh, version=np.int64(VERSION), track_id=track_ids)


def read_map_points(folder: Path | str) -> NDArray[np.int64]:
    """(N,) tracks of the points of the saved map; empty where the log does not say."""
    path = Path(folder) / MAP_POINTS
    if not path.exists():
        return np.empty(0, np.int64)
    arrays = _load(path)
    if "track_id" not in arrays:
        raise FormatError(f"{path}: expected the array track_id; run the sequence again")
    return np.asarray(arrays["track_id"], np.int64)


def _load(path: Path) -> dict[str, NDArray]:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise FormatError(
            f"{path}: expected recorded observations, found them unreadable ({error}); "
            "run the sequence again"
        ) from error
    version = int(arrays.get("version", np.int64(0)))
    if version != VERSION:
        raise FormatError(
            f"{path}: expected observations of version {VERSION}, found {version}; "
            "run the sequence again with this version of the program"
        )
    return arrays
