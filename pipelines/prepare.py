"""`prepare`: depth, flow and masks of a sequence written to files, which later runs then read.

Owns what is computed, what is kept and in which order. Files and codings are in `prepared_folder`;
the methods are those of a run.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.config import Config, DepthConfig, DetectorConfig, FlowConfig
from pipelines.datasets.file_sequence import FileSequence
from pipelines.datasets.files import SATURATED
from pipelines.datasets.folder import FolderSequence
from pipelines.datasets.sequence import Sequence
from pipelines.depth import StereoDepth, to_gray
from pipelines.errors import ConfigError, DatasetError, FrameError
from pipelines.io.files import write_text
from pipelines.io.trajectory import write_tum
from pipelines.object_types import UNNAMED_CLASS, Detections
from pipelines.prepared_folder import DATA_FILES, PreparedFolder, set_camera_key
from pipelines.types import Frame, StereoCamera

KINDS = ("depth", "flow", "masks")
DISPARITY_SCALE = 256.0  # value of 1 px in a depth image, as KITTI has it
PROBED_FRAMES = 5  # that tell what a sequence brings
log = logging.getLogger("dyob.prepare")
Progress = Callable[[int, int], None]


@dataclass(slots=True)
class Prepared:
    """What a call has done. folder: which a run can now open.

    made, kept: number of files computed now, and of those that were there, by kind. left_out: kind
    -> reason. skipped: frames that could not be read.
    """

    folder: Path
    made: dict[str, int] = field(default_factory=dict)
    kept: dict[str, int] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    skipped: int = 0


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


def prepare(
    sequence: Sequence,
    config: Config | None = None,
    output: Path | str | None = None,
    *,
    what: Iterable[str] = KINDS,
    frames: int | None = None,
    overwrite: bool = False,
    progress: Progress | None = None,
    detector: Any = None,
) -> Prepared:
    """Write depth, flow and masks of a sequence, as far as it does not bring them.

    A `folder` gets them in itself unless `output` says otherwise; any other sequence becomes a
    `folder` in `output`, by default prepared/NAME below the working folder, with its images linked.
    Each file is written whole or not at all, and what is there stays: an interrupted call goes on
    where it stopped. what: of KINDS. frames: the first so many. overwrite: make anew what prepare
    has made before; the user's own files are never touched. progress: called with frames done and
    their number. detector: in place of the one that the settings ask for.

    Raises DatasetError where the folder is another's, ConfigError where files in it were made with
    other settings, DyObError where the disk refuses.
    """
    config, what = config or Config(), _checked(what)
    n_frames = len(sequence) if frames is None else min(frames, len(sequence))
    if isinstance(sequence, FolderSequence) and _is_own(sequence, output):
        sequence = FolderSequence.open(sequence.root, prepared=False)
        folder = PreparedFolder.within(sequence)
    else:
        target = Path(output) if output is not None else Path("prepared") / sequence.name
        folder = PreparedFolder.beside(target, sequence)
        _write_texts(folder, sequence)
    done = Prepared(folder.root)
    brings = _what_it_brings(sequence)
    if not folder.in_place and "depth" in brings and "depth" not in what:
        what = ("depth", *what)  # without it nobody could open the new folder
    steps = []
    for kind in what:
        try:
            step = _step_for(kind, folder, sequence, config, kind in brings, detector)
        except LeftOutError as reason:
            done.left_out[kind] = str(reason)
            continue
        folder.claim(kind, step.settings, overwrite)
        done.made[kind] = done.kept[kind] = 0
        steps.append(step)
    _Pass(folder, sequence, steps, done).run(n_frames, progress)
    return done


class LeftOutError(Exception):
    """A kind of file that is not made; its message is the reason. Never leaves this module."""


class _Pass:
    """One walk over the frames, in which each is read at most once, and only if it is needed."""

    def __init__(
        self, folder: PreparedFolder, sequence: Sequence, steps: list[Step], done: Prepared
    ) -> None:
        self.folder, self.sequence, self.steps, self.done = folder, sequence, steps, done
        self._read: dict[int, Frame | None] = {}

    def run(self, n_frames: int, progress: Progress | None) -> None:
        for index in range(n_frames):
            if not self.folder.in_place:
                self._put_images(index)
            for step in self.steps:
                if not step.needs_next or index + 1 < n_frames:
                    self._do(step, index)
            self._read = {k: frame for k, frame in self._read.items() if k > index}
            if progress is not None:
                progress(index + 1, n_frames)

    def _do(self, step: Step, index: int) -> None:
        if step.there(index):
            self.done.kept[step.kind] += 1
            return
        frame = self._frame(index)
        following = self._frame(index + 1) if step.needs_next else None
        if frame is None or (step.needs_next and following is None):
            return
        self.done.made[step.kind] += step.write(index, frame, following)

    def _frame(self, index: int) -> Frame | None:
        """Frame `index`, read once; None, with a warning, where it cannot be read."""
        if index not in self._read:
            try:
                self._read[index] = self.sequence.read(index)
            except FrameError as error:
                log.warning("frame %d is left out: %s", index, error)
                self.done.skipped += 1
                self._read[index] = None
        return self._read[index]

    def _put_images(self, index: int) -> None:
        """Images of a new folder: the sequence's own files, else as PNG."""
        if isinstance(self.sequence, FileSequence):
            files = self.sequence.files(index)
            self.folder.link("images", index, files.image)
            if files.image_right is not None:
                self.folder.link("right", index, files.image_right)
            return
        if self.folder.has("images", index):
            return
        frame = self._frame(index)
        if frame is None:
            return
        if frame.image_right is not None:  # first, as its left one says that both are there
            self.folder.write_image("right", index, frame.image_right)
        self.folder.write_image("images", index, frame.image)


