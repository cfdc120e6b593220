"""Errors of poses: closed forms, and an independent slow implementation of BOP's definitions."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from sidelong.errors import PoseError
from sidelong.evaluation.pose_errors import MOST_POINTS, PoseMetrics
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.transforms import rotation_about, transform, transform_points
from sidelong.simulation.parts import simulated_part
from sidelong.types import FloatArray

CAMERA = PinholeCamera(1280, 1024, 1083.0, 1083.0, 640.0, 512.0)
TRUTH = transform(rotation_about((1, 2, 3), 0.7), (0.02, -0.01, 0.7))
Z = (0.0, 0.0, 1.0)


def part_of(mesh: trimesh.Trimesh) -> Part:
    return part_from_arrays("part", np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.intp))


def metrics_of(mesh: trimesh.Trimesh) -> PoseMetrics:
    return PoseMetrics(part_of(mesh), CAMERA)


def turned(angle_rad: float, axis: tuple[float, float, float] = Z) -> FloatArray:
    """Return the true pose after a turn of the object about an axis of its own."""
    return TRUTH @ transform(rotation_about(axis, angle_rad), np.zeros(3))


@pytest.fixture(scope="module")
def cylinder() -> PoseMetrics:
    """Radius 10, height 40 mm: 96 points on each rim, and the middles of the caps."""
    return metrics_of(trimesh.creation.cylinder(0.01, 0.04, sections=96))


@pytest.fixture(scope="module")
def fitting() -> PoseMetrics:
    return PoseMetrics(simulated_part("tube_fitting"), CAMERA)


@given(seed=st.integers(0, 2**31))
def test_a_shift_is_its_length_in_every_metric(fitting: PoseMetrics, seed: int) -> None:
    shift_m = np.random.default_rng(seed).uniform(-0.01, 0.01, 3)
    estimate = TRUTH.copy()
    estimate[:3, 3] += shift_m
    deviation = fitting.deviation(estimate, TRUTH)
    length_m = float(np.linalg.norm(shift_m))
    assert deviation.add_m == pytest.approx(length_m, rel=1e-9)
    assert deviation.mssd_m == pytest.approx(length_m, rel=1e-9)
    assert deviation.translation_m == pytest.approx(length_m, rel=1e-9)
    assert deviation.rotation_rad == pytest.approx(0.0, abs=1e-12)
    assert deviation.adi_m <= length_m * (1 + 1e-9)


def test_a_turn_of_a_cylinder_has_a_closed_form_in_add_and_is_nothing_to_mssd(cylinder: PoseMetrics) -> None:
    """Each rim point moves by 2 r sin(a / 2), the middles of the caps stay: 192 of 194 points."""
    angle_rad = np.deg2rad(40.0)
    deviation = cylinder.deviation(turned(angle_rad), TRUTH)
    assert deviation.add_m == pytest.approx(2 * 0.01 * np.sin(angle_rad / 2) * 192 / 194, rel=1e-9)
    for name in ("add_symmetric_m", "mssd_m", "rotation_rad", "translation_m"):
        assert getattr(deviation, name) == pytest.approx(0.0, abs=1e-12)
    assert deviation.mspd_px == pytest.approx(0.0, abs=1e-9)


def test_adi_of_a_turned_cylinder_is_at_most_half_the_way_to_the_next_point(cylinder: PoseMetrics) -> None:
    """40 degrees are 10.67 of its points apart: every rim point is a third of a step from the next, 0.22 mm."""
    apart_m = 2 * 0.01 * np.sin(np.deg2rad(360 / 96 / 3) / 2) * 192 / 194
    assert cylinder.deviation(turned(np.deg2rad(40.0)), TRUTH).adi_m == pytest.approx(apart_m, rel=1e-6)


def test_a_flipped_cylinder_is_the_same_a_flipped_cone_is_not(cylinder: PoseMetrics) -> None:
    flipped = turned(np.pi, (1.0, 0.0, 0.0))
    assert cylinder.deviation(flipped, TRUTH).mssd_m == pytest.approx(0.0, abs=1e-9)
    cone = metrics_of(trimesh.creation.cone(0.01, 0.04, sections=96))
    assert cone.deviation(flipped, TRUTH).rotation_rad == pytest.approx(np.pi)
    assert cone.deviation(flipped, TRUTH).mssd_m > 0.05


def test_a_tilted_cylinder_is_wrong_by_the_farthest_rim_point(cylinder: PoseMetrics) -> None:
    """About its middle it tilts by b: the rim points of the plane of the tilt move by 2 R sin(b / 2)."""
    tilt_rad = 0.2
    deviation = cylinder.deviation(turned(1.0) @ transform(rotation_about((1, 0, 0), tilt_rad), np.zeros(3)), TRUTH)
    assert deviation.mssd_m == pytest.approx(2 * np.hypot(0.01, 0.02) * np.sin(tilt_rad / 2), rel=1e-3)
    assert deviation.rotation_rad == pytest.approx(tilt_rad)
    assert deviation.add_symmetric_m < deviation.add_m


def test_all_turns_of_a_ball_are_the_same() -> None:
    radius_m, angle_rad = 0.02, 1.3
    ball = metrics_of(trimesh.creation.icosphere(4, radius_m))
    deviation = ball.deviation(turned(angle_rad, (3.0, 1.0, 2.0)), TRUTH)
    # the distance from the axis, averaged over a sphere, is pi / 4 of the radius
    assert deviation.add_m == pytest.approx(2 * np.sin(angle_rad / 2) * np.pi / 4 * radius_m, rel=1e-3)
    assert deviation.mssd_m == pytest.approx(0.0, abs=1e-12)
    shifted = turned(angle_rad)
    shifted[:3, 3] += (0.001, 0.002, 0.002)
    assert ball.deviation(shifted, TRUTH).mssd_m == pytest.approx(0.003)
    assert ball.deviation(shifted, TRUTH).add_symmetric_m == pytest.approx(0.003)


@pytest.mark.parametrize(("turn_deg", "wrong_deg"), [(60.0, 0.0), (180.0, 0.0), (50.0, 10.0), (30.0, 30.0)])
def test_a_hexagon_is_wrong_by_the_way_to_the_next_sixth(
    fitting: PoseMetrics, turn_deg: float, wrong_deg: float
) -> None:
    deviation = fitting.deviation(turned(np.deg2rad(turn_deg)), TRUTH)
    assert np.rad2deg(deviation.rotation_rad) == pytest.approx(wrong_deg, abs=1e-6)
    widest_m = float(np.linalg.norm(fitting.part.vertices_m[:, :2], axis=1).max())
    assert deviation.mssd_m == pytest.approx(2 * widest_m * np.sin(np.deg2rad(wrong_deg) / 2), abs=1e-8)


def test_a_shift_along_the_image_moves_the_nearest_point_by_f_t_over_z() -> None:
    box = metrics_of(trimesh.creation.box((0.03, 0.04, 0.06)))
    truth = transform(np.eye(3), (0.0, 0.0, 0.5))
    estimate = transform(np.eye(3), (0.002, 0.0, 0.5))
    assert box.deviation(estimate, truth).mspd_px == pytest.approx(1083.0 * 0.002 / (0.5 - 0.03))


def test_what_lies_behind_the_camera_has_no_image() -> None:
    box = metrics_of(trimesh.creation.box((0.03, 0.04, 0.06)))
    behind = transform(np.eye(3), (0.0, 0.0, 0.02))
    assert box.deviation(behind, TRUTH).mspd_px == np.inf
    assert np.isfinite(box.deviation(behind, TRUTH).add_m)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_pose_that_is_none_is_refused(fitting: PoseMetrics, value: float) -> None:
    broken = TRUTH.copy()
    broken[0, 3] = value
    with pytest.raises(PoseError, match="estimated pose of tube_fitting: 1 of 16 not finite"):
        fitting.deviation(broken, TRUTH)
    with pytest.raises(PoseError, match="true pose of tube_fitting"):
        fitting.deviation(TRUTH, broken)


# --- against definitions written down a second time, point by point ---


def slow(metrics: PoseMetrics, estimate: FloatArray, truth: FloatArray, step_rad: float) -> dict[str, float]:
    """BOP's definitions, with loops: nothing of the code under test but the list of symmetries."""
    points = metrics.part.vertices_m
    there = np.array([estimate[:3, :3] @ p + estimate[:3, 3] for p in points])
    here = np.array([truth[:3, :3] @ p + truth[:3, 3] for p in points])
    add_symmetric, mssd, mspd = np.inf, np.inf, np.inf
    for operation in metrics.part.symmetry.equivalent(step_rad):
        same = np.array([truth[:3, :3] @ (operation[:3, :3] @ p + operation[:3, 3]) + truth[:3, 3] for p in points])
        distances = np.linalg.norm(there - same, axis=1)
        pixels = [np.array([CAMERA.fx * x / z, CAMERA.fy * y / z]) for x, y, z in there]
        images = [np.array([CAMERA.fx * x / z, CAMERA.fy * y / z]) for x, y, z in same]
        add_symmetric = min(add_symmetric, distances.mean())
        mssd = min(mssd, distances.max())
        mspd = min(mspd, max(float(np.linalg.norm(a - b)) for a, b in zip(pixels, images, strict=True)))
    adi = np.mean([np.linalg.norm(there - p, axis=1).min() for p in here])
    add = np.linalg.norm(there - here, axis=1).mean()
    return {"add_m": add, "add_symmetric_m": add_symmetric, "adi_m": adi, "mssd_m": mssd, "mspd_px": mspd}


