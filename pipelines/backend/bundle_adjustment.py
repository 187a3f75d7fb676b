"""Bundle adjustment of keyframes and static points by gtsam; step 11 of the design.

Owns the problem, its factors and its solution, as arrays that any process can take. Which keyframes
and points go in is decided by `local_window` and `loop_closing`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipelines.frontend.motion_only_ba import CHI2_95_2DOF, CHI2_95_3DOF
from pipelines.geometry import MIN_DEPTH_M, invert_T, project_stereo
from pipelines.shapes import check_shape
from pipelines.types import Array, StereoCamera

if TYPE_CHECKING:
    import gtsam

_HUBER = 2.0  # standard deviations from which on an observation counts linearly
_FIXED_SIGMA = 1e-6  # rad and m, of the poses that are held
_SIGMA_STEP = 1.1  # sigmas this near share one noise model
_MIN_GAIN = 1e-4  # relative decrease of the error below which a round ends


@dataclass(frozen=True, slots=True)
class BundleProblem:
    """K keyframes, N static points and M observations of them (parallel arrays).

    Ts_world_camera: (K, 4, 4). held: (K,) bool, poses that do not move. points_m: (N, 3) in the
    world. keyframe, point: (M,) rows of these. uv_px: (M, 2). disparity_px: (M,), NaN where not
    known. sigma_uv_px, sigma_disparity_px: (M,).
    """

    camera: StereoCamera
    Ts_world_camera: Array
    held: NDArray[np.bool_]
    points_m: Array
    keyframe: NDArray[np.int64]
    point: NDArray[np.int64]
    uv_px: Array
    disparity_px: Array
    sigma_uv_px: Array
    sigma_disparity_px: Array

    def __post_init__(self) -> None:
        K, N, M = len(self.held), len(self.points_m), len(self.keyframe)
        check_shape("BundleProblem", "Ts_world_camera", self.Ts_world_camera, (K, 4, 4))
        check_shape("BundleProblem", "points_m", self.points_m, (N, 3))
        check_shape("BundleProblem", "uv_px", self.uv_px, (M, 2))
        for name in ("point", "disparity_px", "sigma_uv_px", "sigma_disparity_px"):
            check_shape("BundleProblem", name, getattr(self, name), (M,))


@dataclass(frozen=True, slots=True)
class BundleSolution:
    """Adjusted poses (K, 4, 4) and points (N, 3), and which observations (M,) agree with them.

    error_before, error_after: half the sum of squared whitened residuals under Huber's loss, of
    the observations that agree in the end.
    """

    Ts_world_camera: Array
    points_m: Array
    inliers: NDArray[np.bool_]
    error_before: float
    error_after: float


def load_solver() -> None:
    """Import gtsam, which takes the best part of a second where it was not yet."""
    import gtsam  # noqa: F401


def adjust_bundle(problem: BundleProblem, rounds: int = 2, iterations: int = 10) -> BundleSolution:
    """Minimise the stereo reprojection errors of all observations over poses and points.

    Between rounds, and after the last, observations beyond the 95 % quantile of chi-square are
    dropped. Levenberg-Marquardt with Huber's loss. Deterministic.
    """
    import gtsam

    use = _chi2(problem, problem.Ts_world_camera, problem.points_m)[1]
    Ts, points = problem.Ts_world_camera, problem.points_m
    for _ in range(rounds):
        which = np.unique(problem.point[use])
        graph, values = _graph(problem, use), _values(Ts, points, which)
        params = gtsam.LevenbergMarquardtParams()
        params.setMaxIterations(iterations)
        params.setRelativeErrorTol(_MIN_GAIN)
        params.setLinearSolverType("MULTIFRONTAL_CHOLESKY")
        params.setOrderingType("METIS" if len(Ts) > 30 else "COLAMD")
        result = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
        Ts, points = _read(result, problem, points, which)
        chi2, front = _chi2(problem, Ts, points)
        limit = np.where(np.isnan(problem.disparity_px), CHI2_95_2DOF, CHI2_95_3DOF)
        use = front & (chi2 <= limit)
    before, _ = _chi2(problem, problem.Ts_world_camera, problem.points_m)
    return BundleSolution(Ts, points, use, _robust(before[use]), _robust(chi2[use]))


def _graph(problem: BundleProblem, use: NDArray[np.bool_]) -> gtsam.NonlinearFactorGraph:
    import gtsam
    from gtsam.symbol_shorthand import L, X

    camera, graph = problem.camera, gtsam.NonlinearFactorGraph()
    fx, fy, cx, cy = camera.fx, camera.fy, camera.cx, camera.cy
    K_stereo = gtsam.Cal3_S2Stereo(fx, fy, 0.0, cx, cy, camera.baseline_m)
    K_mono = gtsam.Cal3_S2(fx, fy, 0.0, cx, cy)
    models: dict[tuple[int, int], Any] = {}
    rows = np.flatnonzero(use)
    steps_uv = np.rint(np.log(problem.sigma_uv_px[rows]) / np.log(_SIGMA_STEP)).astype(int)
    steps_d = np.rint(np.log(problem.sigma_disparity_px[rows]) / np.log(_SIGMA_STEP)).astype(int)
    stereo = np.isfinite(problem.disparity_px[rows])
    steps_d = np.where(stereo, steps_d, 10**6)
    for u, d in set(zip(steps_uv.tolist(), steps_d.tolist(), strict=True)):
        models[u, d] = _noise(_SIGMA_STEP**u, None if d == 10**6 else _SIGMA_STEP**d)
    right = problem.uv_px[:, 0] - problem.disparity_px
    columns = (
        steps_uv, steps_d, stereo, problem.keyframe[rows], problem.point[rows],
        problem.uv_px[rows, 0], right[rows], problem.uv_px[rows, 1],
    )  # fmt: skip
    lists = [column.tolist() for column in columns]
    for u, d, is_stereo, k, i, left_px, right_px, v_px in zip(*lists, strict=True):
        if is_stereo:
            graph.add(
                gtsam.GenericStereoFactor3D(
                    gtsam.StereoPoint2(left_px, right_px, v_px), models[u, d], X(k), L(i), K_stereo
                )
            )
        else:
            graph.add(
                gtsam.GenericProjectionFactorCal3_S2(
                    gtsam.Point2(left_px, v_px), models[u, d], X(k), L(i), K_mono
                )
            )
    hold = gtsam.noiseModel.Isotropic.Sigma(6, _FIXED_SIGMA)
    for k in np.flatnonzero(problem.held).tolist():
        pose = gtsam.Pose3(problem.Ts_world_camera[k])
        graph.add(gtsam.PriorFactorPose3(X(k), pose, hold))
    return graph


def _noise(sigma_uv_px: float, sigma_disparity_px: float | None) -> Any:
    """Huber on pixels (u_L, u_R, v), or (u, v) without a disparity; u_R = u_L - d shares u_L's."""
    import gtsam

    gaussian: gtsam.noiseModel.Gaussian
    if sigma_disparity_px is None:
        gaussian = gtsam.noiseModel.Isotropic.Sigma(2, sigma_uv_px)
    else:
        uv, d = sigma_uv_px**2, sigma_disparity_px**2
        covariance = np.array([[uv, uv, 0.0], [uv, uv + d, 0.0], [0.0, 0.0, uv]])
        gaussian = gtsam.noiseModel.Gaussian.Covariance(covariance)
    return gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(_HUBER), gaussian
    )


