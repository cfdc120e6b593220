"""Recorded scenes in ROBI's layout as camera and arm: the arm moves only among the recorded views."""

from __future__ import annotations

import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from sidelong.devices import ArmState, CaptureRequest
from sidelong.errors import DeviceUnavailableError, ImageError, MotionRefusedError
from sidelong.geometry.camera_model import StereoRig
from sidelong.geometry.transforms import invert, rotation_angle, validated_transform
from sidelong.recorded.dataset import Dataset, Scene
from sidelong.types import FloatArray, Frame, View

SAME_PLACE_M, SAME_TURN_RAD = 1e-6, 1e-6
"""A pose this near to a recorded one is that one: what rounding and a hand-eye transform leave."""


class ReplaySettings(BaseModel):
    """Which scene."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    root: Path = Field(description="folder of the data set")
    object: str = Field(min_length=1, description="name of the object")
    scene: int = Field(default=1, ge=0, description="number of the scene")


class _Recording:
    """What camera and arm share: the scene and its views, read on open."""

    def __init__(self, settings: ReplaySettings, name: str) -> None:
        self.settings = settings
        self._name = name
        self._scene: Scene | None = None
        self._views: tuple[View, ...] = ()

    def open(self) -> None:
        """Read list and poses.

        Raises
        ------
        UnknownNameError, DatasetError, PoseError
            The scene does not exist, or a file of it cannot be used.
        """
        self.close()
        scene = Dataset(self.settings.root).scene(self.settings.object, self.settings.scene)
        self._views, self._scene = scene.views(), scene

    def close(self) -> None:
        """Forget the scene."""
        self._scene, self._views = None, ()

    @property
    def scene(self) -> Scene:
        if self._scene is None:
            raise DeviceUnavailableError(self._name, "is not open")
        return self._scene

    @property
    def views(self) -> tuple[View, ...]:
        if self._scene is None:
            raise DeviceUnavailableError(self._name, "is not open")
        return self._views

    def at(self, base_T_camera: FloatArray) -> View | None:
        """Return the view recorded at this pose, None where there is none."""
        for view in self.views:
            apart = invert(view.base_T_camera) @ base_T_camera
            if np.linalg.norm(apart[:3, 3]) <= SAME_PLACE_M and rotation_angle(apart[:3, :3]) <= SAME_TURN_RAD:
                return view
        return None

    def off_the_views(self, base_T_camera: FloatArray) -> str:
        """Say how far this pose is from the nearest recorded one."""
        nearest = min(self.views, key=lambda v: float(np.linalg.norm(v.base_T_camera[:3, 3] - base_T_camera[:3, 3])))
        apart = invert(nearest.base_T_camera) @ base_T_camera
        return (
            f"nothing was recorded at this pose; the nearest view, {nearest.name}, is "
            f"{np.linalg.norm(apart[:3, 3]) * 1e3:.3g} mm and {np.rad2deg(rotation_angle(apart[:3, :3])):.3g} degrees "
            f"away, limits {SAME_PLACE_M * 1e3:g} mm and {np.rad2deg(SAME_TURN_RAD):.2g} degrees"
        )


class ReplayCamera:
    """A ``sidelong.devices.Camera`` that reads what was recorded at a pose."""

    Settings = ReplaySettings

    def __init__(self, settings: ReplaySettings) -> None:
        self._recording = _Recording(settings, self.name)

    @property
    def name(self) -> str:
        """The device's name in messages."""
        return "replay camera"

    @property
    def serial(self) -> str:
        """Serial number of the camera that recorded; raises DeviceUnavailableError when closed."""
        return self._recording.scene.dataset.serial

    @property
    def rig(self) -> StereoRig:
        """Intrinsics, baseline and projector; raises DeviceUnavailableError when closed."""
        return self._recording.scene.dataset.rig

    def open(self) -> None:
        """Read the scene's list, poses and intrinsics. Raises an InputError where it cannot be used."""
        with ExitStack() as undo:
            undo.callback(self.close)
            self._recording.open()
            _ = self.rig
            undo.pop_all()

    def close(self) -> None:
        """Forget the scene. Harmless when repeated or never opened."""
        self._recording.close()

    def capture(self, request: CaptureRequest, base_T_camera: FloatArray) -> Frame:
        """Return what was recorded at ``base_T_camera`` (4, 4), see ``Scene.frame``.

        Raises
        ------
        DeviceUnavailableError
            The camera is not open.
        ImageError
            Nothing was recorded at the pose, or a file is missing, damaged or of the wrong size.
        """
        started_s = time.monotonic()
        scene = self._recording.scene
        pose = validated_transform(base_T_camera, f"{self.name}: base_T_camera")
        view = self._recording.at(pose)
        if view is None:
            raise ImageError(f"{self.name}: {self._recording.off_the_views(pose)}")
        frame = scene.frame(View(view.name, pose), request)
        return replace(frame, started_s=started_s, ended_s=time.monotonic())


class ReplayArm:
    """A ``sidelong.devices.Arm`` that is at one of the recorded views; its flange is the camera."""

    Settings = ReplaySettings

    def __init__(self, settings: ReplaySettings) -> None:
        self._recording = _Recording(settings, self.name)
        self._at: View | None = None

    @property
    def name(self) -> str:
        """The device's name in messages."""
        return "replay arm"

    def open(self) -> None:
        """Read the scene's views and stand at the first. Raises an InputError where they cannot be used."""
        self._recording.open()
        self._at = self._recording.views[0]

    def close(self) -> None:
        """Forget the views. Harmless when repeated or never opened."""
        self._recording.close()
        self._at = None

    def state(self) -> ArmState:
        """Return where it is; an arm that is not there has no joints."""
        if self._at is None:
            raise DeviceUnavailableError(self.name, "is not open")
        return ArmState(self._at.base_T_camera.copy(), np.zeros(0), moving=False, stamp_s=time.monotonic())

    def unreachable(self, base_T_flange: FloatArray) -> str | None:
        """Say that nothing was recorded at this pose; None where something was."""
        target = validated_transform(base_T_flange, f"{self.name}: base_T_flange")
        return None if self._recording.at(target) is not None else self._recording.off_the_views(target)

    def move(self, base_T_flange: FloatArray, deadline_s: float) -> ArmState:
        """Be at the recorded view, at once: no motion was recorded. Raises MotionRefusedError elsewhere."""
        target = validated_transform(base_T_flange, f"{self.name}: base_T_flange")
        view = self._recording.at(target)
        if view is None:
            raise MotionRefusedError(self.name, self._recording.off_the_views(target))
        self._at = view
        return self.state()

    def stop(self) -> None:
        """Do nothing: it never moves."""
