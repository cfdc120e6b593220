"""Next-best-view depth completion: Algorithm 1 of Yang and Waslander.

for step in scan(cell, stages, recipe, Stopwatch()):
    print(step.index, step.view.name, step.completeness)
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from sidelong.detection.refinement import DepthView
from sidelong.detection.report import DetectionReport, NothingFound
from sidelong.devices import CaptureRequest, Cell
from sidelong.errors import DepthError
from sidelong.fusion.completion import Completion
from sidelong.geometry.transforms import invert
from sidelong.planning.gain import Planner
from sidelong.planning.prior import Belief, believe
from sidelong.planning.selection import below_threshold, best_of
from sidelong.recipe import PlanningSettings, Recipe, Stages
from sidelong.stopwatch import Stopwatch
from sidelong.types import BoolArray, DetectedObject, Forecast, Frame, FusedView, Projector, Score, Step, Stop, View


def scan(cell: Cell, stages: Stages, recipe: Recipe, stopwatch: Stopwatch) -> Iterator[Step]:
    """Complete the depth of the cell's reference view.

    Yields a :class:`Step` after every view, the reference view included. The last one says why the scan ended.

    Parameters
    ----------
    cell
        Opened camera and arm, reference view, candidate views.
    stages
        From :func:`sidelong.recipe.build_stages`.
    recipe
        Settings.
    stopwatch
        Measures the stages capture, detect, refine, score, move and fuse.

    Raises
    ------
    DeviceError
        Camera or arm failed, or the arm was stopped.
    DepthError
        The reference view measured no depth at all.
    DetectionError
        The matcher failed.
    """
    depth_request = CaptureRequest(Projector.DOTS, recipe.depth_exposure_s, depth=True)

    # input of Algorithm 1: I_o with the projector off and a long exposure, and D_o
    reference = view = _move(cell, cell.reference, recipe, stopwatch)
    image = _capture(cell, view, CaptureRequest(Projector.OFF, recipe.image_exposure_s), stopwatch)
    frame = _capture(cell, view, depth_request, stopwatch)
    completion = Completion(frame, stages.rig, recipe.fusion)
    missing_at_first = completion.missing.copy()

    # 1: detection, I_o -> {q}; Line2D in the paper
    with stopwatch.stage("detect"):
        objects = stages.detector.detect(image.left, completion.depth.depth_m)

    refiner = stages.new_refiner()
    taken: list[View] = []
    belief: Belief | None = None
    planner: Planner | None = None
    fused: FusedView | None = None
    gained = _Gained()
    while True:
        taken.append(view)

        # every depth map says more of the poses; the paper leaves them as they were detected
        with stopwatch.stage("refine"):
            if fused is None or fused.refused is None:
                refiner.add(_depth_view(frame, view, fused))
            refined: tuple[DetectedObject, ...] = refiner.refine(objects)

        # 2: prior, {q} -> {D, N} at the missing pixels
        if belief is None or refined is not objects:
            with stopwatch.stage("score"):
                belief = believe(
                    refined, stages.part, stages.rig.left, reference.base_T_camera, missing_at_first,
                    recipe.planning.stride_px,
                )  # fmt: skip
            completion.expect(belief.surface_m, stages.modelled(refined))
            objects = refined
            planner = None
        missing = completion.missing
        step = Step(
            index=len(taken) - 1, view=view, frame=frame, objects=objects, depth=completion.depth,
            missing_px=int(belief.target.sum()), recovered_px=int((belief.target & ~missing).sum()),
            predicted_gain_px=gained.predicted_px, measured_gain_px=gained.measured_px, scores=(), stage_s={},
            stop=None, left_out=stages.left_out, forecast=gained.forecast, fused=fused,
            scene=completion.scene,
        )  # fmt: skip

        # 3: G_i of each candidate, equation (13), unless the scan ends here anyway
        stop, best = _spent(step, recipe.planning, stages.detector.last_report), None
        if stop is None:
            with stopwatch.stage("score"):
                if planner is None:
                    light = replace(stages.light, exposure_s=frame.exposure_s)
                    planner = Planner(belief, stages.part, stages.rig, light)
                step = replace(step, scores=_score(cell, stages, planner, taken, missing))
            best = best_of(step.scores)
            stop = _not_worth_it(step, best, recipe.planning)

        # 6: termination
        yield replace(step, stage_s=stopwatch.lap(), stop=stop)
        if stop is not None or best is None or planner is None:
            return

        # 4: move to the argmax, equation (14)
        view = _move(cell, best.view, recipe, stopwatch)

        # 5: capture D*, fuse
        frame = _capture(cell, view, depth_request, stopwatch)
        with stopwatch.stage("fuse"):
            fused = completion.add(frame)
            still_missing = completion.missing
        gained = _Gained(
            predicted_px=best.gain_px,
            # what later views disprove is missing again
            measured_px=float((belief.target & missing).sum()) - float((belief.target & still_missing).sum()),
            forecast=planner.forecast(view, missing, still_missing),
        )


@dataclass(frozen=True)
class _Gained:
    """What a view promised and what it gave, by the belief that chose it; nothing at the reference view."""

    predicted_px: float = 0.0
    measured_px: float = 0.0
    forecast: Forecast | None = None


def _depth_view(frame: Frame, view: View, fused: FusedView | None) -> DepthView:
    """Return the depth of a view where the fusion has found it to be; the reference view is where it is."""
    if frame.depth_m is None:
        raise DepthError(f"view {view.name}: the frame has no depth map, it was captured without")
    return DepthView(view.name, frame.depth_m, np.eye(4) if fused is None else fused.reference_T_view)


def _move(cell: Cell, view: View, recipe: Recipe, stopwatch: Stopwatch) -> View:
    """Move the camera to a view and return where the arm says it is."""
    with stopwatch.stage("move"):
        state = cell.arm.move(view.base_T_camera @ invert(cell.flange_T_camera), recipe.move_deadline_s)
    return View(view.name, state.base_T_flange @ cell.flange_T_camera)


def _capture(cell: Cell, view: View, request: CaptureRequest, stopwatch: Stopwatch) -> Frame:
    with stopwatch.stage("capture"):
        return replace(cell.camera.capture(request, view.base_T_camera), view=view)


def _score(cell: Cell, stages: Stages, planner: Planner, taken: list[View], missing: BoolArray) -> tuple[Score, ...]:
    """Score the shortlisted candidates; the others come with the reason why they cannot be taken."""
    taken_names = {view.name for view in taken}
    dropped: list[Score] = []
    open_views: list[View] = []
    for view in cell.candidates:
        reason = "already taken" if view.name in taken_names else None
        reason = reason or cell.arm.unreachable(view.base_T_camera @ invert(cell.flange_T_camera))
        if reason is None:
            open_views.append(view)
        else:
            dropped.append(Score(view, gain_px=0.0, dropped=reason))
    shortlist = stages.strategy.shortlist(open_views, taken)
    return (*(planner.score(view, missing) for view in shortlist), *dropped)


def _spent(step: Step, settings: PlanningSettings, detection: DetectionReport | None) -> Stop | None:
    """Say why the scan ends here whatever the candidates promise, if it does."""
    if not step.objects:
        empty = detection is not None and detection.nothing_found is NothingFound.EMPTY_SCENE
        return Stop.EMPTY_SCENE if empty else Stop.NO_OBJECTS
    if step.recovered_px >= step.missing_px:
        return Stop.NOTHING_MISSING
    return Stop.MAX_VIEWS if step.index >= settings.max_views else None


def _not_worth_it(step: Step, best: Score | None, settings: PlanningSettings) -> Stop | None:
    """Say why no candidate is worth a move, if none is; equation (15)."""
    if best is None:
        return Stop.NO_REACHABLE_VIEW
    still_missing_px = step.missing_px - step.recovered_px
    thresholds = settings.gain_threshold_px, settings.gain_threshold_share
    return Stop.GAIN_BELOW_THRESHOLD if below_threshold(best.gain_px, still_missing_px, *thresholds) else None
