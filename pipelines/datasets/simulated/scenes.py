"""The scenes by name: which world, which camera, how many frames.

Owns the table that a spec such as `simulated:street` is looked up in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from pipelines.datasets.simulated.world import World
from pipelines.errors import DatasetError
from pipelines.types import StereoCamera

_KITTI = StereoCamera(1242, 375, 721.5377, 721.5377, 609.5593, 172.854, 387.5744)
_RGBD = StereoCamera(640, 480, 525.0, 525.0, 319.5, 239.5, 40.0)


@dataclass(frozen=True, slots=True)
class Scene:
    """One row of the table. make: (frames, seed, camera) to a world. indoors: depth as RGB-D."""

    name: str
    camera: StereoCamera
    frames: int
    fps: float
    make: Callable[[int, int, StereoCamera], World]
    indoors: bool = False


def scaled_camera(camera: StereoCamera, scale: float) -> StereoCamera:
    """The same view in a picture `scale` times as large; the baseline stays."""
    return StereoCamera(
        round(camera.width * scale),
        round(camera.height * scale),
        camera.fx * scale,
        camera.fy * scale,
        (camera.cx + 0.5) * scale - 0.5,
        (camera.cy + 0.5) * scale - 0.5,
        camera.bf * scale,
    )


def _street(frames: int, seed: int, camera: StereoCamera) -> World:
    from pipelines.datasets.simulated.street import make_street

    return make_street(frames, seed, camera)


def _static(frames: int, seed: int, camera: StereoCamera) -> World:
    from pipelines.datasets.simulated.street import make_street

    return make_street(frames, seed, camera, still=True)


def _room(frames: int, seed: int, camera: StereoCamera) -> World:
    from pipelines.datasets.simulated.room import make_room

    return make_room(frames, seed, camera)


SCENES: dict[str, Scene] = {
    scene.name: scene
    for scene in (
        Scene("street", _KITTI, 100, 10.0, _street),
        Scene("room", _RGBD, 100, 20.0, _room, indoors=True),
        Scene("static", _KITTI, 100, 10.0, _static),
        Scene("demo", scaled_camera(_KITTI, 0.5), 40, 10.0, _street),
    )
}


def find_scene(name: str) -> Scene:
    """The scene called `name`; DatasetError names the valid ones."""
    if name not in SCENES:
        raise DatasetError(
            f"no simulated scene is called '{name}': write simulated:NAME with one of "
            f"{', '.join(SCENES)}"
        )
    return SCENES[name]
