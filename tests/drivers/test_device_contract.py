"""One contract for every driver: what ``sidelong.devices`` promises holds for each camera and each arm."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sidelong.devices import Arm, ArmState, Camera, CaptureRequest
from sidelong.errors import (
    DeviceTimeoutError,
    DeviceUnavailableError,
    MotionRefusedError,
    PoseError,
    SettingsError,
    UnknownNameError,
)
from sidelong.geometry.transforms import invert, look_at, transform, validated_transform
from sidelong.planning.candidates import DomeSettings, dome_views
from sidelong.recorded.dataset import Dataset
from sidelong.types import FloatArray, Frame, Projector
from sidelong_drivers.registry import ARMS, CAMERAS, create_arm, create_camera

ROBI = Path(__file__).parents[1] / "data" / "robi"
RECORDED = {"root": str(ROBI), "object": "Tube_fitting"}
NEVER_S = 1000.0
SHARED_MACHINE_S = 30.0


def recorded_poses() -> tuple[FloatArray, ...]:
    return tuple(view.base_T_camera for view in Dataset(ROBI).scene("Tube_fitting", 1).views())


def dome_poses() -> tuple[FloatArray, ...]:
    """Flange poses around the bin of the simulated camera, with that camera's mount."""
    camera_T_flange = invert(transform(np.eye(3), (-0.05059195, -0.06, 0.05)))
    return tuple(view.base_T_camera @ camera_T_flange for view in dome_views((0.5, 0.0, 0.03), DomeSettings()))


@dataclass(frozen=True)
class CameraCase:
    """A camera driver, a place it can look from, and what it applies when asked for these."""

    settings: Mapping[str, Any]
    pose: Callable[[], FloatArray]
    asked: tuple[CaptureRequest, ...]
    applied: tuple[tuple[Projector, float], ...]
    size: tuple[int, int]
    wrong: tuple[str, Any]


@dataclass(frozen=True)
class ArmCase:
    """An arm driver, and poses it reaches; ``takes_time`` where its moves last longer than no time."""

    settings: Mapping[str, Any]
    poses: Callable[[], tuple[FloatArray, ...]]
    takes_time: bool
    wrong: tuple[str, Any]


OFF, DOTS = CaptureRequest(Projector.OFF, 0.1), CaptureRequest(Projector.DOTS, 0.01, depth=True)
DEPTH_IN_WHITE = CaptureRequest(Projector.WHITE, 0.01, depth=True)

CAMERA_CASES = {
    "simulated": CameraCase(
        settings={"width": 320, "height": 256, "count": 4},
        pose=lambda: look_at((0.5, 0.05, 0.7), (0.5, 0.0, 0.0)),
        asked=(OFF, DOTS, DEPTH_IN_WHITE),
        applied=((Projector.OFF, 0.1), (Projector.DOTS, 0.01), (Projector.WHITE, 0.01)),
        size=(256, 320),
        wrong=("width", 10),
    ),
    "replay": CameraCase(
        settings=RECORDED,
        pose=lambda: recorded_poses()[0],
        asked=(OFF, DOTS, DEPTH_IN_WHITE),
        # the recorded exposures; white was not recorded, and the image that stands in says what it shows
        applied=((Projector.OFF, 0.2), (Projector.DOTS, 0.012), (Projector.OFF, 0.012)),
        size=(512, 640),
        wrong=("scene", -1),
    ),
}

ARM_CASES = {
    "mock": ArmCase({"speed_factor": 50.0}, dome_poses, takes_time=True, wrong=("speed_factor", 0.0)),
    "replay": ArmCase(RECORDED, recorded_poses, takes_time=False, wrong=("scene", -1)),
}

camera_drivers = pytest.mark.parametrize("driver", CAMERA_CASES)
arm_drivers = pytest.mark.parametrize("driver", ARM_CASES)
bad_poses = pytest.mark.parametrize(
    "bad",
    [
        np.eye(3),
        np.full((4, 4), np.nan),
        2.0 * np.eye(4),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.vstack([np.eye(4)[:3], [0, 0, 1, 1]]),
    ],
    ids=["3x3", "NaN", "scaled", "mirrored", "last row"],
)
FAR_AWAY = transform(np.eye(3), (10.0, 0.0, 0.5))


