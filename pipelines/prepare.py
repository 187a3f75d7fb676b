"""`prepare`: depth, flow and masks of a sequence written to files, which later runs then read.

Owns what is kept, what is made and in which order. How each kind is made is in `prepare_steps`,
files and codings are in `prepared_folder`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pipelines.config import Config
from pipelines.datasets.file_sequence import FileSequence
from pipelines.datasets.folder import FolderSequence
from pipelines.datasets.sequence import Sequence
from pipelines.errors import ConfigError, DatasetError, FrameError
from pipelines.io.files import write_text
from pipelines.io.trajectory import write_tum
from pipelines.prepare_steps import LeftOutError, Step, step_for
from pipelines.prepared_folder import PreparedFolder
from pipelines.types import Frame, StereoCamera

KINDS = ("depth", "flow", "masks")
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
            step = step_for(kind, folder, sequence, config, kind in brings, detector)
        except LeftOutError as reason:
            done.left_out[kind] = str(reason)
            continue
        folder.claim(kind, step.settings, overwrite)
        done.made[kind] = done.kept[kind] = 0
        steps.append(step)
    _Pass(folder, sequence, steps, done).run(n_frames, progress)
    return done


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
