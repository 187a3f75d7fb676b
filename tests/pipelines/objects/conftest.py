"""Synthetic truth for moving objects: boxes of points, and boards that are rendered exactly.

Owns what is seen of them, with noise of known size. Test modules get all of it by fixtures.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest

from pipelines.frontend.view import View
from pipelines.geometry import exp_se3, invert_T, project_stereo, transform_points
from pipelines.mapping.point_filter import make_points
from pipelines.object_types import Detections
from pipelines.objects.points import ObjectPoints
from pipelines.observations import StereoObservations
from pipelines.types import Features, StereoCamera

KITTI = StereoCamera(1242, 375, 721.5, 721.5, 609.6, 172.9, 387.6)
SMALL = StereoCamera(480, 240, 400.0, 400.0, 239.5, 119.5, 200.0)
SIGMA_UV_PX, SIGMA_DISPARITY_PX = 0.15, 0.3


@dataclass(frozen=True)
class Body:
    """A car-like box of points. center_m: (3,) in the previous camera. G: true motion to the next.

    sizes are of its box; points lie on its rear and on its left side, which the camera sees.
    """

    center_m: tuple[float, float, float] = (2.0, 0.8, 11.0)
    G: np.ndarray = field(
        default_factory=lambda: exp_se3(np.array([0.002, 0.03, -0.001, 0.25, -0.01, 0.9]))
    )

    def points(self, rng: np.random.Generator, n: int) -> np.ndarray:
        local = rng.uniform(-0.5, 0.5, (n, 3)) * [1.8, 1.5, 4.0]
        rear = np.arange(n) % 2 == 0
        local[rear, 2], local[~rear, 0] = -2.0, -0.9
        return local + self.center_m

    def see(
        self,
        rng: np.random.Generator,
        n: int,
        *,
        object_id: int = 1,
        noise: float = 1.0,
        outliers: float = 0.0,
        patch_px: float = 0.0,
    ) -> tuple[ObjectPoints, StereoObservations]:
        """Its points as two frames measured them. noise scales the errors and what is said of them.

        outliers: share of points that are seen 8 to 60 px off. patch_px: size of the patches over
        which errors of pixels are alike, 0 where they are independent.
        """
        camera = KITTI
        truth = self.points(rng, n)
        before = project_stereo(camera, truth)
        disparity = before[:, 0] - before[:, 2] + rng.normal(size=n) * noise * SIGMA_DISPARITY_PX
        sigma_d = np.full(n, max(noise * SIGMA_DISPARITY_PX, 1e-4))
        position, covariance = make_points(
            camera, np.eye(4), before[:, :2], disparity, 1e-4, sigma_d
        )
        now = project_stereo(camera, transform_points(self.G, truth))
        if patch_px > 0.0:
            cells = np.floor(now[:, :2] / patch_px - rng.random(2)).astype(int)
            _, patch = np.unique(cells, axis=0, return_inverse=True)
            error = rng.normal(size=(patch.max() + 1, 2))[patch.ravel()]
        else:
            error = rng.normal(size=(n, 2))
        error *= noise * SIGMA_UV_PX
        wrong = rng.random(n) < outliers
        error[wrong] += (rng.choice([-1, 1], (n, 2)) * rng.uniform(8, 60, (n, 2)))[wrong]
        error_d = rng.normal(size=n) * noise * SIGMA_DISPARITY_PX
        now += np.stack([error[:, 0], error[:, 1], error[:, 0] - error_d], -1)
        points = ObjectPoints(
            np.full(n, object_id), position, covariance, before[:, :2], np.arange(n)
        )
        sigma_uv = np.full(n, max(noise * SIGMA_UV_PX, 1e-4))
        return points, StereoObservations(position, covariance, now, sigma_uv, sigma_d)


@dataclass(frozen=True)
class Board:
    """A textured upright board that faces the camera and moves without turning.

    center_m: time in s -> its centre (3,) in the world. size_m: its width and height. value: its
    mean brightness. name: its class.
    """

    center_m: Callable[[float], tuple[float, float, float]]
    size_m: tuple[float, float] = (2.4, 1.4)
    value: int = 120
    name: str = "car"
    seed: int = 1

    def texture(self) -> np.ndarray:
        rng = np.random.default_rng(self.seed)
        coarse = rng.integers(-70, 70, (14, 24)) + self.value
        return cv2.resize(np.clip(coarse, 5, 250).astype(np.uint8), (192, 112))


@dataclass(frozen=True)
class Street:
    """Boards before a wall, seen by a camera that moves along x and z without turning."""

    boards: tuple[Board, ...]
    camera_m: Callable[[float], tuple[float, float, float]] = lambda t: (0.0, 0.0, 0.0)
    dt_s: float = 0.1
    camera: StereoCamera = SMALL

    def T_world_camera(self, k: int) -> np.ndarray:
        T = np.eye(4)
        T[:3, 3] = self.camera_m(k * self.dt_s)
        return T

    def _all(self) -> tuple[Board, ...]:
        wall = Board(lambda t: (0.0, 0.0, 30.0), (80.0, 40.0), 110, "wall", 99)
        return (wall, *self.boards)

    def _pixels(self, board: Board, k: int) -> tuple[np.ndarray, float]:
        """(2, 3) affine map from metres on the board to pixels, and its depth."""
        x, y, z = np.subtract(board.center_m(k * self.dt_s), self.camera_m(k * self.dt_s))
        s = self.camera.fx / z
        return np.array([[s, 0, s * x + self.camera.cx], [0, s, s * y + self.camera.cy]]), z

    def _render(self, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Grey image, disparities, and which board (row + 1, 1 is the wall) each pixel shows."""
        H, W = self.camera.height, self.camera.width
        gray, disparity = np.zeros((H, W), np.uint8), np.zeros((H, W), np.float32)
        owner = np.zeros((H, W), np.int32)
        v, u = np.mgrid[0:H, 0:W]
        order = sorted(enumerate(self._all()), key=lambda b: -self._pixels(b[1], k)[1])
        for row, board in order:
            A, z = self._pixels(board, k)
            texture = board.texture()
            if row == 0:
                texture = np.tile(texture, (6, 8))
            h, w = texture.shape
            width_m, height_m = board.size_m
            metres = np.array(
                [[width_m / w, 0, -width_m / 2], [0, height_m / h, -height_m / 2], [0, 0, 1]]
            )
            warped = cv2.warpAffine(
                texture, A @ metres, (W, H), flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )
            inside = np.abs((u - A[0, 2]) / A[0, 0]) <= board.size_m[0] / 2
            inside &= np.abs((v - A[1, 2]) / A[1, 1]) <= board.size_m[1] / 2
            gray[inside], disparity[inside] = warped[inside], self.camera.bf / z
            owner[inside] = row + 1
        return gray, disparity, owner

    def view(self, k: int) -> tuple[View, Detections]:
        """Frame k with exact disparities and flow, and exact masks of all boards in sight."""
        gray, disparity, owner = self._render(k)
        flow = None
        if k > 0:
            before = self._render(k - 1)[2]
            flow = np.full((*gray.shape, 2), np.nan, np.float32)
            v, u = np.mgrid[0 : gray.shape[0], 0 : gray.shape[1]]
            for row, board in enumerate(self._all()):
                at = before == row + 1
                A, B = self._pixels(board, k - 1)[0], self._pixels(board, k)[0]
                flow[at, 0] = ((u - A[0, 2]) / A[0, 0] * B[0, 0] + B[0, 2] - u)[at]
                flow[at, 1] = ((v - A[1, 2]) / A[1, 1] * B[1, 1] + B[1, 2] - v)[at]
        labels = np.maximum(owner - 1, 0)
        ids = np.unique(labels[labels > 0]).astype(np.int32)
        names = np.array([self.boards[i - 1].name for i in ids], "U16")
        detections = Detections(labels, ids, names, np.full(len(ids), 0.9))
        image = np.repeat(gray[..., None], 3, axis=2)
        view = View(
            k, k * self.dt_s, image, gray, disparity, labels == 0, Features.empty(), flow, True
        )
        return view, detections


@pytest.fixture(scope="session")
def kitti() -> StereoCamera:
    return KITTI


@pytest.fixture(scope="session")
def body() -> type[Body]:
    """The class itself: test modules cannot import from a conftest."""
    return Body


@pytest.fixture(scope="session")
def board() -> type[Board]:
    return Board


@pytest.fixture(scope="session")
def street_of() -> type[Street]:
    return Street


@pytest.fixture(scope="session")
def twist_between() -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """A function of two near motions A and B: (6,) right perturbation [omega, v] from A to B."""

    def between(A: np.ndarray, B: np.ndarray) -> np.ndarray:
        E = invert_T(A) @ B
        return np.r_[cv2.Rodrigues(E[:3, :3])[0].ravel(), E[:3, 3]]

    return between
