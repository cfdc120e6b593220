"""The mock arm as a device: where it goes and how fast, stopping it at any time, and what it refuses."""

import re
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

import sidelong_drivers.mock
from sidelong.devices import Arm
from sidelong.errors import (
    DeviceTimeoutError,
    DeviceUnavailableError,
    MotionRefusedError,
    MotionStoppedError,
    PoseError,
)
from sidelong.geometry.kinematics import ARMS, forward, inverse, nearest_turns
from sidelong.geometry.transforms import invert, transform
from sidelong.planning.candidates import DomeSettings, dome_views
from sidelong_drivers.mock import MockArm, MockArmSettings, _plan

FLANGE_T_CAMERA = transform(np.eye(3), (-0.05059195, -0.06, 0.05))
DOME = [v.base_T_camera @ invert(FLANGE_T_CAMERA) for v in dome_views((0.5, 0.0, 0.03), DomeSettings())]
UR10E = ARMS["ur10e"]
HOME = np.array(MockArmSettings().home_rad)
NEVER_S = 1000.0
SHARED_MACHINE_S = 30.0


def opened(**settings):
    device = MockArm(MockArm.Settings(**{"speed_factor": 20.0, **settings}))
    device.open()
    return device


@pytest.fixture
def arm():
    device = opened()
    yield device
    device.close()


@pytest.fixture
def slow_arm():
    """Takes seconds, long enough to stop it on its way even where the machine stalls."""
    device = opened(speed_factor=1.0)
    yield device
    device.close()


class Moving(threading.Thread):
    """A move in a thread of its own; ``outcome`` is its answer or its error."""

    def __init__(self, arm, target):
        super().__init__(daemon=True)
        self._arm, self._target = arm, target
        self.outcome = None
        self.start()

    def run(self):
        try:
            self.outcome = self._arm.move(self._target, NEVER_S)
        except Exception as error:  # noqa: BLE001, handed to the test
            self.outcome = error

    def wait_until(self, condition):
        while not condition(self._arm.state()):
            assert self.is_alive(), f"the move ended before: {self.outcome}"
            time.sleep(1e-3)

    def end(self):
        self.join(SHARED_MACHINE_S)
        assert not self.is_alive()
        return self.outcome


def predicted_s(arm, target):
    """How long a move would take, from the message of a deadline that cannot be kept."""
    with pytest.raises(DeviceTimeoutError) as refused:
        arm.move(target, 0.0)
    return float(re.search(r"would take ([0-9.e-]+) s, deadline 0 s", str(refused.value))[1])


def shares_done(start_rad, goal_rad, joints_rad):
    """(N,) how far along the straight line configurations (N, 6) are, and (N,) how far beside it in radians."""
    change = goal_rad - start_rad
    shares = (joints_rad - start_rad) @ change / (change @ change)
    return shares, np.abs(joints_rad - start_rad - shares[:, None] * change).max(axis=1)


def at_home(arm):
    state = arm.state()
    return not state.moving and np.array_equal(state.joints_rad, HOME)


def test_it_is_an_arm_whose_defaults_look_down_on_the_bin():
    device: Arm = MockArm(MockArmSettings())
    device.open()
    base_T_camera = device.state().base_T_flange @ FLANGE_T_CAMERA
    np.testing.assert_allclose(base_T_camera[:3, 3], (0.5, 0.0, 0.7), atol=1e-3)
    np.testing.assert_allclose(base_T_camera[:3, :3], np.diag([1.0, -1.0, -1.0]), atol=2e-3)
    assert not device.state().moving
    device.close()


def test_it_reaches_every_view_of_the_default_dome_in_a_few_seconds():
    device, fast = opened(speed_factor=1.0), opened(speed_factor=1000.0)
    assert [device.unreachable(target) for target in DOME] == [None] * 13
    assert max(predicted_s(device, target) for target in DOME) < 4.0
    hops_s = []
    for here in DOME:
        fast.move(here, NEVER_S)
        hops_s += [1000 * predicted_s(fast, there) for there in DOME if there is not here]
    assert 1.0 < np.median(hops_s) < 3.0
    assert max(hops_s) < 4.0


