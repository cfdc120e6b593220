"""An arm without hardware: takes as long as a real one, can be stopped on its way, and refuses what one would."""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from sidelong.devices import ArmState
from sidelong.errors import DeviceTimeoutError, DeviceUnavailableError, MotionRefusedError, MotionStoppedError
from sidelong.geometry.kinematics import ARMS, forward, inverse, nearest_turns
from sidelong.geometry.transforms import validated_transform
from sidelong.types import FloatArray


def _known_arm(model: str) -> str:
    if model not in ARMS:
        raise ValueError(f"no such arm: {model!r}, there are {', '.join(ARMS)}")
    return model


_TURN = 2 * math.pi

Angle = Annotated[FiniteFloat, Field(ge=-_TURN, le=_TURN)]
Limit = Annotated[FiniteFloat, Field(ge=0.01, le=100)]
Coordinate = Annotated[FiniteFloat, Field(ge=-5, le=5)]
Angles = tuple[Angle, Angle, Angle, Angle, Angle, Angle]
Limits = tuple[Limit, Limit, Limit, Limit, Limit, Limit]
Corner = tuple[Coordinate, Coordinate, Coordinate]

_LEAST_TRAVEL_RAD = 1e-12  # keeps the times of a move to where the arm is already finite


class MockArmSettings(BaseModel):
    """Which arm it is, where it may go, and how fast."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    model: Annotated[str, AfterValidator(_known_arm)] = Field(
        default="ur10e", description="name of an arm in sidelong.geometry.kinematics.ARMS"
    )
    speed_factor: FiniteFloat = Field(
        default=1.0, ge=1e-3, le=1e4, description="time runs that much faster; the paths stay the same"
    )
    home_rad: Angles = Field(
        default=(0.211, -1.310, -1.666, -1.736, 1.571, -1.359),
        description="joints at power-on; by default the simulated camera is 0.7 m above (0.5, 0, 0) m and looks down",
    )
    low_rad: Angles = Field(default=(-_TURN, -_TURN, -_TURN, -_TURN, -_TURN, -_TURN), description="lower joint limits")
    high_rad: Angles = Field(default=(_TURN, _TURN, _TURN, _TURN, _TURN, _TURN), description="upper joint limits")
    # the speed of a URScript movej without arguments; its 1.4 rad/s2 would take 0.75 s to stop, this takes 0.42 s
    speed_rad_per_s: Limits = Field(default=(1.05, 1.05, 1.05, 1.05, 1.05, 1.05), description="joint speed limits")
    acceleration_rad_per_s2: Limits = Field(
        default=(2.5, 2.5, 2.5, 2.5, 2.5, 2.5), description="joint acceleration limits, braking too"
    )
    workspace_low_m: Corner = Field(
        default=(-0.3, -0.9, 0.2), description="lower corner of the box for the flange's targets, base frame"
    )
    workspace_high_m: Corner = Field(default=(1.3, 0.9, 1.4), description="upper corner of that box")

    @model_validator(mode="after")
    def _limits_are_in_order(self) -> MockArmSettings:
        if not (np.less_equal(self.low_rad, self.home_rad) & np.less_equal(self.home_rad, self.high_rad)).all():
            raise ValueError(f"home_rad {self.home_rad} is not between low_rad {self.low_rad} and {self.high_rad}")
        if not np.less(self.workspace_low_m, self.workspace_high_m).all():
            raise ValueError(f"workspace_low_m {self.workspace_low_m} is not below {self.workspace_high_m}")
        return self


@dataclass(frozen=True, eq=False)
class _Path:
    """A straight line in joint space with a trapezoid of speed, from 0 to 1 along it, and perhaps a brake on the way.

    Attributes
    ----------
    start_rad, change_rad
        (6,) where it starts and how far it goes.
    peak_per_s, acceleration_per_s2
        Of the share of the path that is done, 0 to 1.
    started_s
        Monotonic clock at its start.
    brake_s
        Time after the start at which it brakes.
    """

    start_rad: FloatArray
    change_rad: FloatArray
    peak_per_s: float
    acceleration_per_s2: float
    started_s: float = -math.inf
    brake_s: float = math.inf

    @property
    def duration_s(self) -> float:
        """How long it takes when nothing brakes it."""
        return 1 / self.peak_per_s + self.peak_per_s / self.acceleration_per_s2

    @property
    def rest_s(self) -> float:
        """Monotonic clock at which it comes to rest."""
        braked_s = self.brake_s + self._speed(self.brake_s) / self.acceleration_per_s2
        return self.started_s + min(self.duration_s, braked_s)

    def braked(self, now_s: float) -> _Path:
        """Return the same path, left as soon as the limits allow it."""
        return replace(self, brake_s=min(self.brake_s, now_s - self.started_s))

    def joints_rad(self, now_s: float) -> FloatArray:
        """Return the joints (6,) at a time."""
        elapsed_s = min(now_s - self.started_s, self.duration_s)
        before_s = min(elapsed_s, self.brake_s)
        speed = self._speed(before_s)
        braking_s = min(elapsed_s - before_s, speed / self.acceleration_per_s2)
        share = self._unbraked(before_s) + speed * braking_s - self.acceleration_per_s2 / 2 * braking_s**2
        return self.start_rad + share * self.change_rad

    def _speed(self, elapsed_s: float) -> float:
        rising = self.acceleration_per_s2 * elapsed_s
        falling = self.acceleration_per_s2 * (self.duration_s - elapsed_s)
        return max(0.0, min(rising, self.peak_per_s, falling))

    def _unbraked(self, elapsed_s: float) -> float:
        """Return the share done: peak speed all the time, less what the two ramps take from it."""
        ramp_s = self.peak_per_s / self.acceleration_per_s2
        missing_s2 = ramp_s**2 - max(ramp_s - elapsed_s, 0.0) ** 2 + max(elapsed_s - self.duration_s + ramp_s, 0.0) ** 2
        return self.peak_per_s * elapsed_s - self.acceleration_per_s2 / 2 * missing_s2


def _plan(start_rad: FloatArray, goal_rad: FloatArray, settings: MockArmSettings) -> _Path:
    """Return the quickest path on which all joints start and end together; time runs ``speed_factor`` faster."""
    change_rad = goal_rad - start_rad
    travel_rad = np.maximum(np.abs(change_rad), _LEAST_TRAVEL_RAD)
    factor = settings.speed_factor
    speed_per_s = factor * float((settings.speed_rad_per_s / travel_rad).min())
    acceleration_per_s2 = factor**2 * float((settings.acceleration_rad_per_s2 / travel_rad).min())
    return _Path(start_rad, change_rad, min(speed_per_s, math.sqrt(acceleration_per_s2)), acceleration_per_s2)


class MockArm:
    """A ``sidelong.devices.Arm`` of the UR kind without hardware: its joints are a function of the monotonic clock.

    It knows no collisions, and the workspace box holds for targets, not for the way there.
    """

    Settings = MockArmSettings

    def __init__(self, settings: MockArmSettings) -> None:
        self.settings = settings
        self._geometry = ARMS[settings.model]
        self._open = False
        self._stops = 0
        home_rad = np.array(settings.home_rad)
        self._path = _plan(home_rad, home_rad, settings)
        # guards the three above; told when the path changes
        self._changed = threading.Condition()

    @property
    def name(self) -> str:
        """The device's name in messages."""
        return "mock arm"

    def open(self) -> None:
        """Power on, at home the first time. Harmless when repeated."""
        with self._changed:
            self._open = True

    def close(self) -> None:
        """Stop, wait until it rests, power off. Harmless when repeated or never opened."""
        self.stop()
        with self._changed:
            self._wait_for_rest()
            self._open = False

    def state(self) -> ArmState:
        """Read the arm now, on its way or at rest; from any thread. Raises DeviceUnavailableError when closed."""
        with self._changed:
            self._require_open()
            path, now_s = self._path, time.monotonic()
        joints_rad = path.joints_rad(now_s)
        return ArmState(forward(self._geometry, joints_rad), joints_rad, now_s < path.rest_s, now_s)

    def unreachable(self, base_T_flange: ArrayLike) -> str | None:
        """Say why this pose (4, 4) cannot be reached from where the arm is; None where it can. Nothing moves.

        Raises
        ------
        DeviceUnavailableError
            The arm is not open.
        PoseError
            The target is not a rigid motion.
        """
        try:
            self._quickest(base_T_flange)
        except MotionRefusedError as error:
            return error.problem
        return None

    def move(self, base_T_flange: ArrayLike, deadline_s: float) -> ArmState:
        """Move there in a straight line of the joints, wait until the arm rests, and return a new reading.

        Of all configurations that reach the pose it takes the one that is reached first. The time a move takes is
        known beforehand: one that would miss its deadline is refused before anything moves, and as no move takes
        longer than that, none has to be stopped half-way for its deadline.

        Parameters
        ----------
        base_T_flange
            (4, 4) target.
        deadline_s
            Longest time the move may take, on the clock on the wall.

        Raises
        ------
        DeviceUnavailableError
            The arm is not open.
        PoseError
            The target is not a rigid motion.
        MotionRefusedError
            The target is outside the limits, or another thread moves the arm; nothing moved.
        DeviceTimeoutError
            The move would take longer than ``deadline_s``; nothing moved.
        MotionStoppedError
            ``stop`` or ``close`` was called meanwhile; the arm rests on its path.
        """
        # held while it plans, so that a stop comes either before this call or to a path it can brake
        with self._changed:
            path = self._quickest(base_T_flange)
            if time.monotonic() < self._path.rest_s:
                raise MotionRefusedError(self.name, "moves already, on the order of another thread")
            if not path.duration_s <= deadline_s:
                raise DeviceTimeoutError(
                    self.name,
                    f"the move would take {path.duration_s:.3g} s, deadline {deadline_s:.3g} s; nothing moved",
                )
            stops, self._path = self._stops, replace(path, started_s=time.monotonic())
            self._wait_for_rest()
            if self._stops != stops:
                raise MotionStoppedError(self.name, "was stopped on its way")
            return self.state()

    def stop(self) -> None:
        """Brake along the path at the acceleration limit; from any thread, at any time. Does not wait for rest."""
        with self._changed:
            self._stops += 1
            self._path = self._path.braked(time.monotonic())
            self._changed.notify_all()

    def _wait_for_rest(self) -> None:
        """Wait, with the lock given up, until the path ends, wherever a stop lets it end."""
        while (left_s := self._path.rest_s - time.monotonic()) > 0:
            self._changed.wait(left_s)

    def _quickest(self, base_T_flange: ArrayLike) -> _Path:
        """Return the path to the configuration that is reached first; MotionRefusedError where there is none."""
        target = validated_transform(base_T_flange, f"{self.name}: target base_T_flange")
        start_rad, settings = self.state().joints_rad, self.settings
        self._require_in_workspace(target[:3, 3])
        solutions_rad = inverse(self._geometry, target, free_q6_rad=start_rad[5])
        if not len(solutions_rad):
            raise MotionRefusedError(self.name, f"no joint angles reach the flange position {_metres(target[:3, 3])}")
        goals_rad = nearest_turns(solutions_rad, start_rad, settings.low_rad, settings.high_rad)
        if not len(goals_rad):
            raise MotionRefusedError(
                self.name,
                f"all {len(solutions_rad)} joint configurations of the flange position {_metres(target[:3, 3])} are "
                f"outside the joint limits {settings.low_rad} to {settings.high_rad} rad",
            )
        return min((_plan(start_rad, goal_rad, settings) for goal_rad in goals_rad), key=lambda path: path.duration_s)

    def _require_in_workspace(self, flange_m: FloatArray) -> None:
        settings = self.settings
        for axis, value, low, high in zip(
            "xyz", flange_m, settings.workspace_low_m, settings.workspace_high_m, strict=True
        ):
            if not low <= value <= high:
                raise MotionRefusedError(
                    self.name,
                    f"the flange's {axis} would be {value:.4g} m, outside the workspace {low:g} to {high:g} m",
                )

    def _require_open(self) -> None:
        if not self._open:
            raise DeviceUnavailableError(self.name, "is not open")


def _metres(position_m: FloatArray) -> str:
    return "(" + ", ".join(f"{value:.3f}" for value in position_m) + ") m"
