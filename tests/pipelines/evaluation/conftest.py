"""A small world of boxes on wheels, its truth, and estimates made of that truth.

Owns the scene that the tests of objects share. Estimates are exact unless a test changes them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.evaluation.object_truth import RunFrames
from pipelines.geometry import exp_se3, invert_T, make_T, transform_points
from pipelines.object_types import ObjectEstimates
from pipelines.types import ObjectTruth

DT_S = 0.1
CARS = {1: (0.8, 0.0), 2: (1.2, 0.03), 3: (0.0, 0.0)}  # id: metres and radians a frame
D_OFFSET = make_T(exp_se3(np.array([0.2, -0.4, 0.1, 0, 0, 0]))[:3, :3], np.array([0.3, -0.7, 0.5]))


class ObjectWorld:
    """Truth of N frames: cars 1 and 2 drive, car 3 is parked; and estimates of chosen frames."""

    def __init__(self, n_frames: int = 30) -> None:
        self.n_frames = n_frames
        self.stamps = DT_S * np.arange(n_frames)
        steps = {j: exp_se3(np.array([0, turn, 0, 0, 0, m])) for j, (m, turn) in CARS.items()}
        start = {j: make_T(np.eye(3), np.array([4.0 * j - 8.0, 1.0, 10.0])) for j in CARS}
        self.poses = {
            j: np.array([start[j] @ np.linalg.matrix_power(steps[j], k) for k in range(n_frames)])
            for j in CARS
        }
        self.cameras = np.tile(np.eye(4), (n_frames, 1, 1))
        self.cameras[:, 2, 3] = 0.9 * np.arange(n_frames)

    def truth(self) -> ObjectTruth:
        keys = [(k, j) for k in range(self.n_frames) for j in CARS]
        return ObjectTruth(
            frame_index=np.array([k for k, _ in keys]),
            object_id=np.array([j for _, j in keys]),
            class_name=np.full(len(keys), "car"),
            Ts_world_object=np.array([self.poses[j][k] for k, j in keys]),
            boxes_px=np.array([self.box(j) for _, j in keys]),
            moving=np.array([j != 3 for _, j in keys]),
            n_pixels=np.full(len(keys), 900),
        )

    def frames(self, index: np.ndarray | None = None) -> RunFrames:
        index = np.arange(self.n_frames) if index is None else index
        return RunFrames(index, self.stamps[index], self.cameras[index])

    def estimates(self, index: np.ndarray | None = None, offset: int = 10) -> ObjectEstimates:
        """Exact estimates of the frames `index`, ids shifted by `offset`, frames set by D."""
        index = np.arange(self.n_frames) if index is None else index
        rows = []
        for n, k in enumerate(index.tolist()):
            for j in CARS:
                H, speed = np.full((4, 4), np.nan), np.nan
                center = self.poses[j][k][:3, 3]
                if n > 0:
                    before = self.poses[j][index[n - 1]]
                    H = self.poses[j][k] @ invert_T(before)
                    span_s = self.stamps[k] - self.stamps[index[n - 1]]
                    moved = transform_points(H, before[None, :3, 3])[0] - before[:3, 3]
                    speed = float(np.linalg.norm(moved)) / span_s
                state = "unknown" if n == 0 else "moving" if j != 3 else "stopped"
                seen = (k, self.stamps[k], j + offset, "car", 0.9, state, self.box(j), 200)
                L, unknown = self.poses[j][k] @ D_OFFSET, np.full((6, 6), np.nan)
                velocity, size = np.array([0.0, 0.0, speed]), np.array([4.0, 1.5, 1.8])
                rows.append((*seen, L, H, unknown, center, speed, 0.1, velocity, 0.1, size))
        return ObjectEstimates(*(np.array(column) for column in zip(*rows, strict=True)))

    @staticmethod
    def box(object_id: int) -> np.ndarray:
        return np.array([100.0 * object_id, 50.0, 100.0 * object_id + 59.0, 89.0])

    @staticmethod
    def changed(objects: ObjectEstimates, **columns: np.ndarray) -> ObjectEstimates:
        return replace(objects, **columns)


@pytest.fixture
def world() -> ObjectWorld:
    return ObjectWorld()
