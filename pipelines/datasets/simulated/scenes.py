"""The scenes by name: which world, which camera, how many frames.

Owns the table that a spec such as `simulated:street` is looked up in.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pipelines.datasets.simulated.world import World
from pipelines.errors import DatasetError
from pipelines.types import StereoCamera

_KITTI = StereoCamera(1242, 375, 721.5377, 721.5377, 609.5593, 172.854, 387.5744)
_RGBD = StereoCamera(640, 480, 525.0, 525.0, 319.5, 239.5, 40.0)


@dataclass(frozen=True, slots=True)
class Scene:
    """One row of the table.

    make: (frames, seed, camera) to a world. indoors: depth as RGB-D. made_of: a hash of the files
    that the world is made of, where there are any; rendered frames are kept by it.
    most_frames: how long it can be, None for as long as one likes.
    """

    name: str
    camera: StereoCamera
    frames: int
    fps: float
    make: Callable[[int, int, StereoCamera], World]
    indoors: bool = False
    made_of: str = ""
    most_frames: int | None = None


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


def _crossing(frames: int, seed: int, camera: StereoCamera) -> World:
    from pipelines.datasets.simulated.crossing import make_crossing

    return make_crossing(frames, seed, camera)


def _loop(frames: int, seed: int, camera: StereoCamera) -> World:
    from pipelines.datasets.simulated.town import make_loop

    return make_loop(frames, seed, camera)


def _long(frames: int, seed: int, camera: StereoCamera) -> World:
    from pipelines.datasets.simulated.town import make_long

    return make_long(frames, seed, camera)


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
        Scene("crossing", _KITTI, 100, 10.0, _crossing),
        Scene("loop", _KITTI, 520, 10.0, _loop),
        Scene("long", scaled_camera(_KITTI, 0.4), 2000, 10.0, _long),
        Scene("static", _KITTI, 100, 10.0, _static),
        Scene("demo", scaled_camera(_KITTI, 0.5), 40, 10.0, _street),
    )
}


KITTI_SEQUENCES = tuple(f"{number:04d}" for number in range(21))
KITTI_FRAMES = 150  # of a replayed sequence, unless told otherwise or it is shorter
_KITTI_PREFIX = "kitti_"


def find_scene(name: str, labels: Path | str | None = None) -> Scene:
    """The scene called `name`.

    labels: folder of KITTI tracking's labels, for `kitti_NNNN`; $DYOB_KITTI_TRACKING where None.
    Raises DatasetError that names the valid scenes, or the files that are missing.
    """
    number = name.removeprefix(_KITTI_PREFIX)
    if number != name and number in KITTI_SEQUENCES:
        return _kitti(name, number, labels)
    if name not in SCENES:
        raise DatasetError(
            f"no simulated scene is called '{name}': write simulated:NAME with one of "
            f"{', '.join(SCENES)}, kitti_0000 to kitti_0020"
        )
    return SCENES[name]


def _kitti(name: str, number: str, labels: Path | str | None) -> Scene:
    from pipelines.datasets.simulated.kitti_labels import KittiFiles

    files = KittiFiles.find(number, labels)
    read = files.read()

    def make(frames: int, seed: int, camera: StereoCamera) -> World:
        from pipelines.datasets.simulated.kitti_scene import make_kitti

        return make_kitti(files, frames, seed, camera)

    frames = len(read.Ts_world_camera)
    return Scene(
        name, read.camera, min(frames, KITTI_FRAMES), 10.0, make,
        made_of=files.digest(), most_frames=frames,
    )  # fmt: skip
