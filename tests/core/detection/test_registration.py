"""Registration against closed forms, exact data, contaminated data, and data that determine nothing."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from depth_scene import CAMERA, average_distance_m, displaced, disturbed, error_twist, measured
from detection_scene import bracket
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sidelong.detection.refinement_settings import RefinementSettings
from sidelong.detection.registration import Cloud, NearestGrid, Registration
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import rotation_about, transform, transform_points
from sidelong.types import FloatArray

POSE = transform(rotation_about((0.3, 1.0, 0.2), 0.9) @ rotation_about((1, 0, 0), 2.4), (0.01, -0.005, 0.45))


def part_of(mesh: trimesh.Trimesh) -> Part:
    return part_from_arrays("part", np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.intp))


def box(*extents_m: float) -> Part:
    return part_of(trimesh.creation.box(extents_m))


def cloud_of(points: FloatArray, cell: FloatArray | None = None) -> Cloud:
    """Points seen by a camera at the origin."""
    length = np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 1e-12)
    nobody = np.zeros(len(points), dtype=np.intp)
    cells = np.arange(len(points)) if cell is None else cell
    return Cloud(points, -points / length, nobody, np.asarray(cells, dtype=np.intp))


def cloud_from(depth_m: FloatArray, rng: np.random.Generator, cell_px: int = 1) -> Cloud:
    row, column = np.nonzero(np.isfinite(depth_m))
    order = rng.permutation(len(row))
    row, column = row[order], column[order]
    points = CAMERA.rays(column, row) * depth_m[row, column][:, None]
    return cloud_of(points, (row // cell_px) * CAMERA.width + column // cell_px)


def registered(registration: Registration, poses: FloatArray, cloud: Cloud) -> FloatArray:
    return registration.settle(registration.approach(poses, cloud), cloud, 1).poses


@pytest.fixture(scope="module")
def part() -> Part:
    return bracket()


@pytest.fixture(scope="module")
def registration(part: Part) -> Registration:
    return Registration(part, RefinementSettings())


class TestNearestPoints:
    def test_on_a_box_they_are_clipped_coordinates(self) -> None:
        half = np.array([0.01, 0.02, 0.03])
        scene = RayScene([(box(*(2 * half)), np.eye(4))])
        points = np.array([[0.002, 0.003, 0.05], [0.03, 0.03, 0.001], [-0.02, -0.03, 0.04]])  # face, edge, corner
        nearest, normals = scene.closest(points)
        assert np.abs(nearest - np.clip(points, -half, half)).max() < 1e-8
        assert normals[0] == pytest.approx([0, 0, 1])
        assert np.linalg.norm(normals, axis=1) == pytest.approx(1)

    def test_none_in_an_empty_scene_and_for_no_points(self) -> None:
        assert np.isnan(RayScene([]).closest(np.ones((2, 3)))).all()
        assert RayScene([(box(1, 1, 1), np.eye(4))]).closest(np.zeros((0, 3)))[0].shape == (0, 3)

    def test_the_grid_answers_for_the_centres_of_its_cells(self) -> None:
        scene = RayScene([(box(0.02, 0.04, 0.06), np.eye(4))])
        low, high = np.array([-0.03, -0.04, -0.05]), np.array([0.03, 0.04, 0.05])
        grid = NearestGrid(scene, low, high, 40)
        points = np.random.default_rng(0).uniform(low, high, (500, 3))
        centres = low + (np.floor((points - low) / grid.cell_m) + 0.5) * grid.cell_m
        assert grid.closest(points)[0] == pytest.approx(scene.closest(centres)[0], abs=1e-12)
        # far outside it neither fails nor wraps around
        assert np.isfinite(grid.closest(np.full((1, 3), 1e9))[0]).all()


class TestExactData:
    def test_returns_to_the_true_pose(self, part: Part, registration: Registration) -> None:
        rng = np.random.default_rng(1)
        cloud = cloud_from(measured(part, [POSE], rng, noise_m=0.0), rng)
        starts = np.stack([disturbed(POSE, part, 8.0, 4e-3, rng) for _ in range(10)])
        found = registered(registration, starts, cloud)
        errors = np.array([average_distance_m(POSE, pose, part) for pose in found])
        # rays and nearest points are float32
        assert np.median(errors) < 1e-6
        assert (errors < 1e-5).mean() >= 0.8

    @settings(max_examples=15)
    @given(st.tuples(*[st.floats(-2, 2)] * 3), st.tuples(*[st.floats(-0.2, 0.2)] * 3))
    def test_moves_with_the_world(self, turn: tuple[float, ...], shift: tuple[float, ...]) -> None:
        """Turn and shift camera and object together: the result follows."""
        part = bracket()
        registration = Registration(part, RefinementSettings(grid_cells=16))
        rng = np.random.default_rng(2)
        cloud = cloud_from(measured(part, [POSE], rng), rng)
        start = disturbed(POSE, part, 4.0, 2e-3, rng)[None]
        world = transform(Rotation.from_rotvec(turn).as_matrix(), shift)
        there = Cloud(transform_points(world, cloud.points), cloud.towards @ world[:3, :3].T, cloud.view, cloud.cell)
        here = registered(registration, start, cloud)[0]
        assert average_distance_m(world @ here, registered(registration, world @ start, there)[0], part) < 2e-6


class TestContaminatedData:
    def test_a_third_of_outliers_costs_at_most_20_um(self, part: Part, registration: Registration) -> None:
        errors: list[float] = []
        for seed in range(12):
            rng = np.random.default_rng(seed)
            pose = transform(Rotation.random(random_state=rng).as_matrix(), POSE[:3, 3])
            cloud = cloud_from(measured(part, [pose], rng, outliers=0.33), rng)
            found = registered(registration, disturbed(pose, part, 5.0, 3e-3, rng)[None], cloud)
            errors.append(average_distance_m(pose, found[0], part))
        assert np.median(errors) < 0.02e-3

    def test_the_error_lies_within_the_covariance(self, part: Part) -> None:
        """NEES: the squared error in units of the covariance is chi-square with 6 degrees of freedom on average."""
        registration = Registration(part, RefinementSettings(slippery=0.0))
        figures: list[float] = []
        for seed in range(60):
            rng = np.random.default_rng(seed)
            pose = transform(Rotation.random(random_state=rng).as_matrix(), POSE[:3, 3])
            cloud = cloud_from(measured(part, [pose], rng, window_px=5), rng, cell_px=5)
            found = registration.settle(disturbed(pose, part, 0.3, 0.2e-3, rng)[None], cloud, 1)
            error = error_twist(pose, found.poses[0], part)
            figures.append(float(error @ np.linalg.solve(found.covariance[0], error)))
        # the mean of 60 has a deviation of 0.45
        assert 4.5 < np.mean(figures) < 8.0

    def test_points_are_not_drawn_to_the_far_side_of_a_sheet(self) -> None:
        """The start lies so far before the points that the back of the sheet is nearer to them than its front."""
        sheet = box(0.06, 0.04, 0.8e-3)
        pose = transform(rotation_about((1, 0, 0), 0.3), (0.0, 0.0, 0.45))
        rng = np.random.default_rng(3)
        cloud = cloud_from(measured(sheet, [pose], rng, noise_m=0.01e-3), rng)
        start = displaced(pose, sheet, np.zeros(3), pose[:3, 2] * -0.5e-3)
        found = Registration(sheet, RefinementSettings()).settle(start[None], cloud, 1)
        assert abs(error_twist(pose, found.poses[0], sheet)[3:] @ pose[:3, 2]) < 0.02e-3


class TestSlipperyDirections:
    def test_a_plane_determines_one_shift_and_two_turns(self) -> None:
        plate = box(0.06, 0.06, 0.01)
        pose = transform(np.eye(3), (0.0, 0.0, 0.45))
        rng = np.random.default_rng(4)
        across = rng.uniform(-0.02, 0.02, (2000, 2))
        points = np.column_stack([across, 0.445 + 0.05e-3 * rng.standard_normal(2000)])
        start = displaced(pose, plate, np.array([0.01, -0.01, 0.02]), np.array([1e-3, -1e-3, 0.3e-3]))
        settings_ = RefinementSettings()
        found = Registration(plate, settings_).settle(start[None], cloud_of(points), 1)
        left = error_twist(start, found.poses[0], plate)
        error = error_twist(pose, found.poses[0], plate)
        assert np.abs(error[[0, 1]]).max() < 1e-3
        assert abs(error[5]) < 0.02e-3
        # what is left alone: the turn about the normal, and shifts along the plane but for the tilt taken back
        assert abs(left[2]) < 1e-4
        assert np.abs(left[3:5]).max() < 0.1e-3
        deviation = np.sqrt(np.diag(found.covariance[0]))
        assert deviation[2] == pytest.approx(np.deg2rad(settings_.prior_turn_deg), rel=0.01)
        assert deviation[3:5] == pytest.approx(settings_.prior_shift_m, rel=0.01)
        assert deviation[[0, 1]].max() < 1e-3

    def test_the_mantle_of_a_cylinder_leaves_its_axis(self) -> None:
        rod = part_of(trimesh.creation.cylinder(radius=8e-3, height=0.1, sections=64))
        pose = transform(rotation_about((1, 0, 0), np.pi / 2), (0.0, 0.0, 0.45))
        rng = np.random.default_rng(5)
        depth_m = measured(rod, [pose], rng, noise_m=0.02e-3)
        depth_m[: CAMERA.height // 2 - 50] = depth_m[CAMERA.height // 2 + 50 :] = np.nan  # without its ends
        start = displaced(pose, rod, pose[:3, 2] * 0.1, pose[:3, 2] * 2e-3 + np.array([0.3e-3, 0, 0.3e-3]))
        found = Registration(rod, RefinementSettings()).settle(start[None], cloud_from(depth_m, rng), 1)
        error = error_twist(pose, found.poses[0], rod)
        axis = pose[:3, 2]
        assert error[:3] @ axis == pytest.approx(-0.1, abs=2e-3)
        assert error[3:] @ axis == pytest.approx(-2e-3, abs=0.05e-3)
        assert np.linalg.norm(error[3:] - axis * (error[3:] @ axis)) < 0.05e-3
        assert np.sqrt(axis @ found.covariance[0, :3, :3] @ axis) == pytest.approx(np.deg2rad(10), rel=0.01)


class TestHardCases:
    @pytest.mark.parametrize(
        "points",
        [
            np.zeros((0, 3)),
            np.array([[0.0, 0.0, 0.45]]),
            np.repeat([[0.0, 0.0, 0.44]], 500, axis=0),
            np.full((100, 3), 1e8),
            np.random.default_rng(0).uniform(-1, 1, (3000, 3)),
        ],
        ids=["none", "one", "equal", "far", "everywhere"],
    )
    def test_no_points_move_a_pose_to_nowhere(self, points: FloatArray, part: Part, registration: Registration) -> None:
        starts = np.stack([POSE, displaced(POSE, part, np.zeros(3), np.array([0, 0, -2.0])), np.eye(4)])
        cloud = cloud_of(points)
        found = registration.settle(registration.approach(starts, cloud), cloud, 1)
        assert np.isfinite(found.poses).all()
        assert np.isfinite(found.covariance).all()
        rotation = found.poses[:, :3, :3]
        assert np.abs(rotation @ np.swapaxes(rotation, 1, 2) - np.eye(3)).max() < 1e-12
        assert (found.poses[~found.determined] == starts[~found.determined]).all()
        if len(np.unique(points, axis=0)) <= 1:
            assert not found.determined[2]

    @pytest.mark.parametrize("factor", [0.05, 10.0])
    def test_parts_of_3_mm_and_600_mm(self, factor: float) -> None:
        """The same scene in another scale, noise and all, is solved as well; kernels in metres do not hinder it."""
        small = bracket()
        part = part_from_arrays("scaled", small.vertices_m * factor, small.triangles)
        pose = POSE.copy()
        pose[:3, 3] *= factor
        rng = np.random.default_rng(6)
        cloud = cloud_from(measured(part, [pose], rng, noise_m=min(0.02e-3 * factor, 0.1e-3)), rng)
        starts = np.stack([disturbed(pose, part, 5.0, 2e-3 * factor, rng) for _ in range(6)])
        found = registered(Registration(part, RefinementSettings()), starts, cloud)
        errors = np.array([average_distance_m(pose, each, part) for each in found])
        assert np.median(errors) < 0.02e-3 * factor
