"""The hand-eye refinement: least squares on the reprojection error of all corners, with an arm that errs.

Corners differ from the prediction ``inv(X) inv(base_T_flange_i) Y`` for two reasons: the image's noise, independent in
each corner, and the arm's, which shifts all corners of an image together. Taking the second for the first would make
the answer worse and its standard errors far too small. A motion ``delta_i`` of the board in the camera, small, obeys::

    delta_i = -xi + Ad(camera_T_board_i) eta + noise,    X exp(xi), Y exp(eta) the better transforms
    cov(noise) = s^2 (P_i^T P_i)^-1 + Ad(inv X) Q Ad(inv X)^T,    P_i = d pixels / d delta

with ``delta_i = (P_i^T P_i)^-1 P_i^T (found - predicted)``, a Gauss-Newton step; s comes from how well the corners of
each image fit a plane, Q = diag(arm_noise_rad^2, arm_noise_m^2) from how the images disagree, by restricted maximum
likelihood (Patterson and Thompson 1971). To find out which images agree, each counts as much as a t distribution of
``FREEDOM`` degrees would have it (Lange, Little and Taylor 1989): a wrong pose then hardly moves the answer. Twists are
(rotation, translation).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from sidelong.calibration.hand_eye.board import BoardObservation
from sidelong.calibration.hand_eye.park_martin import rotation_vectors
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import invert, transform, transform_points
from sidelong.types import FloatArray

NoiseModel = Literal["arm", "image"]
FREEDOM = 5.0
"""Degrees of freedom of the t distribution: the usual choice."""
TWIST = 6
MAX_ITERATIONS = 60
CONVERGED = 1e-3
"""Length of the last step in standard errors."""
ROUGHLY_CONVERGED = 0.05
"""Enough, for step and weights, to find out which images agree."""
LEAST_CORNER_NOISE_PX = 0.005
"""No detector is better; keeps exact corners from being infinitely certain."""
ARM_NOISE_LIMITS = (1e-7, 0.3)
"""Radians and metres."""
IMAGE_SCALE_LIMITS = (1e-3, 1e4)


@dataclass(frozen=True, eq=False)
class Refined:
    """Result of :func:`refine`.

    Attributes
    ----------
    flange_T_camera, base_T_board
        (4, 4) of least weighted error.
    covariance
        (6, 6) of flange_T_camera: rotation (rad) and translation (m) along the flange's axes.
    weights
        (N,) what each image counts; 1 is usual, near 0 where its pose does not agree with the others.
    corner_noise_px, arm_noise_rad, arm_noise_m
        Standard deviations per axis. In mode ``image`` the arm's are zero.
    board_scale, board_scale_error
        How many times larger than stated the board fits best, were that free too, and its standard error.
    iterations, converged
        Of Gauss-Newton.
    """

    flange_T_camera: FloatArray
    base_T_board: FloatArray
    covariance: FloatArray
    weights: FloatArray
    corner_noise_px: float
    arm_noise_rad: float
    arm_noise_m: float
    board_scale: float
    board_scale_error: float
    iterations: int
    converged: bool


@dataclass(frozen=True, eq=False)
class _Linear:
    """The problem around an estimate: ``delta`` (N, 6), ``design`` (N, 6, 12), covariances of the noises (N, 6, 6)."""

    delta: FloatArray
    design: FloatArray
    image: FloatArray
    arm_adjoint: FloatArray

    def noise(self, log_scales: FloatArray) -> FloatArray:
        """Return the covariances (N, 6, 6): of image and arm for two scales, of the image times a scale for one."""
        squares = np.exp(2.0 * log_scales)
        if len(squares) == 1:
            return self.image * squares[0]
        return self.image + self.arm_adjoint @ np.diag(np.repeat(squares, 3)) @ self.arm_adjoint.T

    def normal(self, information: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the normal equations' matrix (12, 12) and right side (12,); information (N, 6, 6) of each image."""
        weighted = np.swapaxes(self.design, 1, 2) @ information
        return (weighted @ self.design).sum(axis=0), (weighted @ self.delta[..., None]).sum(axis=0)[:, 0]


