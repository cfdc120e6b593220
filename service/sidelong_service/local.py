"""The cell without a service: planner, camera and arm in this process."""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

from sidelong.commissioning.documents import Document
from sidelong.devices import Camera
from sidelong.errors import UnknownNameError
from sidelong.geometry.transforms import invert, validated_transform
from sidelong.planning.candidates import dome_views
from sidelong.recipe import Recipe
from sidelong.types import FloatArray, Stop
from sidelong_drivers.registry import create_arm, create_camera
from sidelong_service.cells import cell_of, effective_recipe, plan_of
from sidelong_service.jobs import scan_job
from sidelong_service.messages import CellJob, Settings
from sidelong_service.models import EventKind, ScanRequest
from sidelong_service.runner import ScanRun
from sidelong_service.settings import CellSettings, ServiceSettings


class LocalScan:
    """One scan in this process.

    Parameters
    ----------
    settings
        Cell and data sets.
    request
        What to scan.
    documents
        The calibrations its recipe names.
    folder
        Where the files go.
    tell
        Hears of each event.
    """

    def __init__(
        self,
        settings: ServiceSettings,
        request: ScanRequest,
        documents: Sequence[Document],
        folder: Path,
        tell: Callable[[EventKind, Mapping[str, Any]], None],
    ) -> None:
        self._settings = settings
        self._request = request
        self._documents = tuple(documents)
        self._folder = folder
        self._tell = tell

    def run(self) -> Stop:
        """Run the scan to its end and return why it ended.

        Raises
        ------
        SidelongError
            It failed.
        """
        job = scan_job(self._request, self._settings)
        plan = plan_of(job, self._request.recipe)
        driver = job.cell.arm if isinstance(job, CellJob) else job.arm()
        camera = create_camera(plan.camera.driver, plan.camera.settings)
        arm = create_arm(driver.driver, driver.settings)
        with closing(camera), closing(arm):
            camera.open()
            settings = Settings(recipe=self._request.recipe, documents=self._documents)
            recipe = effective_recipe(job, settings, plan.part, camera.serial)
            arm.open()
            cache_dir = self._settings.data_dir / "templates"
            cell = cell_of(plan, camera, arm, self._documents)
            return ScanRun(cell, plan.part, recipe, self._folder, cache_dir, self).run()

    def note(self, kind: EventKind, data: Mapping[str, Any]) -> None:
        """Pass an event on."""
        self._tell(kind, data)

    def check_cancelled(self) -> None:
        """Go on: here Ctrl-C ends a scan."""


@contextmanager
def devices_at(cell: CellSettings, view: str | None) -> Generator[tuple[Camera, FloatArray, FloatArray]]:
    """Open camera and arm, move to a view of the cell if one is named, and yield camera, base_T_flange, base_T_camera.

    Raises
    ------
    UnknownNameError
        The cell has no such view.
    DeviceError
        A device failed.
    """
    views = {each.name: each for each in dome_views(cell.target_m, cell.dome)}
    if view is not None and view not in views:
        raise UnknownNameError(f"--view: {view!r:.80} is unknown, known are {', '.join(views)}")
    flange_T_camera = validated_transform(cell.flange_T_camera, "cell.flange_T_camera")
    camera = create_camera(cell.camera.driver, cell.camera.settings)
    arm = create_arm(cell.arm.driver, cell.arm.settings)
    with closing(camera), closing(arm):
        camera.open()
        arm.open()
        state = arm.state()
        if view is not None:
            state = arm.move(views[view].base_T_camera @ invert(flange_T_camera), Recipe().move_deadline_s)
        yield camera, state.base_T_flange, state.base_T_flange @ flange_T_camera
