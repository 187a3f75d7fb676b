"""Point clouds as binary PLY with colours, by Open3D.

Owns the files of maps and their checks. Knows nothing of what the points mean.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import DyObError, FormatError
from pipelines.io.files import replacing
from pipelines.types import Array

BYTES_OF_TYPE = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}
EMPTY_PLY = (
    b"ply\nformat binary_little_endian 1.0\ncomment Created by Open3D\nelement vertex 0\n"
    b"property float x\nproperty float y\nproperty float z\n"
    b"property uchar red\nproperty uchar green\nproperty uchar blue\nend_header\n"
)


def point_cloud(points_m: NDArray, colors: NDArray[np.uint8]) -> Any:
    """Open3D tensor point cloud of points (N, 3) in metres and colours (N, 3) uint8 RGB."""
    import open3d as o3d

    cloud = o3d.t.geometry.PointCloud()
    for name, array in (("positions", np.asarray(points_m, np.float32)), ("colors", colors)):
        setattr(cloud.point, name, o3d.core.Tensor.from_numpy(np.ascontiguousarray(array)))
    return cloud


def write_point_cloud(path: Path | str, points_m: Array, colors: NDArray[np.uint8]) -> None:
    """Write points (N, 3) in metres with colours (N, 3) uint8 RGB as a binary PLY; N may be 0.

    Raises ValueError for wrong shapes, DyObError where the disk refuses (the old file stays).
    """
    points_m, colors = np.asarray(points_m), np.asarray(colors)
    if points_m.ndim != 2 or points_m.shape[1] != 3 or colors.shape != points_m.shape:
        raise ValueError(
            f"write_point_cloud: expected (N, 3) points and colors, found {points_m.shape} and "
            f"{colors.shape}"
        )
    with replacing(path) as fresh:
        if len(points_m) == 0:  # Open3D refuses to write no points
            fresh.write_bytes(EMPTY_PLY)
            return
        import open3d as o3d

        with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
            o3d.t.io.write_point_cloud(fresh, point_cloud(points_m, colors))
        try:
            _read_header(fresh)  # Open3D does not tell of a disk that filled up
        except FormatError as error:
            raise DyObError(
                f"{path}: expected to write {len(points_m)} points, found no room for them; "
                "make room on the disk and try again. The old file is kept."
            ) from error


def read_point_cloud(path: Path | str) -> tuple[Array, NDArray[np.uint8]]:
    """Points (N, 3) float64 in metres and colours (N, 3) uint8 RGB of a PLY file.

    A file without colours gives mid grey. Raises FormatError where it is missing or damaged.
    """
    path = Path(path)
    n_points = _read_header(path)
    if n_points == 0:
        return np.empty((0, 3)), np.empty((0, 3), np.uint8)
    import open3d as o3d

    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.t.io.read_point_cloud(path)
    found = len(cloud.point.positions) if "positions" in cloud.point else 0
    if found != n_points:
        raise _cut_short(path, n_points, found)
    points = cloud.point.positions.numpy().astype(np.float64)
    if "colors" not in cloud.point:
        return points, np.full((n_points, 3), 128, np.uint8)
    colors = cloud.point.colors.numpy()
    if colors.dtype != np.uint8:
        colors = np.clip(np.round(colors * 255.0), 0, 255)
    return points, colors.astype(np.uint8)


def _read_header(path: Path) -> int:
    """The number of points a PLY file promises, after a check that it is long enough for them.

    Open3D fills the rest of a file that is cut short with whatever lies in memory.
    """
    try:
        with path.open("rb") as file:
            head = file.read(65536)
        size = path.stat().st_size
    except OSError as error:
        raise FormatError(
            f"{path}: expected a PLY file, found it unreadable ({error.strerror}); check the path"
        ) from error
    header = re.match(rb"ply\r?\n.*?end_header\r?\n", head, re.DOTALL)
    text = header[0].decode("ascii", "replace") if header else ""
    vertex = re.search(r"element vertex (\d+)\s+((?:property \w+ \w+\s+)*)", text)
    if header is None or vertex is None:
        raise FormatError(
            f"{path}: expected a PLY header with 'element vertex', found {head[:20]!r}; the file "
            "is damaged or no PLY, so run the sequence again"
        )
    n_points = int(vertex[1])
    types = re.findall(r"property (\w+) ", vertex[2])
    if "format binary" in text and n_points:
        there = (size - header.end()) // max(sum(BYTES_OF_TYPE.get(t, 0) for t in types), 1)
        if there < n_points:
            raise _cut_short(path, n_points, there)
    return n_points


def _cut_short(path: Path, promised: int, found: int) -> FormatError:
    return FormatError(
        f"{path}: expected {promised} points as its header says, found {found}; the file is cut "
        "short, so run the sequence again"
    )