def test_after_a_move_it_rests_at_the_target(arm):
    for target in DOME[:4]:
        answer = arm.move(target, NEVER_S)
        for state in (answer, arm.state()):
            np.testing.assert_allclose(state.base_T_flange, target, atol=1e-9)
            np.testing.assert_array_equal(state.base_T_flange, forward(UR10E, state.joints_rad))
            assert not state.moving
            assert abs(time.monotonic() - state.stamp_s) < SHARED_MACHINE_S


def test_it_takes_the_branch_that_is_reached_first(arm):
    """All joints have the same limits here, so the one with the least largest turn."""
    for target in DOME:
        before_rad = arm.state().joints_rad
        branches = nearest_turns(inverse(UR10E, target, before_rad[5]), before_rad, [-2 * np.pi] * 6, [2 * np.pi] * 6)
        least_rad = np.abs(branches - before_rad).max(axis=1).min()
        after_rad = arm.move(target, NEVER_S).joints_rad
        assert np.abs(after_rad - before_rad).max() == pytest.approx(least_rad, abs=1e-9)


def test_a_joint_near_its_limit_turns_the_long_way_round():
    home = (*HOME[:5], 2 * np.pi - 0.1)
    target = forward(UR10E, np.array([*HOME[:5], 0.1]))  # a fifth of a radian onward, but beyond the limit
    device = opened(home_rad=home, low_rad=(-0.5, -2, -2, -2, 1, -7e-4), high_rad=(0.5, -1, -1, -1, 2, 2 * np.pi))
    np.testing.assert_allclose(device.move(target, NEVER_S).joints_rad[5], 0.1, atol=1e-9)


def test_on_the_way_it_keeps_to_the_line_and_to_its_limits():
    """Mean speeds between readings, and their differences, are bounded whatever the times of the readings."""
    device = opened(speed_factor=2.0)
    moving = Moving(device, DOME[3])
    readings = []
    while moving.is_alive():
        readings.append(device.state())
        time.sleep(5e-4)
    goal_rad = moving.end().joints_rad
    on_the_way = [reading for reading in readings if reading.moving]
    assert len(on_the_way) > 20
    joints_rad = np.array([reading.joints_rad for reading in on_the_way])
    shares, beside_rad = shares_done(HOME, goal_rad, joints_rad)
    assert beside_rad.max() < 1e-12
    assert (np.diff(shares) > 0).all()
    for reading in on_the_way:
        rotation = reading.base_T_flange[:3, :3]
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(reading.base_T_flange, forward(UR10E, reading.joints_rad), atol=1e-15)
    stamps_s = np.array([reading.stamp_s for reading in on_the_way])
    speeds = np.diff(joints_rad, axis=0) / np.diff(stamps_s)[:, None]
    middles_s = (stamps_s[1:] + stamps_s[:-1]) / 2
    accelerations = np.diff(speeds, axis=0) / np.diff(middles_s)[:, None]
    assert 0.9 * 2 * 1.05 < np.abs(speeds).max() < 2 * 1.05 + 1e-6
    assert np.abs(accelerations).max() < 2**2 * 2.5 + 1e-3


@pytest.mark.parametrize(("turn_rad", "expected_s"), [(1.0, 1.0 / 1.05 + 1.05 / 2.5), (0.1, 2 * (0.1 / 2.5) ** 0.5)])
def test_the_time_of_a_move_is_that_of_a_trapezoid_or_a_triangle(turn_rad, expected_s):
    target = forward(UR10E, np.add(HOME, [0, 0, 0, 0, 0, turn_rad]))
    assert predicted_s(opened(speed_factor=1.0), target) == pytest.approx(expected_s, rel=5e-3)
    device = opened(speed_factor=4.0)
    started_s = time.monotonic()
    device.move(target, NEVER_S)
    assert expected_s / 4 <= time.monotonic() - started_s < SHARED_MACHINE_S


