"""Atomic replacement, on a disk that refuses, and strict JSON and YAML."""

import json
import resource
from contextlib import contextmanager

import numpy as np
import pytest

from pipelines.errors import DyObError, FormatError
from pipelines.io.files import read_json, read_yaml, replacing, write_json, write_text, write_yaml
from pipelines.io.ply import read_point_cloud, write_point_cloud
from pipelines.types import TrackingStatus


@contextmanager
def no_room_beyond(n_bytes: int):
    """Files of this process cannot grow past `n_bytes`, which fails as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (n_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_keeps_the_old_text(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with no_room_beyond(1000), pytest.raises(DyObError, match=r"a\.txt: expected to write"):
        write_text(tmp_path / "a.txt", "new" * 10000)
    assert (tmp_path / "a.txt").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_a_full_disk_keeps_the_old_map(tmp_path):
    write_point_cloud(tmp_path / "m.ply", np.ones((3, 3)), np.ones((3, 3), np.uint8))
    with no_room_beyond(2000), pytest.raises(DyObError, match=r"m\.ply: expected to write"):
        write_point_cloud(tmp_path / "m.ply", np.ones((900, 3)), np.ones((900, 3), np.uint8))
    assert len(read_point_cloud(tmp_path / "m.ply")[0]) == 3
    assert [path.name for path in tmp_path.iterdir()] == ["m.ply"]


def test_an_interruption_keeps_the_old_file(tmp_path):
    write_text(tmp_path / "a.txt", "old")
    with pytest.raises(KeyboardInterrupt), replacing(tmp_path / "a.txt") as fresh:
        fresh.write_text("half")
        raise KeyboardInterrupt
    assert (tmp_path / "a.txt").read_text() == "old"
    assert [path.name for path in tmp_path.iterdir()] == ["a.txt"]


def test_a_missing_folder_is_one_sentence(tmp_path):
    with pytest.raises(DyObError, match="No such file or directory"):
        write_text(tmp_path / "gone" / "a.txt", "text")


def test_json_is_strict(tmp_path):
    content = {"a": np.float32(1.5), "b": [np.nan, np.inf, np.int64(3)], "s": TrackingStatus.OK}
    write_json(tmp_path / "a.json", content)
    text = (tmp_path / "a.json").read_text()
    assert json.loads(text, parse_constant=pytest.fail) == {
        "a": 1.5,
        "b": [None, None, 3],
        "s": "OK",
    }


def test_yaml_round_trip(tmp_path):
    content = {"orb": {"n_features": 2000, "size": (3, 4)}, "path": tmp_path, "x": np.float64(0.5)}
    write_yaml(tmp_path / "a.yaml", content)
    assert read_yaml(tmp_path / "a.yaml") == {
        "orb": {"n_features": 2000, "size": [3, 4]},
        "path": str(tmp_path),
        "x": 0.5,
    }


@pytest.mark.parametrize("text", ['{"a": 1', "[1, 2]", "", "\x00"])
def test_damaged_json(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(FormatError, match=r"a\.json: expected"):
        read_json(tmp_path / "a.json")


@pytest.mark.parametrize("text", ["a: [1", "- 1\n- 2", "a: b: c"])
def test_damaged_yaml(tmp_path, text):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(FormatError, match=r"a\.yaml: expected"):
        read_yaml(tmp_path / "a.yaml")
