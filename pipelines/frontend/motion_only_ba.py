"""Motion-only bundle adjustment: one camera pose from stereo pixels of known points.

Owns eq. (1) of the paper, its weights and its robust minimisation. Knows no images and no map.

Deviation: the paper weighs all observations alike and sees one pixel (u_L, v) a point. Here each
weighs by its noise and its point's covariance, and close points are seen by the right camera too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.geometry import (
    MIN_DEPTH_M,
    exp_se3,
    invert_T,
    projection_jacobian,
    transform_points,
)
from pipelines.observations import StereoObservations
from pipelines.types import Array, StereoCamera

CHI2_95_2DOF = 5.991  # chi-square, 95 %, of a pixel (u_L, v)
CHI2_95_3DOF = 7.815  # chi-square, 95 %, of a stereo pixel (u_L, v, u_R)
_CHI2_MEDIAN_2DOF, _CHI2_MEDIAN_3DOF = 1.386, 2.366
_NOISY = 3.0  # times the expected median of chi-square
_MAX_NOISE_FACTOR = 2.0  # a frame may be this much noisier than the ones before
_MIN_POINTS = 6  # fewer cannot be told from an accident
_MAX_ITERATIONS = 10  # Levenberg-Marquardt steps per round
_CONVERGED_SIGMAS = 0.01  # a step this small beside the pose's standard deviation ends a round


@dataclass(frozen=True, slots=True)
class PoseEstimate:
    """A camera pose with what it was measured from.

    T_world_camera: (4, 4). covariance: (6, 6) of the right perturbation [omega rad, v m].
    inliers: (N,) bool. chi2: (N,) squared Mahalanobis distances, inf behind the camera.
    residuals_px: (N, 3) of (u_L, v, u_R), measured minus predicted; NaN where not measured.
    """

    T_world_camera: Array
    covariance: Array
    inliers: NDArray[np.bool_]
    chi2: Array
    residuals_px: Array

    @property
    def n_inliers(self) -> int:
        return int(self.inliers.sum())


def estimate_camera_pose(
    camera: StereoCamera,
    T_world_camera: Array,
    observations: StereoObservations,
    robust_rounds: int = 2,
    gate_px: float = np.inf,
) -> PoseEstimate:
    """Camera pose that minimises the reprojection error, eq. (1), from an initial guess.

    Huber's kernel on Mahalanobis distances, then chi-square rejection (95 %), `robust_rounds` times
    (one will do from a good guess), and a last solution of the inliers alone. The weight of an
    observation is the inverse of its pixel noise plus its point's uncertainty seen in the image,
    which eliminates the points exactly to first order. Observations more than `gate_px` from the
    guess join after the first round: many that move alike would drag even a robust cost along.
    """
    T = T_world_camera
    problem = _Problem(camera, T, observations)
    used = np.abs(problem.residuals(T)[:, :2]).max(axis=1, initial=0.0) <= gate_px
    if used.sum() < _MIN_POINTS:
        used[:] = True
    for round_index in range(robust_rounds):
        if round_index > 0:
            problem = _Problem(camera, T, observations)
        T = problem.minimise(T, used, robust=True)
        problem.allow_for_noise(T)
        used = problem.chi2(T) <= problem.limit
        if used.sum() < _MIN_POINTS:
            break
    T = problem.minimise(T, used, robust=False)
    residuals, chi2 = problem.residuals(T), problem.chi2(T)
    used = chi2 <= problem.limit
    covariance = np.full((6, 6), np.nan)
    if used.sum() >= _MIN_POINTS:
        covariance = np.linalg.pinv(problem.normal_equations(T, used, False)[0], hermitian=True)
    residuals[np.isnan(observations.uvr_px)] = np.nan
    return PoseEstimate(T, covariance, used, chi2, residuals)


def observation_covariance(
    camera: StereoCamera, T_world_camera: Array, observations: StereoObservations
) -> Array:
    """Covariances (N, 3, 3) of the residuals of eq. (1), in (u_L, v, u_R), square px.

    Pixel noise plus the point's covariance seen through the projection.
    """
    points = transform_points(invert_T(T_world_camera), observations.points_world_m)
    J = projection_jacobian(camera, points) @ T_world_camera[:3, :3].T
    S = J @ observations.point_covariances_m2 @ J.transpose(0, 2, 1)
    return add_pixel_noise(S, observations)


def add_pixel_noise(covariances: Array, observations: StereoObservations) -> Array:
    """Covariances (N, 3, 3) of (u_L, v, u_R), square px, plus the noise of the measured pixels.

    The disparity d is measured on its own, so u_R = u_L - d shares the noise of u_L.
    """
    S = covariances.copy()
    variance = observations.sigma_uv_px**2
    for row, column in ((0, 0), (1, 1), (0, 2), (2, 0), (2, 2)):
        S[:, row, column] += variance
    S[:, 2, 2] += observations.sigma_disparity_px**2
    return S


def whitening(covariances: Array) -> Array:
    """Lower triangular W (N, 3, 3) with W S W^T = I of `covariances` S, by Cholesky, closed form.

    Not finite where S is not positive definite in double precision.
    """
    S = covariances
    W = np.zeros_like(S)
    with np.errstate(invalid="ignore", divide="ignore"):
        g00 = np.sqrt(S[:, 0, 0])
        g10, g20 = S[:, 1, 0] / g00, S[:, 2, 0] / g00
        g11 = np.sqrt(S[:, 1, 1] - g10**2)
        g21 = (S[:, 2, 1] - g20 * g10) / g11
        g22 = np.sqrt(S[:, 2, 2] - g20**2 - g21**2)
        W[:, 0, 0], W[:, 1, 1], W[:, 2, 2] = 1.0 / g00, 1.0 / g11, 1.0 / g22
        W[:, 1, 0] = -g10 * W[:, 0, 0] * W[:, 1, 1]
        W[:, 2, 1] = -g21 * W[:, 1, 1] * W[:, 2, 2]
        W[:, 2, 0] = -(g20 * W[:, 0, 0] + g21 * W[:, 1, 0]) * W[:, 2, 2]
    return W


class _Problem:
    """The least-squares problem of one pose, whitened at a given guess.

    Arrays are kept by component (3, N) rather than by point: long contiguous rows are what makes
    numpy fast here.
    """

    def __init__(self, camera: StereoCamera, T: Array, observations: StereoObservations) -> None:
        self.camera = camera
        self.points = observations.points_world_m
        self.mono = np.isnan(observations.uvr_px[:, 2])
        self.uvr = np.nan_to_num(observations.uvr_px).T.copy()
        self.limit = np.where(self.mono, CHI2_95_2DOF, CHI2_95_3DOF)
        W = whitening(observation_covariance(camera, T, observations))
        W[self.mono, 2] = 0.0  # the first two rows do not know of the third
        self.usable = self._in_camera(T)[3] & np.isfinite(W).all(axis=(1, 2))
        W[~self.usable] = 0.0  # nothing is known of a projection from behind
        self.W = W.transpose(1, 2, 0).copy()

    def allow_for_noise(self, T: Array) -> None:
        """Widen all weights where this frame is so noisy that half of it would be rejected.

        The median of chi-square says by how much; it may at most double the standard deviations.
        """
        if len(self.mono) == 0:
            return
        expected = np.where(self.mono, _CHI2_MEDIAN_2DOF, _CHI2_MEDIAN_3DOF)
        excess = float(np.median(self.chi2(T) / expected))
        if excess > _NOISY:
            self.W /= min(np.sqrt(excess), _MAX_NOISE_FACTOR)

    def _in_camera(self, T: Array) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """x, y, 1 / z of the points in the camera, each (N,), and which are in front of it."""
        x, y, z = T[:3, :3].T @ (self.points.T - T[:3, 3:])
        visible = z > MIN_DEPTH_M
        return x, y, 1.0 / np.where(visible, z, 1.0), visible

    def _residual_rows(self, x: Array, y: Array, inverse_z: Array) -> tuple[Array, Array, Array]:
        """Measured minus predicted u_L, v, u_R, each (N,); eq. (1)."""
        camera = self.camera
        u = camera.fx * x * inverse_z + camera.cx
        v = camera.fy * y * inverse_z + camera.cy
        u_right = u - camera.bf * inverse_z
        return self.uvr[0] - u, self.uvr[1] - v, np.where(self.mono, 0.0, self.uvr[2] - u_right)

    def _whiten(self, a: Array, b: Array, c: Array) -> tuple[Array, Array, Array]:
        W = self.W
        return W[0, 0] * a, W[1, 0] * a + W[1, 1] * b, W[2, 0] * a + W[2, 1] * b + W[2, 2] * c

    def residuals(self, T: Array) -> Array:
        """(N, 3) residuals in px, 0 where unmeasured."""
        return np.stack(self._residual_rows(*self._in_camera(T)[:3]), -1)

    def chi2(self, T: Array) -> Array:
        """(N,) squared Mahalanobis distances, inf behind the camera (now or when whitened)."""
        x, y, inverse_z, visible = self._in_camera(T)
        e0, e1, e2 = self._whiten(*self._residual_rows(x, y, inverse_z))
        return np.where(visible & self.usable, e0 * e0 + e1 * e1 + e2 * e2, np.inf)

    def cost(self, T: Array, used: NDArray[np.bool_], robust: bool) -> float:
        """Half the (Huber) cost of the used observations; one behind the camera costs a lot."""
        chi2, limit = self.chi2(T)[used], self.limit[used]
        chi2 = np.minimum(chi2, 1e6 * limit)
        if robust:
            chi2 = np.where(chi2 <= limit, chi2, 2.0 * np.sqrt(limit * chi2) - limit)
        return 0.5 * float(chi2.sum())

    def normal_equations(
        self, T: Array, used: NDArray[np.bool_], robust: bool
    ) -> tuple[Array, Array]:
        """J^T W J (6, 6) and J^T W r (6,) at `T`, for the right perturbation [omega, v]."""
        camera = self.camera
        x, y, inverse_z, visible = self._in_camera(T)
        z = 1.0 / inverse_z
        e = self._whiten(*self._residual_rows(x, y, inverse_z))
        weight = (used & visible & self.usable).astype(float)
        if robust:
            chi2 = e[0] * e[0] + e[1] * e[1] + e[2] * e[2]
            weight *= np.minimum(1.0, np.sqrt(self.limit / np.maximum(chi2, 1e-12)))
        # d(u_L, v, u_R) / d(point in the camera), whitened, column by column
        fx, fy = camera.fx * inverse_z, camera.fy * inverse_z
        du_dz = -fx * x * inverse_z
        zero = np.zeros_like(x)
        along_x = self._whiten(fx, zero, fx)
        along_y = self._whiten(zero, fy, zero)
        along_z = self._whiten(
            du_dz, -fy * y * inverse_z, du_dz + camera.bf * inverse_z * inverse_z
        )
        J = np.empty((6, 3, len(x)))
        for row in range(3):
            ax, ay, az = along_x[row], along_y[row], along_z[row]
            J[0, row] = ay * z - az * y  # the point moves by [q]x omega - v
            J[1, row] = az * x - ax * z
            J[2, row] = ax * y - ay * x
            J[3, row], J[4, row], J[5, row] = -ax, -ay, -az
        weighted = (J * weight).reshape(6, -1)
        return weighted @ J.reshape(6, -1).T, weighted @ np.concatenate(e)

    def minimise(self, T: Array, used: NDArray[np.bool_], robust: bool) -> Array:
        """Levenberg-Marquardt (paper) from `T` (4, 4) with a fixed set of observations."""
        damping = 1e-6
        cost = self.cost(T, used, robust)
        H, g = self.normal_equations(T, used, robust)
        for _ in range(_MAX_ITERATIONS):
            step = np.linalg.solve(H + np.diag(damping * np.diag(H) + 1e-9), g)
            if not np.isfinite(step).all():
                break
            T_new = T @ exp_se3(step)
            cost_new = self.cost(T_new, used, robust)
            if cost_new <= cost:
                T, cost, damping = T_new, cost_new, max(damping * 0.1, 1e-9)
                if step @ H @ step < _CONVERGED_SIGMAS**2:
                    break
                H, g = self.normal_equations(T, used, robust)
            else:
                damping *= 100.0
                if damping > 1e6:
                    break
        return T
