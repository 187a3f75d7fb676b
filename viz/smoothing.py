"""Values over time made calm, for views that follow something.

Owns the filter alone.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pipelines.types import Array

CALM_S = 0.6  # standard deviation of the smoothing


def smoothed(values: Array, timestamps_s: Array) -> Array:
    """Values (F,) or (F, n) over time without what changes within less than about `CALM_S`.

    The ends go on as they came, so that what moves evenly stays where it is.
    """
    if len(values) < 2:
        return np.array(values, float)
    sigma = CALM_S / max(float(np.median(np.diff(timestamps_s))), 1e-3)
    n = int(4 * sigma) + 1
    pad = [(n, n)] + [(0, 0)] * (values.ndim - 1)
    longer = np.pad(np.asarray(values, float), pad, mode="reflect", reflect_type="odd")
    return np.asarray(gaussian_filter1d(longer, sigma, 0, mode="nearest")[n:-n])
