"""The room: a furnished living room seen by a hand-held RGB-D camera, with things that tumble.

Owns its layout and choreography: a carton, a parcel and a letter cube turn in the air, a chair is
pulled across the floor, a ball rolls, and a person walks round behind the table.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from pipelines.datasets.simulated.furniture import (
    ball,
    bookshelf,
    carton,
    chair,
    floor_lamp,
    picture,
    plant,
    sofa,
    table,
    toy_block,
)
from pipelines.datasets.simulated.interiors import INTERIORS
from pipelines.datasets.simulated.meshes import WHITE, Mesh, box, cylinder, merge, pose, quad
from pipelines.datasets.simulated.people import WARDROBE, walker_mesh
from pipelines.datasets.simulated.textures import SURFACES
from pipelines.datasets.simulated.world import Actor, Light, World
from pipelines.geometry import make_T
from pipelines.types import Array, StereoCamera

Triple = tuple[float, float, float]
FPS = 20.0
_WALL_X, _BACK, _FRONT, _HEIGHT = 3.1, 4.9, -2.4, 2.6


def make_room(frames: int, seed: int, camera: StereoCamera, fps: float = FPS) -> World:
    """The room with a smooth hand-held camera that looks around in it."""
    rng = np.random.default_rng(seed)
    times = np.arange(frames + 1) / fps
    phase = rng.uniform(0, 2 * np.pi, 6)
    return World(
        camera,
        fps,
        _static(rng),
        tuple(_actors(times, phase, rng)),
        _camera_path(times, phase),
        Light(
            (0.22, -1.0, -0.3), (0.52, 0.48, 0.41), (0.8, 0.77, 0.72), (0.72, 0.68, 0.62),
            shadow_texel_m=0.02, shadow_blur_texels=4.0, ceiling_m=-2.3, patch_drop_m=1.1,
            haze_m=None,
        ),
        SURFACES | INTERIORS,
    )  # fmt: skip


def _camera_path(t: Array, phase: Array) -> Array:
    """Poses (N + 1, 4, 4): slow sweeps, and the small sway of a hand on top."""
    x = 0.75 * np.sin(0.42 * t + phase[0]) + 0.02 * np.sin(5.1 * t)
    y = -1.42 + 0.16 * np.sin(0.6 * t + phase[1]) + 0.012 * np.sin(6.3 * t + 1)
    z = -1.0 + 0.55 * np.sin(0.35 * t + phase[2]) + 0.015 * np.sin(4.4 * t + 2)
    yaw = -0.2 * np.sin(0.42 * t + phase[0]) + 0.16 * np.sin(0.73 * t + phase[3])
    pitch = -0.1 + 0.07 * np.sin(0.55 * t + phase[4]) + 0.006 * np.sin(5.7 * t)
    roll = 0.05 * np.sin(0.8 * t + phase[5]) + 0.006 * np.sin(4.9 * t + 1)
    R = Rotation.from_euler("YXZ", np.stack([yaw, pitch, roll], 1)).as_matrix()
    places = np.stack([x, y, z], 1)
    return np.stack([make_T(a, b) for a, b in zip(R, places, strict=True)])


def _tumble(t: Array, centre: Array, sway: Array, spin: Array, phase: float) -> Array:
    """Poses (N + 1, 4, 4) of something that floats around `centre` while it turns."""
    rates = np.array([1.1, 0.9, 0.7])
    places = centre + sway * np.sin(t[:, None] * rates + phase + np.arange(3))
    angles = np.stack([t * spin[0], 0.7 * np.sin(t * spin[1] + phase), t * spin[2]], 1)
    R = Rotation.from_euler("YXZ", angles + phase).as_matrix()
    return np.stack([make_T(a, b) for a, b in zip(R, places, strict=True)])


def _actors(t: Array, phase: Array, rng: np.random.Generator) -> list[Actor]:
    def floating(centre: Triple, sway: Triple, spin: Triple, k: int) -> Array:
        return _tumble(t, np.array(centre), np.array(sway), np.array(spin), phase[k])

    wide = (0.32, 0.14, 0.22)
    parcel, flat = carton((0.34, 0.34, 0.34), "gift", 0.4), (0.32, 0.14, 0.09)
    things: list[tuple[str, Mesh, Array, bool]] = [
        (
            "box",
            carton((0.5, 0.38, 0.42)),
            floating((-0.95, -1.3, 1.9), wide, (0.8, 0.9, 0.35), 1),
            True,
        ),
        ("box", toy_block(), floating((0.75, -1.5, 1.9), wide, (-0.9, 1.1, 0.4), 2), True),
        ("box", parcel, floating((-0.75, -0.62, 2.95), flat, (0.6, 0.7, -0.5), 3), True),
    ]
    things.append(("chair", *_on_the_floor(chair((66, 118, 106)), _pulled_chair(t)), True))
    things.append(
        ("chair", *_on_the_floor(chair(), np.array([pose(0.7, 0, 3.22, 0.15)] * len(t))), False)
    )
    things.append(("ball", ball(), _rolling_ball(t, phase[4]), True))
    walker = walker_mesh(WARDROBE[rng.integers(0, len(WARDROBE))])
    things.append(("person", walker, _walk(t, phase[5], walker), True))
    return [Actor(i + 1, *thing) for i, thing in enumerate(things)]


def _on_the_floor(mesh: Mesh, Ts: Array) -> tuple[Mesh, Array]:
    """The mesh with its origin moved to its box's centre, and its poses moved to match."""
    low, high = mesh.bounds()
    centre = (low + high) / 2
    return mesh.placed(make_T(np.eye(3), -centre)), Ts @ make_T(np.eye(3), centre)


