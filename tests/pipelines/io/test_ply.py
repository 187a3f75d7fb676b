"""Point clouds on disk: colours, binary header, what Open3D reads, damaged files."""

import numpy as np
import pytest

from pipelines.errors import FormatError
from pipelines.io.ply import read_point_cloud, write_point_cloud


def random_cloud(n: int = 500):
    rng = np.random.default_rng(5)
    return rng.normal(size=(n, 3)) * 20.0, rng.integers(0, 256, (n, 3)).astype(np.uint8)


def test_round_trip_is_binary_and_exact_in_colour(tmp_path):
    points, colors = random_cloud()
    write_point_cloud(tmp_path / "map.ply", points, colors)
    points_read, colors_read = read_point_cloud(tmp_path / "map.ply")
    np.testing.assert_allclose(points_read, points, atol=1e-5)
    np.testing.assert_array_equal(colors_read, colors)
    header = (tmp_path / "map.ply").read_bytes().split(b"end_header")[0]
    assert b"format binary_little_endian" in header
    assert b"element vertex 500" in header
    assert b"uchar red" in header


def test_open3d_reads_it(tmp_path):
    o3d = pytest.importorskip("open3d")
    points, colors = random_cloud()
    write_point_cloud(tmp_path / "map.ply", points, colors)
    cloud = o3d.io.read_point_cloud(str(tmp_path / "map.ply"))
    np.testing.assert_allclose(np.asarray(cloud.points), points, atol=1e-5)
    np.testing.assert_allclose(np.asarray(cloud.colors) * 255.0, colors, atol=1e-3)


def test_no_points(tmp_path):
    write_point_cloud(tmp_path / "map.ply", np.empty((0, 3)), np.empty((0, 3), np.uint8))
    points, colors = read_point_cloud(tmp_path / "map.ply")
    assert points.shape == (0, 3)
    assert colors.shape == (0, 3)


@pytest.mark.parametrize("keep", [0, 10, 150, 2000])
def test_cut_short(tmp_path, keep):
    points, colors = random_cloud()
    write_point_cloud(tmp_path / "map.ply", points, colors)
    data = (tmp_path / "map.ply").read_bytes()
    (tmp_path / "map.ply").write_bytes(data[:keep])
    with pytest.raises(FormatError, match=r"map\.ply: expected"):
        read_point_cloud(tmp_path / "map.ply")


def test_wrong_shapes(tmp_path):
    with pytest.raises(ValueError, match=r"\(5, 3\) and \(4, 3\)"):
        write_point_cloud(tmp_path / "map.ply", np.zeros((5, 3)), np.zeros((4, 3), np.uint8))
    assert not list(tmp_path.iterdir())
