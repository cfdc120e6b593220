"""Algorithm 1 on a small simulated cell: what each step says, and every way a scan ends."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from sidelong.detection.refinement import Refiner
from sidelong.detection.refinement_settings import RefinementSettings
from sidelong.detection.settings import DetectionSettings
from sidelong.devices import Cell
from sidelong.errors import DepthError, DeviceTimeoutError, DeviceUnavailableError
from sidelong.fusion.settings import FusionSettings, ModelSettings, RegistrationSettings
from sidelong.geometry.transforms import invert, rotation_about, transform
from sidelong.planning.candidates import DomeSettings, dome_views
from sidelong.planning.selection import StrategyName
from sidelong.recipe import PlanningSettings, Recipe, build_stages
from sidelong.scan import scan
from sidelong.stopwatch import Stopwatch
from sidelong.types import DetectedObject, Hypothesis, PixelState, Step, Stop, View
from sidelong_drivers.mock import MockArm, MockArmSettings
from sidelong_drivers.simulated import SimulatedCamera, SimulatedCameraSettings

VIEWS = dome_views((0.5, 0.0, 0.03), DomeSettings(azimuths=4, elevations_deg=(70.0,)))


@dataclass(frozen=True, eq=False)
class World:
    """A cell and the true poses of its parts in the reference view."""

    cell: Cell
    camera: SimulatedCamera
    objects: tuple[DetectedObject, ...]


@pytest.fixture(scope="module")
def world() -> Iterator[World]:
    yield from world_of(SimulatedCameraSettings(width=320, height=256, count=4))


@pytest.fixture(scope="module")
def sharp_world() -> Iterator[World]:
    yield from world_of(SimulatedCameraSettings(width=640, height=512, count=4))


def world_of(settings: SimulatedCameraSettings) -> Iterator[World]:
    camera = SimulatedCamera(settings)
    camera.open()
    arm = opened_arm()
    camera_T_base = invert(VIEWS[0].base_T_camera)
    objects = tuple(surely(camera_T_base @ pose) for pose in camera.base_T_objects)
    yield World(Cell(camera, arm, camera.flange_T_camera, VIEWS[0], VIEWS), camera, objects)
    arm.close()
    camera.close()


def opened_arm(**settings: object) -> MockArm:
    arm = MockArm(MockArmSettings.model_validate({"speed_factor": 1e3, **settings}))
    arm.open()
    return arm


def surely(camera_T_object: np.ndarray) -> DetectedObject:
    return DetectedObject((Hypothesis(camera_T_object, 100.0, 1.0),))


def steps_of(
    world: World,
    objects: tuple[DetectedObject, ...] | None = None,
    cell: Cell | None = None,
    recipe: Recipe | None = None,
    **planning: object,
) -> list[Step]:
    recipe = recipe or Recipe(planning=PlanningSettings.model_validate(planning))
    given = world.objects if objects is None else objects
    with build_stages(recipe, world.camera.part, world.camera.rig, Path(), objects=given) as stages:
        return list(scan(cell or world.cell, stages, recipe, Stopwatch()))


@pytest.fixture(scope="module")
def steps(world: World) -> list[Step]:
    return steps_of(world, max_views=3)


def test_a_scan_takes_its_views_and_says_at_the_end_why_it_ended(steps: list[Step]) -> None:
    assert [step.index for step in steps] == [0, 1, 2, 3]
    assert [step.stop for step in steps] == [None, None, None, Stop.MAX_VIEWS]
    assert len({step.view.name for step in steps}) == 4


def test_the_next_view_is_the_candidate_of_largest_gain(steps: list[Step]) -> None:
    for before, after in pairwise(steps):
        open_scores = [score for score in before.scores if score.dropped is None]
        best = max(open_scores, key=lambda score: score.gain_px)
        assert (after.view.name, after.predicted_gain_px) == (best.view.name, best.gain_px)
        taken = {score.view.name for score in before.scores if score.dropped == "already taken"}
        assert taken == {step.view.name for step in steps[: after.index]}


def test_gains_add_up_and_completeness_rises(steps: list[Step]) -> None:
    assert steps[0].missing_px > 100
    assert steps[-1].recovered_px == sum(step.measured_gain_px for step in steps) > 0
    assert all(after.completeness > before.completeness - 0.01 for before, after in pairwise(steps))
    assert steps[-1].completeness == steps[-1].recovered_px / steps[-1].missing_px


def test_what_the_reference_view_measured_stays_to_the_bit(steps: list[Step]) -> None:
    reference_m = steps[0].frame.depth_m
    assert reference_m is not None
    measured = np.isfinite(reference_m)
    for step in steps:
        assert np.array_equal(step.depth.depth_m[measured], reference_m[measured])
        assert np.array_equal(step.depth.source == 0, measured)
        assert np.array_equal(step.depth.source == -1, np.isnan(step.depth.depth_m))
        assert step.depth.source.max() <= step.index


def test_what_was_completed_is_near_the_truth(world: World, steps: list[Step]) -> None:
    truth_m = world.camera.true_depth_m(steps[0].view.base_T_camera)
    new = steps[-1].depth.source > 0
    # one disparity of this small image is 6.6 mm at this distance
    assert np.median(np.abs(steps[-1].depth.depth_m - truth_m)[new]) < 3e-3


def test_each_stage_is_timed_and_left_out_terms_are_named(steps: list[Step]) -> None:
    assert {"move", "capture", "detect", "score"} <= steps[0].stage_s.keys()
    assert {"move", "capture", "fuse"} <= steps[1].stage_s.keys()
    assert all(seconds >= 0 for step in steps for seconds in step.stage_s.values())
    assert any(term.startswith("inter-reflection: left out") for term in steps[0].left_out)
    assert any(term.startswith("detection and refinement: left out") for term in steps[0].left_out)


def disturbed(world: World) -> tuple[DetectedObject, ...]:
    """The true poses, 4 mm nearer and turned by 3 degrees about the camera's x axis, as a detector errs."""
    turn = transform(rotation_about((1, 0, 0), np.radians(3.0)), (0.0, 0.0, -4e-3))
    wrong: list[DetectedObject] = []
    for item in world.objects:
        pose = item.hypotheses[0].camera_T_object
        here = transform(np.eye(3), pose[:3, 3])
        wrong.append(surely(here @ turn @ invert(here) @ pose))
    return tuple(wrong)


