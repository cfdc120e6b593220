"""Kinematics against screw axes and closed forms; every branch, the singular ones, and what is out of reach."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from sidelong.errors import PoseError
from sidelong.geometry.kinematics import ARMS, FORWARD_TOLERANCE, ArmGeometry, forward, inverse, nearest_turns
from sidelong.geometry.transforms import transform, validated_transform
from sidelong.types import FloatArray

UR5E, UR10E = ARMS["ur5e"], ARMS["ur10e"]
every_arm = pytest.mark.parametrize("arm", ARMS.values(), ids=list(ARMS))
arms = st.sampled_from(list(ARMS.values()))
# quarter turns put joints on the singularities and the ambiguities of arctan2
angles = st.one_of(st.floats(-7.0, 7.0), st.integers(-4, 4).map(lambda quarter: quarter * np.pi / 2))
configurations = st.tuples(*[angles] * 6).map(np.array)
GENERIC = np.array([0.3, -1.2, 1.1, -0.7, 0.9, 0.4])


def by_screws(arm: ArmGeometry, joints_rad: FloatArray) -> FloatArray:
    """Forward kinematics as a product of exponentials: axes and points read off the arm stretched at zero."""
    reach = arm.a2_m + arm.a3_m
    screws = [
        ((0, 0, 1), (0, 0, 0)),
        ((0, -1, 0), (0, 0, arm.d1_m)),
        ((0, -1, 0), (arm.a2_m, 0, arm.d1_m)),
        ((0, -1, 0), (reach, 0, arm.d1_m)),
        ((0, 0, -1), (reach, -arm.d4_m, 0)),
        ((0, -1, 0), (reach, 0, arm.d1_m - arm.d5_m)),
    ]
    pose = np.eye(4)
    for (axis, point), angle in zip(screws, joints_rad, strict=True):
        turn = Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
        pose = pose @ transform(turn, point - turn @ point)
    return pose @ at_zero(arm)


def at_zero(arm: ArmGeometry) -> FloatArray:
    """The flange with all joints at zero: the arm lies along -x, the flange looks along -y."""
    position_m = (arm.a2_m + arm.a3_m, -arm.d4_m - arm.d6_m, arm.d1_m - arm.d5_m)
    return transform([[1, 0, 0], [0, 0, -1], [0, 1, 0]], position_m)


def distance_rad(one: FloatArray, other: FloatArray) -> FloatArray:
    """Largest difference of a joint, full turns aside."""
    return np.abs(np.angle(np.exp(1j * (one - other)))).max(axis=-1)


def jacobian(arm: ArmGeometry, joints_rad: FloatArray) -> FloatArray:
    """(12, 6) central differences of the pose's entries."""
    steps = 1e-6 * np.eye(6)
    difference = forward(arm, joints_rad + steps) - forward(arm, joints_rad - steps)
    return difference[:, :3].reshape(6, 12).T / 2e-6


def rank(arm: ArmGeometry, joints_rad: FloatArray) -> int:
    return int(np.linalg.matrix_rank(jacobian(arm, joints_rad), tol=1e-6))


def wrist_centre(arm: ArmGeometry, pose: FloatArray) -> FloatArray:
    return pose[:3, 3] - arm.d6_m * pose[:3, 2]


def singularity(arm: ArmGeometry, joints_rad: FloatArray) -> float:
    """How near a configuration is to wrist, elbow or shoulder singularity; 0 is there."""
    beside = np.hypot(*wrist_centre(arm, forward(arm, joints_rad))[:2])
    return min(abs(np.sin(joints_rad[4])), abs(np.sin(joints_rad[2])), beside / arm.d4_m - 1)


def test_the_zero_pose_of_a_ur5e_is_the_one_its_pendant_shows() -> None:
    np.testing.assert_allclose(forward(UR5E, np.zeros(6))[:3, 3], (-0.8172, -0.2329, 0.0628), atol=1e-12)


@every_arm
def test_at_zero_the_lengths_add_up(arm: ArmGeometry) -> None:
    np.testing.assert_allclose(forward(arm, np.zeros(6)), at_zero(arm), atol=1e-15)


def test_the_arms_are_as_long_as_their_data_sheets_say() -> None:
    """The reach a data sheet gives lies between the stretched arm's and that with the wrist bent outward."""
    reaches_m = {"ur3": 0.5, "ur5": 0.85, "ur10": 1.3, "ur3e": 0.5, "ur5e": 0.85, "ur10e": 1.3, "ur16e": 0.9}
    reaches_m |= {"ur20": 1.75, "ur30": 1.3}
    assert reaches_m.keys() == ARMS.keys()
    for name, arm in ARMS.items():
        stretched_m = abs(arm.a2_m + arm.a3_m)
        assert stretched_m < reaches_m[name] < stretched_m + arm.d5_m + 0.005


