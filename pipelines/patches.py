"""Patches: how points looked when they were first seen, and how they should look by now.

Owns the small pictures, and their warping to another view of the plane that each shows. Lies below
front-end and map, and knows neither; pictures are cut in `frontend.patch_cutting`.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import invert_T
from pipelines.types import Array, Image, StereoCamera

SIDE_PX = 21  # the window of the alignment, its gradients, and the fraction of the point's pixel
_MIN_GROWTH, _MAX_GROWTH = 0.85, 2.0  # sizes between which a patch shows its point as it is
_TOO_FAR = 2.0  # times beyond these, it is of no use at all
_PIXELS = np.stack(
    [g.ravel() for g in np.meshgrid(np.arange(SIDE_PX), np.arange(SIDE_PX))] + [np.ones(SIDE_PX**2)]
).astype(np.float32)  # (3, 441) homogeneous pixels of a patch


@dataclass(frozen=True, slots=True)
class Patches:
    """Pictures of points (parallel arrays of length N, by ascending id).

    point_ids: (N,). pixels: (N, 21, 21) uint8. corner_px: (N, 2) int64 where the patch began in its
    image, uv_px: (N, 2) the point's place there. plane: (N, 3) with plane @ (u, v, 1) = 1 / depth
    about it. T_world_camera: (N, 4, 4) of that image.
    """

    point_ids: NDArray[np.int64]
    pixels: Image
    corner_px: NDArray[np.int64]
    uv_px: Array
    plane: Array
    T_world_camera: Array

    def __len__(self) -> int:
        return len(self.point_ids)

    @classmethod
    def empty(cls) -> Patches:
        """None at all."""
        return cls(
            np.empty(0, np.int64),
            np.empty((0, SIDE_PX, SIDE_PX), np.uint8),
            np.empty((0, 2), np.int64),
            np.empty((0, 2)),
            np.empty((0, 3)),
            np.empty((0, 4, 4)),
        )

    def __getitem__(self, which: NDArray) -> Patches:
        """The patches chosen by a boolean mask, or by an index array that keeps ids ascending."""
        return Patches(*(getattr(self, f.name)[which] for f in fields(self)))

    @classmethod
    def concatenate(cls, *parts: Patches) -> Patches:
        """All parts, of which no two hold one point."""
        arrays = [np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)]
        return cls(*arrays)[np.argsort(arrays[0], kind="stable")]

    def rows(self, point_ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """(M,) row of each point's patch, -1 where there is none."""
        if len(self) == 0:
            return np.full(len(point_ids), -1)
        at = np.minimum(np.searchsorted(self.point_ids, point_ids), len(self) - 1)
        return np.where(self.point_ids[at] == point_ids, at, -1)

    def moved(self, Cs: Array) -> Patches:
        """The same in another world, or one corrected: p_new = C @ p_old, (4, 4) or (N, 4, 4)."""
        return replace(self, T_world_camera=Cs @ self.T_world_camera)

    def homographies(
        self, camera: StereoCamera, rows: NDArray[np.int64], T_world_camera: Array
    ) -> Array:
        """(M, 3, 3) from pixels of the patches' images to those of a camera at (4, 4)."""
        K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        T = invert_T(T_world_camera) @ self.T_world_camera[rows]
        return K @ (T[:, :3, :3] @ np.linalg.inv(K) + T[:, :3, 3:] @ self.plane[rows, None])

    def are_like(self, rows: NDArray[np.int64], Hs: Array) -> NDArray[np.bool_]:
        """(M,) which patches show their points about as large as after homographies."""
        growth = _growth(Hs, self.uv_px[rows])
        return (growth > _MIN_GROWTH) & (growth < _MAX_GROWTH)

    def are_of_use(self, rows: NDArray[np.int64], Hs: Array) -> NDArray[np.bool_]:
        """(M,) which patches can be warped by homographies, and still show anything then."""
        growth = _growth(Hs, self.uv_px[rows])
        return (growth > _MIN_GROWTH / _TOO_FAR) & (growth < _MAX_GROWTH * _TOO_FAR)

    def sheets(
        self, rows: NDArray[np.int64], Hs: Array, shape: tuple[int, int]
    ) -> Iterator[tuple[slice, Image, Array]]:
        """Images of `shape` (H, W), tiled with patches as they look after homographies Hs.

        rows: (M,), Hs: (M, 3, 3). Yields which of the rows an image holds, the image, and the
        places (n, 2) of their points in it; more images than one where they do not fit.
        """
        across, down = shape[1] // SIDE_PX, shape[0] // SIDE_PX
        for first in range(0, len(rows), across * down):
            part = slice(first, first + across * down)
            tiles = np.zeros((across * down, SIDE_PX, SIDE_PX), np.uint8)
            n = len(rows[part])
            tiles[:n] = self._warped(rows[part], Hs[part])
            grid = tiles.reshape(down, across, SIDE_PX, SIDE_PX).swapaxes(1, 2)
            sheet = np.zeros(shape, np.uint8)
            sheet[: down * SIDE_PX, : across * SIDE_PX] = grid.reshape(down * SIDE_PX, -1)
            row, column = np.divmod(np.arange(n), across)
            within = self.uv_px[rows[part]] - self.corner_px[rows[part]]
            yield part, sheet, np.column_stack([column, row]) * SIDE_PX + within

    def _warped(self, rows: NDArray[np.int64], Hs: Array) -> Image:
        """(n, 21, 21) patches after homographies, with their points where they were."""
        n, uv = len(rows), self.uv_px[rows]
        within = uv - self.corner_px[rows]
        seen_at = np.einsum("nij,nj->ni", Hs, np.column_stack([uv, np.ones(n)]))
        seen_at = seen_at[:, :2] / seen_at[:, 2:]
        back = np.linalg.inv(_shift(within - seen_at) @ Hs @ _shift(uv - within))
        # By coordinate, as the remapping takes them: copies would cost as much as all the rest
        x, y, w = np.ascontiguousarray(back.swapaxes(0, 1), dtype=np.float32) @ _PIXELS
        for at in (x, y):
            np.divide(at, w, out=at)
            np.clip(at, 0, SIDE_PX - 1, out=at)
        y += SIDE_PX * np.arange(n, dtype=np.float32)[:, None]
        column = self.pixels[rows].reshape(-1, SIDE_PX)
        x, y = x.reshape(-1, SIDE_PX), y.reshape(-1, SIDE_PX)
        warped = cv2.remap(column, x, y, cv2.INTER_LINEAR)
        return warped.reshape(n, SIDE_PX, SIDE_PX)


def _growth(Hs: Array, uv_px: Array) -> Array:
    """(N,) how much larger the surroundings of pixels (N, 2) are after homographies (N, 3, 3).

    0 where they are behind the camera.
    """
    w = np.einsum("nj,nj->n", Hs[:, 2], np.column_stack([uv_px, np.ones(len(uv_px))]))
    with np.errstate(divide="ignore", invalid="ignore"):
        area = np.abs(np.linalg.det(Hs)) / w**3
    return np.sqrt(np.where(w > 0.0, area, 0.0))


def _shift(by_px: Array) -> Array:
    """(N, 3, 3) homographies that add `by_px` (N, 2)."""
    shifts = np.tile(np.eye(3), (len(by_px), 1, 1))
    shifts[:, :2, 2] = by_px
    return shifts