@pytest.mark.parametrize(("group", "cases"), [(CAMERAS, CAMERA_CASES), (ARMS, ARM_CASES)])
def test_every_driver_of_this_package_is_under_contract(group: str, cases: Mapping[str, object]) -> None:
    shipped = {point.name for point in entry_points(group=group) if point.value.startswith("sidelong_drivers.")}
    assert shipped == set(cases)


# --- cameras ---


@pytest.fixture
def closed_camera(driver: str) -> Iterator[Camera]:
    device = create_camera(driver, CAMERA_CASES[driver].settings)
    yield device
    device.close()


@pytest.fixture
def camera(closed_camera: Camera) -> Camera:
    closed_camera.open()
    return closed_camera


def assert_camera_works(device: Camera, case: CameraCase) -> None:
    assert device.rig.left.height == case.size[0]
    assert device.capture(OFF, case.pose()).left.shape == case.size


def assert_camera_is_closed(device: Camera, case: CameraCase) -> None:
    uses: tuple[Callable[[], object], ...] = (
        lambda: device.rig,
        lambda: device.serial,
        lambda: device.capture(OFF, case.pose()),
        lambda: device.capture(DOTS, case.pose()),
    )
    for use in uses:
        with pytest.raises(DeviceUnavailableError, match="is not open") as refused:
            use()
        assert refused.value.device == device.name


@camera_drivers
def test_a_camera_opens_and_closes_as_often_as_one_likes(driver: str, closed_camera: Camera) -> None:
    case = CAMERA_CASES[driver]
    closed_camera.close()
    assert_camera_is_closed(closed_camera, case)
    for _ in range(2):
        closed_camera.open()
        closed_camera.open()
        assert_camera_works(closed_camera, case)
        closed_camera.close()
        closed_camera.close()
        assert_camera_is_closed(closed_camera, case)


@camera_drivers
def test_a_rig_fits_its_images(driver: str, camera: Camera) -> None:
    rig, (height, width) = camera.rig, CAMERA_CASES[driver].size
    assert (rig.left.width, rig.left.height) == (rig.right.width, rig.right.height) == (width, height)
    assert 0.01 < rig.baseline_m < 1.0
    validated_transform(rig.projector.left_T_projector, "left_T_projector")


@camera_drivers
def test_a_camera_has_a_serial_number_that_stays(driver: str, camera: Camera) -> None:
    serial = camera.serial
    assert serial.strip()
    camera.close()
    camera.open()
    assert camera.serial == serial


@camera_drivers
def test_a_capture_gives_what_was_asked_for(driver: str, camera: Camera) -> None:
    case = CAMERA_CASES[driver]
    for request, applied in zip(case.asked, case.applied, strict=True):
        before_s = time.monotonic()
        frame = camera.capture(request, case.pose())
        assert before_s <= frame.started_s <= frame.ended_s <= time.monotonic()
        assert (frame.projector, frame.exposure_s) == (applied[0], pytest.approx(applied[1]))
        np.testing.assert_allclose(frame.view.base_T_camera, case.pose(), atol=1e-9)
        assert_images(frame, case.size)
        assert (frame.depth_m is not None) == request.depth
        if frame.depth_m is not None:
            assert_depth(frame.depth_m, case.size)


def assert_images(frame: Frame, size: tuple[int, int]) -> None:
    assert frame.left.std() > 1
    for image in (frame.left, frame.right):
        assert image is not None
        assert image.shape == size
        assert image.dtype == np.uint8


def assert_depth(depth_m: FloatArray, size: tuple[int, int]) -> None:
    """Missing is NaN and never 0, the rest is a distance of a robot cell in metres."""
    assert depth_m.shape == size
    assert depth_m.dtype == np.float64
    measured = np.isfinite(depth_m)
    assert 0.02 < measured.mean() < 1.0
    assert np.isnan(depth_m[~measured]).all()
    assert depth_m[measured].min() > 0.05
    assert depth_m[measured].max() < 5.0


@camera_drivers
def test_later_captures_have_later_times_and_leave_earlier_frames_alone(driver: str, camera: Camera) -> None:
    case = CAMERA_CASES[driver]
    first = camera.capture(DOTS, case.pose())
    assert first.depth_m is not None
    left, depth_m = first.left.copy(), first.depth_m.copy()
    second = camera.capture(OFF, case.pose())
    assert second.started_s >= first.ended_s
    np.testing.assert_array_equal(first.left, left)
    np.testing.assert_array_equal(first.depth_m, depth_m)


