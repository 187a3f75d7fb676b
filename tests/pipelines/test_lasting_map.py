"""Maps that outlast a run: localised in they stay as they are, continued they grow."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pipelines.datasets.sequence import Sequence
from pipelines.dyob_slam import DyObSlam
from pipelines.errors import ConfigError, DyObError, FormatError
from pipelines.geometry import invert_T, rotation_angle_deg
from pipelines.io.config import load_config
from pipelines.io.map_folder import load_map, load_map_objects
from pipelines.io.result import load_result
from pipelines.io.trajectory import read_tum
from pipelines.lasting_map import LastingMap
from pipelines.mapping.sparse_map import SparseMap
from pipelines.runner import run
from pipelines.types import FrameResult, TrackingStatus

OK, LOST = TrackingStatus.OK, TrackingStatus.LOST
NO_BATCH = ["batch.at_end=false", "batch.record=false"]
MAP_FILES = {"map.json", "points.npz", "keyframes.npz", "static_map.ply", "objects.csv"}


@pytest.fixture(scope="module")
def mapped(street: Sequence, tmp_path_factory) -> Path:
    """The map of the street's 20 frames; not to be changed by tests."""
    root = tmp_path_factory.mktemp("mapped")
    run(
        street,
        load_config(None, NO_BATCH),
        root / "result",
        lasting_map=LastingMap(save=root / "map"),
    )
    return root / "map"


def loaded(folder: Path, sequence: Sequence) -> SparseMap:
    return load_map(folder, sequence.camera, load_config().mapping)


def contents(sparse_map: SparseMap) -> dict[str, np.ndarray]:
    """Copies of all arrays of points and of all keyframe poses."""
    poses = np.array([k.T_world_camera for k in sparse_map.keyframes])
    held = {name: column.copy() for name, column in sparse_map.columns().items()}
    return held | {"keyframe poses": poses}


def localise(slam: DyObSlam, sequence: Sequence, frames: range) -> list[FrameResult]:
    results = []
    for n, k in enumerate(frames):
        frame = replace(sequence.read(k), index=n)
        results.append(slam.process(frame if n else replace(frame, flow_prev_to_curr_px=None)))
    return results


def errors_m_deg(results, sequence: Sequence, frames: range) -> np.ndarray:
    """(N, 2) errors in the world of the sequence's first camera, with no alignment at all."""
    Ts = sequence.ground_truth().Ts_world_camera
    Es = [
        invert_T(invert_T(Ts[0]) @ Ts[k]) @ r.T_world_camera
        for k, r in zip(frames, results, strict=True)
    ]
    return np.array([[np.linalg.norm(E[:3, 3]), float(rotation_angle_deg(E))] for E in Es])


@pytest.mark.parametrize("frames", [range(0, 6), range(9, 15)], ids=["the same", "from its middle"])
def test_a_camera_is_localised_in_the_maps_world_and_the_map_stays(street, mapped, frames) -> None:
    known = loaded(mapped, street)
    before = contents(known)
    slam = DyObSlam(street.camera, known_map=known, localize=True)
    results = localise(slam, street, frames)
    assert [r.status for r in results] == [OK] * len(frames)
    assert not any(r.is_keyframe for r in results)
    errors = errors_m_deg(results, street, frames)
    assert 1e-5 < errors[:, 0].max() < 0.05
    assert 1e-5 < errors[:, 1].max() < 0.1
    after = contents(slam.map)
    assert before.keys() == after.keys()
    for name, array in before.items():
        np.testing.assert_array_equal(after[name], array, err_msg=name)


def test_a_strange_place_stays_lost_and_the_log_says_so(
    street, other_place, mapped, caplog
) -> None:
    known = loaded(mapped, street)
    before = contents(known)
    slam = DyObSlam(street.camera, known_map=known)  # to be continued: but nothing ties it
    caplog.set_level("WARNING", "dyob")
    results = localise(slam, other_place, range(6))
    assert [r.status for r in results] == [LOST] * 6
    said = [r.getMessage() for r in caplog.records if "not recognised" in r.getMessage()]
    assert len(said) == 1
    del before["offset_slope"]  # an earlier run's offset, which ties nothing here
    after = contents(slam.map)
    for name, array in before.items():
        np.testing.assert_array_equal(after[name], array, err_msg=name)


