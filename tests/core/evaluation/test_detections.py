"""Detected objects against true poses: who stands for whom, what counts, and what was imagined."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from sidelong.evaluation.detections import Criterion, best_turns_rad, evaluate
from sidelong.evaluation.pose_errors import PoseMetrics
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import part_from_arrays
from sidelong.geometry.transforms import rotation_about, transform
from sidelong.simulation.parts import simulated_part
from sidelong.types import DetectedObject, FloatArray, Hypothesis

CAMERA = PinholeCamera(1280, 1024, 1083.0, 1083.0, 640.0, 512.0)


@pytest.fixture(scope="module")
def metrics() -> PoseMetrics:
    """Of a tube fitting: diameter 55.6 mm, six turns about z."""
    return PoseMetrics(simulated_part("tube_fitting"), CAMERA)


def at(x_m: float, turn_deg: float = 0.0, axis: tuple[float, float, float] = (0, 0, 1)) -> FloatArray:
    return transform(rotation_about(axis, np.deg2rad(turn_deg)), (x_m, 0.0, 0.7))


def detected(*poses: FloatArray) -> DetectedObject:
    return DetectedObject(tuple(Hypothesis(pose, 90.0, 1 / len(poses)) for pose in poses))


def test_what_is_found_missed_and_imagined_is_counted(metrics: PoseMetrics) -> None:
    """Of three true objects one is found at 1 mm, one is missed, one is 8 mm off (limit 5.56); one more is imagined."""
    truths = [at(0.0), at(0.1), at(0.2)]
    result = evaluate([at(0.208), at(0.001), at(0.4)], truths, metrics)
    assert [(match.detected, match.true) for match in result.correct] == [(1, 0)]
    assert result.rate_of_detected == pytest.approx(1 / 3)
    assert result.recall == pytest.approx(1 / 3)
    assert result.false_alarms == 2
    assert result.deviation is not None
    assert result.deviation.add_m == pytest.approx(0.001)


@pytest.mark.parametrize(("share", "correct"), [(0.0999, 1), (0.1001, 0)])
def test_the_limit_is_a_tenth_of_the_diameter(metrics: PoseMetrics, share: float, correct: int) -> None:
    result = evaluate([at(share * metrics.part.diameter_m)], [at(0.0)], metrics)
    assert len(result.correct) == correct


def test_two_detections_of_one_object_are_one_and_a_false_alarm(metrics: PoseMetrics) -> None:
    result = evaluate([at(0.003), at(0.001)], [at(0.0)], metrics)
    assert [(match.detected, match.true) for match in result.correct] == [(1, 0)]
    assert result.false_alarms == 1


def test_as_many_pairs_as_possible_are_correct(metrics: PoseMetrics) -> None:
    """One detection fits two true objects that touch, the other fits one of them alone: each gets its own."""
    truths = [at(0.0), at(0.006)]
    result = evaluate([at(0.004), at(-0.001)], truths, metrics)
    assert [(match.detected, match.true) for match in result.correct] == [(0, 1), (1, 0)]
    swapped = evaluate([at(-0.001), at(0.004)], truths, metrics)
    assert [(match.detected, match.true) for match in swapped.correct] == [(0, 0), (1, 1)]


def test_hidden_objects_need_not_be_found_but_may(metrics: PoseMetrics) -> None:
    truths = [at(0.0), at(0.1), at(0.2)]
    visible_fraction = np.array([0.9, 0.6, 0.3])
    result = evaluate([at(0.0), at(0.2)], truths, metrics, visible_fraction)
    assert result.recall == 0.5
    assert result.rate_of_detected == 1.0
    assert result.false_alarms == 0


@pytest.mark.parametrize(
    ("criterion", "correct"),
    [(Criterion.ADD, 0), (Criterion.ADD_SYMMETRIC, 1), (Criterion.ADI, 1), (Criterion.MSSD, 1)],
)
def test_a_harmless_turn_is_wrong_to_the_paper_alone(metrics: PoseMetrics, criterion: Criterion, correct: int) -> None:
    result = evaluate([at(0.0, turn_deg=120.0)], [at(0.0)], metrics, criterion=criterion)
    assert len(result.correct) == correct


def test_a_flip_is_wrong_to_every_criterion_but_adi(metrics: PoseMetrics) -> None:
    flipped = at(0.0, turn_deg=180.0, axis=(1, 0, 0))
    counts = {each: len(evaluate([flipped], [at(0.0)], metrics, criterion=each).correct) for each in Criterion}
    assert counts == {Criterion.ADD: 0, Criterion.ADD_SYMMETRIC: 0, Criterion.MSSD: 0, Criterion.ADI: 1}


def test_nothing_detected_and_nothing_there_have_no_rate(metrics: PoseMetrics) -> None:
    nothing = evaluate([], [at(0.0)], metrics)
    assert (nothing.rate_of_detected, nothing.recall, nothing.false_alarms, nothing.deviation) == (None, 0.0, 0, None)
    imagined = evaluate([at(0.0)], [], metrics)
    assert (imagined.rate_of_detected, imagined.recall, imagined.false_alarms) == (0.0, None, 1)
    assert evaluate([], [], metrics).recall is None


def test_the_best_of_the_most_probable_hypotheses_counts(metrics: PoseMetrics) -> None:
    """20 degrees about x, then 5: of two hypotheses it is 5, of one 20. A sixth of a turn about z is nothing."""
    poses = at(0.001, 20.0, (1, 0, 0)), at(0.002, 5.0, (1, 0, 0))
    objects, truths = [detected(at(0.3)), detected(*poses)], [at(0.0, 60.0), at(0.6)]
    two, one = (np.rad2deg(best_turns_rad(objects, truths, metrics, most)) for most in (2, 1))
    assert two[0] < 8.0
    assert one[0] > 15.0
    assert np.isinf([two[1], one[1]]).all()
    assert np.rad2deg(best_turns_rad(objects, [at(0.0)], metrics)) == pytest.approx([5.0])


def test_an_object_stands_for_one_true_object_alone(metrics: PoseMetrics) -> None:
    turns_rad = best_turns_rad([detected(at(0.001))], [at(0.0), at(0.01)], metrics)
    assert np.isfinite(turns_rad).tolist() == [True, False]
    assert np.isinf(best_turns_rad([], [at(0.0)], metrics)).all()
    assert best_turns_rad([detected(at(0.0))], [], metrics).shape == (0,)


def test_the_centre_of_an_object_is_not_the_origin_of_its_frame() -> None:
    """A cone 0.1 m from its origin: turned about its own axis elsewhere, its origin moves and it does not."""
    mesh = trimesh.creation.cone(0.01, 0.04, sections=64)
    vertices = np.asarray(mesh.vertices) + np.array([0.1, 0.0, 0.0])
    cone = PoseMetrics(part_from_arrays("cone", vertices, np.asarray(mesh.faces, dtype=np.intp)), CAMERA)
    truth = at(0.0)
    centre_m = cone.part.symmetry.centre_m
    turn = rotation_about((0, 0, 1), 2.0)
    same = truth @ transform(turn, centre_m - turn @ centre_m)
    result = evaluate([same], [truth], cone, criterion=Criterion.MSSD)
    assert result.recall == 1.0
    assert result.deviation is not None
    assert result.deviation.mssd_m == pytest.approx(0.0, abs=1e-7)
    assert result.deviation.translation_m == pytest.approx(0.0, abs=1e-12)
