"""The run loop: frames of a sequence through the system, into a result folder and to the sinks.

Owns the order of reading, processing and writing, and what happens when a frame cannot be read or
a person interrupts. Ground truth is opened here only after the last frame is done.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from pipelines.checkpoint import Checkpoints, run_origin
from pipelines.config import Config
from pipelines.datasets.sequence import Sequence
from pipelines.dyob_slam import DyObSlam
from pipelines.errors import DatasetError, DyObError, FrameError
from pipelines.evaluation import evaluate_result
from pipelines.frontend.view import PreparedFrame
from pipelines.interruption import Interruption
from pipelines.io import folder as names
from pipelines.io.config import config_to_dict
from pipelines.io.folder import clear_result_folder, is_finished, open_interrupted
from pipelines.io.observations import ObservationRecorder
from pipelines.io.result import (
    Result,
    ResultWriter,
    create_result_folder,
    load_result,
    run_metrics,
)
from pipelines.lasting_map import LastingMap, note_end, note_start
from pipelines.object_map import write_object_map
from pipelines.paged_arrays import PagedArrays
from pipelines.progress import Progress, resume_progress
from pipelines.types import Array, Frame, FrameResult

_FRAMES_IN_MEMORY = 50  # before what they touched of the map is let go
RESULTS = "results"  # folder that result folders go to, below the working folder
_log = logging.getLogger("dyob.run")


class Sink(Protocol):
    """Something that watches a run: a progress bar, a viewer, a writer of annotated frames.

    A sink may also have `go_on(n_done)`, called after `start` where a run is resumed that had done
    so many frames, and `flush()`, called before a checkpoint says that frames are done.
    """

    def start(self, sequence: Sequence, n_frames: int, config: Config, folder: Path) -> None:
        """Before the first frame. folder: the result folder, which exists."""

    def frame(self, frame: Frame, result: FrameResult) -> None:
        """After each frame that could be read."""

    def finish(self) -> None:
        """After the last frame, and whatever ended the run; the files are not written yet."""


@runtime_checkable
class KeyframeSink(Sink, Protocol):
    """A sink that also wants to know where the back-end moves the past."""

    def keyframes(self, frame_index: NDArray[np.int64], Ts_world_camera: Array) -> None:
        """All keyframes (K,) where they are now, (K, 4, 4), before the next `frame`.

        They come when some have moved, and may already hold that next frame.
        """


def run(
    sequence: Sequence,
    config: Config | None = None,
    output: Path | str | None = None,
    *,
    start: int = 0,
    frames: int | None = None,
    stride: int = 1,
    sinks: Iterable[Sink] = (),
    batch_progress: Callable[[int, int], None] = lambda done, total: None,
    lasting_map: LastingMap | None = None,
    resume: bool = False,
    checkpoint_every: int = 50,
) -> Result:
    """Run the whole system on a sequence and return its result folder, read back.

    >>> result = run(open_sequence("path/to/data"))
    >>> result.folder, result.Ts_world_camera.shape, result.objects.speed_mps

    config: all settings; the default ones where None, others by `pipelines.io.config.load_config`.
    output: the folder to write; by default a new one under `results`, with a `latest` link. Files
    of an earlier run in it are replaced. start, frames, stride: which frames to take, all by
    default. sinks: what watches the run, see `Sink`. batch_progress: called with (done, total)
    while the batch at the end runs. lasting_map: the map that the run begins with, and where to
    leave its own, as the front-end made it. A frame that cannot be read is skipped with a warning.
    Ctrl-C ends the run early with a valid, partial result and a checkpoint; there is one every
    `checkpoint_every` frames, too, 0 for none at all. resume: go on from the last checkpoint of an
    interrupted run in `output`, or `results/latest`, to the result that it would have had.
    Raises DatasetError where no frame is asked for or none can be read, ModelError where a
    network's file is missing, FormatError where there is nothing to resume, or not of this run,
    DyObError where the disk refuses, and as `LastingMap.open`.
    """
    lasting_map = lasting_map or LastingMap()
    config = lasting_map.settings(config or Config())
    indices = _chosen_frames(len(sequence), start, frames, stride)
    if resume:
        folder = open_interrupted(Path(RESULTS, names.LATEST) if output is None else Path(output))
        if is_finished(folder):
            _log.warning("%s: this run is finished, there is nothing to resume", folder)
            return load_result(folder)
    known = lasting_map.open(sequence.camera, config.mapping)
    progress = Progress(earlier=lasting_map.objects())
    if not resume:
        folder = create_result_folder(RESULTS, sequence.name) if output is None else Path(output)
        clear_result_folder(folder)
    arrays = PagedArrays(folder)
    slam = DyObSlam(sequence.camera, config, known, lasting_map.localize, arrays)
    origin = run_origin(sequence, config, indices, lasting_map.origin())
    if resume:
        progress = resume_progress(folder, sequence, slam, origin)
        clear_result_folder(folder, resume=True)
    elif config.batch.record or config.batch.at_end:
        progress.recorder = ObservationRecorder(folder / names.OBSERVATIONS, sequence.camera)
    writer = ResultWriter(folder)
    writer.write_config(config_to_dict(config))
    checkpoints = Checkpoints(folder / names.CHECKPOINT, origin, slam.fixed_parts())
    work = _Work(
        sequence, config, indices, slam, writer, tuple(sinks), progress,
        checkpoints if checkpoint_every else None, checkpoint_every,
    )  # fmt: skip
    with writer.log_to_file():
        _log.info("%s (%s), %d frames", sequence.name, sequence.dataset, len(indices))
        note_start(known, lasting_map.localize)
        work.process_frames(resume)
        work.write_result()
        note_end(known, progress.results)
        lasting_map.keep(slam.map, slam.revise(progress.results), progress.earlier)
        is_whole = not progress.interrupted
        if config.batch.at_end and progress.results and is_whole:
            is_whole = _optimise(folder, config, batch_progress)
        if progress.recorder is not None and not config.batch.record and is_whole:
            progress.recorder.remove()
        if is_whole:
            checkpoints.remove()
    return load_result(folder)


@dataclass(frozen=True, slots=True)
class _Work:
    """A run from its first frame, or the first that is left, to the front-end's files."""

    sequence: Sequence
    config: Config
    indices: range
    slam: DyObSlam
    writer: ResultWriter
    sinks: tuple[Sink, ...]
    progress: Progress
    checkpoints: Checkpoints | None
    checkpoint_every: int

    def process_frames(self, resume: bool) -> None:
        """All frames that are left, until somebody interrupts."""
        progress, folder = self.progress, self.writer.folder
        if resume:
            _log.info("resumed after %d frames", progress.n_done)
        for sink in self.sinks:
            sink.start(self.sequence, len(self.indices), self.config, folder)
            if resume:
                getattr(sink, "go_on", lambda n_done: None)(progress.n_done)
        try:
            with Interruption() as ctrl_c:
                self._process_left(ctrl_c)
                progress.in_frame = True  # what is half settled is no place to go on from
                self.slam.settle()
                self._tell_moves()
                progress.in_frame = False
        except KeyboardInterrupt:
            _note_interruption(progress)
            self._keep()
        except Exception:
            if progress.results:  # what was done is worth keeping, whatever went wrong
                _write(self.writer, self.sequence, self.slam, progress)
            raise
        finally:
            self.slam.close()
            for sink in self.sinks:
                sink.finish()
        if not progress.results and not progress.interrupted:
            raise DatasetError(
                f"{self.sequence.name}: expected frames that can be read, found none among "
                f"{len(self.indices)}; see {folder / 'run.log'} for each one's reason"
            )

    def _process_left(self, ctrl_c: Interruption) -> None:
        """Ctrl-C is heard between frames, also while one is awaited."""
        progress, begin = self.progress, time.perf_counter()
        left = self.indices[progress.n_done :]
        for index, pending in _prepare_ahead(self.sequence, self.slam, left):
            try:
                prepared = pending.result()
            except FrameError as error:
                progress.skipped += 1
                progress.n_done += 1
                _log.warning("frame %d skipped: %s", index, error)
                prepared = None
            with ctrl_c.put_off():
                if prepared is not None:
                    begin = self._process(prepared, begin)
                is_last = progress.n_done == len(self.indices)
                if is_last or progress.n_done % max(self.checkpoint_every, 1) == 0:
                    self._keep()
                if progress.n_done % _FRAMES_IN_MEMORY == 0:
                    self.slam.arrays.let_go()

    def _process(self, prepared: PreparedFrame, begin: float) -> float:
        """One frame; begin, and what is returned: times of two results, one after the other."""
        progress = self.progress
        progress.in_frame = True
        result = self.slam.process(prepared)
        end = time.perf_counter()
        result.timings_ms["wall"] = 1e3 * (end - begin)
        if progress.recorder is not None and result.observations is not None:
            progress.recorder.add(result.observations)
        progress.results.append(self.slam.arrays.keep(result.summary()))
        progress.n_done += 1
        progress.last, progress.in_frame = prepared.frame, False
        _log_frame(result)
        self._tell_moves()
        for sink in self.sinks:
            sink.frame(prepared.frame, result)
        return end

    def _tell_moves(self) -> None:
        """Tell the sinks that wish to know where keyframes are, if any has moved."""
        moved = self.slam.n_corrections > self.progress.n_corrections
        self.progress.n_corrections = self.slam.n_corrections
        for sink in self.sinks:
            if moved and isinstance(sink, KeyframeSink):
                sink.keyframes(*self.slam.keyframe_poses())

    def _keep(self) -> None:
        """A checkpoint; what the sinks were told before it is done then."""
        if self.checkpoints is None:
            return
        for sink in self.sinks:
            getattr(sink, "flush", lambda: None)()
        self.progress.keep(self.checkpoints, self.slam)

    def write_result(self) -> None:
        """The front-end's files; Ctrl-C costs only time."""
        try:
            _write(self.writer, self.sequence, self.slam, self.progress)
        except KeyboardInterrupt:  # once more, in peace; a second Ctrl-C ends it
            _note_interruption(self.progress)
            _write(self.writer, self.sequence, self.slam, self.progress)