def test_a_map_that_is_continued_grows_and_keeps_its_world(street, mapped, tmp_path) -> None:
    config = load_config(None, NO_BATCH)
    again = LastingMap(mapped, tmp_path / "grown")
    result = run(street, config, tmp_path / "r", start=12, lasting_map=again)
    assert result.metrics["run"]["tracked"] == 8
    old, new = loaded(mapped, street), loaded(tmp_path / "grown", street)
    assert len(new.keyframes) > len(old.keyframes)
    assert len(new.columns()["alive"]) > len(old.columns()["alive"])
    for one, other in zip(old.keyframes, new.keyframes, strict=False):
        np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)
    _, Ts = read_tum(result.folder / "camera_tum.txt")
    truth = street.ground_truth().Ts_world_camera
    off = invert_T(invert_T(truth[0]) @ truth[19]) @ Ts[-1]
    assert 1e-6 < np.linalg.norm(off[:3, 3]) < 0.05
    known, both = load_map_objects(mapped), load_map_objects(tmp_path / "grown")
    assert len(both) > len(known) > 20
    first = both[np.arange(len(known))]
    np.testing.assert_array_equal(first.object_id, known.object_id)
    assert both.object_id[len(known) :].min() > known.object_id.max()


def test_a_map_may_be_continued_in_its_own_folder(street, mapped, tmp_path) -> None:
    shutil.copytree(mapped, tmp_path / "map")
    own = LastingMap(tmp_path / "map", tmp_path / "map")
    run(street, None, tmp_path / "r", frames=4, lasting_map=own)  # with the batch
    assert {p.name for p in (tmp_path / "map").iterdir()} == MAP_FILES
    assert loaded(tmp_path / "map", street).keyframes


# -------------------------------------------------------------------- refused


def test_localize_needs_a_map_and_saves_none() -> None:
    with pytest.raises(ConfigError, match="--load-map"):
        LastingMap(localize=True)
    with pytest.raises(ConfigError, match="leave one of the two out"):
        LastingMap("there", "here", localize=True)


def test_whatever_is_wrong_is_found_before_the_run(street, stereo_street, mapped, tmp_path) -> None:
    dear = tmp_path / "dear"
    dear.mkdir()
    (dear / "letters.txt").write_text("dear")
    torn = tmp_path / "torn"
    shutil.copytree(mapped, torn)
    (torn / "objects.csv").write_text("frame\n")
    newer = tmp_path / "newer"
    shutil.copytree(mapped, newer)
    head = json.loads((newer / "map.json").read_text())
    (newer / "map.json").write_text(json.dumps(head | {"version": 99}))
    smaller = replace(street.camera, width=street.camera.width - 2)
    cases = [
        (LastingMap(tmp_path / "nowhere"), street.camera, FormatError, "no such folder"),
        (LastingMap(save=dear), street.camera, DyObError, "letters.txt"),
        (LastingMap(torn), street.camera, FormatError, "objects.csv"),
        (LastingMap(newer), street.camera, FormatError, "version 99"),
        (LastingMap(mapped), smaller, FormatError, "width"),
    ]
    for maps, camera, kind, word in cases:
        with pytest.raises(kind) as caught:
            maps.open(camera, load_config().mapping)
        assert word in str(caught.value)
        assert "\n" not in str(caught.value)


# -------------------------------------------------------------- command line


def app(*words: str, cwd: Path, root: Path) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, "-m", "app", *words],
        check=False, cwd=cwd, capture_output=True, text=True, timeout=300,
        env=os.environ | {"DYOB_NO_SETUP": "1", "PYTHONPATH": str(root)},
    )  # fmt: skip


@pytest.mark.slow
def test_the_command_line_saves_and_localises(vdo_folder, tmp_path, repository) -> None:
    common = ["run", str(vdo_folder), "--pictures", "0", "--quiet"]
    made = app(
        *common, "--output", "a", "--save-map", "map", "--frames", "8",
        cwd=tmp_path, root=repository,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    assert {p.name for p in (tmp_path / "map").iterdir()} == MAP_FILES
    before = {p.name: p.read_bytes() for p in (tmp_path / "map").iterdir()}
    found = app(
        *common, "--output", "b", "--load-map", "map", "--localize", "--start", "3",
        cwd=tmp_path, root=repository,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    assert {p.name: p.read_bytes() for p in (tmp_path / "map").iterdir()} == before
    assert load_result(tmp_path / "b").metrics["run"]["tracked"] == 7
    from evo.tools import file_interface

    truth = file_interface.read_tum_trajectory_file(tmp_path / "a/camera_gt_tum.txt")
    part = file_interface.read_tum_trajectory_file(tmp_path / "b/camera_tum.txt")
    gap_m = np.linalg.norm(part.positions_xyz[:5] - truth.positions_xyz[3:], axis=1)
    assert 1e-5 < gap_m.max() < 0.1  # one world
    assert part.positions_xyz[0, 2] > 1.0  # which does not begin at the first frame of this run


def test_the_command_line_says_in_a_sentence_what_is_wrong(tmp_path, repository) -> None:
    alone = app("run", "simulated:demo", "--localize", cwd=tmp_path, root=repository)
    assert alone.returncode == 2
    assert "--load-map" in alone.stderr and "Traceback" not in alone.stderr
    assert len(alone.stderr.strip().splitlines()) == 1
