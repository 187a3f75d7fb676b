"""The run loop: frames of a sequence through the system, into a result folder and to the sinks.

Owns the order of reading, processing and writing, and what happens when a frame cannot be read or
a person interrupts. Ground truth is opened here only after the last frame is done.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from pipelines.config import Config, config_to_dict
from pipelines.datasets.sequence import Sequence
from pipelines.dyob_slam import DyObSlam
from pipelines.errors import DatasetError, DyObError, FrameError
from pipelines.evaluation import evaluate_result
from pipelines.frontend.view import PreparedFrame
from pipelines.io import folder as names
from pipelines.io.folder import clear_result_folder
from pipelines.io.observations import ObservationRecorder
from pipelines.io.result import (
    Result,
    ResultWriter,
    create_result_folder,
    load_result,
    run_metrics,
)
from pipelines.lasting_map import LastingMap, note_end, note_start
from pipelines.types import Array, Frame, FrameResult

RESULTS = "results"  # folder that result folders go to, below the working folder
_log = logging.getLogger("dyob.run")


class Sink(Protocol):
    """Something that watches a run: a progress bar, a viewer, a writer of annotated frames."""

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


@dataclass(slots=True)
class _Progress:
    """What a run has done so far. skipped: frames that could not be read."""

    results: list[FrameResult] = field(default_factory=list)
    skipped: int = 0
    interrupted: bool = False
    recorder: ObservationRecorder | None = None


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
) -> Result:
    """Run the whole system on a sequence and return its result folder, read back.

    >>> result = run(open_sequence("path/to/data"))
    >>> result.folder, result.Ts_world_camera.shape, result.objects.speed_mps

    config: all settings; the default ones where None, others by `pipelines.config.load_config`.
    output: the folder to write; by default a new one under `results`, with a `latest` link. Files
    of an earlier run in it are replaced. start, frames, stride: which frames to take, all by
    default. sinks: what watches the run, see `Sink`. batch_progress: called with (done, total)
    while the batch at the end runs. lasting_map: the map that the run begins with, and where to
    leave its own, as the front-end made it. A frame that cannot be read is skipped with a warning.
    Ctrl-C ends the run early with a valid, partial result. Raises DatasetError where no frame is
    asked for or none can be read, ModelError where a network's file is missing, DyObError where the
    disk refuses, and as `LastingMap.open`.
    """
    lasting_map = lasting_map or LastingMap()
    config = lasting_map.settings(config or Config())
    indices = _chosen_frames(len(sequence), start, frames, stride)
    known = lasting_map.open(sequence.camera, config.mapping)
    folder = create_result_folder(RESULTS, sequence.name) if output is None else Path(output)
    clear_result_folder(folder)
    writer = ResultWriter(folder)
    writer.write_config(config_to_dict(config))
    slam = DyObSlam(sequence.camera, config, known, lasting_map.localize)
    progress = _Progress()
    if config.batch.record or config.batch.at_end:
        progress.recorder = ObservationRecorder(folder / names.OBSERVATIONS, sequence.camera)
    sinks = tuple(sinks)
    with writer.log_to_file():
        _log.info("%s (%s), %d frames", sequence.name, sequence.dataset, len(indices))
        note_start(known, lasting_map.localize)
        for sink in sinks:
            sink.start(sequence, len(indices), config, folder)
        try:
            _process_all(sequence, slam, indices, sinks, progress)
            slam.settle()
        except KeyboardInterrupt:
            _note_interruption(progress)
        except Exception:
            if progress.results:  # what was done is worth keeping, whatever went wrong
                _write(writer, sequence, slam, progress)
            raise
        finally:
            slam.close()
            for sink in sinks:
                sink.finish()
        if not progress.results and not progress.interrupted:
            raise DatasetError(
                f"{sequence.name}: expected frames that can be read, found none among "
                f"{len(indices)}; see {folder / 'run.log'} for each one's reason"
            )
        try:
            _write(writer, sequence, slam, progress)
        except KeyboardInterrupt:  # once more, in peace; a second Ctrl-C ends it
            _note_interruption(progress)
            _write(writer, sequence, slam, progress)
        note_end(known, progress.results)
        lasting_map.keep(slam.map, slam.revise(progress.results))
        if config.batch.at_end and progress.results and not progress.interrupted:
            _optimise(folder, config, batch_progress)
        if progress.recorder is not None and not config.batch.record:
            progress.recorder.remove()
    return load_result(folder)


def _optimise(folder: Path, config: Config, batch_progress: Callable[[int, int], None]) -> None:
    """The global batch at the end; whatever becomes of it, the front-end's result is there."""
    from pipelines.optimisation import optimise_result

    try:
        optimise_result(folder, config.batch, batch_progress)
    except KeyboardInterrupt:
        _log.warning("batch stopped: the result is the front-end's")
    except (DyObError, RuntimeError, MemoryError) as error:  # gtsam's own are RuntimeErrors
        _log.warning("no batch: %s; the result is the front-end's", error)


def _note_interruption(progress: _Progress) -> None:
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


def _process_all(
    sequence: Sequence,
    slam: DyObSlam,
    indices: range,
    sinks: tuple[Sink, ...],
    progress: _Progress,
) -> None:
    begin, n_corrections = time.perf_counter(), 0
    for index, pending in _prepare_ahead(sequence, slam, indices):
        try:
            prepared = pending.result()
        except FrameError as error:
            progress.skipped += 1
            _log.warning("frame %d skipped: %s", index, error)
            continue
        result = slam.process(prepared)
        end = time.perf_counter()
        result.timings_ms["wall"] = 1e3 * (end - begin)
        begin = end
        if progress.recorder is not None and result.observations is not None:
            progress.recorder.add(result.observations)
        # Labels are a megabyte a frame, observations a tenth of it
        progress.results.append(replace(result, object_labels=None, observations=None))
        _log.info(
            "frame %d %s by %s, %d inliers of %d%s, %.1f ms",
            index,
            result.status,
            result.hypothesis,
            int(result.inliers.sum()),
            len(result.inliers),
            ", keyframe" if result.is_keyframe else "",
            result.timings_ms["wall"],
        )
        if slam.n_corrections > n_corrections:
            n_corrections = slam.n_corrections
            for sink in sinks:
                if isinstance(sink, KeyframeSink):
                    sink.keyframes(*slam.keyframe_poses())
        for sink in sinks:
            sink.frame(prepared.frame, result)


def _prepare_ahead(
    sequence: Sequence, slam: DyObSlam, indices: range
) -> Iterator[tuple[int, Future[PreparedFrame]]]:
    """Frames in order, the next being read and prepared while the present one is processed."""

    def prepare(index: int) -> PreparedFrame:
        return slam.prepare(sequence.read(index))

    with ThreadPoolExecutor(1, thread_name_prefix="prepare") as ahead:
        pending = ahead.submit(prepare, indices[0])
        for position, index in enumerate(indices):
            current = pending
            if position + 1 < len(indices):
                pending = ahead.submit(prepare, indices[position + 1])
            yield index, current


def _write(writer: ResultWriter, sequence: Sequence, slam: DyObSlam, progress: _Progress) -> None:
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