def _optimise(folder: Path, config: Config, batch_progress: Callable[[int, int], None]) -> bool:
    """The batch at the end, and whether nobody stopped it; the front-end's result is there."""
    from pipelines.optimisation import optimise_result

    try:
        optimise_result(folder, config.batch, batch_progress)
    except KeyboardInterrupt:
        _log.warning("batch stopped: the result is the front-end's")
        return False
    except (DyObError, RuntimeError, MemoryError, np.linalg.LinAlgError) as error:  # gtsam's, too
        _log.warning("no batch: %s; the result is the front-end's", error)
    return True


def _note_interruption(progress: Progress) -> None:
    progress.interrupted = True
    _log.warning("interrupted after %d frames: the result holds these", len(progress.results))


def _chosen_frames(n_frames: int, start: int, frames: int | None, stride: int) -> range:
    end = n_frames if frames is None else min(n_frames, start + frames * stride)
    indices = range(start, end, max(stride, 1))
    if start < 0 or stride < 1 or len(indices) == 0:
        raise DatasetError(
            f"expected frames within 0 to {n_frames - 1}, found start {start}, stride {stride}, "
            f"frames {frames}; choose fewer or an earlier start"
        )
    return indices


def _log_frame(result: FrameResult) -> None:
    _log.info(
        "frame %d %s by %s, %d inliers of %d%s, %.1f ms",
        result.frame_index,
        result.status,
        result.hypothesis,
        result.n_inliers,
        len(result.inliers),
        ", keyframe" if result.is_keyframe else "",
        result.timings_ms["wall"],
    )


