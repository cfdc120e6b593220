"""What goes wrong in a hand-eye calibration, told from what the arm and the images say.

Poses too few, repeated, or without the rotation that fixes the answer are refused, and so are poses that do not belong
to the images; then the usual mix-ups are tried, and the one that would explain the data is named.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from sidelong.calibration.hand_eye.park_martin import (
    Motions,
    Spread,
    board_scale,
    park_martin,
    relative_motions,
    rotation_vectors,
    spread,
)
from sidelong.errors import CalibrationError
from sidelong.geometry.transforms import invert, validated_transform
from sidelong.types import BoolArray, FloatArray, IntArray

FEWEST_POSES = 3
FEWEST_TO_DOUBT = 6
"""With fewer poses a wrong one cannot be told from the others: those left agree with nearly any answer."""
LEAST_SPREAD_RAD = 0.02
"""Below, an error of the poses comes out more than tenfold with 12 of them, and faster than linear: nothing is known.
Of rotations about one axis, arm noise of 1 mrad makes 0.002."""
POOR_SPREAD_RAD = 0.2
"""Simulated with 3 to 30 poses: the translation's error is 1.4 times that of a pose over (spread times square root of
the number of poses), so two times that of a pose here for 12 poses."""
SAME_POSE_M = 1e-4
SAME_POSE_RAD = 1e-4
TRIPLETS = 300


class HandEyeSettings(BaseModel):
    """What a hand-eye calibration accepts. The limits tell mix-ups from noise; a sound arm stays below a tenth."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    max_residual_m: Annotated[
        FiniteFloat, Field(gt=0, le=0.1, description="disagreement of half the poses above which they are refused")
    ] = 5e-3
    max_residual_rad: Annotated[FiniteFloat, Field(gt=0, le=0.5, description="the same of their rotation")] = 0.02
    max_outlier_share: Annotated[
        FiniteFloat,
        Field(ge=0, lt=0.5, description="poses that may disagree with the others, where there are 6 or more"),
    ] = 0.25
    noise: Literal["arm", "image"] = Field(
        default="arm",
        description="arm: its poses err as well, by as much as the data show; image: they are taken for exact",
    )


