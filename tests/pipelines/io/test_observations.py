"""The observation log: what is written comes back, and damage is told."""

import numpy as np
import pytest

from pipelines.errors import FormatError
from pipelines.frame_observations import FrameObservations, Sightings
from pipelines.io import observations as log_files
from pipelines.io.observations import (
    ObservationRecorder,
    read_camera,
    read_map_points,
    read_observations,
)
from pipelines.types import StereoCamera

CAMERA = StereoCamera(640, 480, 500.0, 501.0, 320.0, 240.0, 100.0, is_rgbd=True)


def make_frames(n):
    rng = np.random.default_rng(0)
    frames = []
    for k in range(n):
        m = int(rng.integers(0, 5))
        sightings = Sightings(
            np.full(m, k), rng.integers(0, 3, m), rng.integers(0, 9000, m),
            rng.uniform(0, 600, (m, 2)), np.where(rng.random(m) < 0.5, np.nan, 5.0),
            np.full(m, 0.1), np.full(m, 0.2), rng.normal(size=(m, 3)),
        )  # fmt: skip
        offset_px = 0.02 * k
        frames.append(
            FrameObservations(k, 0.1 * k, k % 3 != 0, np.eye(4) * 1.0, sightings, offset_px)
        )
    return frames


def test_round_trip_over_several_chunks(tmp_path, monkeypatch):
    monkeypatch.setattr(log_files, "FRAMES_A_CHUNK", 4)
    frames = make_frames(10)
    recorder = ObservationRecorder(tmp_path / "observations", CAMERA)
    for frame in frames:
        recorder.add(frame)
    assert len(list((tmp_path / "observations").glob("0*.npz"))) == 2  # spooled while running
    recorder.finish(np.array([7, 3, 5]))
    back = read_observations(tmp_path / "observations")
    assert read_camera(tmp_path / "observations") == CAMERA
    assert read_map_points(tmp_path / "observations").tolist() == [7, 3, 5]
    assert len(back) == 10
    for ours, theirs in zip(frames, back, strict=True):
        assert (ours.frame_index, ours.timestamp_s, ours.is_tracked) == (
            theirs.frame_index, theirs.timestamp_s, theirs.is_tracked,
        )  # fmt: skip
        assert ours.disparity_offset_px == theirs.disparity_offset_px
        for name in Sightings.__slots__:
            a, b = getattr(ours.sightings, name), getattr(theirs.sightings, name)
            assert a.shape == b.shape and b.dtype in (np.float64, np.int64)
            np.testing.assert_allclose(b, a, rtol=1e-6, err_msg=name)


def test_poses_that_were_corrected_since_come_back_corrected(tmp_path):
    recorder = ObservationRecorder(tmp_path, CAMERA)
    for frame in make_frames(4):
        recorder.add(frame)
    T = np.eye(4)
    T[:3, 3] = (1.0, 2.0, 3.0)
    recorder.finish(None, {2: T})
    back = read_observations(tmp_path)
    for k, frame in enumerate(back):
        np.testing.assert_array_equal(frame.T_world_camera, T if k == 2 else np.eye(4))
    ObservationRecorder(tmp_path, CAMERA)  # the next run's log knows nothing of them
    assert not (tmp_path / log_files.POSES).exists()
    (tmp_path / log_files.POSES).write_bytes(b"no arrays")
    with pytest.raises(FormatError, match="observations"):
        read_observations(tmp_path)


def test_damage_is_a_format_error(tmp_path):
    recorder = ObservationRecorder(tmp_path, CAMERA)
    recorder.add(make_frames(1)[0])
    recorder.finish()
    path = tmp_path / "000000.npz"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(FormatError, match="run the sequence again"):
        read_observations(tmp_path)
    np.savez(path, version=np.int64(99))
    with pytest.raises(FormatError, match="version"):
        read_observations(tmp_path)
    (tmp_path / "camera.json").write_text("{}")
    with pytest.raises(FormatError):
        read_camera(tmp_path)
