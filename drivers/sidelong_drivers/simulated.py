"""A simulated camera over a simulated bin: runs where no device is at hand; tests compare it with the truth."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from sidelong.devices import CaptureRequest
from sidelong.errors import DeviceUnavailableError, SettingsError
from sidelong.geometry.camera_model import StereoRig
from sidelong.geometry.mesh import Part
from sidelong.geometry.transforms import rotation_about, transform, validated_transform
from sidelong.simulation.bin import Bin, fill_bin
from sidelong.simulation.heap import heap
from sidelong.simulation.parts import simulated_part
from sidelong.simulation.rig import BASELINE_M, rig_for
from sidelong.simulation.sensor import ActiveStereoSensor, SensorSettings
from sidelong.types import FloatArray, Frame, View

SHORTEST_EXPOSURE_S, LONGEST_EXPOSURE_S = 1e-6, 10.0

Triple = tuple[FiniteFloat, FiniteFloat, FiniteFloat]


class SimulatedCameraSettings(BaseModel):
    """What lies in the bin, and what looks at it."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    serial: str = Field(default="simulated", min_length=1, description="by which calibrations know it")
    part: str = Field(default="tube_fitting", description="name of a simulated part")
    count: int = Field(default=10, ge=0, le=200, description="how many lie in the bin")
    seed: int = Field(default=0, ge=0, description="how they lie")
    heap: bool = Field(default=False, description="whether they lie on each other instead of side by side")
    sprayed: bool = Field(default=False, description="whether the parts are covered with anti-reflective spray")
    width: int = Field(default=640, ge=80, le=2560, description="image width in pixels")
    height: int = Field(default=512, ge=64, le=2048, description="image height in pixels, 4/5 of the width")
    bin: Bin = Field(default=Bin(), description="sizes of the bin")
    bin_origin_m: Triple = Field(default=(0.5, 0.0, 0.0), description="centre of the bin's floor in the base frame")
    mount_m: Triple = Field(
        default=(-BASELINE_M / 2, -0.06, 0.05), description="left camera in the flange frame; both look the same way"
    )
    arm_shift_m: FiniteFloat = Field(
        default=0.0, ge=0.0, le=0.1, description="how far the camera is from where the arm says, standard deviation"
    )
    arm_turn_rad: FiniteFloat = Field(
        default=0.0, ge=0.0, le=0.1, description="how far it is turned from there, standard deviation"
    )
    sensor: SensorSettings = Field(default=SensorSettings(), description="light, pattern, pixel and matcher")