def test_the_slowest_joint_sets_the_pace():
    target = forward(UR10E, np.add(HOME, [0.2, 0, 0, 0, 0, 1.0]))
    limits = {"speed_rad_per_s": (0.05, *[1.05] * 5), "speed_factor": 1.0}
    expected_s = 0.2 / 0.05 + 0.05 / 2.5
    assert predicted_s(opened(**limits), target) == pytest.approx(expected_s, rel=0.02)


def test_a_faster_clock_changes_times_and_not_paths():
    one, other = opened(speed_factor=10.0), opened(speed_factor=1000.0)
    for target in DOME[1:4]:
        assert predicted_s(one, target) == pytest.approx(100 * predicted_s(other, target), rel=0.01)
        rests_rad = [device.move(target, NEVER_S).joints_rad for device in (one, other)]
        np.testing.assert_allclose(rests_rad[0], rests_rad[1], atol=1e-12)


def test_a_move_to_where_it_is_takes_no_time(arm):
    arm.move(DOME[0], NEVER_S)
    np.testing.assert_allclose(arm.move(DOME[0], 0.01).base_T_flange, DOME[0], atol=1e-9)


def test_a_straight_wrist_keeps_its_last_joint():
    """Joints 4 and 6 could share the turn in any way there; the arm does not spin one against the other."""
    straight_rad = np.array([*HOME[:4], 0.0, HOME[5]])
    low_m, high_m = (-2, -2, -2), (2, 2, 2)
    device = opened(home_rad=tuple(straight_rad), workspace_low_m=low_m, workspace_high_m=high_m)
    target = forward(UR10E, np.add(straight_rad, [0.1, 0.2, 0.1, 0, 0, 0]))
    np.testing.assert_allclose(
        device.move(target, NEVER_S).joints_rad, np.add(straight_rad, [0.1, 0.2, 0.1, 0, 0, 0]), atol=1e-8
    )


def test_a_stop_from_another_thread_leaves_it_at_rest_on_its_path(slow_arm):
    goal_rad = opened().move(DOME[3], NEVER_S).joints_rad
    moving = Moving(slow_arm, DOME[3])
    moving.wait_until(lambda state: np.abs(state.joints_rad - HOME).max() > 0.5)
    before_rad = slow_arm.state().joints_rad
    slow_arm.stop()
    after_rad = slow_arm.state().joints_rad
    assert isinstance(moving.end(), MotionStoppedError)
    rest = slow_arm.state()
    assert not rest.moving
    assert np.array_equal(rest.joints_rad, slow_arm.state().joints_rad)
    shares, beside_rad = shares_done(HOME, goal_rad, np.array([before_rad, after_rad, rest.joints_rad]))
    assert 0 < shares[0] <= shares[1] <= shares[2] < 1
    assert beside_rad.max() < 1e-12
    braking_rad = 1.05**2 / (2 * 2.5)
    assert np.abs(rest.joints_rad - after_rad).max() < braking_rad + 1e-9
    assert np.abs(rest.joints_rad - before_rad).max() > braking_rad - 1e-9, "it brakes, it does not freeze"
    near = forward(UR10E, rest.joints_rad + 0.01)
    np.testing.assert_allclose(slow_arm.move(near, NEVER_S).base_T_flange, near, atol=1e-9)


def test_a_stopped_move_returns_as_soon_as_it_rests():
    device = opened(speed_factor=0.02)
    assert predicted_s(device, DOME[3]) > 3 * SHARED_MACHINE_S
    moving = Moving(device, DOME[3])
    moving.wait_until(lambda state: state.moving)
    device.stop()
    assert isinstance(moving.end(), MotionStoppedError)  # which waits no longer than a third of the move


def test_stops_may_be_repeated_and_do_not_lengthen_the_braking(slow_arm):
    moving = Moving(slow_arm, DOME[3])
    moving.wait_until(lambda state: np.abs(state.joints_rad - HOME).max() > 0.5)
    slow_arm.stop()
    first_rad = slow_arm.state().joints_rad
    while moving.is_alive():
        slow_arm.stop()
        time.sleep(1e-3)
    assert isinstance(moving.end(), MotionStoppedError)
    assert np.abs(slow_arm.state().joints_rad - first_rad).max() <= 1.05**2 / (2 * 2.5) + 1e-9