def errors_m(world: World, step: Step) -> np.ndarray:
    found = [item.hypotheses[0].camera_T_object[:3, 3] for item in step.objects]
    return np.linalg.norm(
        [a - b.hypotheses[0].camera_T_object[:3, 3] for a, b in zip(found, world.objects, strict=True)], axis=1
    )


def test_poses_are_refined_by_every_view_and_stay_as_detected_where_that_is_left_out(sharp_world: World) -> None:
    world = sharp_world
    recipe, objects = Recipe(planning=PlanningSettings(max_views=2)), disturbed(world)
    with build_stages(recipe, world.camera.part, world.camera.rig, Path(), objects=objects) as stages:
        as_detected = list(scan(world.cell, stages, recipe, Stopwatch()))
        refining = replace(stages, new_refiner=partial(Refiner, stages.part, stages.rig.left, RefinementSettings()))
        refined = list(scan(world.cell, refining, recipe, Stopwatch()))
    assert all(step.objects is objects for step in as_detected)
    assert np.median(errors_m(world, as_detected[-1])) == pytest.approx(4e-3)
    assert np.median(errors_m(world, refined[-1])) < 2.2e-3  # one disparity is 6.6 mm at this distance
    assert errors_m(world, refined[-1]).mean() < errors_m(world, refined[0]).mean() < 4e-3
    assert {view for item in refined[-1].objects for view in item.supporting_views} == {s.view.name for s in refined}
    assert all(item.hypotheses[0].covariance is not None for item in refined[-1].objects)