@dataclass(frozen=True, eq=False)
class Closure:
    """How well poses agree on where the board is.

    Attributes
    ----------
    base_T_board
        (4, 4) where the pose in the middle of the others sees it.
    residual_m, residual_rad
        (N,) from there to where each pose sees the board's middle, and how it is turned.
    score
        (N,) the larger of both in units of its limit.
    """

    base_T_board: FloatArray
    residual_m: FloatArray
    residual_rad: FloatArray
    score: FloatArray

    @property
    def typical(self) -> float:
        """Score that half of the poses reach."""
        return float(np.sort(self.score)[len(self.score) // 2])

    @property
    def text(self) -> str:
        """The medians for a message."""
        metres, radians = np.median(self.residual_m), np.median(self.residual_rad)
        return f"{1e3 * metres:.3g} mm and {np.rad2deg(radians):.3g} deg"


@dataclass(frozen=True, eq=False)
class Poses:
    """The arm and the board in the camera at each image, and what a solution must keep to.

    Attributes
    ----------
    names
        (N,) of the images.
    base_T_flanges, camera_T_boards
        (N, 4, 4).
    middle_board
        (3,) of the corners.
    """

    names: tuple[str, ...]
    base_T_flanges: FloatArray
    camera_T_boards: FloatArray
    middle_board: FloatArray
    settings: HandEyeSettings

    @property
    def motions(self) -> Motions:
        """Of all pairs."""
        return relative_motions(self.base_T_flanges, self.camera_T_boards)

    @property
    def outlier_limit(self) -> float:
        """Share of poses that may disagree; none where they are few."""
        return self.settings.max_outlier_share if len(self.names) >= FEWEST_TO_DOUBT else 0.0

    def closure(self, flange_T_camera: FloatArray) -> Closure:
        """Say how well the poses agree, given where the camera sits."""
        seen = self.base_T_flanges @ flange_T_camera @ self.camera_T_boards
        middles = seen[:, :3, :3] @ self.middle_board + seen[:, :3, 3]
        metres = np.linalg.norm(middles[:, None] - middles[None], axis=-1)
        # |R - S| = 2 sqrt(2) sin(angle / 2)
        chords = np.linalg.norm((seen[:, None, :3, :3] - seen[None, :, :3, :3]).reshape(*metres.shape, 9), axis=-1)
        radians = 2 * np.arcsin(np.minimum(chords / np.sqrt(8.0), 1.0))
        scores = np.maximum(metres / self.settings.max_residual_m, radians / self.settings.max_residual_rad)
        best = int(np.argmin(np.sort(scores, axis=0)[len(scores) // 2]))
        return Closure(seen[best], metres[:, best], radians[:, best], scores[:, best])


def validated_arm(base_T_flanges: Sequence[ArrayLike], names: tuple[str, ...]) -> FloatArray:
    """Return the arm's poses (N, 4, 4): rigid motions, one to each name, ``FEWEST_POSES`` of them different.

    Raises
    ------
    PoseError
        A pose is not a rigid motion.
    CalibrationError
        Lists of different lengths, a name twice, or too few different poses.
    """
    if len(base_T_flanges) != len(names):
        raise CalibrationError(f"hand-eye: {len(names)} images and {len(base_T_flanges)} arm poses, need one of each")
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise CalibrationError(f"hand-eye: the name {twice[0]} is given to {names.count(twice[0])} images")
    if len(names) < FEWEST_POSES:
        raise CalibrationError(f"hand-eye: {len(names)} poses, needs {FEWEST_POSES}")
    arm = np.stack(
        [
            validated_transform(pose, f"base_T_flange of {name}")
            for pose, name in zip(base_T_flanges, names, strict=True)
        ]
    )
    again = repeated(arm, names)
    if len(names) - len(again) < FEWEST_POSES:
        raise CalibrationError(
            f"hand-eye: {len(names) - len(again)} different arm poses, needs {FEWEST_POSES}; "
            + ", ".join(f"{name} repeats {first}" for name, first in again)
        )
    return arm


def repeated(arm: FloatArray, names: tuple[str, ...]) -> list[tuple[str, str]]:
    """Return (name, first name) of the poses that repeat an earlier one within ``SAME_POSE_M`` and ``..._RAD``."""
    motion = invert(arm)[:, None] @ arm[None]
    angles = np.linalg.norm(rotation_vectors(motion[..., :3, :3].reshape(-1, 3, 3)), axis=1).reshape(len(arm), -1)
    same = (np.linalg.norm(motion[..., :3, 3], axis=-1) < SAME_POSE_M) & (angles < SAME_POSE_RAD)
    return [(names[i], names[int(np.argmax(same[i]))]) for i in range(len(arm)) if same[i, :i].any()]


def check_motion(turned: Spread, poses: int) -> None:
    """Refuse motions that do not fix where the camera sits.

    Raises
    ------
    CalibrationError
        The arm hardly turned, or about one axis only.
    """
    if turned.least >= LEAST_SPREAD_RAD:
        return
    least_deg, limit_deg = np.rad2deg(turned.least), np.rad2deg(LEAST_SPREAD_RAD)
    if turned.largest < 2 * LEAST_SPREAD_RAD:
        raise CalibrationError(
            f"hand-eye: the {poses} arm poses hardly turn, {np.rad2deg(turned.largest):.3g} deg (rms over "
            f"pairs), need {limit_deg:.3g} deg about two axes: translations do not fix where the camera sits"
        )
    raise CalibrationError(
        f"hand-eye: the {poses} arm poses turn about one axis only, {np.rad2deg(turned.largest):.3g} deg about it and "
        f"{least_deg:.3g} deg about others (rms over pairs), needs {limit_deg:.3g} deg: the camera's place along that "
        "axis is not fixed; tilt the flange about a second one"
    )


def consensus(poses: Poses) -> tuple[FloatArray, BoolArray]:
    """Return flange_T_camera (4, 4) in closed form that half the poses or more agree on, and which do (N,).

    Raises
    ------
    CalibrationError
        No such; the message says which mix-up would explain it.
    """
    flange_T_camera, closure = _best(poses)
    if closure.typical > 1:
        settings = poses.settings
        raise CalibrationError(
            f"hand-eye: arm poses and images disagree by {closure.text} (median), limits "
            f"{1e3 * settings.max_residual_m:g} mm and {np.rad2deg(settings.max_residual_rad):.3g} deg; "
            + (likely_cause(poses) or "inverted poses, another order, other units or another board do not explain it")
        )
    return flange_T_camera, closure.score <= 1


def check_share(poses: Poses, used: BoolArray, flange_T_camera: FloatArray) -> None:
    """Refuse more poses that disagree, not ``used`` (N,), than the settings allow.

    Raises
    ------
    CalibrationError
        Too many; the message names them and the mix-up that would explain them.
    """
    wrong = np.flatnonzero(~used)
    limit = poses.outlier_limit
    if len(wrong) <= limit * len(used):
        return
    residual_m = poses.closure(flange_T_camera).residual_m
    listed = ", ".join(f"{poses.names[k]} {1e3 * residual_m[k]:.3g} mm" for k in wrong)
    raise CalibrationError(
        f"hand-eye: {len(wrong)} of {len(used)} poses disagree with the others ({listed}), limit {100 * limit:g} %"
        + (f" below {FEWEST_TO_DOUBT} poses; " if len(used) < FEWEST_TO_DOUBT else "; ")
        + (likely_cause(poses) or "was the arm at rest at each image, and the board not moved between them?")
    )


def likely_cause(poses: Poses) -> str | None:
    """Say which usual mix-up would make the poses agree; None where none of them does."""
    order = _matched_order(poses)
    scale = board_scale(poses.motions)
    arm, boards, names = poses.base_T_flanges, poses.camera_T_boards, poses.names
    moved = [f"{name} with {names[k]}'s" for name, k in zip(names, order, strict=True) if names[k] != name]
    places = ", ".join(moved[:6]) + (f" and {len(moved) - 6} more" if len(moved) > 6 else "")
    metres, resized = np.ones((4, 4)), np.ones((4, 4))
    metres[:3, 3], resized[:3, 3] = 1e-3, scale
    tried = [
        (
            "with inverted poses it would be {}: the poses seem to be flange_T_base, or the camera stands still and "
            "the arm holds the board", invert(arm), boards,
        ),
        (f"in another order it would be {{}}: the images seem to belong to other poses ({places})", arm[order], boards),
        ("with positions in millimetres it would be {}: they must be metres", arm * metres, boards),
        (
            f"with a board {scale:.4g} times as large it would be {{}}: measure square_m on the print",
            arm, boards * resized,
        ),
    ]  # fmt: skip
    closures = [
        (text, _best(Poses(names, base_T_flanges, camera_T_boards, poses.middle_board, poses.settings))[1])
        for text, base_T_flanges, camera_T_boards in tried
    ]
    text, closure = min(closures, key=lambda item: item[1].typical)
    explained = float((closure.score > 1).mean()) <= poses.outlier_limit
    return text.format(closure.text) if explained else None


def _best(poses: Poses) -> tuple[FloatArray, Closure]:
    """Return flange_T_camera of all motions or, if a pose disagrees, of the three poses that most others agree with."""
    motions = poses.motions
    flange_T_camera = park_martin(motions)
    closure = poses.closure(flange_T_camera)
    if closure.score.max() <= 1:
        return flange_T_camera, closure
    for three in _triplets(len(poses.names)):
        some = motions.among(three)
        if spread(some).least < POOR_SPREAD_RAD / 2:
            continue
        trial = park_martin(some)
        found = poses.closure(trial)
        if found.typical < closure.typical:
            flange_T_camera, closure = trial, found
    agree = motions.among(np.flatnonzero(closure.score <= 1))
    if len(agree.pairs) >= FEWEST_POSES and spread(agree).least >= LEAST_SPREAD_RAD:
        flange_T_camera = park_martin(agree)
        closure = poses.closure(flange_T_camera)
    return flange_T_camera, closure


def _triplets(count: int) -> IntArray:
    """Return sets of three poses (T, 3): all, or ``TRIPLETS`` drawn from a fixed seed."""
    every = np.array(list(combinations(range(count), 3)), dtype=np.intp)
    if len(every) <= TRIPLETS:
        return every
    return every[np.random.default_rng(0).choice(len(every), TRIPLETS, replace=False)]


def _matched_order(poses: Poses) -> IntArray:
    """Return for each image the arm pose that turns by like angles to all others: angles do not depend on X."""
    from scipy.optimize import linear_sum_assignment

    def profiles(rotations: FloatArray) -> FloatArray:
        turned = np.swapaxes(rotations, 1, 2)[:, None] @ rotations[None]
        angles = np.linalg.norm(rotation_vectors(turned.reshape(-1, 3, 3)), axis=1)
        return np.sort(angles.reshape(len(rotations), -1), axis=1)

    camera, flange = profiles(poses.camera_T_boards[:, :3, :3]), profiles(poses.base_T_flanges[:, :3, :3])
    cost = np.abs(camera[:, None] - flange[None]).sum(axis=-1)
    return np.asarray(linear_sum_assignment(cost)[1], dtype=np.intp)
