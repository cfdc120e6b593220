"""Where the camera sits on the flange, from images of a board at rest and the arm's poses.

Every step has its module: the board in the images (``board``), AX = XB in closed form and the motions it needs
(``park_martin``), what goes wrong in a cell (``hand_eye_checks``), and the refinement on all corners
(``hand_eye_refine``). The camera is the rectified left one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from sidelong.calibration.hand_eye.board import BoardObservation, BoardSettings, detect_board
from sidelong.calibration.hand_eye.checks import (
    FEWEST_POSES,
    FEWEST_TO_DOUBT,
    POOR_SPREAD_RAD,
    HandEyeSettings,
    Poses,
    check_motion,
    check_share,
    consensus,
    likely_cause,
    repeated,
    validated_arm,
)
from sidelong.calibration.hand_eye.park_martin import Spread, park_martin, spread
from sidelong.calibration.hand_eye.refine import Refined, predicted_px, refine
from sidelong.errors import CalibrationError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import invert, rotation_angle, transform_points
from sidelong.types import BoolArray, FloatArray, GrayImage

OUTLIER_WEIGHT = 0.2
"""Weight below which a pose has no part in the answer. Simulated (0.5 mrad, 0.2 mm): noise does that to 0 of 720 sound
poses in sets of 12, 1 of 360 in sets of 6; 2 mm off is found in 96 % and 28 % of the sets, 3 mm in 100 % and 68 %."""
AMBIGUOUS = 0.8
SCALE_DOUBT = (4.0, 1e-3)
"""Standard errors, and share of the board's size, by which both it must be off before that is worth a remark."""


@dataclass(frozen=True, eq=False)
class HandEye:
    """Result of :func:`solve_hand_eye`; arrays of N are one entry for each pose, in the order they were given.

    Attributes
    ----------
    flange_T_camera, base_T_board
        (4, 4) the answer, and where the board lay.
    covariance
        (6, 6) of flange_T_camera: rotation (rad) and translation (m) along the flange's axes.
    names
        (N,) of the images.
    used
        (N,) False for poses that do not agree with the others; they have no part in the answer.
    weights
        (N,) how well each pose agrees with the others: 1 or more is usual, near 0 is wrong.
    residual_px
        (N,) reprojection error of the corners, root mean square: the image's noise and the arm's. NaN for a pose that
        puts the board behind the camera.
    residual_m, residual_rad
        (N,) how far the board's middle moves, and the board turns, between where this pose sees it and base_T_board.
    rms_px
        Reprojection error of all corners of the used poses.
    corners_px, missed_px
        N arrays: corners (., 2) as found, and found less predicted.
    corner_noise_px, arm_noise_rad, arm_noise_m
        Standard deviations per axis, estimated from these data.
    board_scale, board_scale_error
        How many times larger than stated the board fits best, and its standard error.
    spread
        How far the arm turned about its worst and its best axis.
    closed_form
        (4, 4) flange_T_camera before the refinement.
    iterations, converged
        Of the refinement.
    warnings
        What to do better, or to look at.
    unused
        Names of images without a board, each with the reason.
    """

    flange_T_camera: FloatArray
    base_T_board: FloatArray
    covariance: FloatArray
    names: tuple[str, ...]
    used: BoolArray
    weights: FloatArray
    residual_px: FloatArray
    residual_m: FloatArray
    residual_rad: FloatArray
    rms_px: float
    corners_px: tuple[FloatArray, ...]
    missed_px: tuple[FloatArray, ...]
    corner_noise_px: float
    arm_noise_rad: float
    arm_noise_m: float
    board_scale: float
    board_scale_error: float
    spread: Spread
    closed_form: FloatArray
    iterations: int
    converged: bool
    warnings: tuple[str, ...]
    unused: tuple[tuple[str, str], ...] = ()

    @property
    def poses(self) -> int:
        """How many poses the answer is made of."""
        return int(self.used.sum())

    @property
    def pairs(self) -> int:
        """How many relative motions the closed form is made of."""
        return self.poses * (self.poses - 1) // 2

    @property
    def standard_error_rad(self) -> FloatArray:
        """Standard errors (3,) of the rotation about the flange's axes."""
        return np.sqrt(np.diag(self.covariance)[:3])

    @property
    def standard_error_m(self) -> FloatArray:
        """Standard errors (3,) of the translation along the flange's axes."""
        return np.sqrt(np.diag(self.covariance)[3:])

    @property
    def down_weighted(self) -> tuple[str, ...]:
        """Names of the poses that do not agree with the others."""
        return tuple(name for name, used in zip(self.names, self.used, strict=True) if not used)