def _pulled_chair(t: Array) -> Array:
    """A chair that is pulled from the table, turned, and after a while pushed back."""
    share = 0.5 - 0.5 * np.cos(np.clip((t - 0.4) / 2.4, 0, None) * np.pi)
    return np.stack([pose(1.05 + 0.35 * s, 0, 1.75 - 0.55 * s, np.pi + 0.9 * s) for s in share])


def _rolling_ball(t: Array, phase: float) -> Array:
    """Rolls to and fro along x without slipping."""
    x = -0.9 + 0.8 * np.sin(0.9 * t + phase)
    R = Rotation.from_euler("Z", (x / 0.22)[:, None]).as_matrix()
    return np.stack([make_T(a, np.array([b, -0.22, 1.2])) for a, b in zip(R, x, strict=True)])


def _walk(t: Array, phase: float, walker: Mesh) -> Array:
    """Walks an oval behind the table at about 0.8 m/s, facing the way of walking."""
    _, high = walker.bounds()
    angle = 0.62 * t + phase
    x, z = 1.5 * np.sin(angle) - 0.2, 4.12 + 0.28 * np.cos(angle)
    heading = np.arctan2(1.5 * np.cos(angle), -0.28 * np.sin(angle))
    bob = 0.02 * np.abs(np.sin(5.2 * t))
    rows = zip(x, bob, z, heading, strict=True)
    return np.stack([pose(a, -high[1] - b, c, d) for a, b, c, d in rows])


