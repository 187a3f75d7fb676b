"""Where results lie: one new folder a run, and the `latest` link beside them.

Owns every file name of a result folder. Knows no content.
"""

from __future__ import annotations

import logging
import re
import time
import uuid
from pathlib import Path

from pipelines.errors import DyObError, FormatError
from pipelines.io.files import read_json

CONFIG = "config.yaml"
LOG = "run.log"
CAMERA_TUM = "camera_tum.txt"
CAMERA_KITTI = "camera_kitti.txt"
CAMERA_GT_TUM = "camera_gt_tum.txt"
OBJECTS_CSV = "objects.csv"
OBJECTS_GT_CSV = "objects_gt.csv"
NOISE_GT = "noise_gt.json"
OBJECTS = "objects"  # a folder: a trajectory an object
STATIC_MAP = "static_map.ply"
OBJECTS_MAP = "objects_map.ply"
METRICS_JSON = "metrics.json"
METRICS_TXT = "metrics.txt"
TIMINGS = "timings.json"
CAMERA_STD = "camera_std.csv"
OBSERVATIONS = "observations"  # a folder: what each frame saw, for the batch
FRONT_END = "front_end"  # a folder: what the batch started from
FRAMES = "frames"
PLOTS = "plots"
RENDERS = "renders"
SCENE = "scene.html"  # the run in 3D, a page of its own
REPORT = "report.html"
CHECKPOINT = "checkpoint"  # a folder, while a run is not finished
LATEST = "latest"

logger = logging.getLogger("dyob.io")


def create_result_folder(root: Path | str, name: str, *, is_latest: bool = True) -> Path:
    """Make `root/<YYYYmmdd-HHMMSS>-<name>`, never one that exists, and point `root/latest` to it.

    The link stays where it is without `is_latest`, of folders that are no run's.

    Characters of `name` that a path should not hold become "_". Raises DyObError where the disk
    refuses; a `latest` that cannot be made is a warning only.
    """
    root = Path(root)
    safe = re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._") or "run"
    base = f"{time.strftime('%Y%m%d-%H%M%S')}-{safe}"
    try:
        root.mkdir(parents=True, exist_ok=True)
        folder = _first_free(root, base)
    except OSError as error:
        raise DyObError(
            f"{root}: expected a folder to put results in, found '{error.strerror}'; "
            "choose another --output"
        ) from error
    if is_latest:
        _point_latest(root, folder.name)
    return folder


def clear_result_folder(folder: Path | str, *, resume: bool = False) -> None:
    """Make `folder`, or remove what an earlier run left in it: files named above, nothing else.

    resume: what the frames done so far have left stays: log, observations, pictures, checkpoint.
    Raises DyObError where it holds files but is no run's, such as a folder of data.
    """
    folder = Path(folder)
    check_output(folder, LOG)
    files = [CONFIG, CAMERA_TUM, CAMERA_KITTI, CAMERA_GT_TUM, STATIC_MAP, OBJECTS_MAP]
    files += [OBJECTS_CSV, OBJECTS_GT_CSV, NOISE_GT, CAMERA_STD, SCENE, REPORT]
    stale = [folder / name for name in (*files, METRICS_JSON, METRICS_TXT, TIMINGS)]
    stale += (folder / OBJECTS).glob("*_tum.txt")
    stale += [*(folder / FRONT_END).glob("*.*"), *(folder / FRONT_END / OBJECTS).glob("*_tum.txt")]
    for name in (PLOTS, RENDERS) if resume else (FRAMES, PLOTS, RENDERS):
        stale += [*(folder / name).glob("*.png"), *(folder / name).glob("*.jpg")]
    stale += (folder / RENDERS).glob("*.mp4")
    if not resume:
        stale += [folder / LOG, *(folder / OBSERVATIONS).glob("*.json")]
        for name in (OBSERVATIONS, CHECKPOINT):
            stale += (folder / name).glob("*.npz")
    try:
        for path in stale:
            path.unlink(missing_ok=True)
    except OSError as error:
        raise DyObError(
            f"{path}: expected to replace an earlier run's file, found '{error.strerror}'; "
            "choose another --output"
        ) from error


def check_output(folder: Path, mark: str) -> None:
    """Make `folder`; one that is there must be empty or hold `mark`, as an earlier result does.

    In others, files of a result's names may be dear. Raises DyObError.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        held = sorted(path.name for path in folder.iterdir())
    except OSError as error:
        found = "a file" if folder.is_file() else f"'{error.strerror}'"
        raise DyObError(
            f"{folder}: expected a folder to put the result in, found {found}; "
            "choose another --output"
        ) from error
    if held and mark not in held:
        more = " and more" if len(held) > 3 else ""
        raise DyObError(
            f"{folder}: expected a new or empty folder or an earlier result with {mark}, "
            f"found {', '.join(held[:3])}{more} in it; choose another --output"
        )


def open_interrupted(path: Path) -> Path:
    """The real folder behind `path`, checked to be of a run, interrupted or finished.

    Raises FormatError where it is none.
    """
    if not (path / LOG).is_file():
        found = f"no {LOG} in it" if path.is_dir() else "no such folder"
        raise FormatError(
            f"{path}: expected the folder of an interrupted run, found {found}; name it with "
            "--output, or run without --resume"
        )
    return path.resolve()


def is_finished(folder: Path) -> bool:
    """Whether the run of a result folder reached its end."""
    if list((folder / CHECKPOINT).glob("*.npz")) or not (folder / METRICS_JSON).is_file():
        return False
    return not read_json(folder / METRICS_JSON).get("run", {}).get("interrupted", True)


def _first_free(root: Path, base: str) -> Path:
    number = 1
    while True:
        folder = root / (base if number == 1 else f"{base}-{number}")
        try:
            folder.mkdir()
            return folder
        except FileExistsError:
            number += 1


def _point_latest(root: Path, target: str) -> None:
    """Replace the link in one step, so that a reader never finds it missing."""
    fresh = root / f".{LATEST}.{uuid.uuid4().hex[:8]}"
    try:
        fresh.symlink_to(target, target_is_directory=True)
        fresh.replace(root / LATEST)
    except OSError as error:
        fresh.unlink(missing_ok=True)
        logger.warning(
            "%s could not be pointed to the new results (%s)", root / LATEST, error.strerror
        )


def open_result_folder(path: Path | str) -> Path:
    """The real folder behind `path` (a result folder or the `latest` link), checked to be one.

    Raises FormatError that says what was expected, what was found and what to do.
    """
    path = Path(path)
    if path.is_symlink() and not path.exists():
        raise FormatError(
            f"{path}: expected a link to a result folder, found that its target is gone; "
            "run a sequence again or name another folder"
        )
    if not path.is_dir():
        found = "a file" if path.exists() else "nothing"
        raise FormatError(
            f"{path}: expected a result folder, found {found}; "
            "run a sequence first, or name the folder that a run has printed"
        )
    if not (path / CAMERA_TUM).is_file():
        hint = "run a sequence first"
        if (path / LATEST / CAMERA_TUM).is_file():
            hint = f"did you mean {path / LATEST}?"
        raise FormatError(
            f"{path}: expected a result folder with {CAMERA_TUM}, found no such file in it; {hint}"
        )
    return path.resolve()
