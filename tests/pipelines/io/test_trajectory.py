"""Trajectory files: round trips, what evo makes of them, and damaged files."""

import numpy as np
import pytest

from pipelines.errors import FormatError
from pipelines.geometry import exp_se3
from pipelines.io.trajectory import read_kitti, read_tum, write_kitti, write_tum


def random_walk(n: int, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    Ts = np.tile(np.eye(4), (n, 1, 1))
    for k in range(1, n):
        Ts[k] = Ts[k - 1] @ exp_se3(rng.normal(size=6) * [0.3, 0.3, 0.3, 1.0, 1.0, 5.0])
    return Ts


def test_tum_round_trip(tmp_path):
    Ts, stamps = random_walk(40), 1.5e9 + np.arange(40) / 30.0
    write_tum(tmp_path / "a.txt", stamps, Ts)
    stamps_read, Ts_read = read_tum(tmp_path / "a.txt")
    np.testing.assert_allclose(stamps_read, stamps, atol=1e-6)
    np.testing.assert_allclose(Ts_read, Ts, atol=5e-9)


def test_tum_digits(tmp_path):
    write_tum(tmp_path / "a.txt", np.array([1.0 / 3.0]), random_walk(2)[1:])
    words = (tmp_path / "a.txt").read_text().splitlines()[-1].split()
    decimals = [len(word.split(".")[1]) for word in words]
    assert decimals[0] >= 6
    assert min(decimals[1:]) >= 9


def test_kitti_round_trip(tmp_path):
    Ts = random_walk(40)
    write_kitti(tmp_path / "a.txt", Ts)
    np.testing.assert_allclose(read_kitti(tmp_path / "a.txt"), Ts, atol=5e-9)


def test_evo_reads_both_as_camera_to_world(tmp_path):
    file_interface = pytest.importorskip("evo.tools.file_interface")
    Ts, stamps = random_walk(12), np.arange(12) * 0.1
    write_tum(tmp_path / "tum.txt", stamps, Ts)
    write_kitti(tmp_path / "kitti.txt", Ts)
    tum = file_interface.read_tum_trajectory_file(tmp_path / "tum.txt")
    kitti = file_interface.read_kitti_poses_file(tmp_path / "kitti.txt")
    np.testing.assert_allclose(tum.timestamps, stamps, atol=1e-9)
    np.testing.assert_allclose(np.array(tum.poses_se3), Ts, atol=5e-9)
    np.testing.assert_allclose(np.array(kitti.poses_se3), Ts, atol=5e-9)


def test_no_poses(tmp_path):
    write_tum(tmp_path / "tum.txt", np.empty(0), np.empty((0, 4, 4)))
    write_kitti(tmp_path / "kitti.txt", np.empty((0, 4, 4)))
    assert read_tum(tmp_path / "tum.txt")[1].shape == (0, 4, 4)
    assert read_kitti(tmp_path / "kitti.txt").shape == (0, 4, 4)


def test_nan_is_refused_and_leaves_the_old_file(tmp_path):
    Ts = random_walk(3)
    write_tum(tmp_path / "a.txt", np.arange(3), Ts)
    before = (tmp_path / "a.txt").read_bytes()
    Ts[1, 0, 3] = np.nan
    with pytest.raises(ValueError, match="pose 1"):
        write_tum(tmp_path / "a.txt", np.arange(3), Ts)
    assert (tmp_path / "a.txt").read_bytes() == before


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("0.2 1 2 3 0 0 0", "expected 8 finite numbers"),
        ("0.2 1 2 3 0 0 0 one", "expected 8 finite numbers"),
        ("0.2 1 2 nan 0 0 0 1", "expected 8 finite numbers"),
        ("0.2 1 2 3 0 0 0 2", "unit quaternion"),
        ("0.2 1 2 3 0 0 0 0", "unit quaternion"),
    ],
)
def test_damaged_tum_names_the_line(tmp_path, line, message):
    (tmp_path / "a.txt").write_text(f"# head\n0.1 0 0 0 0 0 0 1\n\n{line}\n")
    with pytest.raises(FormatError, match=f"line 4: .*{message}"):
        read_tum(tmp_path / "a.txt")


@pytest.mark.parametrize(
    "line", ["1 0 0 0 0 1 0 0 0 0 1", "1 0 0 0 0 1 0 0 0 0 -1 0", "2 0 0 0 0 2 0 0 0 0 2 0"]
)
def test_damaged_kitti_names_the_line(tmp_path, line):
    (tmp_path / "a.txt").write_text(f"1 0 0 0 0 1 0 0 0 0 1 0\n{line}\n")
    with pytest.raises(FormatError, match="line 2"):
        read_kitti(tmp_path / "a.txt")


def test_missing_and_binary_files(tmp_path):
    with pytest.raises(FormatError, match=r"gone\.txt"):
        read_tum(tmp_path / "gone.txt")
    (tmp_path / "b.txt").write_bytes(b"\xff\xfe\x00\x01")
    with pytest.raises(FormatError, match=r"b\.txt"):
        read_kitti(tmp_path / "b.txt")