@given(arms, configurations)
def test_forward_agrees_with_a_product_of_exponentials(arm: ArmGeometry, joints_rad: FloatArray) -> None:
    np.testing.assert_allclose(forward(arm, joints_rad), by_screws(arm, joints_rad), atol=1e-13)


@given(arms, configurations)
def test_poses_are_rigid(arm: ArmGeometry, joints_rad: FloatArray) -> None:
    pose = forward(arm, joints_rad)
    np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-14)
    assert pose[3].tolist() == [0, 0, 0, 1]


def test_many_configurations_are_answered_at_once() -> None:
    many = np.random.default_rng(0).uniform(-3, 3, (2, 5, 6))
    poses = forward(UR10E, many)
    assert poses.shape == (2, 5, 4, 4)
    np.testing.assert_array_equal(poses[1, 3], forward(UR10E, many[1, 3]))


@settings(max_examples=300)
@given(arms, configurations)
@example(
    ARMS["ur3"], np.array([-2.0, 6.0, 1e-9, 0.0, -1.6860884852440234e-8, 0.0])
)  # stretched, wrist all but straight
def test_every_solution_leads_to_the_target(arm: ArmGeometry, joints_rad: FloatArray) -> None:
    """At singular configurations as well; the true joint 6 is given in case it is free."""
    pose = forward(arm, joints_rad)
    solutions = inverse(arm, pose, joints_rad[5])
    assert 1 <= len(solutions) <= 8
    assert np.abs(solutions).max() <= np.pi
    for solution in solutions:
        np.testing.assert_allclose(by_screws(arm, solution), pose, atol=FORWARD_TOLERANCE)


@every_arm
def test_the_true_configuration_is_among_the_branches(arm: ArmGeometry) -> None:
    generator = np.random.default_rng(1)
    tried = generator.uniform(-np.pi, np.pi, (150, 6))
    regular = [joints_rad for joints_rad in tried if singularity(arm, joints_rad) > 0.01]
    assert len(regular) > 100
    for joints_rad in regular:
        assert distance_rad(inverse(arm, forward(arm, joints_rad)), joints_rad).min() < 1e-9


@every_arm
def test_a_target_in_the_middle_of_the_workspace_has_eight_different_solutions(arm: ArmGeometry) -> None:
    size = abs(arm.a2_m + arm.a3_m)
    pose = transform([[1, 0, 0], [0, -1, 0], [0, 0, -1]], (0.5 * size, 0.1 * size, 0.2 * size))
    solutions = inverse(arm, pose)
    assert len(solutions) == 8
    apart = distance_rad(solutions[:, None], solutions[None])
    assert (apart + 9 * np.eye(8)).min() > 0.1
    np.testing.assert_allclose(forward(arm, solutions), np.broadcast_to(pose, (8, 4, 4)), atol=1e-14)


@pytest.mark.parametrize("q5", [0.0, np.pi, 1e-12, 1e-10, 1e-8, 1e-5, np.pi - 1e-8])
def test_a_straight_wrist_keeps_the_digits(q5: float) -> None:
    """An arccos of the cosine of joint 5 would be wrong by 1e-8 there, fifty times what is asked here."""
    for joints_rad in np.random.default_rng(2).uniform(-np.pi, np.pi, (50, 6)):
        joints_rad[4] = q5
        pose = forward(UR10E, joints_rad)
        solutions = inverse(UR10E, pose, joints_rad[5])
        assert len(solutions) >= 2
        assert np.abs(forward(UR10E, solutions) - pose).max() < 2e-10


@pytest.mark.parametrize("q5", [0.0, np.pi])
def test_at_the_wrist_singularity_joint_6_is_the_callers_choice(q5: float) -> None:
    joints_rad = np.array([0.3, -1.2, 1.1, -0.7, q5, 0.4])
    assert rank(UR10E, joints_rad) == 5
    pose = forward(UR10E, joints_rad)
    for free_q6_rad in (0.0, 0.4, -1.0):
        solutions = inverse(UR10E, pose, free_q6_rad)
        straight = solutions[np.abs(np.sin(solutions[:, 4])) < 1e-8]
        assert len(straight) > 0
        np.testing.assert_allclose(straight[:, 5], free_q6_rad, atol=1e-15)
    assert distance_rad(inverse(UR10E, pose, 0.4), joints_rad).min() < 1e-8


@pytest.mark.parametrize("q3", [0.0, 1e-9, 1e-4, np.pi])
def test_a_stretched_or_folded_elbow_has_solutions_that_meet(q3: float) -> None:
    joints_rad = np.array([0.3, -1.2, q3, -0.7, 0.9, 0.4])
    assert rank(UR10E, joints_rad) == (6 if q3 == 1e-4 else 5)
    pose = forward(UR10E, joints_rad)
    solutions = inverse(UR10E, pose)
    assert (distance_rad(solutions, joints_rad) < 2 * np.sin(q3) + 1e-6).sum() == 2
    assert np.abs(forward(UR10E, solutions) - pose).max() < 1e-12


