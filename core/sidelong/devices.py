"""The two protocols behind which cameras and arms stand, and the cell they make up.

Drivers are synchronous and have one owner thread each. Vendor imports happen inside ``open()``. A driver is found by
its entry point (``sidelong.cameras``, ``sidelong.arms``), is a class with a frozen pydantic model ``Settings``, and is
made from an instance of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from sidelong.geometry.camera_model import StereoRig
from sidelong.types import FloatArray, Frame, Projector, View


@dataclass(frozen=True)
class CaptureRequest:
    """What to capture.

    Attributes
    ----------
    projector
        Off for the image that detection reads, dots for depth, white for light calibration.
    exposure_s
        Exposure time in seconds. A replay camera has the recorded one and reports that.
    depth
        Whether a depth map is wanted.
    """

    projector: Projector
    exposure_s: float
    depth: bool = False


class Camera(Protocol):
    """A stereo camera with a projector."""

    @property
    def name(self) -> str:
        """The device's name in messages."""
        ...

    @property
    def serial(self) -> str:
        """Serial number, by which calibrations name the device they are of; valid between open and close."""
        ...

    @property
    def rig(self) -> StereoRig:
        """Intrinsics, baseline and projector; valid between open and close."""
        ...

    def open(self) -> None:
        """Connect. Raises DeviceUnavailableError, or an InputError where the settings name what is not there."""
        ...

    def close(self) -> None:
        """Disconnect. Harmless when repeated or never opened."""
        ...

    def capture(self, request: CaptureRequest, base_T_camera: FloatArray) -> Frame:
        """Take one capture with the camera at rest at ``base_T_camera`` (4, 4).

        Raises
        ------
        DeviceError
            The device failed; ImageError where a recorded file is damaged.
        """
        ...


@dataclass(frozen=True, eq=False)
class ArmState:
    """A fresh reading of the arm.

    Attributes
    ----------
    base_T_flange
        (4, 4) pose of the flange.
    joints_rad
        (J,) joint angles; empty for an arm without joints (replay).
    moving
        Whether it moves now.
    stamp_s
        Monotonic clock of the reading.
    """

    base_T_flange: FloatArray
    joints_rad: FloatArray
    moving: bool
    stamp_s: float


class Arm(Protocol):
    """A robot arm that carries the camera."""

    @property
    def name(self) -> str:
        """The device's name in messages."""
        ...

    def open(self) -> None:
        """Connect. Raises DeviceUnavailableError."""
        ...

    def close(self) -> None:
        """Stop, then disconnect. Harmless when repeated or never opened."""
        ...

    def state(self) -> ArmState:
        """Read the arm now. Raises DeviceLostError where no fresh reading is to be had."""
        ...

    def unreachable(self, base_T_flange: FloatArray) -> str | None:
        """Say why this pose cannot be reached from the present state; None where it can. Nothing moves."""
        ...

    def move(self, base_T_flange: FloatArray, deadline_s: float) -> ArmState:
        """Move there, wait until the arm rests, and return a new reading.

        Raises
        ------
        MotionRefusedError
            The target is outside the limits; nothing moved.
        MotionStoppedError
            ``stop`` was called meanwhile.
        DeviceTimeoutError
            The move took longer than ``deadline_s``; the arm was stopped.
        """
        ...

    def stop(self) -> None:
        """Stop now; from any thread, at any time, as often as one likes."""
        ...


@dataclass(frozen=True, eq=False)
class Cell:
    """A camera on an arm, and the places it may look from.

    Attributes
    ----------
    camera, arm
        Opened devices.
    flange_T_camera
        (4, 4) hand-eye transform.
    reference
        Where the scan starts: the view whose depth is to be completed.
    candidates
        Views the planner may choose among.
    """

    camera: Camera
    arm: Arm
    flange_T_camera: FloatArray
    reference: View
    candidates: tuple[View, ...]
