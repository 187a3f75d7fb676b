"""Data sets: the table of layouts, and `open_sequence`, which finds the one a folder has.

Adding a data set is one file and one line here; the contract tests then run on it.
"""

from __future__ import annotations

import difflib
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pipelines.errors import DatasetError

if TYPE_CHECKING:
    from pipelines.datasets.sequence import Sequence

DATASETS = {
    "simulated": "pipelines.datasets.simulated.sequence:SimulatedSequence",
    "vdo": "pipelines.datasets.vdo:VdoSequence",
    "kitti_odometry": "pipelines.datasets.kitti_odometry:KittiOdometrySequence",
    "kitti_tracking": "pipelines.datasets.kitti_tracking:KittiTrackingSequence",
    "virtual_kitti2": "pipelines.datasets.virtual_kitti2:VirtualKitti2Sequence",
    "omd": "pipelines.datasets.omd:OmdSequence",
    "tum_rgbd": "pipelines.datasets.tum_rgbd:TumRgbdSequence",
    "folder": "pipelines.datasets.folder:FolderSequence",
    "video": "pipelines.datasets.video:VideoSequence",
}


VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v")
_ASK_DATASETS = (
    "see which files each layout wants with 'python3 -m app datasets', or name one with --dataset "
    "to hear what it lacks"
)


def load_dataset(dataset: str) -> Any:
    """The class of a data set by its name in the table; raises DatasetError for an unknown one."""
    if dataset not in DATASETS:
        nearest = difflib.get_close_matches(dataset, DATASETS, 1, 0.4)
        hint = f"did you mean {nearest[0]!r}? " if nearest else ""
        raise DatasetError(f"Unknown data set {dataset!r}; {hint}There are: {', '.join(DATASETS)}.")
    module, name = DATASETS[dataset].split(":")
    return getattr(import_module(module), name)


def open_sequence(
    path: Path | str, dataset: str | None = None, name: str | None = None, **options: Any
) -> Sequence:
    """The sequence in a folder or a video file, or a rendered one such as "simulated:demo".

    >>> sequence = open_sequence("path/to/data")
    >>> len(sequence), sequence.camera, sequence.timestamps_s.shape
    >>> frame = sequence.read(0)  # image, and what there is of depth, right image, flow, masks

    dataset: a name of the table `DATASETS`; guessed from the folder where None. name: a sequence
    inside a folder of several, as a sub-folder of `path` or of `path`/sequences, or as the layout
    names it. options: of that data set, such as depth_scale= and fps= of `folder`, or frames=,
    degrade= and provide= of `simulated`. Raises DatasetError that says which files were expected
    and what was found, ConfigError for an option of a wrong value.
    """
    if name is not None:
        holder = _holder_of_sequences(Path(path), dataset)
        if holder is not None:
            return holder.open(path, sequence=name, **options)
        path = _inner_folder(Path(path), name)
    return load_dataset(dataset or _guess(path)).open(path, **options)


def matching_datasets(path: Path | str) -> list[str]:
    """Names of all data sets whose layout the folder seems to have."""
    return [dataset for dataset in DATASETS if load_dataset(dataset).matches(Path(path))]


def _guess(path: Path | str) -> str:
    found = matching_datasets(path)
    if len(found) == 1:
        return found[0]
    folder = Path(path)
    if not folder.is_dir():
        raise DatasetError(_no_folder(folder))
    if len(found) > 1:
        raise DatasetError(
            f"{folder}: looks like {' and like '.join(found)}; say which one with --dataset."
        )
    hint = _hint_inside(folder) or _hint_at_video(folder) or _ASK_DATASETS
    layouts = [dataset for dataset in DATASETS if dataset != "simulated"]
    raise DatasetError(
        f"{folder}: expected a sequence laid out as {', '.join(layouts[:-1])} or {layouts[-1]}, "
        f"found {_describe(folder)}; {hint}"
    )


def _no_folder(path: Path) -> str:
    if path.is_file():
        hint = ""
        if path.suffix.lower() == ".bag":
            hint = " of images exported from it, since bags are not read"
        return (
            f"{path}: expected a folder{hint} or a video ({', '.join(VIDEOS)}), found another "
            "file; give the folder of a sequence"
        )
    inner = [p.name for p in path.parent.iterdir() if p.is_dir()] if path.parent.is_dir() else []
    nearest = difflib.get_close_matches(path.name, inner, 1, 0.75)
    advice = f"did you mean {path.parent / nearest[0]}?" if nearest else "correct the path"
    return f"{path}: expected the folder of a sequence, found no such folder; {advice}"


def _hint_at_video(folder: Path) -> str:
    if not any(p.suffix.lower() in VIDEOS for p in folder.iterdir()):
        return ""
    return (
        "a video needs a camera.yaml beside it, and a second camera or depth, as "
        "'python3 -m app datasets video' says"
    )


def _describe(folder: Path) -> str:
    from pipelines.datasets.tree import describe_folder

    return describe_folder(folder)


def _hint_inside(folder: Path) -> str:
    """A hint at a sub-folder that is a sequence, as where an archive was unpacked one level up."""
    for inner in sorted(p for p in folder.iterdir() if p.is_dir())[:50]:
        found = matching_datasets(inner)
        if len(found) == 1:
            return f"its sub-folder {inner.name} looks like {found[0]}: give {inner}"
    return ""


def _holder_of_sequences(path: Path, dataset: str | None) -> Any:
    """The class of a layout that keeps several sequences in common sub-folders; None for others."""
    classes = (load_dataset(name) for name in ([dataset] if dataset else DATASETS))
    return next((found for found in classes if found.inside(path)), None)


def _inner_folder(root: Path, name: str) -> Path:
    for folder in (root / name, root / "sequences" / name):
        if folder.is_dir():
            return folder
    raise DatasetError(
        f"{root}: expected a sequence {name!r} in it or in its sequences/, found: "
        f"{_describe(root)}; correct the name, or give the folder itself."
    )
