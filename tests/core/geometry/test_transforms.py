"""Rigid motions: group laws, closed forms at small and large angles, and what is no rigid motion."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sidelong.errors import PoseError
from sidelong.geometry.transforms import (
    invert,
    look_at,
    rotate,
    rotation_about,
    rotation_angle,
    transform,
    transform_points,
    validated_transform,
)
from sidelong.types import FloatArray

lengths = st.floats(-2.0, 2.0)
vectors = st.tuples(lengths, lengths, lengths)
motions = st.builds(
    lambda vector, shift: transform(Rotation.from_rotvec(vector).as_matrix(), shift),
    st.tuples(lengths, lengths, lengths),
    vectors,
)
points = st.lists(vectors, min_size=1, max_size=5).map(np.array)


@given(motions)
def test_a_motion_and_its_inverse_cancel(a_T_b: FloatArray) -> None:
    np.testing.assert_allclose(a_T_b @ invert(a_T_b), np.eye(4), atol=1e-14)
    np.testing.assert_array_equal(invert(invert(a_T_b))[:3, :3], a_T_b[:3, :3])


@given(motions, motions, points)
def test_composed_motions_map_points_one_after_the_other(a_T_b: FloatArray, b_T_c: FloatArray, p: FloatArray) -> None:
    direct = transform_points(a_T_b @ b_T_c, p)
    np.testing.assert_allclose(direct, transform_points(a_T_b, transform_points(b_T_c, p)), atol=1e-13)
    np.testing.assert_allclose(invert(a_T_b @ b_T_c), invert(b_T_c) @ invert(a_T_b), atol=1e-13)


@given(motions, points)
def test_directions_turn_and_do_not_shift(a_T_b: FloatArray, p: FloatArray) -> None:
    turned = rotate(a_T_b, p)
    origin = transform_points(a_T_b, np.zeros_like(p))
    np.testing.assert_allclose(turned, transform_points(a_T_b, p) - origin, atol=1e-13)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), np.linalg.norm(p, axis=1), rtol=1e-13, atol=1e-300)


def test_many_motions_are_inverted_at_once() -> None:
    many = np.stack([transform(rotation_about((1, 2, 3), angle), (angle, 0, 1)) for angle in (0.1, 1.0, 3.0)])
    np.testing.assert_allclose(many @ invert(many), np.broadcast_to(np.eye(4), (3, 4, 4)), atol=1e-15)


@given(motions)
def test_a_motion_passes_validation_in_any_usual_form(a_T_b: FloatArray) -> None:
    for form in (a_T_b, a_T_b.tolist(), a_T_b.ravel().tolist(), a_T_b.astype(np.float32)):
        valid = validated_transform(form, "pose")
        np.testing.assert_allclose(valid, a_T_b, atol=1e-6)
        np.testing.assert_allclose(valid[:3, :3] @ valid[:3, :3].T, np.eye(3), atol=1e-14)
        assert valid.dtype == np.float64


def test_validation_leaves_its_input_alone() -> None:
    rounded = transform(rotation_about((1, 1, 0), 0.7), (1, 2, 3)).round(5)
    before = rounded.copy()
    validated_transform(rounded, "pose")
    np.testing.assert_array_equal(rounded, before)


def test_text_rounded_to_five_digits_is_made_orthonormal() -> None:
    exact = transform(rotation_about((1, 1, 0), 0.7), (1, 2, 3))
    valid = validated_transform(exact.round(5), "pose")
    assert np.abs(valid[:3, :3] - exact[:3, :3]).max() < 1e-5
    np.testing.assert_allclose(valid[:3, :3] @ valid[:3, :3].T, np.eye(3), atol=1e-15)


def changed(row: int, column: int, value: float) -> FloatArray:
    matrix = np.eye(4)
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(4).ravel()[:15], r"view_3\.json: a pose needs 16 numbers \(4x4, row-major\), got 15"),
        (np.eye(3), r"view_3\.json: a pose needs 16 numbers \(4x4, row-major\), got 9"),
        ([], r"view_3\.json: a pose needs 16 numbers \(4x4, row-major\), got 0"),
        (None, r"view_3\.json: a pose needs 16 numbers"),
        ("here", r"view_3\.json: a pose needs 16 numbers, got 'here'"),
        ([[1, 2], [3]], r"view_3\.json: a pose needs 16 numbers, got \[\[1, 2\], \[3\]\]"),
        (changed(1, 3, np.nan), r"view_3\.json: the pose has 1 of 16 entries not finite"),
        (changed(0, 0, np.inf), r"view_3\.json: the pose has 1 of 16 entries not finite"),
        (changed(3, 0, 0.01), r"view_3\.json: the last row of the pose is \[0\.01, 0\.0, 0\.0, 1\.0\], should be"),
        (changed(3, 3, 0.0), r"view_3\.json: the last row of the pose is \[0\.0, 0\.0, 0\.0, 0\.0\], should be"),
        (changed(0, 1, 0.02), r"view_3\.json: the rotation is not orthonormal, \|R R\^T - I\| is 0\.02, limit 0\.0001"),
        (np.diag([1.001, 1.001, 1.001, 1.0]), r"view_3\.json: the rotation is not orthonormal"),
        (np.diag([0.0, 0.0, 0.0, 1.0]), r"view_3\.json: the rotation is not orthonormal, .* is 1, limit"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), r"view_3\.json: the rotation is a reflection, its determinant is -1"),
    ],
)
def test_what_is_no_rigid_motion_is_refused(matrix: object, message: str) -> None:
    with pytest.raises(PoseError, match=message):
        validated_transform(matrix, "view_3.json")  # type: ignore[arg-type]


def test_entries_whose_squares_overflow_are_refused() -> None:
    huge = np.eye(4)
    huge[:2, :2] = [[1e200, 1e200], [1e200, -1e200]]
    with pytest.raises(PoseError, match="the rotation is not orthonormal"):
        validated_transform(huge, "pose")


@given(vectors.filter(lambda v: np.linalg.norm(v) > 1e-3), st.floats(-np.pi, np.pi))
def test_rotation_about_agrees_with_scipy(axis: tuple[float, float, float], angle: float) -> None:
    expected = Rotation.from_rotvec(np.array(axis) / np.linalg.norm(axis) * angle).as_matrix()
    np.testing.assert_allclose(rotation_about(axis, angle), expected, atol=1e-14)


@pytest.mark.parametrize("angle", [1e-3, 1e-6, 1e-9, 1e-12])
def test_tiny_rotations_keep_all_their_digits(angle: float) -> None:
    """The entry ``x y (1 - cos)`` against 40 digits: written as 1 - cos it would be 0 from 1e-8 on."""
    axis = np.array([0.6, 0.8, 0.0])
    with mpmath.workdps(40):
        expected = float(0.48 * (1 - mpmath.cos(mpmath.mpf(angle))))
    assert rotation_about(axis, angle)[0, 1] == pytest.approx(expected, rel=1e-12)


@given(vectors.filter(lambda v: np.linalg.norm(v) > 1e-3), st.floats(0.0, np.pi))
def test_rotation_angle_undoes_rotation_about(axis: tuple[float, float, float], angle: float) -> None:
    assert rotation_angle(rotation_about(axis, angle)) == pytest.approx(angle, abs=1e-14)


@pytest.mark.parametrize("small", [0.0, 1e-12, 1e-9, 1e-6, 1e-3])
def test_rotation_angle_is_accurate_at_both_ends(small: float) -> None:
    """arccos of the trace loses half the digits there."""
    axis = (0.36, 0.48, 0.8)
    assert rotation_angle(rotation_about(axis, small)) == pytest.approx(small, rel=1e-6, abs=1e-15)
    assert np.pi - rotation_angle(rotation_about(axis, np.pi - small)) == pytest.approx(small, rel=1e-3, abs=1e-15)


@pytest.mark.parametrize("axis", [(0.0, 0.0, 0.0), (np.nan, 0.0, 1.0), (np.inf, 0.0, 0.0)])
def test_an_axis_without_direction_is_refused(axis: tuple[float, float, float]) -> None:
    with pytest.raises(PoseError, match=r"axis: \[.*\] has no direction"):
        rotation_about(axis, 1.0)


def test_a_camera_that_looks_straight_down_has_x_along_the_bases_x() -> None:
    base_T_camera = look_at((0.1, 0.2, 0.7), (0.1, 0.2, 0.0))
    np.testing.assert_allclose(base_T_camera[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=1e-15)
    np.testing.assert_array_equal(base_T_camera[:3, 3], (0.1, 0.2, 0.7))


def test_a_camera_at_the_side_sees_up_as_up() -> None:
    """From +x towards the origin: image x along +y, image y down."""
    np.testing.assert_allclose(
        look_at((1, 0, 0), (0, 0, 0))[:3, :3], np.array([[0, 0, -1], [1, 0, 0], [0, -1, 0]]), atol=1e-15
    )


@given(vectors, vectors, st.floats(-3.0, 3.0))
def test_look_at_puts_the_target_on_the_optical_axis(
    eye: tuple[float, float, float], target: tuple[float, float, float], roll: float
) -> None:
    distance = float(np.linalg.norm(np.subtract(target, eye)))
    if distance < 1e-6:
        return
    base_T_camera = look_at(eye, target, roll)
    seen = transform_points(invert(base_T_camera), np.array(target))
    np.testing.assert_allclose(seen, (0.0, 0.0, distance), atol=1e-12)
    validated_transform(base_T_camera, "look_at")
    # roll 0 is level: the image's x axis has no height
    assert look_at(eye, target)[2, 0] == pytest.approx(0.0, abs=1e-9)


def test_roll_turns_the_camera_clockwise_about_its_axis() -> None:
    """With x of the image along base x and y along -y, a quarter turn brings x to where y was."""
    turned = look_at((0, 0, 1), (0, 0, 0), roll_rad=np.pi / 2)
    np.testing.assert_allclose(turned[:3, 0], (0, -1, 0), atol=1e-15)
    level = look_at((1, 0, 1), (0, 0, 0))
    assert rotation_angle(level[:3, :3].T @ look_at((1, 0, 1), (0, 0, 0), 0.4)[:3, :3]) == pytest.approx(0.4)


@pytest.mark.parametrize("eye", [(0.0, 0.0, 0.5), (np.nan, 0.0, 1.0), (np.inf, 0.0, 0.0)])
def test_look_at_needs_a_direction(eye: tuple[float, float, float]) -> None:
    with pytest.raises(
        PoseError, match=r"look_at: there is no direction from eye \[.*\] m to target \[0\.0, 0\.0, 0\.5\] m"
    ):
        look_at(eye, (0.0, 0.0, 0.5))
