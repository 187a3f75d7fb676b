"""Map folders: all comes back as it was, and whatever is wrong is said in one sentence."""

import hashlib
import json
from dataclasses import fields, replace

import numpy as np
import pytest

from pipelines.config import MappingConfig
from pipelines.errors import DyObError, FormatError
from pipelines.geometry import backproject, exp_se3, project_stereo, transform_points
from pipelines.io.files import replacing_folder
from pipelines.io.map_folder import (
    FORMAT,
    VERSION,
    load_map,
    load_map_objects,
    read_map_head,
    save_map,
)
from pipelines.mapping.keyframe import Keyframe
from pipelines.mapping.sparse_map import _COLUMNS, SparseMap
from pipelines.object_types import ObjectEstimates
from pipelines.observations import Tracks
from pipelines.types import Features, StereoCamera

CAMERA = StereoCamera(640, 480, 500.0, 501.0, 320.5, 240.0, 50.0)
CONFIG = MappingConfig()
NOTHING = np.empty(0, np.int64)
FILES = ("map.json", "points.npz", "keyframes.npz", "static_map.ply", "objects.csv")


def features(n, rng):
    return Features(
        rng.uniform(0, 480, (n, 2)),
        rng.integers(0, 8, n).astype(np.int32),
        rng.uniform(0, 360, n).astype(np.float32),
        rng.uniform(0, 1, n).astype(np.float32),
        rng.integers(0, 256, (n, 32)).astype(np.uint8),
        np.where(rng.random(n) < 0.5, np.nan, rng.uniform(3, 50, n)),
    )


@pytest.fixture(scope="module")
def sparse_map():
    """Twelve keyframes along a line, each with new points, some culled, some seen by none yet."""
    rng = np.random.default_rng(4)
    made = SparseMap(CAMERA, CONFIG)
    seen = NOTHING
    for k in range(12):
        T = exp_se3(np.array([0, 0.01 * k, 0, 0.02 * k, 0, 0.5 * k]))
        uv = rng.uniform([5, 5], [635, 475], (60, 2))
        points = transform_points(T, backproject(CAMERA, uv, rng.uniform(4, 30, 60)))
        A = 0.01 * rng.normal(size=(60, 3, 3))
        new = made.add_points(
            points, A @ A.transpose(0, 2, 1), rng.normal(size=(60, 3)),
            rng.integers(0, 256, (60, 32)).astype(np.uint8),
            rng.integers(0, 256, (60, 3)).astype(np.uint8),
        )  # fmt: skip
        ids = np.concatenate([seen[-80:], new[:50]])
        uvr = project_stereo(CAMERA, transform_points(np.linalg.inv(T), made.position_m[ids]))
        disparity = np.where(rng.random(len(ids)) < 0.2, np.nan, uvr[:, 0] - uvr[:, 2])
        tracks = Tracks(ids, uvr[:, :2], disparity, rng.uniform(0.2, 1, len(ids)))
        made.record_sight(ids, ids[::2])
        made.record_sight(ids, ids)
        made.add_keyframe(Keyframe(5 * k, 0.5 * k, T, tracks, features(7 + 3 * k, rng)))
        seen = np.concatenate([seen, new[:50]])
    made.remove_points(seen[10:20])
    made.remove_points(new[55:])
    return made


@pytest.fixture
def saved(sparse_map, tmp_path):
    save_map(tmp_path / "map", sparse_map)
    return tmp_path / "map"


def object_rows():
    M = 3
    Ts = np.stack([exp_se3(np.array([0, 0.2, 0, k, 0, 9.0])) for k in range(M)])
    values = {
        "frame_index": np.arange(M), "timestamp_s": 0.1 * np.arange(M),
        "object_id": np.array([3, 3, 5]), "class_name": np.array(["car", "car", "person"]),
        "score": np.full(M, 0.9), "state": np.array(["moving"] * M),
        "boxes_px": np.ones((M, 4)), "n_points": np.full(M, 20),
        "Ts_world_object": Ts, "Hs_world_curr_prev": Ts,
        "motion_covariances": np.full((M, 6, 6), np.nan), "centers_m": Ts[:, :3, 3],
        "speed_mps": np.full(M, 4.0), "speed_std_mps": np.full(M, 0.1),
        "velocities_mps": np.ones((M, 3)), "velocity_std_mps": np.full(M, 0.2),
        "extents_m": np.ones((M, 3)),
    }  # fmt: skip
    return ObjectEstimates(**values)