def test_a_stop_at_rest_holds_back_no_later_move(arm):
    for _ in range(3):
        arm.stop()
    assert at_home(arm)
    np.testing.assert_allclose(arm.move(DOME[1], NEVER_S).base_T_flange, DOME[1], atol=1e-9)
    arm.stop()
    np.testing.assert_allclose(arm.state().base_T_flange, DOME[1], atol=1e-9)
    np.testing.assert_allclose(arm.move(DOME[0], NEVER_S).base_T_flange, DOME[0], atol=1e-9)


def test_a_stop_while_the_move_is_planned_is_not_lost(slow_arm, monkeypatch):
    full_rad = np.abs(opened().move(DOME[3], NEVER_S).joints_rad - HOME).max()
    stopper = threading.Thread(target=slow_arm.stop)

    def stopped_meanwhile(*arguments, **options):
        stopper.start()
        stopper.join(0.1)
        return inverse(*arguments, **options)

    monkeypatch.setattr(sidelong_drivers.mock, "inverse", stopped_meanwhile)
    assert isinstance(Moving(slow_arm, DOME[3]).end(), MotionStoppedError)
    assert np.abs(slow_arm.state().joints_rad - HOME).max() < full_rad / 2


@given(st.floats(1e-3, 6.0), st.floats(0.0, 1.0))
def test_braked_at_any_time_it_keeps_its_limits_and_rests_no_later(turn_rad, share):
    whole = replace(_plan(HOME, np.add(HOME, turn_rad), MockArmSettings()), started_s=0.0)
    braked = whole.braked(share * whole.duration_s)
    assert share * whole.duration_s <= braked.rest_s <= whole.duration_s + 1e-12
    times_s = np.linspace(0.0, whole.duration_s + 0.1, 400)
    travel_rad = np.array([braked.joints_rad(now_s)[0] for now_s in times_s]) - HOME[0]
    step_s = times_s[1] - times_s[0]
    speeds = np.diff(travel_rad) / step_s
    assert speeds.min() >= -1e-9
    assert speeds.max() <= 1.05 + 1e-9
    assert np.abs(np.diff(speeds) / step_s).max() <= 2.5 + 1e-6
    before = times_s < share * whole.duration_s
    same_rad = [whole.joints_rad(now_s)[0] - HOME[0] for now_s in times_s[before]]
    np.testing.assert_allclose(travel_rad[before], same_rad, atol=1e-12)
    np.testing.assert_array_equal(travel_rad[times_s > braked.rest_s + 1e-9], travel_rad[-1])


def test_a_move_that_would_miss_its_deadline_does_not_begin(arm):
    for deadline_s in (0.01, 0.0, -1.0, np.nan):
        with pytest.raises(
            DeviceTimeoutError, match=rf"mock arm: the move would take .* s, deadline {deadline_s:g} s; nothing"
        ):
            arm.move(DOME[3], deadline_s)
        assert at_home(arm)


def refusals():
    far = DOME[0].copy()
    aside, low = far.copy(), far.copy()
    far[0, 3], aside[1, 3], low[2, 3] = 1.31, -0.95, 0.1
    corner = DOME[0].copy()
    corner[:3, 3] = (1.25, 0.85, 1.35)
    above_the_shoulder = DOME[0].copy()
    above_the_shoulder[:3, 3] = (0.05, 0.05, 0.6)
    yield far, r"the flange's x would be 1\.31 m, outside the workspace -0\.3 to 1\.3 m"
    yield aside, r"the flange's y would be -0\.95 m, outside the workspace -0\.9 to 0\.9 m"
    yield low, r"the flange's z would be 0\.1 m, outside the workspace 0\.2 to 1\.4 m"
    yield corner, r"no joint angles reach the flange position \(1\.250, 0\.850, 1\.350\) m"
    yield above_the_shoulder, r"no joint angles reach the flange position \(0\.050, 0\.050, 0\.600\) m"


