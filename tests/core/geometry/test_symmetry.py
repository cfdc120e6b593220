"""Symmetry of a part: equivalent poses, angles and nearest poses against closed forms and brute force."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sidelong.errors import SettingsError
from sidelong.geometry.symmetry import Symmetry, group_from, no_symmetry
from sidelong.geometry.transforms import rotation_about, rotation_angle, transform, transform_points
from sidelong.types import FloatArray

CENTRE_M = np.array([0.01, -0.02, 0.03])
Z = np.array([0.0, 0.0, 1.0])
HALF_TURN_X = np.diag([1.0, -1.0, -1.0])
seeds = st.integers(0, 2**31)


def turns(seed: int, count: int) -> FloatArray:
    return Rotation.random(count, random_state=seed).as_matrix()


def pose(seed: int) -> FloatArray:
    return transform(turns(seed, 1)[0], np.random.default_rng(seed).uniform(-1, 1, 3))


def smallest_turn_rad(rotations: FloatArray, to: FloatArray) -> float:
    return float(Rotation.from_matrix(np.swapaxes(rotations, -1, -2) @ to).magnitude().min())


def dihedral(order: int) -> Symmetry:
    group = group_from(np.stack([rotation_about(Z, 2 * np.pi / order), HALF_TURN_X]))
    assert group is not None
    return Symmetry(CENTRE_M, group)


CONE = Symmetry(CENTRE_M, np.eye(3)[None], axis=Z)
CYLINDER = Symmetry(CENTRE_M, np.stack([np.eye(3), HALF_TURN_X]), axis=Z)
BALL = Symmetry(CENTRE_M, np.eye(3)[None], ball=True)
EVERY = (no_symmetry(CENTRE_M), dihedral(6), CONE, CYLINDER, BALL)
NAMES = ("none", "hexagon", "cone", "cylinder", "ball")
each_kind = pytest.mark.parametrize("symmetry", EVERY, ids=NAMES)


@each_kind
def test_the_first_equivalent_is_the_identity_and_all_keep_the_centre(symmetry: Symmetry) -> None:
    equivalent = symmetry.equivalent(0.7)
    np.testing.assert_allclose(equivalent[0], np.eye(4), atol=1e-15)
    for object_T_object in equivalent:
        np.testing.assert_allclose(transform_points(object_T_object, CENTRE_M), CENTRE_M, atol=1e-15)
        np.testing.assert_allclose(object_T_object[:3, :3] @ object_T_object[:3, :3].T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(("symmetry", "count"), [(dihedral(6), 12), (CONE, 63), (CYLINDER, 126)])
def test_how_many_equivalents_there_are(symmetry: Symmetry, count: int) -> None:
    assert len(symmetry.equivalent(0.1)) == count  # 2 pi / 0.1 = 62.8


@each_kind
@given(seed=seeds)
def test_no_operation_is_farther_than_half_a_step_from_a_listed_one(symmetry: Symmetry, seed: int) -> None:
    """Any pose that counts as the same as another is close to one of its listed equivalents."""
    step_rad = 0.8
    here = pose(seed)
    same = symmetry.nearest(here, to=pose(seed + 1))
    listed = here @ symmetry.equivalent(step_rad)
    assert smallest_turn_rad(listed[:, :3, :3], same[:3, :3]) <= step_rad / 2 + 1e-7


@pytest.mark.parametrize("step_rad", [0.0, -0.1, np.pi, np.nan])
def test_steps_that_are_none_are_refused(step_rad: float) -> None:
    with pytest.raises(SettingsError, match=r"symmetry: step_rad is .*, limits 0 to pi"):
        CONE.equivalent(step_rad)


@each_kind
@given(seed=seeds)
def test_the_angle_is_the_smallest_over_all_equivalents(symmetry: Symmetry, seed: int) -> None:
    """Brute force over a fine list: it cannot find less, and finds no more than its step."""
    step_rad = 1.0 if symmetry.ball else 0.02
    rotations, to = turns(seed, 3), turns(seed + 1, 1)[0]
    equivalent = symmetry.equivalent(step_rad)[:, :3, :3]
    brute = [smallest_turn_rad(turn @ equivalent, to) for turn in rotations]
    angles = symmetry.angle_rad(rotations, to)
    assert angles.shape == (3,)
    assert (angles <= np.array(brute) + 1e-7).all()
    assert (np.array(brute) <= angles + step_rad / 2 + 1e-7).all()


@each_kind
@given(seed=seeds)
def test_the_nearest_pose_is_equivalent_and_turned_by_the_angle(symmetry: Symmetry, seed: int) -> None:
    here, to = pose(seed), pose(seed + 1)
    near = symmetry.nearest(here, to=to)
    np.testing.assert_allclose(transform_points(near, CENTRE_M), transform_points(here, CENTRE_M), atol=1e-12)
    assert symmetry.angle_rad(near[:3, :3], here[:3, :3]) == pytest.approx(0.0, abs=1e-7)
    expected = symmetry.angle_rad(here[:3, :3], to[:3, :3])
    assert rotation_angle(near[:3, :3].T @ to[:3, :3]) == pytest.approx(float(expected), abs=1e-7)


def test_closed_forms_of_a_turn_about_the_axis_and_a_tilt() -> None:
    spin, tilt = rotation_about(Z, 1.0), rotation_about((1, 0, 0), 0.3)
    for symmetry, angle_rad in ((EVERY[0], 1.0), (dihedral(6), np.pi / 3 - 1.0), (CONE, 0.0), (CYLINDER, 0.0)):
        assert symmetry.angle_rad(spin, np.eye(3)) == pytest.approx(abs(angle_rad), abs=1e-12)
        assert symmetry.angle_rad(tilt, np.eye(3)) == pytest.approx(0.3)


def test_a_flip_is_nothing_to_a_cylinder_and_half_a_turn_to_a_cone() -> None:
    assert CYLINDER.angle_rad(HALF_TURN_X, np.eye(3)) == pytest.approx(0.0, abs=1e-12)
    assert CONE.angle_rad(HALF_TURN_X, np.eye(3)) == pytest.approx(np.pi)
    assert not CYLINDER.trivial
    assert EVERY[0].trivial


@pytest.mark.parametrize("angle_rad", [1e-9, 1e-5, np.pi - 1e-5, np.pi])
def test_small_and_large_angles_keep_their_digits(angle_rad: float) -> None:
    turned = rotation_about((1, 2, 3), angle_rad)
    assert EVERY[0].angle_rad(turned, np.eye(3)) == pytest.approx(angle_rad, abs=3e-8, rel=1e-6)
    tilted = rotation_about((1, 0, 0), angle_rad)
    assert CONE.angle_rad(tilted, np.eye(3)) == pytest.approx(angle_rad, rel=1e-6)


def test_a_group_is_closed_and_exact_where_its_generators_are_not() -> None:
    """A cube's two generators, each 0.1 degrees off: the 24 turns made of them close to rounding."""
    off = rotation_about((1, 2, 3), np.deg2rad(0.1))
    group = group_from(np.stack([off @ rotation_about(Z, np.pi / 2), rotation_about((1, 1, 1), 2 * np.pi / 3) @ off]))
    assert group is not None
    assert len(group) == 24
    np.testing.assert_allclose(group[0], np.eye(3), atol=1e-6)
    products = np.einsum("aij,bjk->abik", group, group)
    nearest = np.linalg.norm(products[:, :, None] - group, axis=(3, 4)).min(axis=2)
    assert nearest.max() < 1e-6


def test_turns_that_never_close_make_no_group() -> None:
    assert group_from(rotation_about(Z, 1.0)[None]) is None
