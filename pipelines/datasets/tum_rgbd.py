"""TUM RGB-D layout (also Bonn's and 7-Scenes copies in it): lists of images with times.

Owns this layout, its public calibrations and the scale of its depth images. Lens distortion is not
removed: of the published cameras only freiburg1's is strong (some pixels at the border).
"""

from __future__ import annotations

import logging
import re
from pathlib import Path
from typing import Self

import numpy as np

from pipelines.datasets.calibration import (
    CAMERA_YAML,
    RGBD_BF,
    Settings,
    bf_of,
    make_camera,
    number,
    read_camera_yaml,
    read_matrix,
    required,
    settings_size,
)
from pipelines.datasets.file_sequence import FileSequence, FrameFiles, common_image_size
from pipelines.datasets.files import SATURATED, DepthCoding, Size, read_depth_values
from pipelines.datasets.timestamps import associate
from pipelines.datasets.tree import first_file, tree_error
from pipelines.datasets.truth import read_tum_poses
from pipelines.errors import DatasetError, FrameError
from pipelines.types import GroundTruth, StereoCamera

log = logging.getLogger("dyob")
# Published colour camera calibrations (fx, fy, cx, cy) of 640 x 480 images, by part of the path.
PUBLIC_CAMERAS = {
    r"freiburg1|\bfr1": (517.306408, 516.469215, 318.643040, 255.313989),
    r"freiburg2|\bfr2": (520.908620, 521.007327, 325.141442, 249.701764),
    r"freiburg3|\bfr3": (535.433105, 539.212524, 320.106653, 247.632132),
    r"rgbd_bonn": (542.822841, 542.576870, 315.593520, 237.756098),
}
PUBLIC_SIZE = (640, 480)
TUM_SCALE, MILLIMETRE_SCALE = 5000.0, 1000.0  # value of 1 m in a depth image
RANGE_MM = 10_000  # no Kinect-like camera sees farther than 10 m


class TumRgbdSequence(FileSequence):
    """Colour images with registered depth, paired by time."""

    dataset = "tum_rgbd"
    layout = (
        "rgb/ and depth/ (16-bit PNG), associations.txt (`time rgb/x.png time depth/x.png`) or "
        "rgb.txt and depth.txt (`time file`); camera.yaml or camera-intrinsics*color*.txt (3 x 3) "
        "unless freiburg1, 2, 3 or rgbd_bonn is in the path; optional groundtruth.txt"
    )

    @classmethod
    def matches(cls, path: Path) -> bool:
        lists = ("associations.txt", "associate.txt", "rgb.txt")
        return (path / "rgb").is_dir() and any((path / name).is_file() for name in lists)

    @classmethod
    def _open(cls, root: Path, depth_scale: float | None = None, bf: float | None = None) -> Self:
        """The sequence in `root`.

        depth_scale: value of 1 m in the depth images, see `find_depth_scale`. bf: of the virtual
        right camera, px * m; 40 where nothing states it.
        """
        pairs = _read_pairs(root)
        if not pairs:
            missing = "no pairs of colour and depth"
            advice = "Add associations.txt, or rgb.txt and depth.txt, that name existing files."
            raise tree_error(cls.dataset, cls.layout, root, missing, advice)
        times = np.array([t for t, _, _ in pairs])
        images, depths = [image for _, image, _ in pairs], [depth for _, _, depth in pairs]
        if not any(image.is_file() for image in images):
            raise tree_error(
                cls.dataset,
                cls.layout,
                root,
                f"no images, {images[0]} and all others are missing",
                "Put the images there.",
            )
        yaml = root / "camera.yaml"
        settings = read_camera_yaml(yaml) if yaml.is_file() else {}
        size = common_image_size(images, settings_size(settings, yaml), str(yaml))
        camera = cls._camera(root, settings, size, bf)
        scale = depth_scale or number(settings, "depth_scale", yaml)
        scale = scale or find_depth_scale(root, depths)
        frames = [FrameFiles(image, depth=depth) for _, image, depth in pairs]
        return cls(root, camera, times, frames, DepthCoding("metric", scale))

    @classmethod
    def _camera(cls, root: Path, settings: Settings, size: Size, bf: float | None) -> StereoCamera:
        """From camera.yaml, else a 3 x 3 matrix, else the published values."""
        yaml = root / "camera.yaml"
        bf = bf or bf_of(settings, yaml) or RGBD_BF
        if settings:
            fx, fy, cx, cy = required(settings, ("fx", "fy", "cx", "cy"), yaml)
            return make_camera(size, fx, fy, cx, cy, bf, yaml, is_rgbd=True)
        matrix = first_file(
            root, ("camera-intrinsics*color*.txt", "camera-intrinsics.txt", "intrinsics.txt")
        )
        if matrix is not None:
            K = read_matrix(matrix)
            if K.shape != (3, 3):
                raise DatasetError(f"{matrix}: expected a 3 x 3 matrix, found {K.shape}.")
            fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
            return make_camera(size, fx, fy, cx, cy, bf, matrix, is_rgbd=True)
        for pattern, values in PUBLIC_CAMERAS.items():
            if size == PUBLIC_SIZE and re.search(pattern, str(root.resolve())):
                return make_camera(size, *values, bf, root, is_rgbd=True)
        raise tree_error(
            cls.dataset, cls.layout, root, "missing calibration", f"Add {CAMERA_YAML}."
        )

    def ground_truth(self) -> GroundTruth | None:
        path = self.root / "groundtruth.txt"
        if not path.is_file():
            return None
        return GroundTruth(self.timestamps_s, read_tum_poses(path, self.timestamps_s))


