"""Strategies side by side on recorded views: completeness after each view, and against seconds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from pydantic import BaseModel, ConfigDict

from sidelong.devices import CaptureRequest, Cell
from sidelong.evaluation.cases import Case
from sidelong.evaluation.depth_score import DepthScore, score_depth
from sidelong.evaluation.metrics import Truth, seen_m
from sidelong.evaluation.pose_score import PoseJudge, PoseScore
from sidelong.planning.selection import StrategyName, strategy_of
from sidelong.recipe import AsDetected, GivenObjects, Recipe, Stages
from sidelong.scan import scan
from sidelong.stopwatch import Stopwatch
from sidelong.types import Projector, Step

COMPUTING = ("detect", "refine", "score", "fuse")
"""Stages that cost computing; the others cost the cell's time on a real cell and reading files on a recorded one."""


class Row(BaseModel):
    """State of one run after one more view."""

    model_config = ConfigDict(frozen=True)

    object: str
    scene: int
    reference: str
    strategy: StrategyName
    refined: bool = True
    """Whether poses were refined by depth; else they stayed as detected, as in the paper."""
    seed: int
    views_added: int
    view: str | None
    """None where the run had ended before: the numbers stay as they were."""
    completeness: float
    """Of depth that some view measured, the doubtful included: the error decides, not the mark."""
    missing_px: int
    predicted_gain_px: float
    measured_gain_px: float
    compute_s: float
    """Detecting, refining, scoring and fusing, since the start of the run."""
    cell_s: float
    """``compute_s`` and the stated time of each capture and move."""
    stage_s: dict[str, float]
    """Seconds in each stage since the start of the run, as measured on the recorded views."""
    poses: PoseScore | None = None
    """Of the objects after this view, where they are judged."""
    depth: DepthScore | None = None
    """Errors of the depth after this view, where it is judged."""


@dataclass(frozen=True)
class CellTime:
    """What captures and moves cost on a real cell; recorded data cannot tell."""

    move_s: float = 3.0
    capture_s: float = 0.7


@dataclass(frozen=True)
class Run:
    """One strategy, with the seed that matters to Random alone, and whether depth refines the poses."""

    strategy: StrategyName
    seed: int = 0
    refined: bool = True


@dataclass(frozen=True, eq=False)
class Yardstick:
    """What one reference view is measured by: true depth, and true poses if they are to be judged.

    With ``depth`` the errors of the depth are judged as well, beyond how much of it is recovered.
    """

    truth: Truth
    judge: PoseJudge | None = None
    depth: bool = False

    @property
    def judges_reference(self) -> bool:
        """Whether there is something to be said of the reference view alone."""
        return self.judge is not None or self.depth


def compare_reference(
    case: Case,
    cell: Cell,
    stages: Stages,
    recipe: Recipe,
    yardstick: Yardstick,
    runs: Sequence[Run],
    time: CellTime = CellTime(),
) -> Iterator[Row]:
    """Run each strategy from one reference view and yield a row for each view added; before them, where poses or depth
    errors are judged, one for the reference view alone.

    The image of the reference view is the same for all, so detection runs once and each run is charged for it.
    Thresholds of the gain are set aside: every run takes ``recipe.planning.max_views`` views if it can.
    """
    watch = Stopwatch()
    pose = cell.reference.base_T_camera
    image = cell.camera.capture(CaptureRequest(Projector.OFF, recipe.image_exposure_s), pose)
    measured = cell.camera.capture(CaptureRequest(Projector.DOTS, recipe.depth_exposure_s, depth=True), pose)
    with watch.stage("detect"):
        objects = stages.detector.detect(image.left, measured.depth_m)
    detect_s = watch.lap()["detect"]
    for run in runs:
        planning = recipe.planning.model_copy(
            update={"strategy": run.strategy, "seed": run.seed, "gain_threshold_px": 0.0, "gain_threshold_share": 0.0}
        )
        mine = replace(
            stages,
            detector=GivenObjects(objects),
            new_refiner=stages.new_refiner if run.refined else AsDetected,
            strategy=strategy_of(run.strategy, run.seed),
        )
        steps = scan(cell, mine, recipe.model_copy(update={"planning": planning}), Stopwatch())
        yield from _rows(case, run, yardstick, _charged(steps, detect_s), (planning.max_views, time))


def _charged(steps: Iterator[Step], detect_s: float) -> Iterator[Step]:
    """Charge the first step of a run for the detection that all runs share."""
    for step in steps:
        yield replace(step, stage_s={**step.stage_s, "detect": detect_s}) if step.index == 0 else step


def _rows(
    case: Case, run: Run, yardstick: Yardstick, steps: Iterator[Step], limits: tuple[int, CellTime]
) -> Iterator[Row]:
    """Turn the steps of a run into rows; a run that ended early keeps its last completeness."""
    max_views, time = limits
    truth, judge = yardstick.truth, yardstick.judge
    spent_s, row = Counter[str](), None
    for step in steps:
        # a lap ends with the scores that choose the next view: they are not this view's cost yet
        stage_s = spent_s + Counter({stage: s for stage, s in step.stage_s.items() if stage != "score"})
        compute_s = sum(stage_s[stage] for stage in COMPUTING)
        spent_s += Counter(step.stage_s)
        row = Row(
            object=case.object,
            scene=case.scene,
            reference=case.reference,
            strategy=run.strategy,
            refined=run.refined,
            seed=run.seed,
            views_added=step.index,
            view=step.view.name,
            completeness=truth.completeness(seen_m(step.depth)),
            missing_px=int(truth.missing.sum()),
            predicted_gain_px=step.predicted_gain_px,
            measured_gain_px=step.measured_gain_px,
            compute_s=compute_s,
            cell_s=compute_s + (step.index + 1) * time.capture_s + step.index * time.move_s,
            stage_s=dict(stage_s),
            poses=None if judge is None else judge.score(step.objects),
            depth=score_depth(step.depth, truth) if yardstick.depth else None,
        )
        if step.index > 0 or yardstick.judges_reference:
            yield row
    if row is not None:
        for index in range(row.views_added + 1, max_views + 1):
            yield row.model_copy(
                update={"views_added": index, "view": None, "predicted_gain_px": 0.0, "measured_gain_px": 0.0}
            )  # fmt: skip