def test_at_the_edge_of_reach_two_solutions_appear() -> None:
    stretched = forward(UR10E, np.array([0.0, 0.0, 0.0, -0.7, 0.9, 0.4]))
    beyond, within = stretched.copy(), stretched.copy()
    beyond[0, 3] -= 1e-6
    within[0, 3] += 1e-6
    assert len(inverse(UR10E, within)) == len(inverse(UR10E, beyond)) + 2


def test_a_wrist_above_the_shoulder_is_met_from_both_sides_and_not_any_nearer() -> None:
    """Its centre stays ``d4`` from the first axis: there both shoulder branches meet, within is no solution."""
    rotation = forward(UR10E, GENERIC)[:3, :3]
    for factor, found in ((1.0, True), (1.0 + 1e-9, True), (0.999, False), (0.0, False)):
        centre = np.array([0.6 * factor * UR10E.d4_m, 0.8 * factor * UR10E.d4_m, 0.9])
        pose = transform(rotation, centre + UR10E.d6_m * rotation[:, 2])
        solutions = inverse(UR10E, pose)
        assert (len(solutions) > 0) == found
        np.testing.assert_allclose(forward(UR10E, solutions), np.broadcast_to(pose, (len(solutions), 4, 4)), atol=1e-12)
        if factor == 1.0:
            assert all(rank(UR10E, solution) == 5 for solution in solutions)
            assert np.ptp(np.cos(solutions[:, 0])) < 1e-6


@pytest.mark.parametrize("far_m", [2.0, 1e3, 1e154, 1e200, 1e308])
def test_out_of_reach_is_an_empty_answer(far_m: float) -> None:
    assert inverse(UR10E, transform(np.eye(3), (far_m, -far_m, far_m))).shape == (0, 6)


@pytest.mark.parametrize("entry", [(0, 3), (1, 1)])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_target_that_is_not_finite_is_refused(entry: tuple[int, int], value: float) -> None:
    pose = np.eye(4)
    pose[entry] = value
    with pytest.raises(PoseError, match="base_T_flange: the pose has 1 of 16 entries not finite"):
        inverse(UR10E, pose)


def test_a_target_with_rounded_digits_is_taken_for_the_rotation_next_to_it() -> None:
    rounded = forward(UR10E, GENERIC).round(6)
    solutions = inverse(UR10E, rounded)
    assert distance_rad(solutions, GENERIC).min() < 1e-4
    reached = np.broadcast_to(validated_transform(rounded, "rounded"), (len(solutions), 4, 4))
    np.testing.assert_allclose(forward(UR10E, solutions), reached, atol=FORWARD_TOLERANCE)


limits = st.floats(-7.0, 7.0, allow_subnormal=False).map(lambda angle: round(angle, 9))


@given(st.tuples(*[st.floats(-np.pi, np.pi)] * 6), st.tuples(*[limits] * 6), limits, st.floats(0.0, 13.0))
def test_turns_are_the_best_of_all_that_keep_the_limits(
    joints: tuple[float, ...], near: tuple[float, ...], low: float, width: float
) -> None:
    shifted = nearest_turns(np.array([joints]), near, [low] * 6, [low + width] * 6)
    best = []
    for joint, wanted in zip(joints, near, strict=True):
        turns = [joint + 2 * np.pi * k for k in range(-4, 5)]
        best.append(min((abs(turn - wanted) for turn in turns if low <= turn <= low + width), default=None))
    if None in best:
        assert shifted.shape == (0, 6)
    else:
        np.testing.assert_allclose(np.abs(shifted[0] - near), best, atol=1e-12)
        np.testing.assert_allclose(distance_rad(shifted, np.array(joints)), 0, atol=1e-12)


def test_turns_leave_out_what_does_not_fit_and_keep_the_order() -> None:
    many = np.zeros((3, 6))
    many[:, 2] = (0.5, 2.0, -0.5)
    kept = nearest_turns(many, [7.0] * 6, [-1.0] * 6, [1.0] * 6)
    np.testing.assert_array_equal(kept, many[[0, 2]])
    np.testing.assert_allclose(nearest_turns(many, [7.0] * 6, [-9.0] * 6, [9.0] * 6), many + 2 * np.pi)
    assert nearest_turns(np.empty((0, 6)), [0.0] * 6, [-1.0] * 6, [1.0] * 6).shape == (0, 6)


def test_the_table_of_arms_cannot_be_changed() -> None:
    with pytest.raises(TypeError):
        ARMS["ur5e"] = UR10E  # type: ignore[index]
    with pytest.raises(dataclasses.FrozenInstanceError):
        UR5E.a2_m = 0.0  # type: ignore[misc]
