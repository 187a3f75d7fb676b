"""Paged arrays: as any others to whoever uses them, and no memory for whoever does not."""

from __future__ import annotations

import errno
import gc
import logging
import os
import tracemalloc
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from pipelines.config import MappingConfig
from pipelines.geometry import make_T
from pipelines.mapping.keyframe import Keyframe
from pipelines.mapping.sparse_map import SparseMap
from pipelines.observations import Tracks
from pipelines.paged_arrays import PagedArrays
from pipelines.types import Features, StereoCamera

CAMERA = StereoCamera(640, 480, 500.0, 500.0, 320.0, 240.0, 50.0)
MIB = 1 << 20
needs_proc = pytest.mark.skipif(
    not Path("/proc/self/status").is_file(), reason="reads what Linux says of a program"
)


def tracks(n: int, seed: int = 0) -> Tracks:
    rng = np.random.default_rng(seed)
    return Tracks(np.arange(n), rng.normal(size=(n, 2)), rng.normal(size=n), rng.normal(size=n))


def resident_bytes() -> int:
    status = Path("/proc/self/status").read_text()
    return 1024 * int(status.split("VmRSS:")[1].split()[0])


@pytest.mark.parametrize("is_paged", [False, True])
def test_arrays_are_as_numpy_makes_them(tmp_path: Path, is_paged: bool) -> None:
    arrays = PagedArrays(tmp_path if is_paged else None)
    for shape, dtype in (((5, 3, 3), np.float64), ((7,), np.bool_), ((0, 4), np.uint8)):
        made, expected = arrays.zeros(shape, dtype), np.zeros(shape, dtype)
        assert type(made) is np.ndarray and made.dtype == expected.dtype
        np.testing.assert_array_equal(made, expected)
        made[1:] = 1
        assert made.sum() == made[1:].size
    before = np.arange(12.0).reshape(6, 2)
    np.testing.assert_array_equal(arrays.grown(before, 9), np.vstack([before, np.zeros((3, 2))]))
    assert list(tmp_path.iterdir()) == []


def test_what_is_kept_is_a_copy_with_all_that_is_in_it(tmp_path: Path) -> None:
    arrays = PagedArrays(tmp_path)
    T, names = np.eye(4), np.array(["car", "person"])
    ours = [Keyframe(k, 0.1 * k, T, tracks(30 * k, k), Features.empty(), 0.2) for k in range(80)]
    kept = [arrays.keep(keyframe) for keyframe in ours]
    kept_names = arrays.keep(names)
    T[0, 3], names[0] = 5.0, "bus"
    assert kept_names.tolist() == ["car", "person"]
    for k, keyframe in enumerate(kept):
        assert (keyframe.frame_index, keyframe.timestamp_s) == (k, 0.1 * k)
        assert keyframe.disparity_offset_px == 0.2 and len(keyframe.free_features) == 0
        np.testing.assert_array_equal(keyframe.T_world_camera, np.eye(4))
        for field in fields(Tracks):
            found = getattr(keyframe.tracks, field.name)
            np.testing.assert_array_equal(found, getattr(tracks(30 * k, k), field.name))
            assert found.flags.aligned


def test_nothing_is_copied_where_there_is_no_folder() -> None:
    ours = tracks(4)
    assert PagedArrays().keep(ours) is ours


@needs_proc
def test_memory_is_let_go_and_comes_back_as_it_was(tmp_path: Path) -> None:
    arrays = PagedArrays(tmp_path)
    arrays.let_go()
    before = resident_bytes()
    large = arrays.zeros((8 * MIB,), np.float64)
    large[:] = np.arange(8 * MIB)
    small = [arrays.keep(np.full(MIB // 8, float(k))) for k in range(16)]
    assert resident_bytes() - before > 70 * MIB
    arrays.let_go()
    assert resident_bytes() - before < 8 * MIB
    assert large[::4096].tolist() == list(range(0, 8 * MIB, 4096))
    assert [(part.min(), part.max()) for part in small] == [(k, k) for k in range(16)]


@needs_proc
def test_files_end_with_their_arrays(tmp_path: Path) -> None:
    arrays, files = PagedArrays(tmp_path), Path("/proc/self/fd")
    n_before = len(list(files.iterdir()))
    held = [arrays.zeros((1000,), np.float64) for _ in range(30)]
    assert len(list(files.iterdir())) >= n_before + 30
    del held
    gc.collect()
    assert len(list(files.iterdir())) <= n_before
    arrays.let_go()


def test_a_disk_that_refuses_costs_a_sentence(tmp_path: Path, monkeypatch, caplog) -> None:
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    arrays = PagedArrays(tmp_path)
    early = arrays.keep(np.arange(5))
    monkeypatch.setattr(os, "posix_fallocate", full)
    with caplog.at_level(logging.WARNING):
        late = arrays.zeros((3, 2), np.int32)
        later = arrays.keep(tracks(10))
    assert late.shape == (3, 2) and not late.any()
    np.testing.assert_array_equal(later.uv_px, tracks(10).uv_px)
    assert early.tolist() == [0, 1, 2, 3, 4]
    assert len(caplog.records) == 1
    assert "grows in memory" in caplog.text and "No space left" in caplog.text


def test_a_map_that_grows_takes_little_memory(tmp_path: Path) -> None:
    """What a keyframe brings, some 100 kB here, goes to the disk but for a few per cent."""

    def grow(sparse_map: SparseMap, n_keyframes: int) -> None:
        rng = np.random.default_rng(len(sparse_map.keyframes))
        for _ in range(n_keyframes):
            k, n = len(sparse_map.keyframes), 300
            ids = sparse_map.add_points(
                rng.normal(size=(n, 3)), rng.normal(size=(n, 3, 3)), rng.normal(size=(n, 3)),
                rng.integers(0, 256, (n, 32)).astype(np.uint8), np.zeros((n, 3), np.uint8),
            )  # fmt: skip
            T = make_T(np.eye(3), np.array([0.0, 0.0, 3.0 * k]))
            seen = Tracks(ids, np.ones((n, 2)), np.ones(n), np.ones(n))
            sparse_map.add_keyframe(Keyframe(k, 0.1 * k, T, seen, Features.empty()))

    def growth(arrays: PagedArrays) -> int:
        sparse_map = SparseMap(CAMERA, MappingConfig())
        sparse_map.move_into(arrays)
        tracemalloc.start()
        grow(sparse_map, 200)
        traced, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        return traced

    in_memory, paged = growth(PagedArrays()), growth(PagedArrays(tmp_path))
    assert in_memory > 200 * 300 * 200
    assert paged < 0.08 * in_memory
