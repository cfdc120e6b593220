"""What the three processes say to each other.

::

    API      -> arm host   Heartbeat, StopArm, ReleaseArm
    arm host -> API        ArmReady, ArmFailed, ArmStopped
    API      -> worker     CheckJob, RunJob, CalibrateJob, CancelJob
    worker   -> API        WorkerReady, JobChecked, Note, JobDone
    worker   -> arm host   ArmCall
    arm host -> worker     ArmAnswer
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter

from sidelong import errors
from sidelong.commissioning.documents import Document
from sidelong.commissioning.tasks import Task
from sidelong.devices import ArmState
from sidelong.recipe import Recipe
from sidelong.types import FloatArray, Stop
from sidelong_service.models import EventKind
from sidelong_service.problems import Problem
from sidelong_service.settings import CellSettings, DriverSettings

HEARTBEAT_S = 0.5
"""How often the API tells the arm hosts that it is there."""
HEARTBEAT_LOST_S = 2.0
"""The arm is stopped when it has said nothing for this long."""


class Message(BaseModel):
    """Base of all messages."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Heartbeat(Message):
    """The API is there."""

    kind: Literal["heartbeat"] = "heartbeat"


class StopArm(Message):
    """Stop now, and refuse moves until released."""

    kind: Literal["stop"] = "stop"


class ReleaseArm(Message):
    """A new scan begins: moves are allowed again."""

    kind: Literal["release"] = "release"


ToArmHost: TypeAlias = Annotated[Heartbeat | StopArm | ReleaseArm, Field(discriminator="kind")]
TO_ARM_HOST: TypeAdapter[ToArmHost] = TypeAdapter(ToArmHost)


class ArmReady(Message):
    """The arm is open."""

    kind: Literal["ready"] = "ready"
    name: str


class ArmFailed(Message):
    """The arm cannot be opened; the host ends."""

    kind: Literal["failed"] = "failed"
    problem: Problem


class ArmStopped(Message):
    """The driver has been told to stop, and moves are refused."""

    kind: Literal["stopped"] = "stopped"


FromArmHost: TypeAlias = Annotated[ArmReady | ArmFailed | ArmStopped, Field(discriminator="kind")]
FROM_ARM_HOST: TypeAdapter[FromArmHost] = TypeAdapter(FromArmHost)


class ArmCall(Message):
    """A call of the arm protocol; ``pose`` is base_T_flange row by row."""

    call: Literal["state", "unreachable", "move"]
    pose: tuple[float, ...] | None = None
    deadline_s: float | None = None


class ArmReading(Message):
    """An ``ArmState``."""

    base_T_flange: tuple[float, ...]
    joints_rad: tuple[float, ...]
    moving: bool
    stamp_s: float

    @classmethod
    def of(cls, state: ArmState) -> ArmReading:
        """Return the reading of a state."""
        return cls(
            base_T_flange=flat(state.base_T_flange),
            joints_rad=tuple(float(angle) for angle in state.joints_rad),
            moving=state.moving,
            stamp_s=state.stamp_s,
        )

    def state(self) -> ArmState:
        """Return the state it was made of."""
        return ArmState(pose(self.base_T_flange), np.array(self.joints_rad), self.moving, self.stamp_s)


class ErrorReport(Message):
    """An exception on its way to another process."""

    name: str
    text: str
    device: str | None = None

    @classmethod
    def of(cls, error: errors.SidelongError) -> ErrorReport:
        """Return the report of an error."""
        if isinstance(error, errors.DeviceError):
            return cls(name=type(error).__name__, text=error.problem, device=error.device)
        return cls(name=type(error).__name__, text=str(error))

    def error(self) -> errors.SidelongError:
        """Return the error it was made of; the nearest base where this side does not know the class."""
        known = getattr(errors, self.name, errors.SidelongError)
        if self.device is not None:
            return (known if issubclass(known, errors.DeviceError) else errors.DeviceError)(self.device, self.text)
        return known(self.text)


class ArmAnswer(Message):
    """The result of a call: a reading, a reason, nothing, or an error."""

    reading: ArmReading | None = None
    reason: str | None = None
    error: ErrorReport | None = None


class CellJob(Message):
    """Scan with the configured cell."""

    kind: Literal["cell"] = "cell"
    cell: CellSettings
    part: str


class RecordingJob(Message):
    """Scan recorded views."""

    kind: Literal["recording"] = "recording"
    root: Path
    object: str
    scene: int
    reference: str | None

    def arm(self) -> DriverSettings:
        """Return the driver that moves among the recorded views."""
        return DriverSettings(driver="replay", settings=self.driver_settings())

    def driver_settings(self) -> dict[str, Any]:
        """Return what the replay drivers need to find the scene."""
        return {"root": str(self.root), "object": self.object, "scene": self.scene}


class CapturesJob(Message):
    """Make a calibration from the captures of a data set."""

    kind: Literal["captures"] = "captures"
    root: Path
    object: str | None
    task: Task


ScanJob: TypeAlias = CellJob | RecordingJob
Job: TypeAlias = Annotated[ScanJob | CapturesJob, Field(discriminator="kind")]


class Settings(Message):
    """The recipe of a job, and the calibrations it names."""

    recipe: Recipe
    documents: tuple[Document, ...]


class CheckJob(Message):
    """Find all that the job names, without moving anything."""

    kind: Literal["check"] = "check"
    job: Job
    settings: Settings


class CalibrateJob(Message):
    """Make a calibration; its files go to ``folder``."""

    kind: Literal["calibrate"] = "calibrate"
    job: CapturesJob
    settings: Settings
    folder: Path


class RunJob(Message):
    """Run a scan: its files go to ``folder``, the arm listens at ``arm_socket``."""

    kind: Literal["run"] = "run"
    job: Annotated[ScanJob, Field(discriminator="kind")]
    settings: Settings
    arm_socket: Path
    arm_name: str
    folder: Path
    cache_dir: Path


class CancelJob(Message):
    """End the running job as soon as may be."""

    kind: Literal["cancel"] = "cancel"


ToWorker: TypeAlias = Annotated[CheckJob | RunJob | CalibrateJob | CancelJob, Field(discriminator="kind")]
TO_WORKER: TypeAdapter[ToWorker] = TypeAdapter(ToWorker)


class WorkerReady(Message):
    """The worker has loaded what it needs."""

    kind: Literal["ready"] = "ready"


class JobChecked(Message):
    """All that the job names is there, or the problem with it."""

    kind: Literal["checked"] = "checked"
    problem: Problem | None


class Note(Message):
    """Something happened in the running job."""

    kind: Literal["note"] = "note"
    event: EventKind
    data: dict[str, Any]


class JobDone(Message):
    """The job has ended: done (a scan with its reason), cancelled, or with a problem."""

    kind: Literal["done"] = "done"
    finish_reason: Stop | None = None
    cancelled: bool = False
    problem: Problem | None = None


FromWorker: TypeAlias = Annotated[WorkerReady | JobChecked | Note | JobDone, Field(discriminator="kind")]
FROM_WORKER: TypeAdapter[FromWorker] = TypeAdapter(FromWorker)


def flat(matrix: FloatArray) -> tuple[float, ...]:
    """Return a pose as 16 numbers, row by row."""
    return tuple(float(entry) for entry in matrix.ravel())


def pose(entries: tuple[float, ...]) -> FloatArray:
    """Return 16 numbers as a (4, 4) matrix; what they are worth is for the receiver to check."""
    return np.array(entries, dtype=np.float64).reshape(4, 4)