@camera_drivers
def test_the_pose_handed_in_is_not_written_to_and_not_kept(driver: str, camera: Camera) -> None:
    case = CAMERA_CASES[driver]
    pose = case.pose().copy()
    frame = camera.capture(OFF, pose)
    np.testing.assert_array_equal(pose, case.pose())
    pose[:3, 3] += 1.0
    np.testing.assert_allclose(frame.view.base_T_camera, case.pose(), atol=1e-9)


@bad_poses
@camera_drivers
def test_a_camera_refuses_a_pose_that_is_none(driver: str, camera: Camera, bad: FloatArray) -> None:
    with pytest.raises(PoseError, match=f"{camera.name}: base_T_camera"):
        camera.capture(OFF, bad)
    assert_camera_works(camera, CAMERA_CASES[driver])


# --- arms ---


@pytest.fixture
def closed_arm(driver: str) -> Iterator[Arm]:
    device = create_arm(driver, ARM_CASES[driver].settings)
    yield device
    device.close()


@pytest.fixture
def arm(closed_arm: Arm) -> Arm:
    closed_arm.open()
    return closed_arm


def assert_arm_is_closed(device: Arm, case: ArmCase) -> None:
    target = case.poses()[1]
    uses: tuple[Callable[[], object], ...] = (
        device.state,
        lambda: device.unreachable(target),
        lambda: device.move(target, NEVER_S),
    )
    for use in uses:
        with pytest.raises(DeviceUnavailableError, match="is not open") as refused:
            use()
        assert refused.value.device == device.name


def assert_rests_at(device: Arm, base_T_flange: FloatArray) -> None:
    state = device.state()
    assert not state.moving
    np.testing.assert_allclose(state.base_T_flange, base_T_flange, atol=1e-6)


@arm_drivers
def test_an_arm_opens_and_closes_as_often_as_one_likes(driver: str, closed_arm: Arm) -> None:
    case = ARM_CASES[driver]
    closed_arm.close()
    assert_arm_is_closed(closed_arm, case)
    for _ in range(2):
        closed_arm.open()
        closed_arm.open()
        assert_rests_at(closed_arm, closed_arm.state().base_T_flange)
        closed_arm.close()
        closed_arm.close()
        assert_arm_is_closed(closed_arm, case)


@arm_drivers
def test_a_state_is_fresh_finite_and_rigid(driver: str, arm: Arm) -> None:
    before_s = time.monotonic()
    first, second = arm.state(), arm.state()
    assert before_s <= first.stamp_s <= second.stamp_s <= time.monotonic()
    assert not first.moving
    assert np.isfinite(first.joints_rad).all()
    assert first.joints_rad.ndim == 1
    rigid = validated_transform(first.base_T_flange, "state")
    np.testing.assert_allclose(first.base_T_flange, rigid, atol=1e-9)


@arm_drivers
def test_a_reachable_target_is_where_a_move_ends(driver: str, arm: Arm) -> None:
    for target in ARM_CASES[driver].poses()[:4]:
        asked_s = time.monotonic()
        assert arm.unreachable(target) is None
        reached = arm.move(target, NEVER_S)
        np.testing.assert_allclose(reached.base_T_flange, target, atol=1e-6)
        assert not reached.moving
        assert reached.stamp_s >= asked_s
        assert_rests_at(arm, target)


@arm_drivers
def test_a_move_to_where_the_arm_is_already_stays_there(driver: str, arm: Arm) -> None:
    here = arm.state().base_T_flange.copy()
    for _ in range(2):
        np.testing.assert_allclose(arm.move(here, NEVER_S).base_T_flange, here, atol=1e-6)


@arm_drivers
def test_asking_what_is_reachable_moves_nothing(driver: str, arm: Arm) -> None:
    here = arm.state()
    reasons = [arm.unreachable(pose) for pose in (*ARM_CASES[driver].poses()[:4], FAR_AWAY)]
    assert reasons[:4] == [None] * 4
    assert reasons[4]
    assert_rests_at(arm, here.base_T_flange)
    np.testing.assert_array_equal(arm.state().joints_rad, here.joints_rad)


