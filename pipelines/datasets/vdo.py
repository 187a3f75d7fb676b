"""VDO-SLAM's demo layout: images, depth or disparity, flow, masks and object poses in one folder.

Owns this layout and what its settings file leaves unsaid. Decoding is in `files`.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Self

import numpy as np
from numpy.typing import NDArray

from pipelines.datasets.calibration import (
    make_camera,
    number,
    read_settings,
    required,
    settings_size,
)
from pipelines.datasets.depth_form import disparity_share
from pipelines.datasets.file_sequence import (
    FileSequence,
    FrameFiles,
    common_image_size,
    read_optional,
)
from pipelines.datasets.files import DepthCoding, DepthForm, read_depth_values, read_labels
from pipelines.datasets.timestamps import frame_times
from pipelines.datasets.tree import (
    first_folder,
    frame_numbers,
    list_files,
    tree_error,
)
from pipelines.datasets.truth import read_numbered_poses
from pipelines.datasets.vdo_truth import read_object_truth
from pipelines.errors import DatasetError, FrameError
from pipelines.types import GroundTruth

log = logging.getLogger("dyob")
KITTI_FACTOR = 256.0  # KITTI's development kit: disparity PNG = px * 256
KITTI_DATA, OMD_DATA = 2, 1  # VDO-SLAM's ChooseData
MASK_SUFFIXES = (".txt", ".png", ".npy")


class VdoSequence(FileSequence):
    """A folder as VDO-SLAM's example reads it.

    flow/k.flo points from frame k to k + 1, so our frame k + 1 gets it. The depth images of this
    layout come in two forms that nothing in the folder names for sure; see `depth_coding`.
    """

    dataset = "vdo"
    layout = (
        "image_0/ or image/ with 000000.png ..., depth/ (16-bit PNG) or image_1/, "
        "a settings .yaml with Camera.fx ...; optional flow/*.flo, semantic/*.txt or .png, "
        "times.txt, pose_gt.txt, object_pose.txt"
    )

    @classmethod
    def matches(cls, path: Path) -> bool:
        # Truth files are no marks: what is opened may not depend on them.
        marked = any((path / mark).is_dir() for mark in ("semantic", "flow"))
        marked = marked and not (path / "camera.yaml").is_file()
        has_images = first_folder(path, ("image_0", "image")) is not None
        return has_images and (marked or _find_settings(path) is not None)

    @classmethod
    def _open(
        cls,
        root: Path,
        settings: Path | str | None = None,
        depth_form: DepthForm | None = None,
        depth_factor: float | None = None,
        depth_source: str = "files",
        fps: float | None = None,
    ) -> Self:
        """The sequence in `root`.

        settings: the yaml file. depth_form: "disparity" or "metric". depth_factor: see
        `depth_coding`. depth_source: "files", or "stereo" for image_1 in place of depth/.
        """
        folder = first_folder(root, ("image_0", "image"))
        images = list_files(folder) if folder else {}
        if not images:
            raise tree_error(cls.dataset, cls.layout, root, "no images", "Put the images there.")
        source = Path(settings) if settings else _find_settings(root)
        if source is None:
            advice = "Add the settings file, or name it with the option settings."
            raise tree_error(cls.dataset, cls.layout, root, "missing calibration", advice)
        depths, rights = list_files(root / "depth"), list_files(root / "image_1")
        stereo = bool(rights) and (depth_source == "stereo" or not depths)
        if not depths and not stereo:
            advice = "Add one of them, `prepare` can make depth."
            raise tree_error(cls.dataset, cls.layout, root, "no depth and no right images", advice)

        values = read_settings(source)
        fx, fy, cx, cy, bf = required(
            values, [f"Camera.{key}" for key in ("fx", "fy", "cx", "cy", "bf")], source
        )
        size = common_image_size(
            list(images.values()), settings_size(values, source, "Camera."), str(source)
        )
        coding = None
        if not stereo:
            coding = depth_coding(list(depths.values()), values, source, depth_form, depth_factor)
        is_rgbd = number(values, "ChooseData", source) == OMD_DATA
        fps = fps or number(values, "Camera.fps", source)
        return cls(
            root,
            make_camera(size, fx, fy, cx, cy, bf, source, is_rgbd),
            frame_times(root / "times.txt", fps, len(images), root),
            _frame_files(root, images, stereo),
            coding,
            frame_numbers(images),
        )

    def ground_truth(self) -> GroundTruth | None:
        """Truth from pose_gt.txt, and objects from gt_objects.npz or object_pose.txt if there."""
        poses = self.root / "pose_gt.txt"
        if not poses.is_file():
            return None
        Ts_world_camera = read_numbered_poses(poses, self._numbers)
        objects = read_object_truth(
            self.root, self._numbers, self.timestamps_s, Ts_world_camera, self._read_mask
        )
        return GroundTruth(self.timestamps_s, Ts_world_camera, objects)

    def _read_mask(self, index: int) -> NDArray[np.int32] | None:
        labels, size = self._frames[index].labels, (self.camera.width, self.camera.height)
        return read_optional(index, "mask", labels, size, read_labels)


def depth_coding(
    depths: list[Path],
    settings: dict[str, str],
    source: Path,
    form: DepthForm | None = None,
    factor: float | None = None,
) -> DepthCoding:
    """How to read this folder's depth images; `form` and `factor` override the rule.

    A settings file with ChooseData is VDO-SLAM's own: the factor is its DepthMapFactor. One without
    is its predecessor's, whose DepthMapFactor was never used: disparity * 256. ChooseData 2 (KITTI)
    means disparity. Else (1 is the Oxford Multimotion data, of which both forms exist) planes in up
    to six images decide; where they cannot, it is metric, with a warning.
    """
    bf = required(settings, ["Camera.bf"], source)[0]
    data = number(settings, "ChooseData", source)
    if factor is None:
        stated = number(settings, "DepthMapFactor", source)
        factor = KITTI_FACTOR if data is None else stated or KITTI_FACTOR
    if form is None:
        form = "disparity" if data in (None, KITTI_DATA) else _form_of(depths)
    return DepthCoding(form, factor, bf)


def _form_of(depths: list[Path]) -> DepthForm:
    images = []
    for path in depths[:: max(len(depths) // 5, 1)][:6]:
        try:
            images.append(read_depth_values(path))
        except FrameError as error:
            log.warning("%s", error)
    share = disparity_share(images)
    if not share > 0.65 and not share < 0.35:
        log.warning("depth images: metric or disparity? taken as metric; depth_form says otherwise")
    return "disparity" if share > 0.65 else "metric"


def _find_settings(root: Path) -> Path | None:
    """The first .yaml or .yml of the folder that has the line `Camera.fx:`."""
    if not root.is_dir():
        return None
    for path in sorted([*root.glob("*.yaml"), *root.glob("*.yml")]):
        try:
            if "Camera.fx" in read_settings(path):
                return path
        except DatasetError as error:
            log.warning("%s", error)
    return None


def _frame_files(root: Path, images: dict[str, Path], stereo: bool) -> list[FrameFiles]:
    """The files of each frame, by stem; a folder that is absent gives no path at all."""
    flows = root / "flow" if list_files(root / "flow", (".flo",)) else None
    masks = list_files(root / "semantic", MASK_SUFFIXES)
    suffix = next(iter(masks.values())).suffix if masks else ""
    right = next(iter(list_files(root / "image_1").values())).suffix if stereo else ""
    stems = list(images)
    frames = []
    for k, stem in enumerate(stems):
        frames.append(
            FrameFiles(
                image=images[stem],
                image_right=root / "image_1" / f"{stem}{right}" if stereo else None,
                depth=None if stereo else root / "depth" / f"{stem}.png",
                flow_prev_to_curr=flows / f"{stems[k - 1]}.flo" if flows and k > 0 else None,
                labels=root / "semantic" / f"{stem}{suffix}" if masks else None,
            )
        )
    return frames