@pytest.mark.parametrize(("target", "reason"), list(refusals()))
def test_what_it_cannot_reach_it_refuses_with_the_same_reason(arm, target, reason):
    said = arm.unreachable(target)
    assert re.fullmatch(reason, said)
    with pytest.raises(MotionRefusedError) as refused:
        arm.move(target, NEVER_S)
    assert refused.value.problem == said
    assert refused.value.device == arm.name == "mock arm"
    assert at_home(arm)


def test_joint_limits_leave_out_branches_and_then_the_target():
    narrow = {"low_rad": tuple(HOME - 0.01), "high_rad": tuple(HOME + 0.01)}
    device = opened(**narrow)
    with pytest.raises(MotionRefusedError, match=r"all 8 joint configurations of .* are outside the joint limits \("):
        device.move(DOME[1], NEVER_S)
    assert at_home(device)
    near = forward(UR10E, HOME + 0.009)
    np.testing.assert_allclose(device.move(near, NEVER_S).joints_rad, HOME + 0.009, atol=1e-9)


def test_a_pose_that_is_none_is_refused_before_anything_moves(arm):
    broken = DOME[0].copy()
    broken[0, 0] = np.nan
    for use in (arm.unreachable, lambda pose: arm.move(pose, NEVER_S)):
        with pytest.raises(PoseError, match="mock arm: target base_T_flange: the pose has 1 of 16 entries not"):
            use(broken)
    assert at_home(arm)


def test_a_second_move_at_the_same_time_is_refused_and_the_first_goes_on():
    device = opened(speed_factor=3.0)
    moving = Moving(device, DOME[3])
    moving.wait_until(lambda state: state.moving)
    with pytest.raises(MotionRefusedError, match="moves already"):
        device.move(DOME[0], NEVER_S)
    np.testing.assert_allclose(moving.end().base_T_flange, DOME[3], atol=1e-9)


def test_closing_on_the_way_stops_it_first(slow_arm):
    moving = Moving(slow_arm, DOME[3])
    moving.wait_until(lambda state: np.abs(state.joints_rad - HOME).max() > 0.2)
    slow_arm.close()
    assert isinstance(moving.end(), MotionStoppedError)
    slow_arm.open()
    assert not slow_arm.state().moving
    assert np.abs(slow_arm.state().joints_rad - HOME).max() > 0.2
    assert np.abs(slow_arm.state().base_T_flange - DOME[3]).max() > 1e-3


def test_before_open_and_after_close_everything_is_refused():
    device = MockArm(MockArmSettings())
    device.close()
    device.stop()
    for _ in range(2):
        for use in (device.state, lambda: device.unreachable(DOME[0]), lambda: device.move(DOME[0], NEVER_S)):
            with pytest.raises(DeviceUnavailableError, match="mock arm: is not open"):
                use()
        device.open()
        device.open()
        assert at_home(device)
        device.close()
        device.close()


@pytest.mark.parametrize("model", ARMS)
def test_every_model_moves_as_its_own_kinematics_say(model):
    device = opened(model=model, workspace_low_m=(-2, -2, -2), workspace_high_m=(2, 2, 2))
    target = forward(ARMS[model], HOME + 0.1)
    np.testing.assert_allclose(device.move(target, NEVER_S).base_T_flange, target, atol=1e-9)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("model", "ur11", "no such arm: 'ur11', there are ur3, ur5"),
        ("speed_factor", 0.0, "greater than"),
        ("speed_factor", np.inf, "finite"),
        ("home_rad", (0.0,) * 5, "Field required"),
        ("home_rad", (7.0, 0, 0, 0, 0, 0), "less than"),
        ("high_rad", (0.0,) * 6, "home_rad .* is not between"),
        ("speed_rad_per_s", (0.0,) * 6, "greater than"),
        ("workspace_low_m", (1.3, -0.9, 0.2), "workspace_low_m .* is not below"),
        ("payload", 1.0, "Extra inputs"),
    ],
)
def test_settings_out_of_range_are_refused(field, value, message):
    with pytest.raises(ValidationError, match=message):
        MockArmSettings(**{field: value})
