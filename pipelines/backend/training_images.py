"""The images a vocabulary is learned from, and their descriptors.

Owns the choice for the shipped vocabulary: rendered scenes and painted leaves, both made here, so
that nobody else's licence rests on it. Knows nothing of clustering.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np

from pipelines.backend.vocabulary import Descriptors
from pipelines.config import OrbConfig
from pipelines.datasets import matching_datasets, open_sequence
from pipelines.datasets.files import IMAGE_SUFFIXES, read_image
from pipelines.datasets.tree import list_files
from pipelines.depth import to_gray
from pipelines.frontend.orb import OrbExtractor
from pipelines.frontend.view import normalise_contrast
from pipelines.types import Image

_SCENES = ("room", "street", "crossing")
_SEEDS = (11, 12, 13, 14)  # the tests' and the demo's scenes are others
_FRAMES, _STRIDE = 24, 2
_FAULTS = "blur,exposure,noise"
_N_PAINTED = 300
_PAINTED_PX = (640, 480)  # width, height
_LEAVES = 2500  # of a painted image
_LEAF_RADIUS_PX = (3.0, 200.0)


def descriptors_of(images: Iterable[Image], config: OrbConfig) -> list[Descriptors]:
    """ORB descriptors (N, 32) of each image, found as those of tracked frames are.

    Images (H, W) or (H, W, 3) RGB, uint8.
    """
    orb = OrbExtractor(config)
    grays = (to_gray(image) for image in images)
    return [orb.extract(g, detect_on=normalise_contrast(g)).descriptors for g in grays]


def images_of(source: str, stride: int = 1) -> Iterator[Image]:
    """Every `stride`-th image of an image file, a folder of images, or a sequence.

    source: also `simulated:NAME`. Raises DatasetError where there is nothing of the kind.
    """
    path = Path(source).expanduser()
    if path.is_file() and path.suffix.lower() in IMAGE_SUFFIXES:
        yield read_image(path)
        return
    if path.is_dir() and not matching_datasets(path):
        plain = list(list_files(path).values())
        if plain:
            yield from (read_image(file) for file in plain[::stride])
            return
    sequence = open_sequence(source)
    yield from (sequence.read(k).image for k in range(0, len(sequence), stride))


def own_images() -> Iterator[Image]:
    """What the shipped vocabulary is learned from; rendering takes some minutes at first."""
    for scene in _SCENES:
        for seed in _SEEDS:
            for faults in (None, _FAULTS):
                sequence = open_sequence(
                    f"simulated:{scene}",
                    seed=seed,
                    frames=_FRAMES,
                    degrade=faults,
                    provide=("depth",),
                )
                yield from (sequence.read(k).image for k in range(0, _FRAMES, _STRIDE))
    yield from (paint_leaves(seed) for seed in range(_N_PAINTED))


def paint_leaves(seed: int) -> Image:
    """A grey image (H, W) of shapes that lie over each other like fallen leaves.

    Their sizes follow the inverse cube law, which gives edges and corners the statistics that they
    have in photographs (Lee, Mumford and Huang, Occlusion models for natural images, 2001); so
    words come out of it that the few textures of the rendered scenes do not have.
    """
    rng = np.random.default_rng(seed)
    W, H = _PAINTED_PX
    image = np.full((H, W), 128, np.uint8)
    least, most = (radius**-2.0 for radius in _LEAF_RADIUS_PX)
    radii_px = (least - rng.random(_LEAVES) * (least - most)) ** -0.5
    for radius_px in radii_px:
        _paint_leaf(image, rng, radius_px)
    blurred = cv2.GaussianBlur(image, (0, 0), rng.uniform(0.6, 1.4)).astype(np.float32)
    light = rng.uniform(0.4, 1.6, (4, 5)).astype(np.float32)
    light = cv2.resize(light, (W, H), interpolation=cv2.INTER_CUBIC)
    noise = rng.normal(0.0, rng.uniform(1.0, 4.0), (H, W))
    return np.clip((0.6 * blurred + 30.0) * light + noise, 0, 255).astype(np.uint8)


def _paint_leaf(image: Image, rng: np.random.Generator, radius_px: float) -> None:
    """Draw one shape of random kind, place and brightness into the image."""
    H, W = image.shape
    centre_px = rng.uniform((-50.0, -50.0), (W + 50.0, H + 50.0))
    brightness = int(rng.integers(0, 256))
    kind = rng.choice(("disc", "ellipse", "rectangle", "polygon"))
    if kind in ("disc", "ellipse"):
        longer, shorter = (1.0, 1.0) if kind == "disc" else (2.0, 0.6)
        steps = np.linspace(0.0, 2 * np.pi, 40, endpoint=False)
        outline = np.column_stack([longer * np.cos(steps), shorter * np.sin(steps)])
    else:
        n_corners = 4 if kind == "rectangle" else int(rng.integers(3, 7))
        angles = np.sort(rng.uniform(0.0, 2 * np.pi, n_corners))
        if kind == "rectangle":
            half = rng.uniform(0.3, 0.8)
            angles = np.array([half, np.pi - half, np.pi + half, -half])
        outline = np.column_stack([np.cos(angles), np.sin(angles)])
    # Much of what people build stands upright.
    turn = rng.uniform(0.0, 2 * np.pi) if rng.random() < 0.5 or kind == "ellipse" else 0.0
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    corners = np.rint(16.0 * (centre_px + radius_px * outline @ R.T)).astype(np.int32)
    cv2.fillPoly(image, [corners], brightness, cv2.LINE_AA, 4)
