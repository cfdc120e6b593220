"""AX = XB in closed form, and whether the motions fix X.

Park and Martin, *Robot Sensor Calibration: Solving AX = XB on the Euclidean Group*, IEEE Trans. Robotics and Automation
10(5), 1994. With the board at rest, ``base_T_flange_i X camera_i_T_board`` is the same for all poses i; for each pair::

    A X = X B,   A = flange_j_T_flange_i,   B = camera_j_T_camera_i,   X = flange_T_camera
    log R_A = R_X log R_B                    the rotation, least squares over pairs
    (R_A - I) t_X = R_X t_B - t_A            the translation, least squares over pairs
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sidelong.geometry.transforms import invert, transform
from sidelong.types import FloatArray, IntArray

SURE_ANGLE_RAD = np.deg2rad(160.0)
"""Nearer to half a turn, noise may flip the sign of a logarithm."""


@dataclass(frozen=True, eq=False)
class Motions:
    """Relative motions of all pairs of poses.

    Attributes
    ----------
    pairs
        (P, 2) indices i, j with i < j.
    flange, camera
        (P, 4, 4) A = flange_j_T_flange_i and B = camera_j_T_camera_i.
    """

    pairs: IntArray
    flange: FloatArray
    camera: FloatArray

    def among(self, poses: IntArray) -> Motions:
        """Return the motions between these poses alone."""
        kept = np.isin(self.pairs, poses).all(axis=1)
        return Motions(self.pairs[kept], self.flange[kept], self.camera[kept])


@dataclass(frozen=True)
class Spread:
    """How far the arm's motions turn: root mean square over pairs of 2 sin(angle / 2), counting only what is not about
    one axis; radians for small angles. It does not grow with the number of poses.

    The translation's equations are these singular values of the stacked ``R_A - I``, over the square root of the number
    of pairs: an error e of the poses moves t_X by about e / least.

    Attributes
    ----------
    least, largest
        About the axis that most, and that least of the rotation is about.
    """

    least: float
    largest: float

    @property
    def condition(self) -> float:
        """Condition number of the translation's equations: largest over least."""
        return self.largest / self.least if self.least > 0 else float("inf")


def relative_motions(base_T_flanges: FloatArray, camera_T_boards: FloatArray) -> Motions:
    """Return the motions of all pairs of poses; both (N, 4, 4)."""
    i, j = np.triu_indices(len(base_T_flanges), 1)
    return Motions(
        np.stack([i, j], axis=1),
        invert(base_T_flanges[j]) @ base_T_flanges[i],
        camera_T_boards[j] @ invert(camera_T_boards[i]),
    )


def spread(motions: Motions) -> Spread:
    """Return how far the arm's motions turn about their worst and their best axis."""
    stacked = (motions.flange[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    values = np.linalg.svd(stacked, compute_uv=False) / np.sqrt(max(len(motions.pairs), 1))
    return Spread(float(values[-1]), float(values[0]))


def rotation_vectors(rotations: FloatArray) -> FloatArray:
    """Return the logarithms (P, 3) of rotations (P, 3, 3): axis times angle, radians."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_matrix(rotations).as_rotvec(), dtype=np.float64)


def park_martin(motions: Motions) -> FloatArray:
    """Return X = flange_T_camera (4, 4) of least squares over the pairs.

    Motions whose ``spread(...).least`` is near zero do not fix X; the answer is then arbitrary. Check first.
    """
    alpha = rotation_vectors(motions.flange[:, :3, :3])
    beta = rotation_vectors(motions.camera[:, :3, :3])
    # axis times sine has no jump at half a turn: its rotation says which of the two logarithms agrees
    angles = np.linalg.norm(beta, axis=1)
    turned = beta @ _aligning(_sines(alpha), _sines(beta)).T
    other = (angles > SURE_ANGLE_RAD) & ((alpha * turned).sum(axis=1) < 0)
    beta[other] *= 1 - 2 * np.pi / angles[other, None]
    rotation = _aligning(alpha, beta)
    stacked = motions.flange[:, :3, :3] - np.eye(3)
    shifted = motions.camera[:, :3, 3] @ rotation.T - motions.flange[:, :3, 3]
    translation = np.linalg.lstsq(stacked.reshape(-1, 3), shifted.ravel())[0]
    return transform(rotation, translation)


def _sines(vectors: FloatArray) -> FloatArray:
    """Return rotation vectors (P, 3) as axis times sine of the angle."""
    return vectors * np.sinc(np.linalg.norm(vectors, axis=1, keepdims=True) / np.pi)


def _aligning(alpha: FloatArray, beta: FloatArray) -> FloatArray:
    """Return the rotation R (3, 3) of least squares in alpha = R beta, both (P, 3).

    The paper's (M^T M)^(-1/2) M^T with M = sum beta alpha^T, by SVD: right where M has rank 2 as well.
    """
    left, _, right = np.linalg.svd(alpha.T @ beta)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


def board_scale(motions: Motions) -> float:
    """Return the factor on all of the camera's distances that fits the arm's motions best.

    The translation's equations with one unknown more: ``(R_A - I) t_X = s R_X t_B - t_A``.
    """
    rotation = park_martin(motions)[:3, :3]
    turned = motions.camera[:, :3, 3] @ rotation.T
    stacked = np.concatenate([motions.flange[:, :3, :3] - np.eye(3), -turned[..., None]], axis=2)
    return float(np.linalg.lstsq(stacked.reshape(-1, 4), -motions.flange[:, :3, 3].ravel())[0][3])
