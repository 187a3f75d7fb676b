"""How depth, flow and masks of one frame come about when `prepare` writes them.

Owns which method makes each kind of file, and the settings that a file depends on. The methods are
those of a run; the order of the work is in `prepare`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.config import Config, DepthConfig, DetectorConfig, FlowConfig
from pipelines.datasets.file_sequence import FileSequence
from pipelines.datasets.files import SATURATED
from pipelines.datasets.sequence import Sequence
from pipelines.depth import StereoDepth, to_gray
from pipelines.object_types import UNNAMED_CLASS, Detections
from pipelines.prepared_folder import DATA_FILES, PreparedFolder, set_camera_key
from pipelines.types import Frame, StereoCamera

DISPARITY_SCALE = 256.0  # value of 1 px in a depth image, as KITTI has it


@dataclass(frozen=True, slots=True)
class Step:
    """How one kind of file comes about. settings: what it depends on, for the record.

    there: whether the file of a frame is there. write: (index, frame, next frame or None), writes
    the file and says whether it could. needs_next: whether the frame after is needed, as for flow.
    """

    kind: str
    settings: dict[str, Any]
    there: Callable[[int], bool]
    write: Callable[[int, Frame, Frame | None], bool]
    needs_next: bool = False


class LeftOutError(Exception):
    """A kind of file that is not made; its message is the reason. `prepare` turns it into words."""


def step_for(
    kind: str,
    folder: PreparedFolder,
    sequence: Sequence,
    config: Config,
    given: bool,
    detector: Any,
) -> Step:
    """The step that makes `kind`; raises LeftOutError with the reason where there is none."""
    if given and folder.in_place:
        raise LeftOutError("comes with the data")
    if kind == "depth":
        make = _given_depth(folder, sequence) if given else None
        return make or _stereo_depth(folder, sequence.camera, config.depth)
    if kind == "flow":
        return _flow(folder, config.flow, given)
    return _masks(folder, config.detector, given, detector)


def _stereo_depth(folder: PreparedFolder, camera: StereoCamera, config: DepthConfig) -> Step:
    """Disparities of the stereo matcher, with the fraction that 16 bits leave for the range."""
    stereo, search_px = StereoDepth(config, camera), config.sgbm_num_disparities
    scale = DISPARITY_SCALE
    while scale * (search_px + 16) >= SATURATED:  # the search is rounded up to 16
        scale /= 2
    settings = {
        "method": "sgbm",
        "sgbm_num_disparities": search_px,
        "sgbm_block_size": config.sgbm_block_size,
        "left_right_max_px": config.left_right_max_px,
    }

    def write(index: int, frame: Frame, _: Frame | None) -> bool:
        if frame.image_right is None:
            return False
        # Before the first image, so that a folder left half-way can be opened.
        set_camera_key(folder.root / "camera.yaml", "disparity_scale", scale)
        folder.write_disparity(index, stereo.disparity(frame.image, frame.image_right), scale)
        return True

    return Step("depth", settings, lambda index: folder.has("depth", index), write)


def _given_depth(folder: PreparedFolder, sequence: Sequence) -> Step:
    """The sequence's own depth files with their coding; else its metres, exactly."""
    coding = sequence.depth_coding if isinstance(sequence, FileSequence) else None
    if coding is not None and coding.form == "disparity" and sequence.camera.is_rgbd:
        coding = None  # its bf is not the new folder's

    def source(index: int) -> Path | None:
        known = coding is not None and isinstance(sequence, FileSequence)
        return sequence.files(index).depth if known else None  # type: ignore[attr-defined]

    def there(index: int) -> bool:
        path = source(index)
        return folder.path("depth", index, path.suffix if path else ".npy").is_file()

    def write(index: int, frame: Frame, _: Frame | None) -> bool:
        path = source(index)
        if path is None:
            if frame.depth_m is not None:
                folder.write_depth_m(index, frame.depth_m)
            return frame.depth_m is not None
        if coding is not None:
            key = "disparity_scale" if coding.form == "disparity" else "depth_scale"
            set_camera_key(folder.root / "camera.yaml", key, coding.factor)
        folder.link("depth", index, path)
        return path.is_file()

    return Step("depth", {"method": DATA_FILES}, there, write)


def _flow(folder: PreparedFolder, config: FlowConfig, given: bool) -> Step:
    name = config.name if config.name != "auto" else DATA_FILES if given else "dis"
    if name == DATA_FILES and not given:
        raise LeftOutError("does not come with the data; choose another flow.name")
    settings = {"method": DATA_FILES} if name == DATA_FILES else asdict(config) | {"method": name}
    settings.pop("name", None)
    method = None if name == DATA_FILES else _load_flow(name, config)

    def write(index: int, frame: Frame, following: Frame | None) -> bool:
        if following is None:
            return False
        flow: NDArray[np.float32] | None = following.flow_prev_to_curr_px
        if method is not None:
            flow = method.compute(_seen(name, frame), _seen(name, following))
        if flow is not None:
            folder.write_flow(index, flow)
        return flow is not None

    return Step("flow", settings, lambda index: folder.has("flow", index), write, needs_next=True)


def _load_flow(name: str, config: FlowConfig) -> Any:
    """The flow method of a run; the one place that knows how it is asked for."""
    from pipelines.flow import load_flow

    return load_flow(replace(config, name=name))


def _seen(name: str, frame: Frame) -> Any:
    """The image that a method wants: the network was trained on colours."""
    return frame.image if name == "pwc_net" else to_gray(frame.image)


def _masks(folder: PreparedFolder, config: DetectorConfig, given: bool, detector: Any) -> Step:
    name = DATA_FILES if given and config.name in ("auto", DATA_FILES) else config.name
    if name != DATA_FILES and detector is None:
        detector, name = _load_detector(config, given)
    settings = {"method": DATA_FILES}
    if name != DATA_FILES:
        settings = asdict(config) | {"method": name, "classes": list(config.classes)}
        for ineffective in ("name", "every_n", "threads"):
            settings.pop(ineffective)

    def write(index: int, frame: Frame, _: Frame | None) -> bool:
        found = _given_masks(frame) if name == DATA_FILES else detector.detect(frame)
        if found is not None:
            folder.write_masks(index, found)
        return found is not None

    return Step("masks", settings, lambda index: folder.has("masks", index), write)


def _load_detector(config: DetectorConfig, given: bool) -> tuple[Any, str]:
    """The detector of a run and its name; the one place that knows how it is asked for."""
    from pipelines.detection import choose_detector, load_detector

    name = choose_detector(config, given)
    if name == "motion":
        raise LeftOutError(
            "no network is at hand, and the detector 'motion' finds things only while it tracks; "
            "'python3 -m app models' says how to get one"
        )
    if name == DATA_FILES:
        raise LeftOutError("does not come with the data; choose another detector.name")
    return load_detector(replace(config, name=name)), name


def _given_masks(frame: Frame) -> Detections | None:
    """The masks that a frame brings, with the classes that it knows."""
    labels = frame.instance_labels
    if labels is None:
        return None
    ids = np.unique(labels[labels > 0]).astype(np.int32)
    classes = frame.instance_classes or {}
    names = np.array([classes.get(int(label), UNNAMED_CLASS) for label in ids], np.str_)
    return Detections(labels, ids, names, np.full(len(ids), np.nan))