def _static(rng: np.random.Generator) -> Mesh:
    parts = [*_shell(), table().placed(pose(0.75, 0, 2.65))]
    parts.append(sofa().placed(pose(-_WALL_X + 0.5, 0, 2.3, -np.pi / 2)))
    parts.append(bookshelf(rng).placed(pose(1.15, 0, _BACK - 0.3)))
    parts.append(bookshelf(rng).placed(pose(2.5, 0, _BACK - 0.3)))
    parts.append(floor_lamp().placed(pose(-2.6, 0, 4.25)))
    parts.append(plant(rng).placed(pose(2.6, 0, 0.9)))
    parts.append(plant(rng).placed(pose(-2.65, 0, 0.7)))
    for x, z, size, turn in (
        (2.45, 3.2, (0.6, 0.45, 0.5), 0.3),
        (2.5, 3.22, (0.4, 0.34, 0.4), 0.7),
    ):
        lift = 0.0 if turn < 0.5 else 0.45
        parts.append(carton(size).placed(pose(x, -lift - size[1] / 2, z, turn)))
    parts.append(carton((0.45, 0.36, 0.42)).placed(pose(2.45, -0.18, 2.55, -0.4)))
    back = ((-1.0, -1.55, "still_life", 0.8, 0.6), (0.1, -1.6, "poster", 0.6, 0.8))
    for x, y, name, w, h in back:
        parts.append(picture(name, w, h).placed(pose(x, y, _BACK)))
    for z, name in ((1.6, "landscape"), (3.0, "abstract")):
        parts.append(picture(name, 0.8, 0.6).placed(pose(-_WALL_X, -1.55, z, -np.pi / 2)))
    rug = [(-1.9, -0.012, 2.5), (0.5, -0.012, 2.5), (0.5, -0.012, 0.8), (-1.9, -0.012, 0.8)]
    parts.append(quad(rug, "rug"))
    return merge(parts)


def _shell() -> list[Mesh]:
    """Walls with skirting, floor, ceiling, window with curtains, door and ceiling lamp."""
    X, B, F, H = _WALL_X, _BACK, _FRONT, _HEIGHT
    cream, green = (236, 224, 200), (176, 194, 176)
    floor = [(-X, 0, B), (X, 0, B), (X, 0, F), (-X, 0, F)]
    parts = [
        quad([(-X, -H, B), (X, -H, B), (X, 0, B), (-X, 0, B)], "wallpaper", green),
        quad([(X, -H, F), (-X, -H, F), (-X, 0, F), (X, 0, F)], "wallpaper", green),
        quad([(-X, -H, F), (-X, -H, B), (-X, 0, B), (-X, 0, F)], "wallpaper", cream),
        quad([(X, -H, B), (X, -H, F), (X, 0, F), (X, 0, B)], "wallpaper", cream),
        quad([(-X, -H, F), (X, -H, F), (X, -H, B), (-X, -H, B)], "plain", (365, 358, 342)),
        quad(floor, "floor_boards", (214, 164, 112)),
    ]
    white = (240, 238, 230)
    for x in (-X, X):
        parts.append(box((0.03, 0.1, B - F), "plain", white, (x, -0.05, (B + F) / 2)))
    parts.append(box((2 * X, 0.1, 0.03), "plain", white, (0, -0.05, B)))
    parts.append(box((2 * X, 0.06, 0.06), "plain", white, (0, -H + 0.03, B)))
    window = quad([(-0.8, -0.7, 0), (0.8, -0.7, 0), (0.8, 0.7, 0), (-0.8, 0.7, 0)], "window_view")
    hung = [window, box((1.8, 0.06, 0.2), "wood", WHITE, (0, 0.74, -0.06))]
    for x in (-0.98, 0.98):
        drape = [
            (x - 0.28, -0.85, -0.1),
            (x + 0.28, -0.85, -0.1),
            (x + 0.25, 1.05, -0.1),
            (x - 0.25, 1.05, -0.1),
        ]
        hung.append(quad(drape, "curtain", (190, 104, 76)))
    hung.append(
        cylinder((-1.4, -0.87, -0.1), (1.4, -0.87, -0.1), (0.02, 0.02), "wood", (120, 84, 56), 8)
    )
    parts.append(merge(hung).placed(pose(X - 0.01, -1.45, 1.9, np.pi / 2)))
    door = [(-0.5, -2.1, 0), (0.5, -2.1, 0), (0.5, 0, 0), (-0.5, 0, 0)]
    parts.append(quad(door, "door", WHITE).placed(pose(-2.1, 0, B - 0.012)))
    parts.append(
        cylinder((0, -H, 2.2), (0, -H + 0.12, 2.2), (0.24, 0.2), "plain", (440, 420, 370), 20)
    )
    return parts
