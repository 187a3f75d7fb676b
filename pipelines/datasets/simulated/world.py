"""The description of a simulated world: what stands still, what moves and how, and the light.

Owns the nouns that scenes make and the renderer reads; the true poses come from here alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.simulated.meshes import Mesh
from pipelines.datasets.simulated.textures import Texture
from pipelines.geometry import invert_T
from pipelines.types import Array, StereoCamera


@dataclass(frozen=True, slots=True)
class Actor:
    """An instance of a movable class.

    object_id: its label, 1 to 255. mesh: in its own frame. Ts_scene_object: (N + 1, 4, 4), one
    more than there are frames. moving: whether it ever moves in the sequence. present: (N + 1,)
    frames in which it is there at all, None for always; its poses run on beyond, so that the flow
    out of its last frame is that of its motion.
    """

    object_id: int
    class_name: str
    mesh: Mesh
    Ts_scene_object: Array
    moving: bool
    present: NDArray[np.bool_] | None = None

    def is_present(self, index: int) -> bool:
        """Whether the actor is there in frame `index`."""
        return self.present is None or bool(self.present[index])


@dataclass(frozen=True, slots=True)
class Light:
    """One far lamp and what comes from all around; colours are RGB factors.

    towards: (3,) direction to the lamp in the scene. lamp, above, below: its colour, and that of
    the light from the sky and back from the ground. shadow_texel_m, shadow_blur_texels: sharpness
    of the shadows of what stands still. ceiling_m: whatever lies above this height (y below it)
    casts no shadow. patch_drop_m: how far below a movable thing its dark patch reaches.
    haze_m: distance at which the air hides 63 %, None indoors.
    """

    towards: tuple[float, float, float]
    lamp: tuple[float, float, float]
    above: tuple[float, float, float]
    below: tuple[float, float, float]
    shadow_texel_m: float = 0.08
    shadow_blur_texels: float = 1.2
    ceiling_m: float = -np.inf
    patch_drop_m: float = 0.35
    haze_m: float | None = 420.0


@dataclass(frozen=True, slots=True)
class World:
    """Everything of one sequence in the scene's own axes (y down, ground at y = 0).

    Ts_scene_camera: (N + 1, 4, 4), one pose more than frames, so that motion blur has an end.
    reach_m: actors farther away than this are not drawn.
    """

    camera: StereoCamera
    fps: float
    static: Mesh
    actors: tuple[Actor, ...]
    Ts_scene_camera: Array
    light: Light
    textures: dict[str, Callable[[np.random.Generator], Texture]]
    sky: str | None = None
    reach_m: float = 150.0

    @property
    def n_frames(self) -> int:
        return len(self.Ts_scene_camera) - 1

    def Ts_world_camera(self) -> Array:
        """Camera poses (N + 1, 4, 4); the world is the first camera."""
        return invert_T(self.Ts_scene_camera[0]) @ self.Ts_scene_camera

    def Ts_world_object(self, actor: Actor) -> Array:
        """Poses (N + 1, 4, 4) of an actor; the world is the first camera."""
        return invert_T(self.Ts_scene_camera[0]) @ actor.Ts_scene_object
