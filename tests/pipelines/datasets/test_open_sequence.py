"""Opening a folder: guessing, forcing, and the sentences when neither works."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from pipelines.datasets import DATASETS, open_sequence
from pipelines.errors import DatasetError

Write = Callable[[str], Path]


def test_missing_folder(tmp_path: Path) -> None:
    (tmp_path / "neighbour").mkdir()
    with pytest.raises(DatasetError, match=r"found no such folder; correct the path$"):
        open_sequence(tmp_path / "something_else")
    with pytest.raises(DatasetError, match=r"found no such folder; did you mean .*/neighbour\?$"):
        open_sequence(tmp_path / "neighbor")
    with pytest.raises(DatasetError, match="found no such folder"):
        open_sequence(tmp_path / "not" / "even" / "near")


def test_missing_folder_with_a_forced_data_set(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="expected a folder, found no such folder"):
        open_sequence(tmp_path / "nothing_here", "vdo")


def test_file_in_place_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "film.mkv").write_bytes(b"x")
    with pytest.raises(DatasetError, match=r"film\.mkv: expected a video, found a file of 1 bytes"):
        open_sequence(tmp_path / "film.mkv")
    with pytest.raises(DatasetError, match=r"a video needs a camera\.yaml beside it, and a second"):
        open_sequence(tmp_path)
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(DatasetError, match=r"expected a folder or a video \(.*found another file"):
        open_sequence(tmp_path / "notes.txt")
    (tmp_path / "room.bag").write_bytes(b"x")
    with pytest.raises(DatasetError, match="images exported from it, since bags are not read"):
        open_sequence(tmp_path / "room.bag")


def test_empty_folder(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="found an empty folder; see which files") as error:
        open_sequence(tmp_path)
    assert "\n" not in str(error.value)
    assert all(name in str(error.value) for name in DATASETS if name != "simulated")


def test_foreign_folder_shows_its_first_entries(tmp_path: Path) -> None:
    for name in "abcdefghijkl":
        (tmp_path / f"{name}.dat").touch()
    with pytest.raises(DatasetError, match=r"found a\.dat, b\.dat.* and 4 more"):
        open_sequence(tmp_path)


def test_unknown_data_set_names_the_nearest() -> None:
    with pytest.raises(DatasetError, match=r"'kitty'; did you mean 'kitti_odometry'\?"):
        open_sequence("anywhere", "kitty")
    with pytest.raises(DatasetError, match="There are: simulated, vdo"):
        open_sequence("anywhere", "xyzzy")


def test_folder_that_matches_twice_is_not_guessed(write_tree: Write) -> None:
    root = write_tree("vdo")
    (root / "calib.txt").write_text("P0: 1\n")
    (root / "semantic").rename(root / "elsewhere")
    with pytest.raises(DatasetError, match=r"like vdo and like kitti_odometry.*--dataset"):
        open_sequence(root)
    assert open_sequence(root, "vdo").dataset == "vdo"


def test_sequence_inside_a_folder_is_hinted_at_and_opened_by_name(write_tree: Write) -> None:
    inner = write_tree("tum_rgbd")
    with pytest.raises(DatasetError, match="sub-folder tum_rgbd_tree looks like tum_rgbd"):
        open_sequence(inner.parent)
    assert open_sequence(inner.parent, name=inner.name).name == inner.name
    with pytest.raises(DatasetError, match=r"expected a sequence '07'.*found: .*tum_rgbd_tree/"):
        open_sequence(inner.parent, name="07")


def test_sequences_folder_of_kitti_is_searched(write_tree: Write) -> None:
    tree = write_tree("kitti_odometry")
    root = tree.parent / "dataset"
    (root / "sequences").mkdir(parents=True)
    (root / "poses").mkdir()
    (tree / "poses.txt").rename(root / "poses" / "06.txt")
    tree.rename(root / "sequences" / "06")
    sequence = open_sequence(root, name="06")
    assert sequence.name == "06"
    truth = sequence.ground_truth()
    assert truth is not None
    assert truth.Ts_world_camera[3, 2, 3] == pytest.approx(1.5)