class SimulatedCamera:
    """A ``sidelong.devices.Camera`` that renders its bin. The same settings, pose and request give the same frame."""

    Settings = SimulatedCameraSettings

    def __init__(self, settings: SimulatedCameraSettings) -> None:
        self.settings = settings
        self._part: Part | None = None
        self._base_T_objects: list[FloatArray] = []
        self._sensor: ActiveStereoSensor | None = None

    @property
    def name(self) -> str:
        """The device's name in messages."""
        return "simulated camera"

    @property
    def serial(self) -> str:
        """Serial number, as the settings say; raises DeviceUnavailableError when closed."""
        self._opened()
        return self.settings.serial

    @property
    def rig(self) -> StereoRig:
        """Intrinsics, baseline and projector; raises DeviceUnavailableError when closed."""
        return self._opened().rig

    @property
    def part(self) -> Part:
        """The CAD model of what lies in the bin; raises DeviceUnavailableError when closed."""
        if self._part is None:
            raise DeviceUnavailableError(self.name, "is not open")
        return self._part

    @property
    def base_T_objects(self) -> Sequence[FloatArray]:
        """True pose (4, 4) of each part in the bin; raises DeviceUnavailableError when closed."""
        self._opened()
        return tuple(self._base_T_objects)

    @property
    def flange_T_camera(self) -> FloatArray:
        """How the camera is mounted: (4, 4) pose of the left camera in the flange."""
        return transform(np.eye(3), self.settings.mount_m)

    @property
    def base_T_bin(self) -> FloatArray:
        """(4, 4) pose of the bin, its floor at z = 0."""
        return transform(np.eye(3), self.settings.bin_origin_m)

    def open(self) -> None:
        """Fill the bin. Harmless when repeated.

        Raises
        ------
        UnknownNameError
            There is no such part.
        SettingsError
            That many do not fit into the bin, or the image has not 5:4 sides.
        """
        settings = self.settings
        rig = rig_for(settings.width, settings.height)
        part = simulated_part(settings.part)
        fill = heap if settings.heap else fill_bin
        base_T_objects = fill(part, settings.count, settings.seed, self.base_T_bin, settings.bin)
        # spray makes every surface matte
        shown = replace(part, materials=("matte",) * len(part.materials)) if settings.sprayed else part
        scene = [(settings.bin.part(), self.base_T_bin), *((shown, pose) for pose in base_T_objects)]
        self._sensor = ActiveStereoSensor(rig, scene, settings.sensor)
        self._part, self._base_T_objects = part, base_T_objects

    def close(self) -> None:
        """Forget the scene. Harmless when repeated or never opened."""
        self._sensor, self._part, self._base_T_objects = None, None, []

    def capture(self, request: CaptureRequest, base_T_camera: FloatArray) -> Frame:
        """Take one capture with the camera at rest at ``base_T_camera`` (4, 4); ``left`` shows the first dot pattern.

        Raises
        ------
        DeviceUnavailableError
            The camera is not open.
        SettingsError
            The exposure is outside ``SHORTEST_EXPOSURE_S`` to ``LONGEST_EXPOSURE_S``.
        PoseError
            The pose is not a rigid motion.
        """
        sensor = self._opened()
        if not SHORTEST_EXPOSURE_S <= request.exposure_s <= LONGEST_EXPOSURE_S:
            raise SettingsError(
                f"{self.name}: exposure is {request.exposure_s} s, limits {SHORTEST_EXPOSURE_S:g} to "
                f"{LONGEST_EXPOSURE_S:g} s"
            )
        pose = validated_transform(base_T_camera, f"{self.name}: base_T_camera")
        started_s = time.monotonic()
        shot = sensor.capture(self._truly_at(pose), request.projector, request.exposure_s, request.depth)
        return Frame(
            view=View("simulated", pose),
            left=shot.left,
            right=shot.right,
            depth_m=shot.depth_m,
            projector=request.projector,
            exposure_s=request.exposure_s,
            started_s=started_s,
            ended_s=time.monotonic(),
        )

    def true_depth_m(self, base_T_camera: FloatArray) -> FloatArray:
        """Return the depth (H, W) a perfect sensor would measure, NaN where nothing is; for evaluation."""
        return self._opened().true_depth_m(self._truly_at(base_T_camera))

    def _truly_at(self, base_T_camera: FloatArray) -> FloatArray:
        """Return where the camera is when the arm says that it is there: the same error at the same place each time."""
        shift_m, turn_rad = self.settings.arm_shift_m, self.settings.arm_turn_rad
        if not (shift_m or turn_rad):
            return base_T_camera
        digest = hashlib.blake2b(np.round(base_T_camera, 6).tobytes(), digest_size=16).digest()
        drawn = np.random.default_rng([self.settings.seed, int.from_bytes(digest)]).normal(size=(2, 3)) / np.sqrt(3)
        there = base_T_camera.copy()
        there[:3, 3] += shift_m * drawn[0]
        angle_rad = turn_rad * float(np.linalg.norm(drawn[1]))
        there[:3, :3] = there[:3, :3] @ rotation_about(drawn[1], angle_rad)
        return there

    def _opened(self) -> ActiveStereoSensor:
        if self._sensor is None:
            raise DeviceUnavailableError(self.name, "is not open")
        return self._sensor