def find_depth_scale(root: Path, depths: list[Path]) -> float:
    """Value of 1 m in the depth images: 5000 (TUM, Bonn) or 1000 (millimetres, 7-Scenes).

    TUM's and Bonn's own folders have rgb.txt and depth.txt: 5000. Elsewhere the farthest readings
    (99th percentile) of up to six images decide: beyond 10000 they cannot be millimetres, since no
    such camera sees beyond 10 m, and within 10000 they would be a scene all nearer than 2 m.
    """
    if (root / "depth.txt").is_file() and (root / "rgb.txt").is_file():
        return TUM_SCALE
    farthest = 0.0
    for path in depths[:: max(len(depths) // 5, 1)][:6]:
        try:
            values = read_depth_values(path)
        except FrameError as error:
            log.warning("%s", error)
            continue
        known = values[(values > 0) & (values < SATURATED)]
        if known.size:
            farthest = max(farthest, float(np.percentile(known, 99)))
    return TUM_SCALE if farthest > RANGE_MM else MILLIMETRE_SCALE


def _read_pairs(root: Path) -> list[tuple[float, Path, Path]]:
    """Time, colour and depth file of each frame, in order of time."""
    listed = first_file(root, ("associations.txt", "associate.txt"))
    if listed is not None:
        rows = _read_list(listed, 4)
        pairs = [(float(r[0]), root / r[1], root / r[3]) for r in rows]
    elif (root / "rgb.txt").is_file() and (root / "depth.txt").is_file():
        colours, depths = _read_list(root / "rgb.txt", 2), _read_list(root / "depth.txt", 2)
        times = np.array([float(r[0]) for r in colours])
        partner = associate(times, np.array([float(r[0]) for r in depths]))
        pairs = [
            (float(r[0]), root / r[1], root / depths[j][1])
            for r, j in zip(colours, partner, strict=True)
            if j >= 0
        ]
    else:
        return []
    pairs.sort(key=lambda pair: pair[0])
    return [pair for i, pair in enumerate(pairs) if i == 0 or pair[0] > pairs[i - 1][0]]


def _read_list(path: Path, n_words: int) -> list[list[str]]:
    rows = []
    for n, line in enumerate(path.read_text().splitlines(), start=1):
        words = line.split("#", 1)[0].replace(",", " ").split()
        if not words:
            continue
        try:
            for word in words[::2]:
                float(word)
            complete = len(words) >= n_words
        except ValueError:
            complete = False
        if not complete:
            raise DatasetError(
                f"{path}, line {n}: expected {'time file ' * (n_words // 2)}, found {line!r}."
            )
        rows.append(words)
    return rows