def test_small_errors_of_the_arm_are_registered_and_reported_and_that_can_be_left_out() -> None:
    """0.3 mm and 0.9 mrad; what it is worth is shown in tests/core/fusion/test_completion.py."""
    for registration in (RegistrationSettings(), None):
        settings = SimulatedCameraSettings(count=4, arm_shift_m=0.3e-3, arm_turn_rad=0.9e-3)
        for world in world_of(settings):
            taken = steps_of(world, recipe=Recipe(fusion=FusionSettings(registration=registration)))
            fused = [step.fused for step in taken[1:] if step.fused is not None]
            assert len(fused) == len(taken) - 1
            assert all(each.refused is None and each.agreement > 0.99 for each in fused)
            assert all((each.shift_m > 1e-5) == (registration is not None) for each in fused)
            assert all((each.sigma_shift_m > 0) == (registration is not None) for each in fused)
            named = [term for term in taken[0].left_out if term.startswith("registration")]
            assert bool(named) == (registration is None)


def test_views_from_wrong_poses_are_refused_and_the_scan_goes_on_without_them() -> None:
    """An arm that is 50 mm off each time: no view fits the reference, none is fused, and the scan ends as it should."""
    for world in world_of(SimulatedCameraSettings(count=4, arm_shift_m=0.05)):
        taken = steps_of(world, max_views=3)
        assert taken[-1].stop is not None
        assert len(taken) == 4
        for step in taken[1:]:
            assert step.fused is not None
            assert step.fused.refused is not None
            assert (step.fused.filled_px, step.measured_gain_px, step.recovered_px) == (0, 0, 0)
        assert set(np.unique(taken[-1].depth.source)) == {-1, 0}


def test_the_model_completes_what_no_view_measured_where_that_is_asked_for(sharp_world: World) -> None:
    """Detected poses, a little off, are refined by depth; then the CAD model fills in, marked, and is not counted."""
    recipe = Recipe(fusion=FusionSettings(model=ModelSettings()), planning=PlanningSettings(max_views=1))
    part, rig = sharp_world.camera.part, sharp_world.camera.rig
    with build_stages(recipe, part, rig, Path(), objects=disturbed(sharp_world)) as stages:
        refined = replace(stages, new_refiner=partial(Refiner, part, rig.left, RefinementSettings()))
        taken = list(scan(sharp_world.cell, refined, recipe, Stopwatch()))
    last = taken[-1]
    modelled = last.depth.state == PixelState.MODELLED
    assert modelled.sum() > 50
    truth_m = sharp_world.camera.true_depth_m(taken[0].view.base_T_camera)
    assert np.median(np.abs(last.depth.depth_m - truth_m)[modelled]) < 1e-3
    assert not last.depth.trusted[modelled].any()
    assert last.recovered_px <= last.missing_px - modelled.sum()


def test_views_are_where_the_arm_says_it_is(world: World, steps: list[Step]) -> None:
    wanted = {view.name: view.base_T_camera for view in VIEWS}
    for step in steps:
        np.testing.assert_allclose(step.view.base_T_camera, wanted[step.view.name], atol=1e-6)


def test_without_objects_there_is_nothing_to_plan(world: World) -> None:
    (only,) = steps_of(world, objects=())
    assert (only.stop, only.missing_px, only.completeness) == (Stop.NO_OBJECTS, 0, 1.0)


def test_an_empty_bin_ends_the_scan_as_such(tmp_path: Path) -> None:
    recipe = Recipe(detection=DetectionSettings(view_step_deg=40, roll_step_deg=30, distance_m=(0.65, 0.75)))
    for empty in world_of(SimulatedCameraSettings(width=640, height=512, count=0)):
        with build_stages(recipe, empty.camera.part, empty.camera.rig, tmp_path) as stages:
            (only,) = scan(empty.cell, stages, recipe, Stopwatch())
    assert (only.stop, only.objects, only.missing_px) == (Stop.EMPTY_SCENE, (), 0)


