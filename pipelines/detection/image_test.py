"""The image test: does a region look as if it had stood still?

Owns one comparison of grey levels. Computed flow is everywhere, also where nothing shows it.
"""

from __future__ import annotations

import cv2
import numpy as np

from pipelines.detection.cells import Bools, CellGrid, Floats, sample
from pipelines.detection.flow_test import FlowResiduals
from pipelines.detection.masks import box_of

_WORSE, _WORSE_GREY = 1.3, 0.7  # factor, grey levels: so much worse must stillness look
_GREY_WINDOW_PX = 15  # differences count less their mean over this window


def looks_still(
    grid: CellGrid, images: tuple[Floats, Floats], flow: FlowResiduals, region: Bools
) -> bool:
    """Whether the image before, read where still matter was, fits as well as where flow leads.

    images: (H, W) float32 grey of this frame and the one before. region: (h, w), not empty. True
    where nothing of it can be compared. Where there is little texture, computed flow follows what
    passes in front; both places then look alike.
    """
    rows, columns = box = box_of(region)
    size = grid.cell_px
    window = (
        slice(rows.start * size, rows.stop * size),
        slice(columns.start * size, columns.stop * size),
    )
    here, before = images[0][window], images[1]
    u, v = flow.from_u_px[box], flow.from_v_px[box]
    error_u, error_v = flow.error_px[0][box], flow.error_px[1][box]
    still = _difference(here, before, u - error_u, v - error_v)
    moved = _difference(here, before, u, v)
    inside = region[box] & flow.valid[box] & np.isfinite(still) & np.isfinite(moved)
    if not inside.any():
        return True
    by_still, by_flow = float(still[inside].mean()), float(moved[inside].mean())
    return by_still < max(_WORSE * by_flow, by_flow + _WORSE_GREY)


def _difference(here: Floats, before: Floats, u_px: Floats, v_px: Floats) -> Floats:
    """Mean absolute difference of each cell, NaN where a pixel of it was out of sight.

    here: pixels of a window. u_px, v_px: of its cells, places in the image `before`.
    """
    shape = here.shape[::-1]
    u, v = (cv2.resize(x, shape, interpolation=cv2.INTER_LINEAR) for x in (u_px, v_px))
    there = sample(before, np.asarray(u, np.float32), np.asarray(v, np.float32))
    # Less its mean, so that exposure does not count; NaN would spread through it
    known = np.isfinite(there)
    difference = np.where(known, there - here, np.float32(0))
    difference -= cv2.blur(difference, (_GREY_WINDOW_PX, _GREY_WINDOW_PX))
    difference = np.where(known, np.abs(difference), np.float32(np.nan))
    mean = cv2.resize(difference, u_px.shape[::-1], interpolation=cv2.INTER_AREA)
    return np.asarray(mean, np.float32)
