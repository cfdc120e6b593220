"""Detected objects against the true poses of a scene: how many are found, how exactly, and what was imagined.

The paper counts a pose as correct "if its ADD is below 10 % of the object diameter" (section V-B) and lists the
"correct detection rate in %, (ADD in mm)" (Table 2), both "evaluated on each Line2D detected object": correct poses
over detected objects, and the mean ADD of the correct ones (means of 1 to 2 mm hold no wrong pose). That rate says
nothing of parts that were not detected, so the share of the true objects stands beside it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from enum import StrEnum

import numpy as np
from scipy.optimize import linear_sum_assignment

from sidelong.evaluation.pose_errors import PoseDeviation, PoseMetrics
from sidelong.geometry.transforms import transform_points
from sidelong.types import BoolArray, DetectedObject, FloatArray

CORRECT_WITHIN = 0.1
"""Largest error of a correct pose, as a share of the part's diameter (paper, section V-B)."""
SUFFICIENTLY_VISIBLE = 0.6
"""Least visible fraction of a true object that has to be found."""
NEAR = 0.5
"""How far the centres of a detected and of a true object may be apart if one stands for the other, in diameters."""


class Criterion(StrEnum):
    """Which error decides whether a pose is correct."""

    ADD = "add"
    """As the paper: a harmless turn of a round part counts as wrong."""
    ADD_SYMMETRIC = "add_symmetric"
    ADI = "adi"
    MSSD = "mssd"


@dataclass(frozen=True)
class Match:
    """A detected object that stands for a true one: their positions in their lists, and the errors of the pose."""

    detected: int
    true: int
    deviation: PoseDeviation


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Detected objects beside true ones.

    Attributes
    ----------
    detected
        How many objects were detected.
    sufficiently_visible
        (M,) true objects that have to be found.
    correct
        Pairs whose error is below the limit, one to one; hidden true objects may be among them.
    deviation
        Means of the errors of ``correct``; None where there is none.
    """

    detected: int
    sufficiently_visible: BoolArray
    correct: tuple[Match, ...]

    @property
    def rate_of_detected(self) -> float | None:
        """Correct over detected objects, the paper's rate; None where nothing was detected."""
        return len(self.correct) / self.detected if self.detected else None

    @property
    def recall(self) -> float | None:
        """Found over true objects that are sufficiently visible; None where there is none."""
        found = sum(bool(self.sufficiently_visible[match.true]) for match in self.correct)
        wanted = int(self.sufficiently_visible.sum())
        return found / wanted if wanted else None

    @property
    def false_alarms(self) -> int:
        """Detected objects that are at no true pose, or at one that another detected object is nearer to."""
        return self.detected - len(self.correct)

    @property
    def deviation(self) -> PoseDeviation | None:
        """Means over the correct ones of all errors; None where there is none."""
        if not self.correct:
            return None
        names = [each.name for each in fields(PoseDeviation)]
        means = (float(np.mean([getattr(match.deviation, name) for match in self.correct])) for name in names)
        return PoseDeviation(*means)


def evaluate(
    estimates: Sequence[FloatArray],
    truths: Sequence[FloatArray],
    metrics: PoseMetrics,
    visible_fraction: FloatArray | None = None,
    criterion: Criterion = Criterion.ADD,
) -> Evaluation:
    """Match poses to true poses and count.

    Pairs are chosen together so that as many as possible are correct and, of those choices, the sum of errors is
    least (Hungarian method). Taking them one after another, best score first, as BOP does, is the same unless one pose
    is correct for two parts that touch; then it depends on scores, which differ from detector to detector.

    Parameters
    ----------
    estimates, truths
        (4, 4) ``camera_T_object`` each, of one part in one view.
    visible_fraction
        (M,) of the true objects; those below ``SUFFICIENTLY_VISIBLE`` need not be found, but may. None: all must.
    """
    limit_m = CORRECT_WITHIN * metrics.part.diameter_m
    errors_m, deviations = _errors(estimates, truths, metrics, criterion)
    # a wrong pair costs more than any number of right ones
    cost = np.where(errors_m < limit_m, errors_m / limit_m, 1.0 + min(errors_m.shape))
    rows, columns = linear_sum_assignment(cost)
    correct = tuple(
        Match(row, column, deviations[row, column])
        for row, column in zip(rows.tolist(), columns.tolist(), strict=True)
        if errors_m[row, column] < limit_m
    )
    visible = np.ones(len(truths)) if visible_fraction is None else visible_fraction
    return Evaluation(len(estimates), visible >= SUFFICIENTLY_VISIBLE, correct)


def _errors(
    estimates: Sequence[FloatArray], truths: Sequence[FloatArray], metrics: PoseMetrics, criterion: Criterion
) -> tuple[FloatArray, dict[tuple[int, int], PoseDeviation]]:
    """Return errors (N, M), infinite for pairs whose centres are too far apart to be correct, and the other pairs."""
    errors_m = np.full((len(estimates), len(truths)), np.inf)
    deviations: dict[tuple[int, int], PoseDeviation] = {}
    near = _centres_apart_m(estimates, truths, metrics) < NEAR * metrics.part.diameter_m
    for row, column in np.argwhere(near).tolist():
        deviations[row, column] = deviation = metrics.deviation(estimates[row], truths[column])
        errors_m[row, column] = getattr(deviation, f"{criterion}_m")
    return errors_m, deviations


def _centres_apart_m(estimates: Sequence[FloatArray], truths: Sequence[FloatArray], metrics: PoseMetrics) -> FloatArray:
    centre_m = metrics.part.symmetry.centre_m
    here, there = (
        np.array([transform_points(pose, centre_m) for pose in poses]).reshape(-1, 3) for poses in (estimates, truths)
    )
    return np.linalg.norm(here[:, None] - there, axis=2)


def best_turns_rad(
    objects: Sequence[DetectedObject], truths: Sequence[FloatArray], metrics: PoseMetrics, most: int = 10
) -> FloatArray:
    """Return for each true pose (M,) the smallest turn from it among the hypotheses of the object that stands there.

    Modulo the symmetry, in radians; infinite where no object's hypotheses are near. Objects and true poses are paired
    one to one by the distance of their centres, at most ``NEAR`` of the diameter.

    Parameters
    ----------
    truths
        (4, 4) ``camera_T_object`` each.
    most
        How many hypotheses of each object count, the most probable ones.
    """
    chosen = [[hypothesis.camera_T_object for hypothesis in each.hypotheses[:most]] for each in objects]
    limit_m = NEAR * metrics.part.diameter_m
    apart_m = np.array([_centres_apart_m(poses, truths, metrics).min(axis=0, initial=np.inf) for poses in chosen])
    apart_m = apart_m.reshape(len(objects), len(truths))
    best_rad = np.full(len(truths), np.inf)
    rows, columns = linear_sum_assignment(np.minimum(apart_m, limit_m))
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        if apart_m[row, column] < limit_m:
            rotations = np.array([pose[:3, :3] for pose in chosen[row]])
            best_rad[column] = metrics.part.symmetry.angle_rad(rotations, truths[column][:3, :3]).min()
    return best_rad