def edited(folder, **changes):
    """Change entries of map.json."""
    head = json.loads((folder / "map.json").read_text())
    (folder / "map.json").write_text(json.dumps(head | changes))


def rewritten(folder, name, **changes):
    """Change arrays of a file so that its checksum is right; None takes an array away."""
    arrays = dict(np.load(folder / name)) | changes
    arrays = {key: array for key, array in arrays.items() if array is not None}
    np.savez(folder / name, **arrays)
    content = (folder / name).read_bytes()
    files = read_map_head(folder)["files"]
    files[name] = {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
    edited(folder, files=files)


def refused(folder, *words, camera=CAMERA):
    """Loading must fail with one sentence that has all these words; returns it."""
    with pytest.raises(FormatError) as caught:
        load_map(folder, camera, CONFIG)
    message = str(caught.value)
    for word in ("expected", "found", *words):
        assert word in message, message
    assert "\n" not in message
    return message


def test_every_array_comes_back(sparse_map, saved):
    loaded = load_map(saved, CAMERA, CONFIG)
    before, after = sparse_map.columns(), loaded.columns()
    assert set(before) == set(_COLUMNS)
    for name, column in before.items():
        np.testing.assert_array_equal(after[name], column, err_msg=name)
        assert after[name].dtype == column.dtype
    assert len(loaded.keyframes) == len(sparse_map.keyframes) == 12
    for old, new in zip(sparse_map.keyframes, loaded.keyframes, strict=True):
        assert (new.frame_index, new.timestamp_s) == (old.frame_index, old.timestamp_s)
        np.testing.assert_array_equal(new.T_world_camera, old.T_world_camera)
        for part in ("tracks", "free_features"):
            a, b = getattr(old, part), getattr(new, part)
            for field in fields(a):
                x, y = getattr(a, field.name), getattr(b, field.name)
                np.testing.assert_array_equal(x, y, err_msg=field.name)
                assert x.dtype == y.dtype


def test_the_loaded_map_answers_the_same(sparse_map, saved):
    loaded = load_map(saved, CAMERA, CONFIG)
    some = False
    for k, keyframe in enumerate(sparse_map.keyframes):
        covisible = sparse_map.covisible_keyframes(k)
        np.testing.assert_array_equal(loaded.covisible_keyframes(k), covisible)
        some |= len(covisible) > 1
        T, tracked = keyframe.T_world_camera, keyframe.tracks.point_ids[:30]
        ids, uv = sparse_map.local_points(T, tracked)
        again_ids, again_uv = loaded.local_points(T, tracked)
        np.testing.assert_array_equal(again_ids, ids)
        np.testing.assert_array_equal(again_uv, uv)
        assert len(ids) > 20
    assert some
    a, b = sparse_map.snapshot(), loaded.snapshot()
    for field in fields(a):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))


def test_a_loaded_map_goes_on(sparse_map, saved):
    """Rows that were free are used again, young points still die, and keyframes join."""
    loaded = load_map(saved, CAMERA, CONFIG)
    size, alive = len(loaded.columns()["alive"]), loaded.alive.copy()
    young = np.flatnonzero(loaded.columns()["alive"] & (loaded.columns()["n_keyframes"] == 0))
    assert len(young) > 20
    loaded.cull_points(NOTHING, NOTHING)
    assert not loaded.alive[young].any()
    rows = (np.ones((3, 3)), np.zeros((3, 3, 3)), np.zeros((3, 3)),
            np.zeros((3, 32), np.uint8), np.zeros((3, 3), np.uint8))  # fmt: skip
    ids = loaded.add_points(*rows)
    assert len(loaded.columns()["alive"]) == size
    assert not alive[ids].any()  # rows that were free when the map was saved
    last = loaded.keyframes[-1]
    loaded.add_keyframe(replace(last, frame_index=99))
    assert loaded.covisible_keyframes(12)[0] == 11
    assert sparse_map.columns()["alive"][young].all()  # nothing is shared with the first