def random_pair(seed: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    truth = transform(Rotation.random(random_state=seed).as_matrix(), (*rng.uniform(-0.1, 0.1, 2), rng.uniform(0.5, 1)))
    apart = Rotation.from_rotvec(rng.normal(0, 1.0, 3)).as_matrix()
    return truth @ transform(apart, rng.normal(0, 0.01, 3)), truth


MESHES = {
    "brick": trimesh.creation.box((0.03, 0.04, 0.06)),
    "hexagon": trimesh.creation.cylinder(0.012, 0.03, sections=6),
    "cylinder": trimesh.creation.cylinder(0.012, 0.03, sections=32),
    "cone": trimesh.creation.cone(0.012, 0.03, sections=32),
}


@pytest.mark.parametrize("name", MESHES)
@settings(max_examples=8)
@given(seed=st.integers(0, 2**31))
def test_the_definitions_written_a_second_time_agree(name: str, seed: int) -> None:
    """A continuous axis is searched there in steps of 2 degrees, evenly: what it finds is nearly the same."""
    metrics, step_rad = metrics_of(MESHES[name]), np.deg2rad(2.0)
    estimate, truth = random_pair(seed)
    mine, other = metrics.deviation(estimate, truth), slow(metrics, estimate, truth, step_rad)
    continuous = metrics.part.symmetry.axis is not None
    slack_m = step_rad / 2 * 0.012 if continuous else 0.0
    slack = {"mspd_px": slack_m * 2 * CAMERA.fx / 0.4, "add_symmetric_m": slack_m, "mssd_m": slack_m}
    for key, value in other.items():
        assert getattr(mine, key) <= value * (1 + (1e-3 if continuous else 1e-9)) + 1e-9
        assert getattr(mine, key) >= value - slack.get(key, 0.0) - 1e-9 * (1 + value)


def test_the_table_of_add_is_that_of_single_pairs(fitting: PoseMetrics) -> None:
    pairs = [random_pair(seed) for seed in range(3)]
    estimates, truths = np.stack([pair[0] for pair in pairs]), np.stack([pair[1] for pair in pairs])
    table = fitting.add_m(estimates, truths)
    expected = [[fitting.deviation(estimate, truth).add_m for truth in truths] for estimate in estimates]
    np.testing.assert_allclose(table, expected, rtol=1e-12)
    assert fitting.add_m(estimates[:0], truths).shape == (0, 3)


def test_a_part_of_many_vertices_is_thinned_with_little_effect() -> None:
    """A ball of 40,962 vertices: errors change by less than 1 %, and the same vertices are taken every time."""
    mesh = trimesh.creation.icosphere(6, 0.02)
    assert len(mesh.vertices) > 2 * MOST_POINTS
    estimate = turned(0.3)
    estimate[:3, 3] += (0.001, 0.0, 0.002)
    points = np.asarray(mesh.vertices)
    exact = np.linalg.norm(transform_points(estimate, points) - transform_points(TRUTH, points), axis=1)
    first, again = (metrics_of(mesh).deviation(estimate, TRUTH) for _ in range(2))
    assert first == again
    assert first.add_m == pytest.approx(exact.mean(), rel=0.01)
    assert first.mssd_m == pytest.approx(np.sqrt(0.001**2 + 0.002**2), rel=0.01)
    neighbours_m = cKDTree(transform_points(estimate, points)).query(transform_points(TRUTH, points))[0]
    assert first.adi_m == pytest.approx(neighbours_m.mean(), rel=0.01)
