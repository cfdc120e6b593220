"""Small errors of the arm, registered away by the depth that two views share.

Point to plane (Chen and Medioni, 1992) with projective association and a robust kernel, and with what the arm is known
to err as prior: where the geometry says nothing, a plane sliding along itself, the arm is believed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from sidelong.fusion.engine import common_noise
from sidelong.fusion.registration_kernel import INDEPENDENT_PX, accumulate
from sidelong.fusion.settings import RegistrationSettings
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import rotation_about
from sidelong.kernels import strips
from sidelong.types import Float32Array, FloatArray

KERNELS_M = (4e-3, 4e-3, 2e-3, 1e-3, 1e-3)
"""One step each: the first find what is shared, the last no longer look at what is not."""

ALIKE = 0.15
"""Of a camera's noise, what all depths of a map have in common: a matcher's disparity is off by what is left of a
pixel, and on the ground of a bin that is much the same everywhere. Taken for nothing, it tilts views, and what is
tilted about a camera 0.7 m away slides."""

LEAST_INFORMATION = 0.1
"""On a direction, in units of what the prior holds: less is scaled as if it were that."""
ROUNDING = 1e-6
"""Of information that is a million times the prior's, in units of the least; where nothing is told, it is the noise."""

LEAST_POINTS = 100
"""Fewer shared points tell nothing of a pose."""

SMOOTHING_PX = 7
"""Window of the means that slopes are taken from."""


@dataclass(frozen=True, eq=False)
class Registered:
    """Where a view is, after registration.

    Attributes
    ----------
    reference_T_view
        (4, 4).
    covariance
        (6, 6) of a small turn (rad) about the view's camera, then a small shift (m), along the axes of the reference.
    shift_m, turn_rad
        How far that is from where the arm says.
    shared_points
        Points of the view that lie on surface the reference measured too.
    """

    reference_T_view: FloatArray
    covariance: FloatArray
    shift_m: float
    turn_rad: float
    shared_points: int


def as_the_arm_says(reference_T_view: FloatArray, settings: RegistrationSettings | None) -> Registered:
    """Return a view as it is, with the uncertainty of the arm; with none where the arm is exact."""
    covariance = np.zeros((6, 6)) if settings is None else _arm_covariance(reference_T_view, settings)
    return Registered(reference_T_view, covariance, 0.0, 0.0, 0)


def register(
    view: tuple[Float32Array, Float32Array],
    reference: tuple[Float32Array, Float32Array],
    reference_T_view: FloatArray,
    camera: PinholeCamera,
    settings: RegistrationSettings,
) -> Registered:
    """Bring a view in line with the reference.

    Parameters
    ----------
    view, reference
        (H, W) depth and its standard deviation, NaN where missing.
    reference_T_view
        (4, 4) as the arm says.
    camera
        Of both.
    settings
        What the arm may err.
    """
    root: FloatArray = np.linalg.cholesky(_arm_covariance(reference_T_view, settings)).astype(np.float64)
    alike = ALIKE * common_noise(*view), ALIKE * common_noise(*reference)
    intrinsics = np.array([camera.fx, camera.fy, camera.cx, camera.cy])
    pose, correction, covariance, count = reference_T_view, np.zeros(6), root @ root.T, 0
    for step, kernel_m in enumerate(KERNELS_M):
        # at first it is the pose that makes residuals large, in the end what is not as the noise says
        as_seen = step >= len(KERNELS_M) - 2
        at = partial(accumulate, view, reference, pose, intrinsics, alike, kernel_m, as_seen)
        parts = strips(at, view[0].shape[0] // INDEPENDENT_PX)
        count = sum(int(part[4]) for part in parts)
        hessian, gradient, scatter, modes = (_summed([part[k] for part in parts]) for k in range(4))
        if count < LEAST_POINTS:
            return as_the_arm_says(reference_T_view, settings)
        correction, covariance = _estimate(hessian, scatter + modes @ modes.T, hessian @ correction - gradient, root)
        pose = _moved(reference_T_view, correction)
    shift_m, turn_rad = float(np.linalg.norm(correction[3:])), float(np.linalg.norm(correction[:3]))
    return Registered(pose, covariance, shift_m, turn_rad, count)


def _estimate(
    hessian: FloatArray, noise: FloatArray, told: FloatArray, root: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the correction c (6,) and its covariance (6, 6) from ``told = hessian c`` and noise of that covariance.

    Of all that is linear in what is told, the estimate comes nearest to a correction drawn from the prior ``root
    root^T``. It is made along the principal axes of the information in units of the prior, each scaled by itself: on a
    plane three of them hold a million times the information of the other three, which may be exactly none.
    """
    rows, values, columns = np.linalg.svd(root.T @ hessian @ root)
    scale = 1.0 / np.maximum(values, LEAST_INFORMATION)
    share = values * scale
    heard = (root @ rows) * scale
    inverse = np.linalg.inv(np.diag(share**2 + ROUNDING) + heard.T @ noise @ heard)
    base = root @ columns.T
    correction: FloatArray = base @ (share[:, None] * inverse) @ (heard.T @ told)
    left = (1 + ROUNDING) * np.eye(6) - share[:, None] * inverse * share
    covariance: FloatArray = base @ left @ base.T
    return correction, (covariance + covariance.T) / 2


def _summed(arrays: list[FloatArray]) -> FloatArray:
    return np.sum(arrays, axis=0)


def smoothed(depth_m: Float32Array) -> Float32Array:
    """Return the mean of 1/z over a window of each pixel as depth (H, W), NaN where one of the window is missing.

    The noise of single depths turns normals by ten degrees, and normals that waver on a plane hold it in its place.
    """
    import cv2

    inverse = np.zeros_like(depth_m)
    np.divide(1, depth_m, out=inverse, where=depth_m > 0)
    window = SMOOTHING_PX, SMOOTHING_PX
    mean: Any = cv2.boxFilter(inverse, -1, window, borderType=cv2.BORDER_CONSTANT)
    gaps: Any = cv2.erode(
        (inverse > 0).astype(np.uint8), np.ones(window, dtype=np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0
    )
    return np.divide(1, mean, out=np.full_like(depth_m, np.nan), where=gaps > 0)


def _moved(pose: FloatArray, step: FloatArray) -> FloatArray:
    """Turn a view about its camera and shift it: ``step`` (6,) in rad and m, along the reference's axes."""
    moved = pose.copy()
    angle_rad = float(np.linalg.norm(step[:3]))
    if angle_rad > 0:
        moved[:3, :3] = rotation_about(step[:3], angle_rad) @ pose[:3, :3]
    moved[:3, 3] += step[3:]
    return moved


def _arm_covariance(reference_T_view: FloatArray, settings: RegistrationSettings) -> FloatArray:
    """Return (6, 6) of a view's pose in the reference: the arm errs at both, at the reference about the reference."""
    own = np.diag(np.repeat([settings.arm_turn_rad, settings.arm_shift_m], 3) ** 2 / 3)
    x, y, z = reference_T_view[:3, 3]
    about_reference = np.eye(6)
    about_reference[3:, :3] = -np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return own + about_reference @ own @ about_reference.T
