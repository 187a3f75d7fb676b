"""gtsam's reprojection factors for pixels and disparities, each with weights of its own.

Owns the noise models, shared by observations of nearly equal sigmas, and Huber's kernel on them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np

from pipelines.types import Array, StereoCamera

HUBER = 2.0  # standard deviations from which on an observation counts linearly
_SIGMA_STEP = 1.1  # sigmas this near share one noise model

Factor = Callable[[int, int], Any]  # of the keys of a camera pose and of a point


class PixelNoise:
    """Makes stereo factors where the disparity is known, and projection factors elsewhere."""

    def __init__(self, camera: StereoCamera) -> None:
        import gtsam

        fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
        self._stereo = gtsam.Cal3_S2Stereo(fx, fy, 0.0, cx, cy, camera.baseline_m)
        self._mono = gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)
        self._models: dict[tuple[int, int | None], Any] = {}

    def factors(
        self, uv_px: Array, disparity_px: Array, sigma_uv_px: Array, sigma_disparity_px: Array
    ) -> Iterator[Factor]:
        """For each of N observations (N, 2), (N,) a function that makes its factor of two keys."""
        import gtsam

        known = np.isfinite(disparity_px)
        steps_uv = _steps(sigma_uv_px)
        steps_d = _steps(np.where(known, sigma_disparity_px, 1.0))
        columns = (known, steps_uv, steps_d, uv_px[:, 0], uv_px[:, 0] - disparity_px, uv_px[:, 1])
        lists = [column.tolist() for column in columns]
        for is_stereo, step_uv, step_d, left_px, right_px, v_px in zip(*lists, strict=True):
            model = self._model(step_uv, step_d if is_stereo else None)
            if is_stereo:
                seen = gtsam.StereoPoint2(left_px, right_px, v_px)
                yield partial(_stereo_factor, seen, model, self._stereo)
            else:
                pixel = gtsam.Point2(left_px, v_px)
                yield partial(_projection_factor, pixel, model, self._mono)

    def _model(self, step_uv: int, step_d: int | None) -> Any:
        if (step_uv, step_d) not in self._models:
            sigma_d = None if step_d is None else _SIGMA_STEP**step_d
            self._models[step_uv, step_d] = huber_noise(_SIGMA_STEP**step_uv, sigma_d)
        return self._models[step_uv, step_d]


def huber_noise(sigma_uv_px: float, sigma_disparity_px: float | None) -> Any:
    """Huber on pixels (u_L, u_R, v), or (u, v) without a disparity; u_R = u_L - d shares u_L's."""
    import gtsam

    gaussian: gtsam.noiseModel.Gaussian
    if sigma_disparity_px is None:
        gaussian = gtsam.noiseModel.Isotropic.Sigma(2, sigma_uv_px)
    else:
        uv, d = sigma_uv_px**2, sigma_disparity_px**2
        covariance = np.array([[uv, uv, 0.0], [uv, uv + d, 0.0], [0.0, 0.0, uv]])
        gaussian = gtsam.noiseModel.Gaussian.Covariance(covariance)
    return gtsam.noiseModel.Robust.Create(gtsam.noiseModel.mEstimator.Huber.Create(HUBER), gaussian)


def _stereo_factor(seen: Any, model: Any, K: Any, X: int, p: int) -> Any:
    import gtsam

    return gtsam.GenericStereoFactor3D(seen, model, X, p, K)


def _projection_factor(pixel: Any, model: Any, K: Any, X: int, p: int) -> Any:
    import gtsam

    return gtsam.GenericProjectionFactorCal3_S2(pixel, model, X, p, K)


def _steps(sigmas_px: Array) -> Any:
    return np.rint(np.log(sigmas_px) / np.log(_SIGMA_STEP)).astype(int)