def refine(
    observations: Sequence[BoardObservation],
    base_T_flanges: FloatArray,
    camera: PinholeCamera,
    start: tuple[FloatArray, FloatArray],
    weights: FloatArray | None = None,
    noise: NoiseModel = "arm",
) -> Refined:
    """Refine flange_T_camera and base_T_board from all corners of all images.

    Parameters
    ----------
    base_T_flanges
        (N, 4, 4), one for each observation.
    start
        flange_T_camera and base_T_board to start from.
    weights
        (N,) what each image counts at the start: 1, or little where it is known not to agree; then the t distribution
        decides. None: each image counts 1 to the end, which is best where all of them agree.
    noise
        ``arm``: as described above. ``image``: the reprojection error alone, as if the arm's poses were exact.
    """
    flange_T_camera, base_T_board = start
    corner_noise_px = _corner_noise_px(observations)
    log_scales = np.log([1e-3, 5e-4]) if noise == "arm" else np.zeros(1)
    robust, weights = weights is not None, np.ones(len(observations)) if weights is None else weights
    iterations = 0
    while True:
        iterations += 1
        predicted = invert(flange_T_camera) @ invert(base_T_flanges) @ base_T_board
        linear = _linearise(observations, predicted, flange_T_camera, camera, corner_noise_px)
        log_scales = _likeliest(linear, log_scales, weights)
        information: FloatArray = np.linalg.inv(linear.noise(log_scales)).astype(np.float64)
        normal, right = linear.normal(information * weights[:, None, None])
        step = np.linalg.solve(normal, right).astype(np.float64)
        flange_T_camera, base_T_board = flange_T_camera @ _motion(step[:TWIST]), base_T_board @ _motion(step[TWIST:])
        last = weights
        if robust:
            weights = _weights(linear.delta - linear.design @ step, information)
        moved = max(float(np.sqrt(step @ normal @ step)), float(np.abs(last / weights - 1).max()))
        converged = moved < (ROUGHLY_CONVERGED if robust else CONVERGED)
        if converged or iterations == MAX_ITERATIONS:
            break
    to_flange = np.kron(np.eye(2), flange_T_camera[:3, :3])
    scale, scale_error = _board_scale(linear, information * weights[:, None, None], predicted)
    scales = [float(value) for value in np.exp(log_scales)]
    if noise == "image":
        corner_noise_px, scales = corner_noise_px * scales[0], [0.0, 0.0]
    return Refined(
        flange_T_camera, base_T_board, to_flange @ np.linalg.inv(normal)[:TWIST, :TWIST] @ to_flange.T, weights,
        corner_noise_px, scales[0], scales[1], scale, scale_error, iterations, converged,
    )  # fmt: skip


def predicted_px(observation: BoardObservation, camera_T_board: FloatArray, camera: PinholeCamera) -> FloatArray:
    """Return where the found corners (N, 2) should be; NaN behind the camera."""
    return camera.project(transform_points(camera_T_board, observation.corners_board))


def _corner_noise_px(observations: Sequence[BoardObservation]) -> float:
    """Return the standard deviation per coordinate that the planes' fits leave."""
    squares = sum(len(seen.corners_px) * seen.rms_px**2 for seen in observations)
    freedom = sum(2 * len(seen.corners_px) - TWIST for seen in observations)
    return max(float(np.sqrt(squares / freedom)), LEAST_CORNER_NOISE_PX)


def _linearise(
    observations: Sequence[BoardObservation],
    predicted: FloatArray,
    flange_T_camera: FloatArray,
    camera: PinholeCamera,
    corner_noise_px: float,
) -> _Linear:
    """Return the problem around predicted camera_T_board (N, 4, 4)."""
    steps, informations = zip(
        *(_gauss_newton(seen, pose, camera) for seen, pose in zip(observations, predicted, strict=True)), strict=True
    )
    adjoint = np.stack([_adjoint(pose) for pose in predicted])
    design = np.concatenate([np.broadcast_to(-np.eye(TWIST), adjoint.shape), adjoint], axis=2)
    image = corner_noise_px**2 * np.linalg.inv(np.stack(informations))
    return _Linear(np.stack(steps), design, image, _adjoint(invert(flange_T_camera)))


