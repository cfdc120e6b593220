"""Rigid motions as 4x4 matrices ``a_T_b`` that map coordinates in b to coordinates in a."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from sidelong.errors import PoseError
from sidelong.types import FloatArray

ORTHONORMAL_TOLERANCE = 1e-4
"""Largest entry of ``R R^T - I`` accepted: float32 text files reach 1e-6, a wrong scale or a shear exceeds it."""


def validated_transform(matrix: ArrayLike, name: str) -> FloatArray:
    """Return ``matrix`` as a (4, 4) float64 rigid motion, its rotation projected on the nearest rotation.

    Parameters
    ----------
    matrix
        (4, 4) or 16 numbers, row-major.
    name
        Where it came from: the file or field, for the message.

    Raises
    ------
    PoseError
        Wrong shape, NaN or infinity, a last row other than 0 0 0 1, or a rotation that is not orthonormal within
        ``ORTHONORMAL_TOLERANCE`` or is a reflection.
    """
    try:
        a_T_b = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise PoseError(f"{name}: a pose needs 16 numbers, got {matrix!r:.80}") from error
    if a_T_b.size != 16:
        raise PoseError(f"{name}: a pose needs 16 numbers (4x4, row-major), got {a_T_b.size}")
    a_T_b = a_T_b.reshape(4, 4)
    if not np.isfinite(a_T_b).all():
        raise PoseError(f"{name}: the pose has {int((~np.isfinite(a_T_b)).sum())} of 16 entries not finite")
    if np.abs(a_T_b[3] - (0.0, 0.0, 0.0, 1.0)).max() > ORTHONORMAL_TOLERANCE:
        raise PoseError(f"{name}: the last row of the pose is {a_T_b[3].tolist()}, should be [0, 0, 0, 1]")
    rotation = a_T_b[:3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if not error <= ORTHONORMAL_TOLERANCE:  # entries of 1e200 make it NaN
        raise PoseError(
            f"{name}: the rotation is not orthonormal, |R R^T - I| is {error:.3g}, limit {ORTHONORMAL_TOLERANCE:g}"
        )
    if np.linalg.det(rotation) < 0:
        raise PoseError(f"{name}: the rotation is a reflection, its determinant is -1, should be +1")
    left, _, right = np.linalg.svd(rotation)
    a_T_b[:3, :3] = left @ right
    a_T_b[3] = (0.0, 0.0, 0.0, 1.0)
    return a_T_b


def transform(rotation: ArrayLike, translation_m: ArrayLike) -> FloatArray:
    """Assemble ``a_T_b`` (4, 4) from a rotation (3, 3) and a translation (3,)."""
    a_T_b = np.eye(4)
    a_T_b[:3, :3] = rotation
    a_T_b[:3, 3] = translation_m
    return a_T_b


def invert(a_T_b: FloatArray) -> FloatArray:
    """Return ``b_T_a`` of a rigid motion; (..., 4, 4)."""
    b_T_a = np.zeros_like(a_T_b)
    b_R_a = np.swapaxes(a_T_b[..., :3, :3], -1, -2)
    b_T_a[..., :3, :3] = b_R_a
    b_T_a[..., :3, 3] = -(b_R_a @ a_T_b[..., :3, 3, None])[..., 0]
    b_T_a[..., 3, 3] = 1.0
    return b_T_a


def transform_points(a_T_b: FloatArray, points_b: FloatArray) -> FloatArray:
    """Map points (..., 3) from b to a."""
    return points_b @ a_T_b[:3, :3].T + a_T_b[:3, 3]


def rotate(a_T_b: FloatArray, directions_b: FloatArray) -> FloatArray:
    """Map directions (..., 3) from b to a."""
    return directions_b @ a_T_b[:3, :3].T


def rotation_about(axis: ArrayLike, angle_rad: float) -> FloatArray:
    """Return the (3, 3) rotation about ``axis`` (3,), any non-zero length, by ``angle_rad`` (Rodrigues).

    Raises
    ------
    PoseError
        The axis has no direction.
    """
    direction = np.asarray(axis, dtype=np.float64)
    length = float(np.linalg.norm(direction))
    if not 0 < length < np.inf:
        raise PoseError(f"axis: {direction.tolist()} has no direction")
    x, y, z = direction / length
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # 1 - cos as 2 sin^2(a/2): exact for small angles
    return np.eye(3) + np.sin(angle_rad) * cross + 2.0 * np.sin(angle_rad / 2.0) ** 2 * (cross @ cross)


def rotation_angle(rotation: FloatArray) -> float:
    """Return the angle of a rotation (3, 3) in radians, 0..pi, accurate at both ends."""
    axis_sine = np.array(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return float(np.arctan2(np.linalg.norm(axis_sine), np.trace(rotation) - 1.0))


def look_at(eye_m: ArrayLike, target_m: ArrayLike, roll_rad: float = 0.0) -> FloatArray:
    """Return ``base_T_camera`` of a camera at ``eye_m`` that looks at ``target_m`` (OpenCV axes: z forward, y down).

    At roll 0 the image's x axis is horizontal; a camera that looks straight down has x along the base's x.

    Raises
    ------
    PoseError
        Eye and target coincide, or are not finite.
    """
    eye, target = np.asarray(eye_m, dtype=np.float64), np.asarray(target_m, dtype=np.float64)
    forward = target - eye
    length = float(np.linalg.norm(forward))
    if not 0 < length < np.inf:
        raise PoseError(f"look_at: there is no direction from eye {eye.tolist()} m to target {target.tolist()} m")
    forward /= length
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right = np.array([1.0, 0.0, 0.0]) if np.linalg.norm(right) < 1e-9 else right / np.linalg.norm(right)
    right -= forward * (right @ forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    return transform(rotation @ rotation_about((0, 0, 1), roll_rad), eye)
