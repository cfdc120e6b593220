"""A board, a camera on an arm and what they see: exact corners or rendered images, with known noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from sidelong.calibration.hand_eye.board import BoardObservation, BoardSettings, observe
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import invert, transform, transform_points

CAMERA = PinholeCamera(1280, 1024, 1400.0, 1405.0, 645.0, 508.0)
BOARD = BoardSettings(squares_x=8, squares_y=6, square_m=0.03, marker_m=0.022)
MIDDLE = np.array([0.12, 0.09, 0.0])
FLANGE_T_CAMERA = transform(Rotation.from_rotvec([0.02, -0.03, 1.57]).as_matrix(), (0.03, -0.06, 0.11))
BASE_T_BOARD = transform(Rotation.from_rotvec([np.pi, 0.1, 0.0]).as_matrix(), (0.55, 0.1, 0.0))


def small_motion(random: np.random.Generator, rad: float, metres: float) -> np.ndarray:
    return transform(Rotation.from_rotvec(random.normal(size=3) * rad).as_matrix(), random.normal(size=3) * metres)


def camera_T_board(random: np.random.Generator, tilt_rad: float = 0.25, distance_m: float = 0.6) -> np.ndarray:
    """Return a pose that looks at the board's middle, tilted and turned at random."""
    rotation = Rotation.from_rotvec(random.normal(size=3) * tilt_rad * np.array([1.0, 1.0, 2.0])).as_matrix()
    return transform(rotation, np.array([0.0, 0.0, distance_m + 0.05 * random.normal()]) - rotation @ MIDDLE)


@dataclass(frozen=True, eq=False)
class Noise:
    arm_rad: float = 0.0
    arm_m: float = 0.0
    corner_px: float = 0.0


USUAL = Noise(5e-4, 2e-4, 0.05)


def exact_arm(boards: np.ndarray, flange_T_camera: np.ndarray = FLANGE_T_CAMERA) -> np.ndarray:
    """Return base_T_flange (N, 4, 4) of camera_T_board (N, 4, 4)."""
    return BASE_T_BOARD @ invert(boards) @ invert(flange_T_camera)


def seen(
    boards: np.ndarray, noise: Noise = Noise(), random: np.random.Generator | None = None, board: BoardSettings = BOARD
) -> list[BoardObservation]:
    """Return observations whose corners are exact but for the noise."""
    random = np.random.default_rng(0) if random is None else random
    corners = board.corners_board
    found: list[BoardObservation] = []
    for k, pose in enumerate(boards):
        exact = CAMERA.project(transform_points(pose, corners))
        found.append(observe(exact + noise.corner_px * random.normal(size=exact.shape), corners, f"image_{k}", CAMERA))
    return found


def scene(
    poses: int, seed: int = 0, noise: Noise = USUAL, tilt_rad: float = 0.25
) -> tuple[list[BoardObservation], np.ndarray]:
    """Return observations and the arm's poses as it reports them, both noisy."""
    random = np.random.default_rng(seed)
    boards = np.stack([camera_T_board(random, tilt_rad) for _ in range(poses)])
    arm = exact_arm(boards)
    reported = np.stack([pose @ small_motion(random, noise.arm_rad, noise.arm_m) for pose in arm])
    return seen(boards, noise, random), reported


def error(flange_T_camera: np.ndarray) -> tuple[float, float]:
    """Return the error in metres and radians."""
    turned = Rotation.from_matrix(flange_T_camera[:3, :3] @ FLANGE_T_CAMERA[:3, :3].T)
    return float(np.linalg.norm(flange_T_camera[:3, 3] - FLANGE_T_CAMERA[:3, 3])), float(turned.magnitude())
