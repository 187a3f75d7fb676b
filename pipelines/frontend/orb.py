"""Evenly spread ORB features on the static part of an image.

Owns detection, spreading and description. Knows no poses and no map.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pipelines.config import OrbConfig
from pipelines.types import Array, Features, Image

_BORDER_PX = 19  # at each level, so that a turned patch stays in the image (ORB-SLAM)
_PATCH_PX = 31  # side of the patch that is described (ORB)
_CORNERS_PER_CELL = 4.0  # wanted: fewer spread more evenly, more let the strong ones win
_MIN_CELL_PX = 8.0
_OVERSAMPLING = 3  # corners detected per feature kept, so that spreading has a choice


class OrbExtractor:
    """Detects, spreads and describes ORB corners (paper, section ORB Feature Extraction).

    Holds the OpenCV detectors, which are costly to make; it keeps nothing from image to image.
    """

    def __init__(self, config: OrbConfig) -> None:
        self.config = config
        self._orb = cv2.ORB_create(
            nfeatures=config.n_features * _OVERSAMPLING,
            scaleFactor=config.scale_factor,
            nlevels=config.n_levels,
            fastThreshold=config.fast_threshold,
            edgeThreshold=_BORDER_PX,
            patchSize=_PATCH_PX,
        )

    def extract(
        self,
        gray: Image,
        static: NDArray[np.bool_] | None = None,
        movable_too: bool = False,
        detect_on: Image | None = None,
    ) -> Features:
        """ORB features of a grey image (H, W): the strongest of each image cell.

        static: (H, W) bool, about `n_features` lie where it is True. movable_too: as many more as
        the rest has room for at the same density. detect_on: (H, W) uint8, what corners and their
        angles are found on, if not on the image that is described. Depths are left unknown (NaN).
        """
        self._orb.setNLevels(self._levels_that_fit(gray.shape))
        searched = gray if detect_on is None else detect_on
        corners = self._orb.detect(searched, None)  # masking afterwards is faster
        if not corners:
            return Features.empty()
        uv = cv2.KeyPoint_convert(corners).astype(np.float64)
        response = np.array([corner.response for corner in corners])
        kept = self._spread(uv, response, gray.shape[:2], static, movable_too)
        keypoints, descriptors = self._orb.compute(gray, [corners[i] for i in kept])
        if descriptors is None or not keypoints:
            return Features.empty()
        table = np.array([(*k.pt, k.octave, k.angle, k.response) for k in keypoints])
        return Features(
            table[:, :2],
            table[:, 2].astype(np.int32),
            table[:, 3].astype(np.float32),
            table[:, 4].astype(np.float32),
            descriptors,
            np.full(len(keypoints), np.nan),
        )

    def _spread(
        self,
        uv_px: Array,
        response: Array,
        shape: tuple[int, int],
        static: NDArray[np.bool_] | None,
        movable_too: bool,
    ) -> NDArray[np.int64]:
        """Indices of the corners to keep, of the static part and perhaps of the rest."""
        n_wanted = self.config.n_features
        if static is None:
            return spread_evenly(uv_px, response, shape, n_wanted)
        column, row = np.rint(uv_px).astype(np.int64).T
        is_static = static[row, column]
        parts = [(is_static, n_wanted)]
        if movable_too:
            parts.append((~is_static, _share_of_rest(n_wanted, float(static.mean()))))
        kept = []
        for part, n in parts:
            candidates = np.flatnonzero(part)
            best = spread_evenly(uv_px[candidates], response[candidates], shape, n)
            kept.append(candidates[best])
        return np.sort(np.concatenate(kept))

    def _levels_that_fit(self, shape: tuple[int, ...]) -> int:
        """Levels on which something of an image (H, W) is left between the borders, one at least.

        OpenCV fails where a level shrinks to nothing.
        """
        shrinkage = min(shape) / (2 * _BORDER_PX + 1)
        fitting = 1 + int(np.log(max(shrinkage, 1.0)) / np.log(self.config.scale_factor))
        return min(self.config.n_levels, fitting)


def _share_of_rest(n_wanted: int, static_share: float) -> int:
    """How many corners the rest of an image gets, when its static share gets `n_wanted`."""
    return int(n_wanted * min(1.0, (1.0 - static_share) / max(static_share, 1e-3)))


def spread_evenly(
    uv_px: Array, response: Array, shape: tuple[int, int], n_wanted: int
) -> NDArray[np.int64]:
    """Indices of about `n_wanted` corners spread over the image, the strongest of each cell first.

    uv_px: (N, 2). response: (N,). shape: (H, W) in pixels. Corners are ranked inside square cells
    of about `_CORNERS_PER_CELL` wanted corners, and taken rank by rank until there are enough.
    """
    if len(uv_px) <= n_wanted:
        return np.arange(len(uv_px))
    cell_px = max(_MIN_CELL_PX, np.sqrt(_CORNERS_PER_CELL * shape[0] * shape[1] / n_wanted))
    columns = int(np.ceil(shape[1] / cell_px))
    column, row = (uv_px // cell_px).astype(np.int64).T
    cell = row * columns + column
    order = np.lexsort((-response, cell))
    sorted_cell = cell[order]
    starts = np.flatnonzero(np.r_[True, sorted_cell[1:] != sorted_cell[:-1]])
    sizes = np.diff(np.r_[starts, len(cell)])
    rank = np.arange(len(cell)) - np.repeat(starts, sizes)
    by_rank = np.lexsort((-response[order], rank))
    return np.sort(order[by_rank[:n_wanted]])