def hand_eye_from_images(
    images: Sequence[GrayImage],
    names: Sequence[str],
    base_T_flanges: Sequence[ArrayLike],
    camera: PinholeCamera,
    board: BoardSettings,
    progress: Callable[[int, int], None] | None = None,
    settings: HandEyeSettings | None = None,
) -> HandEye:
    """Find the board in rectified left images and return flange_T_camera; images that show no board are left out.

    Parameters
    ----------
    images, names, base_T_flanges
        One entry each for every pose; poses in metres.
    progress
        Called after each image with how many are done, and of how many.

    Raises
    ------
    ImageError
        An image is not 8-bit grey of the camera's size.
    CalibrationError
        Lists of different lengths, a name twice, or whatever :func:`solve_hand_eye` refuses.
    PoseError
        A pose is not a rigid motion.
    """
    if not len(images) == len(names) == len(base_T_flanges):
        raise CalibrationError(
            f"hand-eye: {len(images)} images, {len(names)} names and {len(base_T_flanges)} arm poses, need one of each"
        )
    observations: list[BoardObservation] = []
    arm: list[ArrayLike] = []
    unused: list[tuple[str, str]] = []
    for done, (image, name, base_T_flange) in enumerate(zip(images, names, base_T_flanges, strict=True), start=1):
        try:
            observations.append(detect_board(image, name, camera, board))
            arm.append(base_T_flange)
        except CalibrationError as error:
            unused.append((name, str(error)))
        if progress is not None:
            progress(done, len(images))
    if len(observations) < FEWEST_POSES:
        raise CalibrationError(
            f"hand-eye: {len(observations)} of {len(images)} images show the board, needs {FEWEST_POSES}; "
            + "; ".join(reason for _, reason in unused)
        )
    return replace(solve_hand_eye(observations, arm, camera, settings), unused=tuple(unused))


def solve_hand_eye(
    observations: Sequence[BoardObservation],
    base_T_flanges: Sequence[ArrayLike],
    camera: PinholeCamera,
    settings: HandEyeSettings | None = None,
) -> HandEye:
    """Return flange_T_camera from a board at rest, seen from ``FEWEST_POSES`` or more poses of the arm.

    Parameters
    ----------
    observations
        The board in each image.
    base_T_flanges
        The arm's pose (4, 4) at each image, metres.

    Raises
    ------
    PoseError
        A pose is not a rigid motion.
    CalibrationError
        Fewer than ``FEWEST_POSES`` different poses; motions that turn about one axis only, or hardly at all; images and
        poses that do not belong together; or more wrong poses than ``max_outlier_share``. The message names what would
        explain it.
    """
    names = tuple(seen.name for seen in observations)
    arm = validated_arm(base_T_flanges, names)
    boards = np.stack([seen.camera_T_board for seen in observations])
    middle = np.concatenate([seen.corners_board for seen in observations]).mean(axis=0)
    poses = Poses(names, arm, boards, middle, HandEyeSettings() if settings is None else settings)
    motions = poses.motions
    check_motion(spread(motions), len(names))
    flange_T_camera, used = consensus(poses)
    weights = used.astype(np.float64)
    noise = poses.settings.noise
    if len(names) >= FEWEST_TO_DOUBT:
        start = flange_T_camera, poses.closure(flange_T_camera).base_T_board
        weights = refine(observations, arm, camera, start, np.maximum(weights, 1e-3), noise).weights
        used = weights >= OUTLIER_WEIGHT
    check_share(poses, used, flange_T_camera)
    kept = motions.among(np.flatnonzero(used))
    check_motion(spread(kept), int(used.sum()))
    closed_form = park_martin(kept)
    chosen = [seen for seen, use in zip(observations, used, strict=True) if use]
    start = closed_form, poses.closure(closed_form).base_T_board
    refined = refine(chosen, arm[used], camera, start, None, noise)
    return _result(observations, poses, camera, refined, closed_form, used, weights, spread(kept))


