"""A drive past points and one turning object, with pixels that drift along their tracks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from pipelines.config import ObjectsConfig
from pipelines.frame_observations import FrameObservations, Sightings
from pipelines.geometry import exp_se3, inside_image, invert_T, make_T, project_stereo
from pipelines.geometry import transform_points as move
from pipelines.object_types import ObjectEstimates
from pipelines.objects.rows import RowTable
from pipelines.objects.track import ObjectTrack
from pipelines.types import StereoCamera

CAMERA = StereoCamera(640, 480, 500.0, 500.0, 320.0, 240.0, 100.0)
SIGMA_UV_PX, SIGMA_DISPARITY_PX, BIRTH_PX = 0.1, 0.1, 0.05
DT_S = 0.1


@dataclass(frozen=True)
class Drive:
    """Ts_true, Ls_true: (K, 4, 4) of camera and object. log, objects: by the front-end."""

    Ts_true: np.ndarray
    Ls_true: np.ndarray
    log: list[FrameObservations]
    objects: ObjectEstimates


def make_drive(seed=0, n_frames=12, n_points=150, n_object=60, jitter=0.02, turn_radps=0.4):
    """jitter: m and a tenth of it in rad, by which the front-end is wrong in every pose."""
    rng = np.random.default_rng(seed)
    k = np.arange(n_frames)
    Ts = np.stack([exp_se3(np.array([0.0, 0.004 * i, 0.0, 0.0, 0.0, 0.15 * i])) for i in k])
    step = exp_se3(np.array([0.0, turn_radps * DT_S, 0.0, 0.03, 0.0, 0.2]))
    Ls = [make_T(np.eye(3), np.array([1.0, 0.5, 7.0]))]
    for _ in k[1:]:
        Ls.append(Ls[-1] @ step)
    Ls = np.stack(Ls)
    world = rng.uniform((-6, -3, 4), (6, 3, 16), (n_points, 3))
    body = rng.uniform((-0.9, -0.7, -0.9), (0.9, 0.7, 0.9), (n_object, 3))
    wrong = np.repeat([0.1, 1.0], 3) * jitter
    X = Ts @ exp_se3(rng.normal(size=(n_frames, 6)) * wrong)
    X[0] = Ts[0]
    L = Ls @ exp_se3(rng.normal(size=(n_frames, 6)) * wrong)
    drift = {0: np.zeros((n_points, 2)), 1: np.zeros((n_object, 2))}
    born = {0: np.zeros(n_points, bool), 1: np.zeros(n_object, bool)}
    log, parts = [], []
    for i in k:
        seen = []
        for owner, points, T_body in ((0, world, np.eye(4)), (1, body, Ls[i])):
            p = move(invert_T(Ts[i]) @ T_body, points)
            uvr = project_stereo(CAMERA, p)
            inside = (p[:, 2] > 0.5) & inside_image(CAMERA, uvr[:, :2])
            old = born[owner]
            sigma = np.where(old, SIGMA_UV_PX, BIRTH_PX)
            drift[owner] += rng.normal(size=(len(p), 2)) * sigma[:, None]
            born[owner] = old | inside
            n = int(inside.sum())
            d = (uvr[:, 0] - uvr[:, 2])[inside] + rng.normal(size=n) * SIGMA_DISPARITY_PX
            front = invert_T(X[i]) @ (np.eye(4) if owner == 0 else L[i])
            seen.append(
                Sightings(
                    np.full(n, i), np.full(n, owner), np.flatnonzero(inside),
                    (uvr[:, :2] + drift[owner])[inside], d, sigma[inside],
                    np.full(n, SIGMA_DISPARITY_PX), move(front, points)[inside],
                )
            )  # fmt: skip
            drift[owner][~inside] = 0.0
            born[owner] &= inside
        log.append(FrameObservations(int(i), DT_S * i, True, X[i], Sightings.concatenate(*seen)))
        table = RowTable(int(i), DT_S * i)
        track = ObjectTrack(1, ObjectsConfig())
        track.take_detection("car", 1.0, np.zeros(64))
        track.T_world_object = L[i]
        H = None if i == 0 else L[i] @ invert_T(L[i - 1])
        table.add(
            track, 1.0, center_m=L[i, :3, 3], n_points=n_object, H_world_curr_prev=H,
            motion_covariance=None if i == 0 else 1e-4 * np.eye(6), state="moving",
        )  # fmt: skip
        parts.append(table.estimates())
    return Drive(Ts, Ls, log, ObjectEstimates.concatenate(*parts))


@pytest.fixture(name="make_drive")
def make_drive_fixture():
    return make_drive


@pytest.fixture
def stereo():
    return CAMERA
