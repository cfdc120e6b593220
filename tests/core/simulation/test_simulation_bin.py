"""Parts in the bin rest on its floor, touch neither each other nor the walls, and lie the same for a seed."""

import itertools

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from sidelong.errors import SettingsError
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import invert, rotation_about, transform, transform_points
from sidelong.simulation.bin import Bin, convex_outline, fill_bin, outline_distance, resting_rotations
from sidelong.simulation.parts import PART_NAMES, simulated_part

BASE_T_BIN = transform(rotation_about((0, 0, 1), 0.4), (0.5, -0.1, 0.02))


@pytest.mark.parametrize("name", PART_NAMES)
def test_parts_stand_on_the_floor_inside_the_walls(name):
    part, bin_ = simulated_part(name), Bin()
    for base_T_object in fill_bin(part, 8, 3, BASE_T_BIN, bin_):
        in_bin = transform_points(invert(BASE_T_BIN) @ base_T_object, part.vertices_m)
        assert in_bin[:, 2].min() == pytest.approx(0.0, abs=1e-9)
        assert np.abs(in_bin[:, 0]).max() < bin_.length_m / 2
        assert np.abs(in_bin[:, 1]).max() < bin_.width_m / 2


@pytest.mark.parametrize("name", PART_NAMES)
def test_no_part_is_inside_another(name):
    # an independent check: no vertex of one part lies in the convex hull of another
    part = simulated_part(name)
    hull = trimesh.Trimesh(part.vertices_m, part.triangles, process=False).convex_hull
    normals, index = np.unique(hull.face_normals.round(4), axis=0, return_index=True)
    offsets = np.einsum("ij,ij->i", hull.triangles[index, 0], normals)
    poses = fill_bin(part, 6, 5, BASE_T_BIN, Bin())
    for first, second in itertools.permutations(poses, 2):
        points = transform_points(invert(first) @ second, part.vertices_m)
        assert (points @ normals.T - offsets).max(axis=1).min() > 0


def test_a_ray_from_above_meets_each_part_where_it_was_put():
    part = simulated_part("gear")
    poses = fill_bin(part, 6, 1, BASE_T_BIN, Bin())
    scene = RayScene([(Bin().part(), BASE_T_BIN), *((part, pose) for pose in poses)])
    rim = np.array([0.0145, 0.0, 0.0])
    starts = np.array([transform_points(pose, rim) for pose in poses]) + np.array([0.0, 0.0, 0.5])
    assert scene.cast(starts, np.array([0.0, 0.0, -1.0])).instance.tolist() == [1, 2, 3, 4, 5, 6]


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_the_same_seed_gives_the_same_bin(seed):
    part = simulated_part("tube_fitting")
    first, second = (fill_bin(part, 5, seed, BASE_T_BIN, Bin()) for _ in range(2))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, fill_bin(part, 5, seed + 1, BASE_T_BIN, Bin()))


def test_a_cube_rests_on_each_of_its_six_faces_as_often():
    box = trimesh.creation.box((0.03, 0.03, 0.03))
    part = simulated_part("gear").__class__(
        "cube", np.asarray(box.vertices), np.asarray(box.faces), np.zeros(12, dtype=np.intp), ("matte",)
    )
    rotations, likelihood = resting_rotations(part)
    assert np.allclose(likelihood, 1 / 6)
    assert len({tuple(np.round(rotation[2]).astype(int)) for rotation in rotations}) == 6


def test_a_part_never_rests_on_a_face_its_centre_is_not_above():
    # the eye bolt cannot stand on the tip of its shank's rim: every pose keeps its centre above the contact
    part = simulated_part("eye_bolt")
    centre = np.asarray(trimesh.Trimesh(part.vertices_m, part.triangles).center_mass)
    for rotation in resting_rotations(part)[0]:
        points = part.vertices_m @ rotation.T
        contact = points[points[:, 2] < points[:, 2].min() + 1e-5, :2]
        assert outline_distance(convex_outline(contact), (rotation @ centre)[None, :2] + _SPECK) < 1e-6


_SPECK = np.array([[-1e-7, -1e-7], [1e-7, -1e-7], [0.0, 1e-7]])


def test_outline_distance_of_squares_side_by_side():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    assert outline_distance(square, square + np.array([1.25, 0.3])) == pytest.approx(0.25)
    assert outline_distance(square, square + np.array([0.9, 0.0])) == pytest.approx(-0.1)


def test_more_than_fit_are_refused_with_the_number_that_did():
    with pytest.raises(SettingsError, match=r"bin count: 40 x gear do not fit .* into 0.1 x 0.1 m, [3-9] did"):
        fill_bin(simulated_part("gear"), 40, 0, np.eye(4), Bin(length_m=0.1, width_m=0.1))


def test_a_negative_count_is_refused():
    with pytest.raises(SettingsError, match="bin count: is -1, needs at least 0"):
        fill_bin(simulated_part("gear"), -1, 0, np.eye(4), Bin())


def test_the_bin_is_an_open_box_of_the_given_sizes():
    bin_ = Bin(length_m=0.4, width_m=0.2, height_m=0.05)
    scene = RayScene([(bin_.part(), np.eye(4))])
    starts = np.array([[0.0, 0.0, 1.0], [0.202, 0.0, 1.0], [0.0, 0.102, 1.0], [0.3, 0.0, 1.0]])
    heights = 1.0 - scene.cast(starts, np.array([0.0, 0.0, -1.0])).distance
    assert heights == pytest.approx([0.0, 0.05, 0.05, -bin_.wall_m], abs=1e-6)
