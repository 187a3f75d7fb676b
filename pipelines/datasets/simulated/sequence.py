"""`SimulatedSequence`: a rendered scene behind the same door as real data.

Owns the way from a spec such as `simulated:street` to frames: the first opening renders and caches
everything, later ones only read. Rendering is in `renderer.py`, faults are in `degrade.py`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable
from dataclasses import asdict
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.sequence import Sequence
from pipelines.datasets.simulated.cache import (
    cache_root,
    ensure_folder,
    frame_file,
    read_arrays,
    write_arrays,
)
from pipelines.datasets.simulated.degrade import (
    Degradation,
    computed_flow,
    exposure_gain,
    noisy_flow,
    worn_depth,
    worn_image,
    worn_masks,
)
from pipelines.datasets.simulated.motion import blur_along, rigid_flow
from pipelines.datasets.simulated.scenes import Scene, find_scene, scaled_camera
from pipelines.errors import ConfigError, FrameError
from pipelines.geometry import invert_T, make_T
from pipelines.types import Array, Frame, GroundTruth, Image, ObjectTruth

VERSION = 4  # of what the same scene and seed look like: raise it when that changes
INPUTS = ("depth", "flow", "masks", "right")
Progress = Callable[[int, int], None]
_FLOW_STEP_PX = 1 / 64  # computed flow is stored in these units, far below its errors


class SimulatedSequence(Sequence):
    """A rendered sequence with exact truth; its inputs are exact too, or degraded."""

    dataset = "simulated"
    layout = (
        "no folder: a scene that the project renders itself, written simulated:NAME with NAME one "
        "of street, crossing, loop, long, room, static, demo or kitti_0000 to kitti_0020, and kept "
        "under .cache/simulated or $DYOB_CACHE/simulated; kitti_NNNN replays the ego path and "
        "traffic of KITTI tracking from your own label_02/NNNN.txt, calib/NNNN.txt and "
        "orbslam3_poses/NNNN/CameraTrajectory.txt in the folder that $DYOB_KITTI_TRACKING names"
    )

    def __init__(
        self,
        spec: str = "demo",
        *,
        frames: int | None = None,
        seed: int = 0,
        noise_seed: int | None = None,
        degrade: str | Iterable[str] | Degradation | None = None,
        provide: str | Iterable[str] = ("depth", "flow", "masks"),
        scale: float = 1.0,
        cache: Path | str | None = None,
        labels: Path | str | None = None,
        progress: Progress | None = None,
    ) -> None:
        """Open, and at first render, a scene.

        spec: name of the scene, with or without `simulated:`. frames, scale: length, and size as
        a share of the scene's own. seed: of the scene and of its faults, unless noise_seed gives
        the same scene other faults. degrade: see `Degradation.of`. provide: which of depth, flow,
        masks and right the frames bring. labels: for kitti_NNNN, the folder of KITTI tracking's
        labels; $DYOB_KITTI_TRACKING where None. progress: called with (done, total) frames of each
        stage that is rendered: left, right, degraded.
        Raises DatasetError for an unknown scene or missing labels, ConfigError for a bad option.
        """
        self._scene: Scene = find_scene(_scene_name(spec), labels)
        self._frames = self._scene.frames if frames is None else int(frames)
        self._seed, self._progress = int(seed), progress
        self._noise_seed = self._seed if noise_seed is None else int(noise_seed)
        self._provide = _inputs(provide)
        if self._frames < 1 or not 0.05 <= scale <= 4 or min(self._seed, self._noise_seed) < 0:
            raise ConfigError(
                "a simulated sequence needs frames >= 1, seed >= 0 and 0.05 <= scale <= 4, "
                f"found frames={frames}, seed={seed}, scale={scale}"
            )
        if self._scene.most_frames is not None and self._frames > self._scene.most_frames:
            raise ConfigError(
                f"{self._scene.name} has {self._scene.most_frames} frames, found "
                f"frames={self._frames}: ask for fewer"
            )
        self.camera = scaled_camera(self._scene.camera, scale)
        self.timestamps_s = np.arange(self._frames) / self._scene.fps
        self._how = Degradation.of(degrade, self._scene.indoors)
        self.name = self._scene.name + ("-degraded" if self._how.any else "")
        self._key: dict[str, Any] = {
            "version": VERSION,
            "scene": self._scene.name,
            "frames": self._frames,
            "seed": self._seed,
            "camera": asdict(self.camera),
        }
        if self._scene.made_of:
            self._key["made_of"] = self._scene.made_of
        base = cache_root() if cache is None else Path(cache)
        self._exact = self._folder(base, "exact", {}, self._render_left)
        self.root = self._exact
        self._right: Path | None = None
        self._counts: NDArray[np.int64] | None = None
        self._worn: Path | None = None
        if "right" in self._provide:
            self._right = self._folder(base, "right", {"right": True}, self._render_right)
        if self._how.any:
            faults = {"degrade": self._how.stored(), "right": "right" in self._provide}
            if self._noise_seed != self._seed:
                faults["noise_seed"] = self._noise_seed
            self._worn = self._folder(base, "degraded", faults, self._wear)
            self.root = self._worn
        self.__dict__.pop("_renderer", None)  # its textures and rays take 200 MB

    @classmethod
    def open(cls, path_or_spec: str | Path, **options: Any) -> SimulatedSequence:
        """The sequence of a spec such as `simulated:street`; options as of the constructor."""
        return cls(str(path_or_spec), **options)

    @staticmethod
    def matches(path: str | Path) -> bool:
        """Whether a path given by a user names a simulated scene rather than a folder."""
        text = str(path)
        return text == "simulated" or text.startswith("simulated:")

    def read(self, index: int) -> Frame:
        """Frame `index` with the inputs chosen by `provide`; a damaged file is rendered again."""
        if not 0 <= index < len(self):
            raise IndexError(f"expected a frame from 0 to {len(self) - 1}, found {index}")
        exact = self._left(index)
        worn = {} if self._worn is None else self._worn_arrays(self._worn, index)
        found = exact | worn
        right = flow = None
        if "right" in self._provide:
            assert self._right is not None
            right = worn.get("image_right")
            if right is None:
                right = self._right_arrays(index)["image"]
        if "flow" in self._provide and index > 0:
            if "flow" in worn:
                flow = worn["flow"].astype(np.float32) * np.float32(_FLOW_STEP_PX)
            else:
                flow = self._exact_flow(index - 1)
            flow = noisy_flow(flow, self._how, self._rng(index, 5))
        labels = found["labels"].astype(np.int32) if "masks" in self._provide else None
        return Frame(
            index,
            float(self.timestamps_s[index]),
            found["image"],
            right,
            found["depth"] if "depth" in self._provide else None,
            flow,
            labels,
            None if labels is None else self._classes(labels),
        )

    def ground_truth(self) -> GroundTruth:
        """Exact camera and object poses; the world is the first camera.

        Boxes are the first and last pixel columns and rows that an object is seen in. Objects have
        rows for the frames in which they are there, seen or not.
        """
        truth = self._truth
        N, A = self._frames, len(truth["object_id"])
        # Only what may be absent has `present`: most scenes' objects are always there.
        present = truth.get("present", np.ones((N, A), bool))[:N]
        frame, row = np.nonzero(present)
        objects = ObjectTruth(
            frame,
            truth["object_id"][row],
            truth["class_name"][row],
            truth["Ts_world_object"][frame, row],
            truth["boxes_px"][frame, row],
            truth["moving"][row],
            self._pixel_counts(truth["object_id"])[frame, row],
        )
        noise = self._how.known_noise(self._provide)
        return GroundTruth(self.timestamps_s.copy(), truth["Ts_world_camera"][:N], objects, noise)

    def _pixel_counts(self, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """(N, A) pixels that each object is seen in; counted once, when the truth is asked for."""
        if self._counts is None:
            counts = np.zeros((self._frames, max(ids, default=0) + 1), np.int64)
            for index in range(self._frames):
                labels = self._left(index)["labels"].ravel()
                counts[index] = np.bincount(labels, minlength=counts.shape[1])[: counts.shape[1]]
            self._counts = counts[:, ids]
        return self._counts

    def _folder(
        self, base: Path, kind: str, extra: dict[str, Any], make: Callable[[Path], None]
    ) -> Path:
        key = self._key | extra
        digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:10]
        name = f"{self._scene.name}-{self._frames}f-seed{self._seed}-{kind}-{digest}"
        return ensure_folder(base / name, key, make)

    @cached_property
    def _renderer(self) -> Any:
        from pipelines.datasets.simulated.renderer import Renderer

        return Renderer(self._scene.make(self._frames, self._seed, self.camera))

    @cached_property
    def _truth(self) -> dict[str, NDArray]:
        return read_arrays(self._exact / "truth.npz")

    @cached_property
    def _class_names(self) -> dict[int, str]:
        truth = self._truth
        return dict(zip(truth["object_id"].tolist(), truth["class_name"].tolist(), strict=True))

    def _classes(self, labels: NDArray[np.int32]) -> dict[int, str]:
        """Class names of the labels in a frame, which a detector would know as well."""
        seen = np.flatnonzero(np.bincount(labels.ravel()))
        return {label: self._class_names[label] for label in seen.tolist() if label}

    def _tell(self, index: int) -> None:
        if self._progress is not None:
            self._progress(index + 1, self._frames)

    def _render_left(self, folder: Path) -> None:
        boxes = []
        for index in range(self._frames):
            boxes.append(self._write_left(folder, index))
            self._tell(index)
        world = self._renderer.world
        presence = {}
        if any(a.present is not None for a in world.actors):
            there = [[a.is_present(k) for a in world.actors] for k in range(self._frames)]
            presence["present"] = np.array(there, bool)
        write_arrays(
            folder / "truth.npz",
            **presence,
            object_id=np.array([a.object_id for a in world.actors], np.int64),
            class_name=np.array([a.class_name for a in world.actors], str),
            moving=np.array([a.moving for a in world.actors], bool),
            Ts_world_camera=world.Ts_world_camera(),
            Ts_world_object=_stacked(
                [world.Ts_world_object(a) for a in world.actors], self._frames
            ),
            boxes_px=np.stack(boxes),
        )

    def _write_left(self, folder: Path, index: int) -> Array:
        """Render one frame into `folder`; boxes (A, 4) of what is seen of each object."""
        view = self._renderer.render(index)
        ids = [actor.object_id for actor in self._renderer.world.actors]
        smallest = np.uint8 if max(ids, default=0) < 256 else np.uint16
        write_arrays(
            frame_file(folder, index),
            image=view.image,
            depth=view.depth_m,
            labels=view.labels.astype(smallest),
        )
        return _boxes_px(view.labels, ids)

    def _render_right(self, folder: Path) -> None:
        for index in range(self._frames):
            self._write_right(folder, index)
            self._tell(index)

    def _write_right(self, folder: Path, index: int) -> None:
        view = self._renderer.render(index, right=True)
        # Its depth serves motion blur alone: half precision is plenty.
        depth = np.minimum(view.depth_m, 6e4).astype(np.float16)
        labels = view.labels.astype(np.uint16)
        write_arrays(frame_file(folder, index), image=view.image, depth=depth, labels=labels)

    def _left(self, index: int) -> dict[str, NDArray]:
        try:
            return read_arrays(frame_file(self._exact, index))
        except FrameError:
            self._write_left(self._exact, index)
            return read_arrays(frame_file(self._exact, index))

    def _right_arrays(self, index: int) -> dict[str, NDArray]:
        assert self._right is not None
        try:
            return read_arrays(frame_file(self._right, index))
        except FrameError:
            self._write_right(self._right, index)
            return read_arrays(frame_file(self._right, index))

    def _worn_arrays(self, folder: Path, index: int) -> dict[str, NDArray]:
        try:
            return read_arrays(frame_file(folder, index))
        except FrameError:
            self._write_worn(folder, index)
            return read_arrays(frame_file(folder, index))

    def _motions(self, index: int, right: bool = False) -> dict[int, Array]:
        """By label, what takes points from camera `index` to camera `index + 1`."""
        truth = self._truth
        Ts, objects = truth["Ts_world_camera"], truth["Ts_world_object"]
        a, b = Ts[index], Ts[index + 1]
        if right:
            shift = make_T(np.eye(3), np.array([self.camera.baseline_m, 0, 0]))
            a, b = a @ shift, b @ shift
        H = objects[index + 1] @ invert_T(objects[index])
        motions = {int(i): invert_T(b) @ h @ a for i, h in zip(truth["object_id"], H, strict=True)}
        return motions | {0: invert_T(b) @ a}

    def _exact_flow(self, index: int) -> NDArray[np.float32]:
        """True flow from frame `index` to the next, on the grid of `index`."""
        found = self._left(index)
        return rigid_flow(self.camera, found["depth"], found["labels"], self._motions(index))

    def _wear(self, folder: Path) -> None:
        previous: Image | None = None
        for index in range(self._frames):
            previous = self._write_worn(folder, index, previous)
            self._tell(index)

    def _write_worn(self, folder: Path, index: int, previous: Image | None = None) -> Image:
        """Write the degraded inputs of one frame; returns its degraded picture."""
        how, exact = self._how, self._left(index)
        arrays: dict[str, NDArray] = {}
        image = self._worn_picture(index)
        if how.touches_image:
            arrays["image"] = image
            if "right" in self._provide:
                arrays["image_right"] = self._worn_picture(index, right=True)
        if how.touches_depth:
            arrays["depth"] = worn_depth(exact["depth"], self.camera, how, self._rng(index, 1))
        if how.touches_masks:
            labels = worn_masks(exact["labels"].astype(np.int32), how, self._rng(index, 2))
            arrays["labels"] = labels.astype(exact["labels"].dtype)
        if how.computed_flow and index > 0:
            if previous is None:
                previous = self._worn_picture(index - 1)
            flow = np.round(computed_flow(previous, image) / _FLOW_STEP_PX)
            arrays["flow"] = np.clip(flow, -32767, 32767).astype(np.int16)
        write_arrays(frame_file(folder, index), **arrays)
        return image

    def _worn_picture(self, index: int, right: bool = False) -> Image:
        how = self._how
        found = self._right_arrays(index) if right else self._left(index)
        image: Image = found["image"]
        if how.blur_share > 0:
            depth = found["depth"].astype(np.float32)
            motions = self._motions(index, right)
            flow = rigid_flow(self.camera, depth, found["labels"], motions)
            image = blur_along(image, flow, how.blur_share)
        if how.touches_image:
            gain = float(exposure_gain(self.timestamps_s, how, self._noise_seed)[index])
            image = worn_image(image, gain, how, self._rng(index, 4 if right else 3))
        return image

    def _rng(self, index: int, purpose: int) -> np.random.Generator:
        return np.random.default_rng([self._noise_seed, index, purpose])


def _scene_name(spec: str) -> str:
    """`simulated:street` and `street` are the same scene; `simulated` alone is the demo."""
    name = spec.removeprefix("simulated").removeprefix(":")
    return name or "demo"


def _inputs(provide: str | Iterable[str]) -> frozenset[str]:
    chosen = provide.split(",") if isinstance(provide, str) else provide
    names = frozenset(name.strip() for name in chosen) - {""}
    unknown = sorted(names - set(INPUTS))
    if unknown:
        raise ConfigError(f"unknown input '{unknown[0]}': use some of {', '.join(INPUTS)}")
    return names


def _stacked(paths: list[Array], frames: int) -> Array:
    """Poses (N + 1, A, 4, 4) of A paths (N + 1, 4, 4), of which there may be none."""
    return np.stack(paths, 1) if paths else np.empty((frames + 1, 0, 4, 4))


def _boxes_px(labels: NDArray[np.int32], ids: list[int]) -> Array:
    """Boxes (A, 4) x1 y1 x2 y2 of the labels `ids`, NaN where a label is not seen."""
    from scipy.ndimage import find_objects

    windows = find_objects(labels, max_label=max(ids, default=0))
    boxes = np.full((len(ids), 4), np.nan)
    for row, label in enumerate(ids):
        window = windows[label - 1]
        if window is not None:
            y, x = window
            boxes[row] = x.start, y.start, x.stop - 1, y.stop - 1
    return boxes
