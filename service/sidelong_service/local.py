"""A scan without a service: planner, camera and arm in this process."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

from sidelong.errors import UnknownNameError
from sidelong.types import Stop
from sidelong_drivers.registry import create_arm, create_camera
from sidelong_service.cells import cell_of, effective_recipe, plan_of
from sidelong_service.messages import CellJob, Job, RecordingJob
from sidelong_service.models import EventKind, ScanRequest
from sidelong_service.runner import ScanRun
from sidelong_service.settings import ServiceSettings


class LocalScan:
    """One scan in this process.

    Parameters
    ----------
    settings
        Cell and data sets.
    request
        What to scan.
    folder
        Where the files go.
    tell
        Hears of each event.
    """

    def __init__(
        self,
        settings: ServiceSettings,
        request: ScanRequest,
        folder: Path,
        tell: Callable[[EventKind, Mapping[str, Any]], None],
    ) -> None:
        self._settings = settings
        self._request = request
        self._folder = folder
        self._tell = tell

    def run(self) -> Stop:
        """Run the scan to its end and return why it ended.

        Raises
        ------
        SidelongError
            It failed.
        """
        job = self._job()
        plan = plan_of(job, self._request.recipe)
        driver = job.cell.arm if isinstance(job, CellJob) else job.arm()
        camera = create_camera(plan.camera.driver, plan.camera.settings)
        arm = create_arm(driver.driver, driver.settings)
        with closing(camera), closing(arm):
            camera.open()
            arm.open()
            cache_dir = self._settings.data_dir / "templates"
            cell = cell_of(plan, camera, arm)
            recipe = effective_recipe(job, self._request.recipe, plan.part)
            return ScanRun(cell, plan.part, recipe, self._folder, cache_dir, self).run()

    def note(self, kind: EventKind, data: Mapping[str, Any]) -> None:
        """Pass an event on."""
        self._tell(kind, data)

    def check_cancelled(self) -> None:
        """Go on: here Ctrl-C ends a scan."""

    def _job(self) -> Job:
        recording = self._request.recording
        if recording is None:
            return CellJob(cell=self._settings.cell, part=self._request.part or "")
        root = self._settings.datasets.get(recording.dataset)
        if root is None:
            known = ", ".join(sorted(self._settings.datasets)) or "none"
            raise UnknownNameError(f"dataset: {recording.dataset!r} is neither a folder nor known, known are {known}")
        return RecordingJob(root=root, object=recording.object, scene=recording.scene, reference=recording.reference)