def _prepare_ahead(
    sequence: Sequence, slam: DyObSlam, indices: range
) -> Iterator[tuple[int, Future[PreparedFrame]]]:
    """Frames in order, the next being read and prepared while the present one is processed."""
    if not indices:
        return

    def prepare(index: int) -> PreparedFrame:
        return slam.prepare(sequence.read(index))

    with ThreadPoolExecutor(1, thread_name_prefix="prepare") as ahead:
        pending = ahead.submit(prepare, indices[0])
        for position, index in enumerate(indices):
            current = pending
            if position + 1 < len(indices):
                pending = ahead.submit(prepare, indices[position + 1])
            yield index, current


def _write(writer: ResultWriter, sequence: Sequence, slam: DyObSlam, progress: Progress) -> None:
    """All files: first what was estimated; the truth, which may be damaged, costs only errors."""
    static_map, results = slam.static_map(), slam.revise(progress.results)
    writer.write_run(results, static_map)
    if progress.recorder is not None:
        corrected = {
            now.frame_index: now.T_world_camera
            for now, then in zip(results, progress.results, strict=True)
            if now is not then
        }
        progress.recorder.finish(static_map.track_ids, corrected)
    write_object_map(writer.folder)
    metrics = {
        "run": run_metrics(
            results,
            static_map,
            sequence=sequence.name,
            dataset=sequence.dataset,
            skipped=progress.skipped,
            interrupted=progress.interrupted,
        )
    }
    writer.write_metrics(metrics, "")
    try:
        truth = sequence.ground_truth()
        if truth is not None:
            writer.write_ground_truth(results, truth)
    except DatasetError as error:
        _log.warning("no errors can be computed, the ground truth cannot be read: %s", error)
    evaluate_result(writer.folder)