def _checked(what: Iterable[str]) -> tuple[str, ...]:
    what = tuple(dict.fromkeys(what))
    for kind in what:
        if kind not in KINDS:
            raise ConfigError(f"--what: expected some of {', '.join(KINDS)}, found {kind!r}")
    return what


def _is_own(sequence: FolderSequence, output: Path | str | None) -> bool:
    return output is None or Path(output).resolve() == sequence.root.resolve()


def _what_it_brings(sequence: Sequence) -> set[str]:
    """Kinds of files that frames of the sequence come with; the first cannot have flow."""
    kinds: set[str] = set()
    read = 0
    for index in range(min(1, len(sequence) - 1), min(1 + PROBED_FRAMES, len(sequence))):
        try:
            frame = sequence.read(index)
        except FrameError:
            continue  # the walk over all frames will say so
        parts = (frame.depth_m, frame.flow_prev_to_curr_px, frame.instance_labels)
        kinds |= {kind for kind, part in zip(KINDS, parts, strict=True) if part is not None}
        read += 1
        if read == 2:
            break
    return kinds


def _write_texts(folder: PreparedFolder, sequence: Sequence) -> None:
    """camera.yaml, times.txt and the camera's truth of a new folder."""
    camera, yaml = sequence.camera, folder.root / "camera.yaml"
    if not yaml.is_file():
        write_text(yaml, _camera_yaml(camera))
    times = "".join(f"{float(t)!r}\n" for t in sequence.timestamps_s)
    write_text(folder.root / "times.txt", times)
    try:
        truth = sequence.ground_truth()
    except DatasetError as error:
        log.warning("the truth is not taken along: %s", error)
        return
    if truth is not None:
        known = np.isfinite(truth.Ts_world_camera).all((1, 2))
        stamps_s, Ts = truth.timestamps_s[known], truth.Ts_world_camera[known]
        write_tum(folder.root / "groundtruth.txt", stamps_s, Ts)
        if truth.objects is not None:
            log.warning("the truth of objects stays behind: a folder has none")


def _camera_yaml(camera: StereoCamera) -> str:
    keys = ["width", "height", "fx", "fy", "cx", "cy"]
    keys += [] if camera.is_rgbd else ["bf"]  # of RGB-D it is a convention, not a measurement
    return "".join(f"{key}: {getattr(camera, key)!r}\n" for key in keys)


# ---------------------------------------------------------------------- how each kind is made


def _step_for(
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

    options = {"preset": config.preset, "check": config.check, "max_miss_px": config.max_miss_px}
    return load_flow(name, **(options if name == "dis" else {}))


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