def _values(Ts: Array, points: Array, which: NDArray[np.int64]) -> gtsam.Values:
    import gtsam
    from gtsam.symbol_shorthand import L, X

    values = gtsam.Values()
    for k, T in enumerate(Ts):
        values.insert(X(k), gtsam.Pose3(T))
    for i, p in zip(which.tolist(), points[which], strict=True):
        values.insert(L(i), p)
    return values


def _read(
    values: gtsam.Values, problem: BundleProblem, points: Array, which: NDArray[np.int64]
) -> tuple[Array, Array]:
    import gtsam
    from gtsam.symbol_shorthand import X

    Ts = np.stack([values.atPose3(X(k)).matrix() for k in range(len(problem.held))])
    Ts[problem.held] = problem.Ts_world_camera[problem.held]
    moved = points.copy()
    moved[which] = gtsam.utilities.extractPoint3(values)  # in the order of their keys
    return Ts, moved


def _chi2(problem: BundleProblem, Ts: Array, points: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Squared whitened residuals (M,), and which points lie in front of their camera."""
    inverse = np.stack([invert_T(T) for T in Ts])[problem.keyframe]
    local = np.einsum("mij,mj->mi", inverse[:, :3, :3], points[problem.point]) + inverse[:, :3, 3]
    front = local[:, 2] > MIN_DEPTH_M
    local[~front] = (0.0, 0.0, 1.0)
    predicted = project_stereo(problem.camera, local)
    uv = problem.uv_px - predicted[:, :2]
    disparity = problem.disparity_px - (predicted[:, 0] - predicted[:, 2])
    chi2 = (uv**2).sum(1) / problem.sigma_uv_px**2
    chi2 += np.where(np.isnan(disparity), 0.0, (disparity / problem.sigma_disparity_px) ** 2)
    return chi2, front


def _robust(chi2: Array) -> float:
    """Half the sum of Huber's loss of squared residuals (M,)."""
    r = np.sqrt(chi2)
    return 0.5 * float(np.where(r <= _HUBER, chi2, 2.0 * _HUBER * r - _HUBER**2).sum())