def test_an_empty_map_comes_back(tmp_path):
    save_map(tmp_path / "map", SparseMap(CAMERA, CONFIG))
    loaded = load_map(tmp_path / "map", CAMERA, CONFIG)
    assert loaded.keyframes == []
    assert len(loaded.columns()["alive"]) == 0
    assert len(load_map_objects(tmp_path / "map")) == 0


def test_the_folder_is_what_it_says_it_is(sparse_map, saved):
    assert sorted(p.name for p in saved.iterdir()) == sorted(FILES)
    assert [p.name for p in saved.parent.iterdir()] == ["map"]
    head = json.loads((saved / "map.json").read_text())
    assert (head["format"], head["version"]) == (FORMAT, VERSION)
    assert head["camera"]["fy"] == 501.0
    alive = sparse_map.columns()["alive"]
    assert head["counts"]["points_alive"] == alive.sum() < head["counts"]["points"] == len(alive)
    with np.load(saved / "keyframes.npz", allow_pickle=False) as arrays:
        start, ids = arrays["track_start"], arrays["track_point_id"]
        own = ids[start[3] : start[4]]
    np.testing.assert_array_equal(own, sparse_map.keyframes[3].tracks.point_ids)


def test_open3d_reads_the_cloud(sparse_map, saved):
    import open3d as o3d

    cloud = o3d.io.read_point_cloud(str(saved / "static_map.ply"))
    static = sparse_map.snapshot()
    assert len(static) > 50
    np.testing.assert_allclose(np.asarray(cloud.points), static.points_m, atol=1e-4)


def test_objects_come_back(sparse_map, tmp_path):
    objects = object_rows()
    save_map(tmp_path / "map", sparse_map, objects)
    loaded = load_map_objects(tmp_path / "map")
    np.testing.assert_array_equal(loaded.object_id, objects.object_id)
    np.testing.assert_allclose(loaded.Ts_world_object, objects.Ts_world_object, atol=1e-9)
    assert read_map_head(tmp_path / "map")["counts"]["objects"] == 2
    (tmp_path / "map" / "objects.csv").write_text("frame,object_id\n")
    with pytest.raises(FormatError, match=r"objects\.csv"):
        load_map_objects(tmp_path / "map")


def test_columns_cannot_be_written_to(sparse_map):
    with pytest.raises(ValueError, match="read-only"):
        sparse_map.columns()["position_m"][0] = 0
    assert sparse_map.position_m.flags.writeable  # the map itself can be


@pytest.mark.parametrize("name", FILES[:3])
def test_a_missing_file_is_named(saved, name):
    (saved / name).unlink()
    refused(saved, name)


