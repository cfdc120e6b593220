"""Recordings of a simulated device, in the layout that calibrations are made from."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from sidelong.calibration.hand_eye.board import BoardSettings, render_board
from sidelong.geometry.transforms import invert, transform
from sidelong.recorded.writing import pose_to_mm, write_gray, write_json, write_rig
from sidelong.simulation.rig import rig_for
from sidelong.types import FloatArray

SERIAL = "N35-1"
BOARD = BoardSettings(squares_x=8, squares_y=6, square_m=0.03, marker_m=0.022)
FLANGE_T_CAMERA = transform(Rotation.from_rotvec([0.02, -0.03, 1.57]).as_matrix(), (0.03, -0.06, 0.11))
BASE_T_BOARD = transform(Rotation.from_rotvec([np.pi, 0.1, 0.0]).as_matrix(), (0.55, 0.1, 0.0))


def board_poses(count: int, tilt_rad: float = 0.25) -> list[FloatArray]:
    """Return poses camera_T_board that show the board's middle, tilted and turned."""
    random = np.random.default_rng(3)
    middle = np.array([BOARD.squares_x, BOARD.squares_y, 0.0]) * BOARD.square_m / 2
    poses: list[FloatArray] = []
    for _ in range(count):
        turn = Rotation.from_rotvec(random.normal(size=3) * tilt_rad * np.array([1.0, 1.0, 2.0])).as_matrix()
        # the left camera's axis passes left of its image's middle
        poses.append(transform(turn, np.array([0.12, 0.0, 0.7]) - turn @ middle))
    return poses


def record_boards(root: Path, poses: list[FloatArray], arm_noise_m: float = 0.0) -> None:
    """Write images of a board and the arm's poses."""
    rig = rig_for(640, 512)
    write_rig(root, rig, SERIAL)
    folder = root / "Calibration" / "HandEye"
    write_json(folder / "board.json", BOARD.model_dump(mode="json"))
    random = np.random.default_rng(4)
    told: dict[str, list[float]] = {}
    for index, camera_T_board in enumerate(poses):
        name = f"LEFT_{index}.bmp"
        write_gray(folder / name, render_board(BOARD, rig.left, camera_T_board, noise_grey=1.0, seed=index))
        base_T_flange = BASE_T_BOARD @ invert(camera_T_board) @ invert(FLANGE_T_CAMERA)
        base_T_flange[:3, 3] += arm_noise_m * random.normal(size=3)
        told[name] = pose_to_mm(base_T_flange)
    write_json(folder / "poses.json", {"unit": "mm", "poses": told})
