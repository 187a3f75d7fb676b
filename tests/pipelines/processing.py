"""A system that is fed frame by frame, and what frames may go through on their way to it."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np

from pipelines.datasets.sequence import Sequence
from pipelines.dyob_slam import DyObSlam
from pipelines.evaluation import evaluate_camera
from pipelines.io.config import load_config
from pipelines.object_types import ObjectEstimates
from pipelines.types import Frame, FrameResult, TrackingStatus

Alter = Callable[[Frame], Frame]


def process(
    sequence: Sequence,
    alter: Alter = lambda frame: frame,
    settings: Iterable[str] = (),
    frames: Iterable[int] | None = None,
) -> list[FrameResult]:
    """A new system's results of a sequence, all of it unless `frames` says which."""
    slam = DyObSlam(sequence.camera, load_config(None, settings))
    indices = range(len(sequence)) if frames is None else frames
    return [slam.process(alter(sequence.read(k))) for k in indices]


def statuses(results: Iterable[FrameResult]) -> list[TrackingStatus]:
    return [r.status for r in results]


def rows_of(results: Iterable[FrameResult]) -> ObjectEstimates:
    """All that was told of objects."""
    return ObjectEstimates.concatenate(*(r.objects for r in results))


def camera_errors(sequence: Sequence, results: Iterable[FrameResult]) -> dict[str, Any]:
    """Camera metrics of the measured frames, as the evaluator defines them."""
    tracked = [r for r in results if r.status is TrackingStatus.OK]
    stamps = np.array([r.timestamp_s for r in tracked])
    Ts = np.array([r.T_world_camera for r in tracked])
    truth = sequence.ground_truth()
    return evaluate_camera(stamps, Ts, truth.timestamps_s, truth.Ts_world_camera)


def without_flow(frame: Frame) -> Frame:
    return dataclasses.replace(frame, flow_prev_to_curr_px=None)