def _result(
    observations: Sequence[BoardObservation],
    poses: Poses,
    camera: PinholeCamera,
    refined: Refined,
    closed_form: FloatArray,
    used: BoolArray,
    weights: FloatArray,
    turned: Spread,
) -> HandEye:
    X, Y = refined.flange_T_camera, refined.base_T_board
    predicted = invert(X) @ invert(poses.base_T_flanges) @ Y
    missed = [
        seen.corners_px - predicted_px(seen, pose, camera) for seen, pose in zip(observations, predicted, strict=True)
    ]
    residual_px = np.array([np.sqrt((one**2).sum(axis=1).mean()) for one in missed])
    seen_at = poses.base_T_flanges @ X @ poses.camera_T_boards
    moved = transform_points(invert(Y), seen_at[:, :3, :3] @ poses.middle_board + seen_at[:, :3, 3])
    result = HandEye(
        flange_T_camera=X,
        base_T_board=Y,
        covariance=refined.covariance,
        names=poses.names,
        used=used,
        weights=weights,
        residual_px=residual_px,
        residual_m=np.linalg.norm(moved - poses.middle_board, axis=1),
        residual_rad=np.array([rotation_angle(Y[:3, :3].T @ seen[:3, :3]) for seen in seen_at]),
        rms_px=float(np.sqrt((np.concatenate([m for m, u in zip(missed, used, strict=True) if u]) ** 2).sum(1).mean())),
        corners_px=tuple(seen.corners_px for seen in observations),
        missed_px=tuple(missed),
        corner_noise_px=refined.corner_noise_px,
        arm_noise_rad=refined.arm_noise_rad,
        arm_noise_m=refined.arm_noise_m,
        board_scale=refined.board_scale,
        board_scale_error=refined.board_scale_error,
        spread=turned,
        closed_form=closed_form,
        iterations=refined.iterations,
        converged=refined.converged,
        warnings=(),
    )
    return replace(result, warnings=tuple(_remarks(result, poses, observations)))


def _remarks(result: HandEye, poses: Poses, observations: Sequence[BoardObservation]) -> Iterator[str]:
    """Say what to do better, or to look at."""
    if not result.converged:
        yield f"the refinement did not converge in {result.iterations} iterations"
    if result.spread.least < POOR_SPREAD_RAD:
        yield (
            f"poor motion: about one axis the arm turned by {np.rad2deg(result.spread.least):.2g} deg only (rms over "
            f"pairs), good from {np.rad2deg(POOR_SPREAD_RAD):.2g} deg: rotate more, about two different axes"
        )
    if result.poses < FEWEST_TO_DOUBT:
        yield (
            f"{result.poses} poses: below {FEWEST_TO_DOUBT} a wrong pose is not told from the others, and the "
            "standard errors are rough; take 12"
        )
    for name, first in repeated(poses.base_T_flanges, poses.names):
        yield f"{name} repeats the arm pose of {first} and adds next to nothing"
    for seen in observations:
        if seen.ambiguity > AMBIGUOUS:
            yield f"{seen.name}: the board's tilt is ambiguous (ratio {seen.ambiguity:.2f}, limit {AMBIGUOUS:g})"
    for k in np.flatnonzero(~result.used):
        yield (
            f"{result.names[k]} disagrees with the other poses by {1e3 * result.residual_m[k]:.3g} mm and "
            f"{np.rad2deg(result.residual_rad[k]):.3g} deg and is left out: was the arm at rest?"
        )
    if (~result.used).sum() > 1 and (cause := likely_cause(poses)):
        yield cause
    off = abs(result.board_scale - 1.0)
    if off > max(SCALE_DOUBT[0] * result.board_scale_error, SCALE_DOUBT[1]):
        yield (
            f"a board {result.board_scale:.4f} times as large (standard error {result.board_scale_error:.1g}) fits the "
            "arm's motions better: measure square_m on the print, or check the camera's focal length"
        )