def test_where_nothing_is_missing_nothing_moves(world: World) -> None:
    # an object beside the image covers no pixel, so none of its pixels is missing
    outside = (surely(transform(np.eye(3), (5.0, 0.0, 0.7))),)
    (only,) = steps_of(world, objects=outside)
    assert (only.stop, only.missing_px) == (Stop.NOTHING_MISSING, 0)


def test_no_further_view_may_be_allowed(world: World) -> None:
    (only,) = steps_of(world, max_views=0)
    assert only.stop is Stop.MAX_VIEWS
    assert only.missing_px > 0


def test_a_gain_below_the_threshold_ends_the_scan_with_its_scores(world: World) -> None:
    for planning in ({"gain_threshold_share": 1.0}, {"gain_threshold_px": 1e9}):
        (only,) = steps_of(world, **planning)
        assert only.stop is Stop.GAIN_BELOW_THRESHOLD
        assert max(score.gain_px for score in only.scores) > 0


def test_where_no_candidate_can_be_reached_each_says_why(world: World) -> None:
    flange = VIEWS[0].base_T_camera @ invert(world.camera.flange_T_camera)
    low, high = flange[:3, 3] - 0.05, flange[:3, 3] + 0.05
    arm = opened_arm(workspace_low_m=tuple(low), workspace_high_m=tuple(high))
    (only,) = steps_of(world, cell=replace(world.cell, arm=arm))
    arm.close()
    assert only.stop is Stop.NO_REACHABLE_VIEW
    reasons = {score.view.name: score.dropped or "" for score in only.scores}
    assert reasons.pop("top") == "already taken"
    assert len(reasons) == 4
    assert all("outside the workspace" in reason for reason in reasons.values())


def test_when_all_candidates_are_taken_none_is_left(world: World) -> None:
    last = steps_of(world, max_views=50, gain_threshold_share=0.0)[-1]
    assert last.stop is Stop.NO_REACHABLE_VIEW
    reasons = {score.dropped for score in last.scores} - {"already taken"}
    assert all(reason is not None and reason.startswith("no joint angles reach") for reason in reasons)
    assert last.index >= 3


def test_random_repeats_itself_with_its_seed_and_only_then(world: World) -> None:
    def views(seed: int) -> list[str]:
        planning = {"strategy": StrategyName.RANDOM, "seed": seed, "gain_threshold_share": 0.0}
        return [step.view.name for step in steps_of(world, **planning)]

    assert views(1) == views(1)
    assert len({tuple(views(seed)) for seed in range(6)}) > 1


def test_maximum_distance_goes_to_the_far_side(world: World) -> None:
    planning = {"strategy": StrategyName.MAX_DISTANCE, "gain_threshold_share": 0.0, "max_views": 2}
    places = [step.view.base_T_camera[:3, 3] for step in steps_of(world, **planning)]
    first, second = places[1] - places[0], places[2] - places[0]
    assert first[:2] @ second[:2] < 0


def test_a_reference_view_without_any_depth_is_an_error(world: World) -> None:
    blind = Recipe(depth_exposure_s=1e-6)
    with pytest.raises(DepthError, match="view top: the depth map has 0 of"):
        steps_of(world, recipe=blind)


def test_a_device_that_fails_ends_the_scan_with_its_error(world: World) -> None:
    closed = SimulatedCamera(world.camera.settings)
    with pytest.raises(DeviceUnavailableError, match="simulated camera: is not open"):
        steps_of(world, cell=replace(world.cell, camera=closed))
    slow = opened_arm(speed_factor=1.0)
    with pytest.raises(DeviceTimeoutError, match=r"deadline 0\.1 s"):
        steps_of(world, cell=replace(world.cell, arm=slow, reference=far()), recipe=Recipe(move_deadline_s=0.1))
    slow.close()


def far() -> View:
    return VIEWS[-1]
