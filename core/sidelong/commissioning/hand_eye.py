"""Where the camera sits on the flange, from recorded images of a board."""

from __future__ import annotations

import numpy as np
from pydantic import ValidationError

from sidelong.calibration.hand_eye.board import BoardSettings
from sidelong.calibration.hand_eye.picture import draw_hand_eye
from sidelong.calibration.hand_eye.solution import HandEye, hand_eye_from_images
from sidelong.commissioning.documents import HandEyeDocument, PoseResidual
from sidelong.commissioning.made import Captures, Made, Progress
from sidelong.commissioning.tasks import HandEyeTask
from sidelong.errors import CalibrationError
from sidelong.recorded.captures import BoardCaptures
from sidelong.types import FloatArray

FARTHEST_CAMERA_M = 1.5
"""Off the flange; no bracket is that long."""


def make_hand_eye(task: HandEyeTask, captures: Captures, progress: Progress) -> Made:
    """Solve the hand-eye transform from the images of a data set.

    Raises
    ------
    DatasetError, ImageError, PoseError
        A file is missing or cannot be used.
    CalibrationError
        The board is not described well, or poses and images do not determine the transform.
    """
    recorded = captures.recorded.board()

    def told(done: int, total: int) -> None:
        progress("images of the board", done, total)

    result = hand_eye_from_images(
        recorded.images, recorded.names, recorded.base_T_flanges, captures.dataset.rig.left, _board(recorded), told
    )
    _check_mount(result, recorded)
    return Made(_document(task, captures, recorded, result), draw_hand_eye(result), _summary(result))


def _check_mount(result: HandEye, recorded: BoardCaptures) -> None:
    """Refuse a camera far off the flange: where all poses are as far from the board, another scale fits as well."""
    distance_m = float(np.linalg.norm(result.flange_T_camera[:3, 3]))
    if distance_m > FARTHEST_CAMERA_M:
        board_file, poses_file = recorded.files[:2]
        raise CalibrationError(
            f"{poses_file}: the camera would sit {distance_m * 1e3:.4g} mm off the flange, limit "
            f"{FARTHEST_CAMERA_M * 1e3:g} mm: check unit there, and square_m in {board_file.name}"
        )


def _board(recorded: BoardCaptures) -> BoardSettings:
    try:
        return BoardSettings.model_validate(dict(recorded.board))
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"])) or "board"
        raise CalibrationError(f"{recorded.files[0]}: {field}: {first['msg']}, got {first['input']!r:.60}") from error


def _document(task: HandEyeTask, captures: Captures, recorded: BoardCaptures, result: HandEye) -> HandEyeDocument:
    left_out = tuple(f"{name}: left out, {reason}" for name, reason in result.unused)
    return HandEyeDocument(
        device_serial=captures.dataset.serial,
        inputs=captures.hashed(recorded.files),
        warnings=(*result.warnings, *left_out),
        flange_T_camera=_numbers(result.flange_T_camera),
        base_T_board=_numbers(result.base_T_board),
        arm=task.arm,
        poses=result.poses,
        smallest_singular_value=result.spread.least,
        residual_rms_px=result.rms_px,
        residuals={
            name: PoseResidual(px=float(px), m=float(m), rad=float(rad), used=bool(used))
            for name, px, m, rad, used in zip(
                result.names, result.residual_px, result.residual_m, result.residual_rad, result.used, strict=True
            )
        },
        translation_error_m=tuple(float(error) for error in result.standard_error_m),
        rotation_error_rad=tuple(float(error) for error in result.standard_error_rad),
    ).sealed()


def _numbers(pose: FloatArray) -> tuple[float, ...]:
    return tuple(float(entry) for entry in pose.ravel())


def _summary(result: HandEye) -> str:
    x, y, z = result.flange_T_camera[:3, 3] * 1e3
    return (
        f"{result.poses} poses, camera at {x:.2f}, {y:.2f}, {z:.2f} mm of the flange, standard error "
        f"{result.standard_error_m.max() * 1e3:.2f} mm, corners off by {result.rms_px:.2f} px"
    )