def _gauss_newton(
    seen: BoardObservation, predicted: FloatArray, camera: PinholeCamera
) -> tuple[FloatArray, FloatArray]:
    """Return the twist (6,) of the board in the camera that the corners ask for, and P^T P (6, 6) of one pixel."""
    derivatives = _pixel_derivatives(transform_points(predicted, seen.corners_board), camera)
    missed = seen.corners_px - predicted_px(seen, predicted, camera)
    if np.isfinite(missed).all():
        information = derivatives.T @ derivatives
        return np.linalg.solve(information, derivatives.T @ missed.ravel()).astype(np.float64), information
    # a pose so wrong that the board comes out behind the camera: nothing to project, compare the poses
    derivatives = _pixel_derivatives(transform_points(seen.camera_T_board, seen.corners_board), camera)
    rotation = seen.camera_T_board[:3, :3] @ predicted[:3, :3].T
    shift = seen.camera_T_board[:3, 3] - rotation @ predicted[:3, 3]
    return np.concatenate([rotation_vectors(rotation[None])[0], shift]), derivatives.T @ derivatives


def _pixel_derivatives(points_camera: FloatArray, camera: PinholeCamera) -> FloatArray:
    """Return d pixels / d twist (2 N, 6) of points (N, 3)."""
    x, y, z = points_camera.T
    zero = np.zeros_like(z)
    projection = np.stack(
        [camera.fx / z, zero, -camera.fx * x / z**2, zero, camera.fy / z, -camera.fy * y / z**2], axis=1
    ).reshape(-1, 2, 3)
    motion = np.concatenate([-_cross(points_camera), np.broadcast_to(np.eye(3), (len(z), 3, 3))], axis=2)
    return (projection @ motion).reshape(-1, TWIST)


def _likeliest(linear: _Linear, log_scales: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the logarithms of the noise scales of highest restricted likelihood."""
    from scipy.optimize import minimize

    def loss(trial: FloatArray) -> float:
        # the weights' share of the determinants is the same for all trials
        information = np.linalg.inv(linear.noise(trial)) * weights[:, None, None]
        normal, right = linear.normal(information)
        left_over = linear.delta - linear.design @ np.linalg.solve(normal, right)
        determinants = float(np.linalg.slogdet(normal)[1] - np.linalg.slogdet(information)[1].sum())
        return determinants + float(_squares(left_over, information).sum())

    low, high = np.log(ARM_NOISE_LIMITS if len(log_scales) == 2 else IMAGE_SCALE_LIMITS)
    found = minimize(
        loss,
        log_scales,
        method="Nelder-Mead",
        bounds=[(low, high)] * len(log_scales),
        options={"xatol": 1e-3, "fatol": 1e-4, "maxfev": 200},
    )
    return np.asarray(found.x, dtype=np.float64)


def _weights(left_over: FloatArray, information: FloatArray) -> FloatArray:
    """Return what each image counts (N,), 1 in the middle: the fit leaves less than the noise where poses are few."""
    weights = (FREEDOM + TWIST) / (FREEDOM + _squares(left_over, information))
    return weights / np.median(weights)


def _board_scale(linear: _Linear, information: FloatArray, camera_T_boards: FloatArray) -> tuple[float, float]:
    """Return the factor on the board's size that fits best, and its standard error: one column more."""
    nearer = np.concatenate([np.zeros((len(camera_T_boards), 3)), -camera_T_boards[:, :3, 3]], axis=1)
    wider = _Linear(
        linear.delta, np.concatenate([linear.design, nearer[..., None]], axis=2), linear.image, linear.arm_adjoint
    )
    normal, right = wider.normal(information)
    covariance = np.linalg.pinv(normal, rcond=1e-15, hermitian=True)
    return 1.0 + float((covariance @ right)[-1]), float(np.sqrt(covariance[-1, -1]))


def _squares(left_over: FloatArray, information: FloatArray) -> FloatArray:
    return np.einsum("ni,nij,nj->n", left_over, information, left_over)


def _motion(twist: FloatArray) -> FloatArray:
    from scipy.spatial.transform import Rotation

    return transform(Rotation.from_rotvec(twist[:3]).as_matrix(), twist[3:])


def _cross(vectors: FloatArray) -> FloatArray:
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vectors.shape[:-1], 3, 3)


def _adjoint(a_T_b: FloatArray) -> FloatArray:
    """Return the (6, 6) matrix that maps twists in b to twists in a."""
    rotation = a_T_b[:3, :3]
    return np.block([[rotation, np.zeros((3, 3))], [_cross(a_T_b[:3, 3]) @ rotation, rotation]])