@arm_drivers
def test_a_refused_target_says_why_and_the_arm_stays(driver: str, arm: Arm) -> None:
    start = ARM_CASES[driver].poses()[1]
    arm.move(start, NEVER_S)
    with pytest.raises(MotionRefusedError) as refused:
        arm.move(FAR_AWAY, NEVER_S)
    assert refused.value.device == arm.name
    assert refused.value.problem == arm.unreachable(FAR_AWAY)
    assert_rests_at(arm, start)


@bad_poses
@arm_drivers
def test_an_arm_refuses_a_pose_that_is_none_and_stays(driver: str, arm: Arm, bad: FloatArray) -> None:
    here = arm.state().base_T_flange.copy()
    with pytest.raises(PoseError, match=f"{arm.name}: .*base_T_flange"):
        arm.move(bad, NEVER_S)
    with pytest.raises(PoseError, match=f"{arm.name}: .*base_T_flange"):
        arm.unreachable(bad)
    assert_rests_at(arm, here)


@arm_drivers
def test_a_stop_at_rest_is_harmless_and_moves_go_on_afterwards(driver: str, closed_arm: Arm) -> None:
    closed_arm.stop()
    closed_arm.open()
    target = ARM_CASES[driver].poses()[2]
    closed_arm.move(target, NEVER_S)
    for _ in range(3):
        closed_arm.stop()
    stopping = [threading.Thread(target=closed_arm.stop) for _ in range(3)]
    for thread in stopping:
        thread.start()
    for thread in stopping:
        thread.join(SHARED_MACHINE_S)
        assert not thread.is_alive()
    assert_rests_at(closed_arm, target)
    other = ARM_CASES[driver].poses()[0]
    closed_arm.move(other, NEVER_S)
    assert_rests_at(closed_arm, other)
    closed_arm.close()
    closed_arm.stop()


@arm_drivers
def test_a_deadline_that_cannot_be_kept_is_an_error_and_the_arm_rests(driver: str, arm: Arm) -> None:
    """An arm that moves in time misses a deadline of a microsecond; one that is there at once keeps it."""
    case, target = ARM_CASES[driver], ARM_CASES[driver].poses()[3]
    if not case.takes_time:
        assert_same_place(arm.move(target, 1e-6), target)
        return
    with pytest.raises(DeviceTimeoutError, match="deadline") as missed:
        arm.move(target, 1e-6)
    assert missed.value.device == arm.name
    assert not arm.state().moving
    started_s = time.monotonic()
    assert_same_place(arm.move(target, SHARED_MACHINE_S), target)
    assert 0 < time.monotonic() - started_s < SHARED_MACHINE_S


def assert_same_place(state: ArmState, target: FloatArray) -> None:
    np.testing.assert_allclose(state.base_T_flange, target, atol=1e-6)


# --- the registry ---


@pytest.mark.parametrize(
    ("create", "kind", "known"),
    [(create_camera, "camera", CAMERA_CASES), (create_arm, "arm", ARM_CASES)],
    ids=["camera", "arm"],
)
@pytest.mark.parametrize("name", ["teapot", "", "Simulated", "sidelong_drivers.mock:MockArm"])
def test_an_unknown_driver_is_refused_with_the_known_ones(
    create: Callable[[str, Mapping[str, Any]], object], kind: str, known: Mapping[str, object], name: str
) -> None:
    with pytest.raises(UnknownNameError, match=f"^{kind} driver: {name!r} is unknown, known are ") as refused:
        create(name, {})
    assert all(each in str(refused.value).split("known are ")[1].split(", ") for each in known)


MADE = [("camera", create_camera, name, case) for name, case in CAMERA_CASES.items()]
MADE += [("arm", create_arm, name, case) for name, case in ARM_CASES.items()]


@pytest.mark.parametrize(("kind", "create", "name", "case"), MADE, ids=[f"{kind}-{name}" for kind, _, name, _ in MADE])
def test_settings_it_does_not_take_are_refused_by_driver_and_field(
    kind: str,
    create: Callable[[str, Mapping[str, Any]], object],
    name: str,
    case: CameraCase | ArmCase,
) -> None:
    field, value = case.wrong
    for wrong, wrong_field in (({"colour": 1}, "colour"), ({field: value}, field)):
        got = next(iter(wrong.values()))
        with pytest.raises(SettingsError, match=rf"^{kind} driver '{name}': {wrong_field}: .*, got {got}$"):
            create(name, {**case.settings, **wrong})
