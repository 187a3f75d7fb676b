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
    "tum_rgbd": "pipelines.datasets.tum_rgbd:TumRgbdSequence",
    "folder": "pipelines.datasets.folder:FolderSequence",
}


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
    """The sequence in a folder.

    dataset: a name of the table; guessed from the folder where None. name: a sequence inside a
    folder of several, as a sub-folder of `path` or of `path`/sequences. options: of that data set.
    Raises DatasetError that says what trees are expected and what was found.
    """
    if name is not None:
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
    if len(found) > 1:
        raise DatasetError(
            f"{folder}: looks like {' and like '.join(found)}; say which one with --dataset."
        )
    if not folder.is_dir():
        raise DatasetError(_no_folder(folder, list(DATASETS)))
    raise DatasetError(
        f"{folder}: no known sequence.{_hint_inside(folder)} Found: {_describe(folder)}. "
        f"{_expected(list(DATASETS))}"
    )


def _no_folder(path: Path, datasets: list[str]) -> str:
    parent = path.resolve().parent
    what = "a file, expected a folder" if path.exists() else "no such folder"
    return f"{path}: {what}. {parent} has: {_describe(parent)}. {_expected(datasets)}"


def _expected(datasets: list[str]) -> str:
    trees = [f"\n  {name}: {load_dataset(name).layout}" for name in datasets]
    return "Expected one of these:" + "".join(trees)


def _describe(folder: Path) -> str:
    from pipelines.datasets.tree import describe_folder

    return describe_folder(folder)


def _hint_inside(folder: Path) -> str:
    """A hint at a sub-folder that is a sequence, as where an archive was unpacked one level up."""
    for inner in sorted(p for p in folder.iterdir() if p.is_dir())[:50]:
        found = matching_datasets(inner)
        if len(found) == 1:
            return f" Its sub-folder {inner.name} looks like {found[0]}: open {inner}."
    return ""


def _inner_folder(root: Path, name: str) -> Path:
    for folder in (root / name, root / "sequences" / name):
        if folder.is_dir():
            return folder
    raise DatasetError(
        f"{root}: expected a sequence {name!r} in it or in its sequences/, found: "
        f"{_describe(root)}; correct the name, or give the folder itself."
    )
