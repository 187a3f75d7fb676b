"""A small finished run that needs no running: a car that drives, a parked one, and a few points."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from pipelines.geometry import exp_se3, make_T
from pipelines.io.result import Result
from pipelines.object_types import ObjectEstimates
from pipelines.types import ObjectTruth, StereoCamera

N_FRAMES = 8
STEP = exp_se3(np.array([0.0, 0.02, 0.0, 0.1, 0.0, 0.8]))  # of the car a frame, in the world
CAMERA = StereoCamera(640, 240, 400.0, 400.0, 320.0, 120.0, 200.0)


def rows(object_id: int, state: str, Ls: np.ndarray, Hs: np.ndarray, speed: float):
    n = len(Ls)
    nan3 = np.full((n, 3), np.nan)
    return ObjectEstimates(
        np.arange(n), 0.1 * np.arange(n), np.full(n, object_id), np.full(n, "car"), np.ones(n),
        np.full(n, state), np.tile([10.0, 10, 40, 30], (n, 1)), np.full(n, 80), Ls, Hs,
        np.full((n, 6, 6), np.nan), Ls[:, :3, 3], np.full(n, speed), np.full(n, 0.2), nan3,
        np.full(n, np.nan), np.tile([4.0, 1.5, 1.8], (n, 1)),
    )  # fmt: skip


@pytest.fixture(scope="session")
def objects() -> ObjectEstimates:
    """Car 3 drives off to the front, car 5 is parked at the left; eight frames of both."""
    facing = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])  # x ahead
    Ls = [make_T(facing, np.array([2.0, 0.8, 9.0]))]
    for _ in range(N_FRAMES - 1):
        Ls.append(STEP @ Ls[-1])
    Hs = np.array([np.full((4, 4), np.nan)] + [STEP] * (N_FRAMES - 1))
    parked = np.tile(make_T(facing, np.array([-3.0, 0.8, 8.0])), (N_FRAMES, 1, 1))
    still = np.tile(np.eye(4), (N_FRAMES, 1, 1))
    return ObjectEstimates.concatenate(
        rows(3, "moving", np.array(Ls), Hs, 8.0), rows(5, "stopped", parked, still, 0.0)
    )


@pytest.fixture(scope="session")
def result(tmp_path_factory, objects) -> Result:
    """The run in memory; its folder holds annotated frames of plain colours, but not of frame 4."""
    folder: Path = tmp_path_factory.mktemp("finished")
    (folder / "frames").mkdir()
    for k in range(N_FRAMES):
        picture = np.full((120, 320, 3), (20 + 25 * k, 90, 160), np.uint8)
        if k != 4:
            assert cv2.imwrite(str(folder / "frames" / f"{k:06d}.png"), picture)
    Ts = np.array([make_T(np.eye(3), np.array([0.0, 0.0, 0.4 * k])) for k in range(N_FRAMES)])
    points = np.random.default_rng(0).uniform([-8, -3, 2], [8, 1.5, 22], (600, 3))
    stamps = 0.1 * np.arange(N_FRAMES)
    timings = {
        "frames_index": list(range(N_FRAMES)),
        "frames_timestamp_s": stamps.tolist(),
    }
    drives = objects.object_id == 3
    poses = objects.Ts_world_object.copy()
    poses[:, 0, 3] += np.where(drives, 1.5, 0.0)  # the true car drives beside the estimated one
    truth = ObjectTruth(
        objects.frame_index, objects.object_id, objects.class_name, poses, objects.boxes_px, drives
    )
    metrics = {"run": {"sequence": "a <b>road</b>"}, "batch": {"accepted": True}}
    return Result(
        folder, stamps, Ts, stamps, Ts + 0.01, points, np.full((600, 3), 140, np.uint8),
        metrics=metrics, timings=timings, objects=objects, gt_objects=truth,
    )  # fmt: skip
