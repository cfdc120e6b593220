"""What the poses of a scan are worth against the truth, in the form of the paper's Table 2 and modulo symmetry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from pydantic import BaseModel, ConfigDict

from sidelong.evaluation.detections import Criterion, Evaluation, evaluate
from sidelong.evaluation.pose_errors import PoseMetrics
from sidelong.types import DetectedObject, FloatArray


class PoseScore(BaseModel):
    """Counts and mean errors of the most probable poses in one reference view.

    ``correct`` and ``add_m`` are the paper's: of the detected objects those with ADD below 10 % of the diameter, and
    their mean ADD. ``correct_symmetric`` and the means beside it count a pose as the nearest of those that the part's
    symmetry makes equivalent; ``found`` are those of them that stand for one of the ``visible`` parts, of which at
    least 60 % is unoccluded. Means are None where nothing is correct.
    """

    model_config = ConfigDict(frozen=True)

    detected: int
    visible: int
    found: int
    correct: int
    add_m: float | None
    correct_symmetric: int
    add_symmetric_m: float | None
    adi_m: float | None
    mssd_m: float | None
    mspd_px: float | None
    rotation_rad: float | None


@dataclass(frozen=True, eq=False)
class PoseJudge:
    """The true poses of one reference view.

    Attributes
    ----------
    metrics
        Of the part in the camera of the view.
    camera_T_objects
        (N, 4, 4) true poses.
    visible_fraction
        (N,) share of each that is unoccluded.
    """

    metrics: PoseMetrics
    camera_T_objects: FloatArray
    visible_fraction: FloatArray

    def score(self, objects: Sequence[DetectedObject]) -> PoseScore:
        """Judge the most probable pose of each object."""
        poses = [item.hypotheses[0].camera_T_object for item in objects]
        by_add, symmetric = (self._evaluated(poses, by) for by in (Criterion.ADD, Criterion.ADD_SYMMETRIC))
        mine, means = by_add.deviation, symmetric.deviation
        return PoseScore(
            detected=len(poses),
            visible=int(symmetric.sufficiently_visible.sum()),
            found=sum(bool(symmetric.sufficiently_visible[match.true]) for match in symmetric.correct),
            correct=len(by_add.correct),
            add_m=mine and mine.add_m,
            correct_symmetric=len(symmetric.correct),
            add_symmetric_m=means and means.add_symmetric_m,
            adi_m=means and means.adi_m,
            mssd_m=means and means.mssd_m,
            mspd_px=means and means.mspd_px,
            rotation_rad=means and means.rotation_rad,
        )

    def _evaluated(self, poses: Sequence[FloatArray], criterion: Criterion) -> Evaluation:
        return evaluate(poses, list(self.camera_T_objects), self.metrics, self.visible_fraction, criterion)
