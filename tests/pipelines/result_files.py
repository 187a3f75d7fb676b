"""What lies in a result folder, to be compared."""

from __future__ import annotations

from pathlib import Path

ESTIMATES = (
    "camera_tum.txt",
    "camera_kitti.txt",
    "objects.csv",
    "static_map.ply",
    "objects_map.ply",
)


def estimates(folder: Path) -> dict[str, bytes]:
    """Content of every file of the estimate, of each object's trajectory too, by name."""
    trajectories = sorted(f"objects/{path.name}" for path in (folder / "objects").glob("*"))
    return {name: (folder / name).read_bytes() for name in (*ESTIMATES, *trajectories)}


def names_in(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}
