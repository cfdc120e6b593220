"""Runs one scan and tells of it: the same in the scan worker and in a process without a service."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from sidelong.devices import Camera, CaptureRequest, Cell
from sidelong.geometry.camera_model import StereoRig
from sidelong.geometry.mesh import Part
from sidelong.recipe import Recipe, Stages, build_stages
from sidelong.scan import scan
from sidelong.stopwatch import Stopwatch
from sidelong.types import FloatArray, Frame, GrayImage, Projector, Stop
from sidelong_service.artifacts import Record, write_results, write_view
from sidelong_service.models import EventKind, Setup
from sidelong_service.pictures import draw

PROGRESS_STEPS = 50
"""How many times the training of templates is told of."""


class Cancelled(Exception):  # noqa: N818 - an ending that was asked for, not an error
    """The scan was asked to end."""


class Listener(Protocol):
    """Who hears of a scan."""

    def note(self, kind: EventKind, data: Mapping[str, Any]) -> None:
        """Something happened."""
        ...

    def check_cancelled(self) -> None:
        """Raise Cancelled where the scan shall end."""
        ...


@dataclass(frozen=True, eq=False)
class ScanRun:
    """A scan that is ready to run.

    Attributes
    ----------
    cell, part
        Opened devices, views, and what is looked for.
    recipe
        Settings.
    folder
        Where its files go.
    cache_dir
        Where trained templates are kept.
    listener
        Who hears of it.
    """

    cell: Cell
    part: Part
    recipe: Recipe
    folder: Path
    cache_dir: Path
    listener: Listener

    def run(self) -> Stop:
        """Run the scan to its end and write its files, those of a scan that fails or is cancelled too.

        Raises
        ------
        Cancelled
            The listener asked for the end.
        SidelongError
            The scan failed.
        OSError
            A file could not be written.
        """
        camera = WatchedCamera(self.cell.camera)
        with build_stages(self.recipe, self.part, camera.rig, self.cache_dir, progress=self._progress) as stages:
            record = Record(camera.rig.left, self.part, self._setup(stages))
            self.listener.note("setup", record.setup.model_dump())
            try:
                self._take_views(replace(self.cell, camera=camera), stages, record)
            finally:
                record.image, record.detection = camera.image, stages.detector.last_report
                for artifact in write_results(self.folder, record, draw):
                    self.listener.note("artifact", artifact.model_dump())
        if record.last is None or record.last.stop is None:
            raise RuntimeError("the scan ended without a reason")
        return record.last.stop

    def _take_views(self, cell: Cell, stages: Stages, record: Record) -> None:
        for step in scan(cell, stages, self.recipe, LiveStopwatch(self._enter_stage)):
            report = record.add(step)
            self.listener.note("artifact", write_view(self.folder, step).model_dump())
            self.listener.note("view", report.model_dump())

    def _enter_stage(self, name: str) -> None:
        self.listener.check_cancelled()
        self.listener.note("phase", {"phase": name})

    def _progress(self, done: int, total: int) -> None:
        self.listener.check_cancelled()
        if done == total or done % max(1, total // PROGRESS_STEPS) == 0:
            self.listener.note("progress", {"work": "training templates", "done": done, "total": total})

    def _setup(self, stages: Stages) -> Setup:
        return Setup(
            part=self.part.name,
            repairs=self.part.repairs,
            camera=self.cell.camera.name,
            arm=self.cell.arm.name,
            width_px=stages.rig.left.width,
            height_px=stages.rig.left.height,
            candidates=len(self.cell.candidates),
            left_out=stages.left_out,
            recipe=self.recipe.model_dump(mode="json"),
        )


class LiveStopwatch(Stopwatch):
    """A stopwatch that tells when a stage begins."""

    def __init__(self, entered: Callable[[str], None]) -> None:
        super().__init__()
        self._entered = entered

    @contextmanager
    def stage(self, name: str) -> Generator[None]:
        """Tell, then count the time inside the ``with`` block."""
        self._entered(name)
        with super().stage(name):
            yield


class WatchedCamera:
    """A camera that keeps its first image with the projector off: the one that detection reads."""

    def __init__(self, camera: Camera) -> None:
        self._camera = camera
        self.image: GrayImage | None = None

    @property
    def name(self) -> str:
        """The device's name in messages."""
        return self._camera.name

    @property
    def serial(self) -> str:
        """Serial number of the device."""
        return self._camera.serial

    @property
    def rig(self) -> StereoRig:
        """Intrinsics, baseline and projector."""
        return self._camera.rig

    def open(self) -> None:
        """Open the camera."""
        self._camera.open()

    def close(self) -> None:
        """Close the camera."""
        self._camera.close()

    def capture(self, request: CaptureRequest, base_T_camera: FloatArray) -> Frame:
        """Take one capture."""
        frame = self._camera.capture(request, base_T_camera)
        if request.projector is Projector.OFF and self.image is None:
            self.image = frame.left
        return frame