@pytest.mark.parametrize("name", FILES[:3])
@pytest.mark.parametrize("damage", ["cut", "flipped", "emptied"])
def test_a_damaged_file_is_named(saved, name, damage):
    content = bytearray((saved / name).read_bytes())
    if damage == "flipped":
        content[len(content) // 2] ^= 0xFF
    (saved / name).write_bytes({"cut": content[:-9], "flipped": content, "emptied": b""}[damage])
    refused(saved, name)


def test_no_map_at_all(tmp_path):
    refused(tmp_path / "nothing", "no such folder", "--save-map")
    refused(tmp_path, "map.json")


def test_a_newer_map_and_another_format(saved):
    edited(saved, version=VERSION + 1)
    refused(saved, f"version {VERSION + 1}", "update the program")
    edited(saved, version="one")
    refused(saved, "'one'")
    edited(saved, version=VERSION, format="another map")
    refused(saved, "another map", FORMAT)


@pytest.mark.parametrize("part", ["counts", "files", "camera"])
def test_a_head_without_its_parts(saved, part):
    edited(saved, **{part: None})
    refused(saved, "map.json")


def test_a_map_of_another_camera(saved):
    message = refused(saved, "fx 500", "fx 510", camera=replace(CAMERA, fx=510.0))
    assert "fy" not in message
    refused(saved, "is_rgbd", camera=replace(CAMERA, is_rgbd=True))


@pytest.mark.parametrize(
    ("name", "changes", "word"),
    [
        ("points.npz", {"alive": None}, "alive"),
        ("points.npz", {"position_m": np.zeros((4, 3))}, "one length"),
        ("points.npz", {"descriptor": np.zeros((720, 16), np.uint8)}, "descriptor"),
        ("points.npz", {"n_found": np.zeros(720)}, "int32"),
        ("points.npz", {"first_keyframe": np.full(720, 12)}, "first_keyframe"),
        ("keyframes.npz", {"track_point_id": None}, "track_point_id"),
        ("keyframes.npz", {"track_start": np.arange(13)}, "track_start"),
        ("keyframes.npz", {"T_world_camera": np.full((12, 4, 4), np.nan)}, "T_world_camera"),
        ("keyframes.npz", {"frame_index": np.arange(3)}, "one length"),
    ],
)
def test_arrays_that_do_not_fit_are_named(saved, name, changes, word):
    rewritten(saved, name, **changes)
    refused(saved, word)


def test_tracks_of_points_that_are_not_there(saved):
    ids = np.load(saved / "keyframes.npz")["track_point_id"]
    rewritten(saved, "keyframes.npz", track_point_id=ids + 700)
    refused(saved, "point_ids")


def test_counts_must_agree(saved):
    counts = read_map_head(saved)["counts"]
    edited(saved, counts=counts | {"points_alive": 1})
    refused(saved, "points_alive")


def test_pickles_are_not_opened(saved):
    rewritten(saved, "points.npz", alive=np.array([{}], dtype=object))
    refused(saved, "points.npz")


def test_an_earlier_map_is_replaced_and_other_folders_are_not(sparse_map, saved, tmp_path):
    save_map(saved, SparseMap(CAMERA, CONFIG))
    assert read_map_head(saved)["counts"]["points"] == 0
    save_map(saved, sparse_map)
    (saved / "notes.txt").write_text("dear")
    with pytest.raises(DyObError, match=r"notes\.txt"):
        save_map(saved, sparse_map)
    assert (saved / "notes.txt").read_text() == "dear"
    (tmp_path / "data").mkdir()
    (tmp_path / "data" / "image.png").write_text("dear")
    with pytest.raises(DyObError, match=r"image\.png"):
        save_map(tmp_path / "data", sparse_map)
    (tmp_path / "file").write_text("dear")
    with pytest.raises(DyObError, match="a file"):
        save_map(tmp_path / "file", sparse_map)


def test_a_failed_save_keeps_the_old_map(sparse_map, saved, monkeypatch):
    before = {p.name: p.read_bytes() for p in saved.iterdir()}

    def full(*_args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("pipelines.io.map_folder.write_objects", full)
    with pytest.raises(DyObError, match="No space left"):
        save_map(saved, sparse_map)
    assert {p.name: p.read_bytes() for p in saved.iterdir()} == before
    assert [p.name for p in saved.parent.iterdir()] == ["map"]


def test_a_folder_is_replaced_whole_or_not_at_all(tmp_path):
    target = tmp_path / "target"
    with replacing_folder(target) as fresh:
        (fresh / "a").write_text("1")
        assert not target.exists()
    with pytest.raises(KeyError), replacing_folder(target) as fresh:
        (fresh / "a").write_text("2")
        raise KeyError
    assert (target / "a").read_text() == "1"
    link = tmp_path / "link"
    link.symlink_to(target, target_is_directory=True)
    with replacing_folder(link) as fresh:
        (fresh / "b").write_text("3")
    assert link.is_symlink()
    assert [p.name for p in target.iterdir()] == ["b"]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["link", "target"]
