"""Own data: a folder of images with depth or right images, and a camera.yaml.

Owns this layout. Decoding is in `files`, the yaml's keys in `calibration`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Self

from pipelines.datasets.calibration import (
    CAMERA_YAML,
    RGBD_BF,
    bf_of,
    depth_coding_of,
    make_camera,
    number,
    read_camera_yaml,
    required,
    settings_size,
)
from pipelines.datasets.file_sequence import FileSequence, FrameFiles, common_image_size
from pipelines.datasets.timestamps import frame_times
from pipelines.datasets.tree import first_folder, list_files, tree_error
from pipelines.datasets.truth import read_tum_poses
from pipelines.errors import DatasetError
from pipelines.io.files import read_json
from pipelines.types import GroundTruth

IMAGE_FOLDERS = ("images", "left", "image", "rgb", "color")
DEPTH_SUFFIXES = (".png", ".npy")
FLOW_SUFFIXES = (".flo", ".npy")
MASK_SUFFIXES = (".png", ".npy", ".txt")
PREPARED = "prepared.json"  # written by prepare: kind of file -> the settings that made it
LISTS = ("associations.txt", "associate.txt", "rgb.txt")  # of tum_rgbd


class FolderSequence(FileSequence):
    """Own recordings: images in order of their numbers, all else in files of the same stem."""

    dataset = "folder"
    layout = (
        "images/ (or left/, image/, rgb/, color/), depth/ (16-bit PNG or .npy in metres) or "
        "right/, camera.yaml; optional times.txt, flow/ (.flo or .npy; that of frame k, by its "
        "name, leads to k + 1), masks/ (.png, .npy or .txt of labels, with .json of the same name "
        'for their classes: {"1": {"class": "car", "score": 0.9}}), groundtruth.txt (TUM)'
    )

    @classmethod
    def matches(cls, path: Path) -> bool:
        if first_folder(path, IMAGE_FOLDERS) is None:
            return False
        if any((path / name).is_file() for name in LISTS):
            return False
        if (path / "camera.yaml").is_file():
            return True
        foreign = (path / "semantic").is_dir() or any(path.glob("*.y*ml"))
        return not foreign and any((path / other).is_dir() for other in ("depth", "right"))

    @classmethod
    def _open(
        cls,
        root: Path,
        depth_scale: float | None = None,
        fps: float | None = None,
        prepared: bool = True,
    ) -> Self:
        """The sequence in `root`.

        depth_scale, fps: override camera.yaml. prepared: False leaves out what `prepare` has made.
        """
        folder = first_folder(root, IMAGE_FOLDERS)
        images = list_files(folder) if folder else {}
        if not images:
            raise tree_error(cls.dataset, cls.layout, root, "no images", "Put the images there.")
        yaml = root / "camera.yaml"
        if not yaml.is_file():
            advice = f"Add {CAMERA_YAML}."
            raise tree_error(cls.dataset, cls.layout, root, "missing calibration", advice)
        hidden = set() if prepared else prepared_kinds(root)
        depths = {} if "depth" in hidden else list_files(root / "depth", DEPTH_SUFFIXES)
        rights = list_files(root / "right")
        if not depths and not rights:
            advice = "Add one of them: one camera alone has no scale."
            raise tree_error(cls.dataset, cls.layout, root, "no depth and no right images", advice)
        settings = read_camera_yaml(yaml)
        fx, fy, cx, cy = required(settings, ("fx", "fy", "cx", "cy"), yaml)
        bf = bf_of(settings, yaml)
        if bf is None and depths:
            rights = {}  # images of a second camera that nobody measured
        if bf is None and rights:
            raise DatasetError(
                f"{yaml}: missing calibration, expected bf (px * m) or baseline_m of the stereo "
                "pair, found neither; add one."
            )
        size = common_image_size(list(images.values()), settings_size(settings, yaml), str(yaml))
        is_rgbd = bf is None  # a baseline that is stated is that of a real pair
        camera = make_camera(size, fx, fy, cx, cy, bf or RGBD_BF, yaml, is_rgbd)
        fps = fps or number(settings, "fps", yaml)
        times_s = frame_times(root / "times.txt", fps, len(images), root)
        coding = depth_coding_of(depths.values(), settings, camera.bf, yaml, depth_scale)
        frames = _frame_files(root, images, depths, rights, hidden)
        return cls(root, camera, times_s, frames, coding)

    def ground_truth(self) -> GroundTruth | None:
        path = self.root / "groundtruth.txt"
        if not path.is_file():
            return None
        return GroundTruth(self.timestamps_s, read_tum_poses(path, self.timestamps_s))


def prepared_kinds(root: Path) -> set[str]:
    """Kinds of files in `root` (depth, flow, masks) that `prepare` has made."""
    path = root / PREPARED
    return set(read_json(path)) if path.is_file() else set()


def _frame_files(
    root: Path,
    images: dict[str, Path],
    depths: dict[str, Path],
    rights: dict[str, Path],
    hidden: set[str],
) -> list[FrameFiles]:
    """Files by stem; one that is absent from a kind that others have gets a path all the same.

    But where there are right images too, a frame without depth has its right image.
    """
    flows = {} if "flow" in hidden else list_files(root / "flow", FLOW_SUFFIXES)
    masks = {} if "masks" in hidden else list_files(root / "masks", MASK_SUFFIXES)
    stems = list(images)

    def file_of(found: dict[str, Path], stem: str) -> Path | None:
        if not found:
            return None
        example = next(iter(found.values()))
        return found.get(stem, example.with_name(stem + example.suffix))

    frames = []
    for k, stem in enumerate(stems):
        by_stereo = bool(rights) and stem not in depths
        mask = file_of(masks, stem)
        frames.append(
            FrameFiles(
                image=images[stem],
                image_right=file_of(rights, stem) if by_stereo else None,
                depth=None if by_stereo else file_of(depths, stem),
                flow_prev_to_curr=file_of(flows, stems[k - 1]) if k > 0 else None,
                labels=mask,
                classes=mask.with_suffix(".json") if mask else None,
            )
        )
    return frames
