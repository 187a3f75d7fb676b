"""Motion-only bundle adjustment: poses from stereo pixels of known points, of one body or many.

Owns eqs. (1) and (3) of the paper, their weights and their robust minimisation. Knows no images and
no map. The still world is one body; each moving object is another, of which the camera has a pose
as well, so that one solver serves both and all objects are solved at once.

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
_CONVERGED_SIGMAS = 0.01  # a step this small beside the pose's standard deviation ends the last
_ROBUST_SIGMAS = 0.1  # and this small any other round: weights change after it anyway
_ROUNDING = 1e-9  # of a cost: no worse than this is no worse, and no reason to try shorter steps
_I6 = np.eye(6)


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


@dataclass(frozen=True, slots=True)
class PoseEstimates:
    """The camera's poses as J bodies see it, each in the axes of its own points.

    Ts_body_camera: (J, 4, 4). covariances: (J, 6, 6) of the right perturbations, NaN where fewer
    than six points agree. n_inliers: (J,). The rest is as in `PoseEstimate`, all bodies in a row.
    """

    Ts_body_camera: Array
    covariances: Array
    n_inliers: NDArray[np.int64]
    inliers: NDArray[np.bool_]
    chi2: Array
    residuals_px: Array


def estimate_camera_pose(
    camera: StereoCamera,
    T_world_camera: Array,
    observations: StereoObservations,
    robust_rounds: int = 2,
    gate_px: float = np.inf,
) -> PoseEstimate:
    """Camera pose that minimises the reprojection error, eq. (1), from an initial guess.

    See `estimate_poses`, of which this is the case of one body: the still world.
    """
    sizes = np.array([len(observations)])
    found = estimate_poses(
        camera, T_world_camera[None], observations, sizes, robust_rounds, gate_px
    )
    return PoseEstimate(
        found.Ts_body_camera[0],
        found.covariances[0],
        found.inliers,
        found.chi2,
        found.residuals_px,
    )


def estimate_poses(
    camera: StereoCamera,
    Ts_body_camera: Array,
    observations: StereoObservations,
    sizes: NDArray[np.int64],
    robust_rounds: int = 2,
    gate_px: float = np.inf,
    max_steps: int = _MAX_ITERATIONS,
) -> PoseEstimates:
    """Poses (J, 4, 4) that minimise the reprojection error of each body, eqs. (1) and (3).

    Ts_body_camera: (J, 4, 4) initial guesses. observations: of all bodies in a row, the points of
    each in its own axes. sizes: (J,) how many belong to each.
    Huber's kernel on Mahalanobis distances, then chi-square rejection (95 %), `robust_rounds` times
    (one will do from a good guess), and a last solution of the inliers alone. The weight of an
    observation is the inverse of its pixel noise plus its point's uncertainty seen in the image,
    which eliminates the points, and the error of the measured flow, exactly to first order (what
    VDO-SLAM calls the joint refinement of flow and pose). Observations more than `gate_px` from the
    guess join after the first round: many that move alike would drag even a robust cost along.
    max_steps: of each round, for all bodies; the slowest holds up the rest.
    """
    Ts = Ts_body_camera
    problem = _Problem(camera, Ts, observations, sizes)
    used = np.abs(problem.residuals(Ts)[:, :2]).max(axis=1, initial=0.0) <= gate_px
    for j in np.flatnonzero(problem.count(used) < _MIN_POINTS):
        used[problem.bodies[j]] = True
    for round_index in range(robust_rounds):
        if round_index > 0:
            problem = _Problem(camera, Ts, observations, sizes)
        Ts = problem.minimise(Ts, used, True, max_steps)
        problem.allow_for_noise(Ts)
        used = problem.chi2(Ts) <= problem.limit
    Ts = problem.minimise(Ts, used, False, max_steps)
    residuals, chi2 = problem.residuals(Ts), problem.chi2(Ts)
    used = chi2 <= problem.limit
    n_inliers = problem.count(used)
    covariances = np.full((len(Ts), 6, 6), np.nan)
    solved = n_inliers >= _MIN_POINTS
    if solved.any():
        information = problem.normal_equations(Ts, used, False)[0]
        covariances[solved] = np.linalg.pinv(information[solved], hermitian=True)
    residuals[np.isnan(observations.uvr_px)] = np.nan
    return PoseEstimates(Ts, covariances, n_inliers, used, chi2, residuals)


def observation_covariance(
    camera: StereoCamera, T_world_camera: Array, observations: StereoObservations
) -> Array:
    """Covariances (N, 3, 3) of the residuals of eq. (1), in (u_L, v, u_R), square px.

    Pixel noise plus the point's covariance seen through the projection.
    """
    points = transform_points(invert_T(T_world_camera), observations.points_world_m)
    return _residual_covariance(camera, points, T_world_camera[:3, :3], observations)


def _residual_covariance(
    camera: StereoCamera, points_camera: Array, R: Array, observations: StereoObservations
) -> Array:
    """The same from points (N, 3) in the camera and rotations (3, 3) or (N, 3, 3) to it."""
    J = projection_jacobian(camera, points_camera)
    if R.ndim == 2:  # one product, not N of them
        J = (J.reshape(-1, 3) @ R.T).reshape(-1, 3, 3)
    else:
        J = J @ np.ascontiguousarray(np.swapaxes(R, -1, -2))
    # Rows in a row: products of transposed views take twice the time
    S = J @ observations.point_covariances_m2 @ np.ascontiguousarray(J.transpose(0, 2, 1))
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


@dataclass(frozen=True, slots=True)
class _Sight:
    """All points (N) as seen from poses `Ts` (J, 4, 4).

    points: (3, N) in the camera, with inverse_z: (N,). visible: (N,) in front of it. errors: (3, N)
    residuals of u_L, v, u_R, whitened; chi2: (N,) their squared lengths.
    """

    Ts: Array
    points: Array
    inverse_z: Array
    visible: NDArray[np.bool_]
    errors: Array
    chi2: Array


class _Problem:
    """The least-squares problems of the poses of J bodies, whitened at given guesses.

    Arrays are kept by component (3, N) rather than by point: long contiguous rows are what makes
    numpy fast here, and all bodies share them. What was seen from the last poses is kept, as their
    cost, their normal equations and their inliers are asked for one after the other.
    """

    def __init__(
        self,
        camera: StereoCamera,
        Ts: Array,
        observations: StereoObservations,
        sizes: NDArray[np.int64],
    ) -> None:
        self.camera = camera
        self._sizes, ends = sizes, np.cumsum(sizes)
        self.bodies = [slice(int(end - n), int(end)) for n, end in zip(sizes, ends, strict=True)]
        self._filled = np.flatnonzero(sizes > 0)
        self._starts = (ends - sizes)[self._filled]
        known = np.isfinite(observations.points_world_m).all(axis=1)
        known &= np.isfinite(observations.uvr_px[:, :2]).all(axis=1)
        self.points = observations.points_world_m.T.copy()
        self.points[:, ~known] = 0.0
        self.mono = np.isnan(observations.uvr_px[:, 2])
        self.uvr = np.nan_to_num(observations.uvr_px).T.copy()
        self.limit = np.where(self.mono, CHI2_95_2DOF, CHI2_95_3DOF)
        points, inverse_z, visible = self._in_camera(Ts)
        points_camera = np.stack([points[0], points[1], 1.0 / inverse_z], -1)
        R = Ts[0, :3, :3] if len(Ts) == 1 else np.repeat(Ts[:, :3, :3], sizes, axis=0)
        W = whitening(_residual_covariance(camera, points_camera, R, observations))
        W[self.mono, 2] = 0.0  # the first two rows do not know of the third
        self.usable = known & visible & np.isfinite(W).all(axis=(1, 2))
        W[~self.usable] = 0.0  # nothing is known of a projection from behind
        self.W = W.transpose(1, 2, 0).copy()
        self._sight: _Sight | None = None

    def _sum(self, values: Array) -> Array:
        """(J,) sums of values (N,) over each body."""
        sums = np.zeros(len(self.bodies))
        if len(self._filled):
            sums[self._filled] = np.add.reduceat(values, self._starts)
        return sums

    def count(self, used: NDArray[np.bool_]) -> NDArray[np.int64]:
        """(J,) how many observations of each body are used."""
        return self._sum(used.astype(float)).astype(np.int64)

    def allow_for_noise(self, Ts: Array) -> None:
        """Widen a body's weights where it is so noisy that half of it would be rejected.

        The median of chi-square says by how much; it may at most double the standard deviations.
        """
        expected = np.where(self.mono, _CHI2_MEDIAN_2DOF, _CHI2_MEDIAN_3DOF)
        share = self.chi2(Ts) / expected
        for body in self.bodies:
            if body.start == body.stop:
                continue
            excess = float(np.median(share[body]))
            if excess > _NOISY:
                self.W[:, :, body] /= min(np.sqrt(excess), _MAX_NOISE_FACTOR)
                self._sight = None

    def _in_camera(self, Ts: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
        """The points in the camera (3, N), 1 / z (N,), and which are in front of it (N,)."""
        Ts_camera_body = invert_T(Ts)
        if len(Ts) == 1:
            q = Ts_camera_body[0, :3, :3] @ self.points + Ts_camera_body[0, :3, 3:]
        else:  # each point with the numbers of its own body: quicker than body by body
            of_body = Ts_camera_body[:, :3].transpose(2, 1, 0).reshape(12, -1)
            a, b, c, t = np.repeat(of_body, self._sizes, axis=1).reshape(4, 3, -1)
            q = a * self.points[0] + b * self.points[1] + c * self.points[2] + t
        visible = q[2] > MIN_DEPTH_M
        return q, 1.0 / np.where(visible, q[2], 1.0), visible

    def _residual_rows(self, points: Array, inverse_z: Array) -> tuple[Array, Array, Array]:
        """Measured minus predicted u_L, v, u_R, each (N,); eqs. (1) and (3)."""
        camera = self.camera
        u = camera.fx * points[0] * inverse_z + camera.cx
        v = camera.fy * points[1] * inverse_z + camera.cy
        u_right = u - camera.bf * inverse_z
        return self.uvr[0] - u, self.uvr[1] - v, np.where(self.mono, 0.0, self.uvr[2] - u_right)

    def _look(self, Ts: Array) -> _Sight:
        """All points as seen from poses (J, 4, 4), which nobody changes in place."""
        if self._sight is not None and self._sight.Ts is Ts:
            return self._sight
        W = self.W
        points, inverse_z, visible = self._in_camera(Ts)
        du, dv, du_right = self._residual_rows(points, inverse_z)
        e = W[:, 0] * du
        e[1:] += W[1:, 1] * dv
        e[2] += W[2, 2] * du_right
        squared = e * e
        chi2 = squared[0] + squared[1] + squared[2]
        self._sight = _Sight(Ts, points, inverse_z, visible, e, chi2)
        return self._sight

    def residuals(self, Ts: Array) -> Array:
        """(N, 3) residuals in px, 0 where unmeasured."""
        return np.stack(self._residual_rows(*self._in_camera(Ts)[:2]), -1)

    def chi2(self, Ts: Array) -> Array:
        """(N,) squared Mahalanobis distances, inf behind the camera (now or when whitened)."""
        sight = self._look(Ts)
        return np.where(sight.visible & self.usable, sight.chi2, np.inf)

    def cost(self, Ts: Array, used: NDArray[np.bool_], robust: bool) -> Array:
        """(J,) half the (Huber) costs of the used observations; one behind costs a lot."""
        chi2, limit = np.minimum(self.chi2(Ts), 1e6 * self.limit), self.limit
        if robust:
            chi2 = np.where(chi2 <= limit, chi2, 2.0 * np.sqrt(limit * chi2) - limit)
        return 0.5 * self._sum(chi2 * used)

    def normal_equations(
        self, Ts: Array, used: NDArray[np.bool_], robust: bool
    ) -> tuple[Array, Array]:
        """J^T W J (J, 6, 6) and J^T W r (J, 6) at `Ts`, for right perturbations [omega, v]."""
        camera, W, sight = self.camera, self.W, self._look(Ts)
        (x, y, _), inverse_z, e = sight.points, sight.inverse_z, sight.errors
        z = 1.0 / inverse_z
        weight = (used & sight.visible & self.usable).astype(float)
        if robust:
            weight *= np.minimum(1.0, np.sqrt(self.limit / np.maximum(sight.chi2, 1e-12)))
        # d(u_L, v, u_R) / d(point in the camera), whitened, column by column: each (3, N)
        fx, fy = camera.fx * inverse_z, camera.fy * inverse_z
        of_u = W[:, 0].copy()  # u_R moves as u_L does
        of_u[2] += W[2, 2]
        along_x, along_y, along_z = of_u * fx, W[:, 1] * fy, of_u * (-fx * x * inverse_z)
        along_z += W[:, 1] * (-fy * y * inverse_z)
        along_z[2] += W[2, 2] * (camera.bf * inverse_z * inverse_z)
        J = np.empty((6, 3, len(x)))
        J[0] = along_y * z - along_z * y  # the point moves by [q]x omega - v
        J[1] = along_z * x - along_x * z
        J[2] = along_x * y - along_y * x
        J[3], J[4], J[5] = -along_x, -along_y, -along_z
        weighted = J * weight
        H, g = np.empty((len(Ts), 6, 6)), np.empty((len(Ts), 6))
        for j, body in enumerate(self.bodies):
            w = weighted[:, :, body].reshape(6, -1)
            H[j] = w @ J[:, :, body].reshape(6, -1).T
            g[j] = w @ e[:, body].ravel()
        return H, g

    def minimise(self, Ts: Array, used: NDArray[np.bool_], robust: bool, max_steps: int) -> Array:
        """Levenberg-Marquardt (paper) from `Ts` (J, 4, 4) with a fixed set of observations.

        Each body has its own damping, and stops on its own.
        """
        converged = (_ROBUST_SIGMAS if robust else _CONVERGED_SIGMAS) ** 2
        damping = np.full(len(Ts), 1e-6)
        going = np.ones(len(Ts), bool)
        cost = self.cost(Ts, used, robust)
        H, g = self.normal_equations(Ts, used, robust)
        for _ in range(max_steps):
            diagonal = damping[:, None] * np.diagonal(H, axis1=1, axis2=2) + 1e-9
            step = np.linalg.solve(H + diagonal[:, :, None] * _I6, g[..., None])[..., 0]
            going &= np.isfinite(step).all(axis=1)
            step[~going] = 0.0
            Ts_new = Ts @ exp_se3(step)
            cost_new = self.cost(Ts_new, used, robust)
            better = going & (cost_new <= cost + _ROUNDING * (1.0 + cost))
            Ts = Ts_new if better.all() else np.where(better[:, None, None], Ts_new, Ts)
            cost = np.where(better, cost_new, cost)
            damping = np.where(better, np.maximum(damping * 0.1, 1e-9), damping * 100.0)
            length2 = ((H @ step[..., None])[..., 0] * step).sum(1)
            going &= ~(better & (length2 < converged)) & (damping <= 1e6)
            if not going.any():
                break
            if better.any():
                H, g = self.normal_equations(Ts, used, robust)
        return Ts
