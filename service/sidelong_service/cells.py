"""Makes cells of what a job names: the configured one, or recorded views."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from sidelong.commissioning.applied import calibrated, calibrated_mount
from sidelong.commissioning.documents import Document
from sidelong.commissioning.white import lit_by_recording
from sidelong.devices import Arm, Camera, Cell
from sidelong.errors import UnknownNameError
from sidelong.geometry.mesh import Part, load_part
from sidelong.geometry.transforms import validated_transform
from sidelong.planning.candidates import dome_views
from sidelong.recipe import Recipe
from sidelong.recorded.dataset import Dataset
from sidelong.simulation.parts import simulated_part
from sidelong.types import View
from sidelong_drivers.registry import create_camera
from sidelong_service.messages import CapturesJob, CellJob, Job, RecordingJob, ScanJob, Settings
from sidelong_service.settings import SIMULATED_PART, CellSettings, DriverSettings

AROUND_TARGET_M = 0.08
"""How far before and behind the target of the views parts may lie."""
NEAREST_M = 0.05
CAD_SUFFIXES = (".stl", ".obj", ".ply", ".off")


@dataclass(frozen=True, eq=False)
class Plan:
    """What a job names, found and checked: everything but the devices."""

    camera: DriverSettings
    part: Part
    flange_T_camera: tuple[float, ...]
    reference: View
    candidates: tuple[View, ...]


def plan_of(job: ScanJob, recipe: Recipe) -> Plan:
    """Find all that a job names. Nothing is opened and nothing moves.

    Raises
    ------
    InputError
        A name is unknown, a file cannot be used, or the recipe has no reflectance for the part.
    """
    plan = _cell_plan(job) if isinstance(job, CellJob) else _recording_plan(job)
    recipe.light.reflectances(plan.part.materials)
    return plan


def check(job: Job, settings: Settings) -> None:
    """Find all that a job names, as far as that can be done with no device open.

    Raises
    ------
    InputError
        A name is unknown, a file cannot be used, or a calibration does not fit the recorded device.
    """
    if isinstance(job, CapturesJob):
        calibrated(settings.recipe, settings.documents, Dataset(job.root).serial)
        return
    plan_of(job, settings.recipe)
    if isinstance(job, RecordingJob):
        calibrated(settings.recipe, settings.documents, Dataset(job.root).serial)


def effective_recipe(job: ScanJob, settings: Settings, part: Part, camera_serial: str) -> Recipe:
    """Return the recipe of a job with its calibrations in it, and with what it leaves open filled in.

    The distances of the templates come from the reference view or the recorded depth; the projector's intensity is
    fitted where recorded data have a white capture and no calibration tells.

    Raises
    ------
    InputError
        A recorded file cannot be used.
    CalibrationError
        A calibration is of another device, or does not go with the others.
    """
    recipe = calibrated(settings.recipe, settings.documents, camera_serial)
    if isinstance(job, CellJob):
        distance_m = job.cell.dome.distances_m[0]
        return _reaching(recipe, (distance_m - AROUND_TARGET_M, distance_m + AROUND_TARGET_M))
    dataset = Dataset(job.root)
    if recipe.detection.distance_m is None:
        recipe = _reaching(recipe, dataset.scene(job.object, job.scene).distance_range_m())
    return lit_by_recording(recipe, dataset, job.object, part)


def _reaching(recipe: Recipe, distances_m: tuple[float, float] | None) -> Recipe:
    if distances_m is None:
        return recipe
    near_m, far_m = distances_m
    return recipe.model_copy(update={"detection": recipe.detection.reaching(max(near_m, NEAREST_M), far_m)})


class Cameras:
    """Opens cameras. The configured one stays open from scan to scan, unless it failed."""

    def __init__(self) -> None:
        self._kept: tuple[DriverSettings, Camera] | None = None

    def open(self, driver: DriverSettings) -> Camera:
        """Return the open camera; the one that was open before is closed if it is another.

        Raises
        ------
        DeviceUnavailableError
            It cannot be opened.
        InputError
            Its settings are out of range, or name what is not there.
        """
        if self._kept is not None and self._kept[0] == driver:
            return self._kept[1]
        self.close()
        camera = create_camera(driver.driver, driver.settings)
        with ExitStack() as undo:
            undo.callback(camera.close)
            camera.open()
            undo.pop_all()
        self._kept = driver, camera
        return camera

    def close(self) -> None:
        """Close the camera that is open; the next scan opens it anew."""
        if self._kept is not None:
            self._kept[1].close()
        self._kept = None


def cell_of(plan: Plan, camera: Camera, arm: Arm, documents: Sequence[Document] = ()) -> Cell:
    """Return the cell of a plan and its open devices; a hand-eye calibration goes before the configured transform."""
    configured = validated_transform(plan.flange_T_camera, "cell.flange_T_camera")
    flange_T_camera = calibrated_mount(configured, documents)
    return Cell(camera, arm, flange_T_camera, plan.reference, plan.candidates)


def _cell_plan(job: CellJob) -> Plan:
    views = dome_views(job.cell.target_m, job.cell.dome)
    part = _part_of(job.cell, job.part)
    return Plan(job.cell.camera, part, job.cell.flange_T_camera, views[0], views)


def _part_of(cell: CellSettings, name: str) -> Part:
    files = {file.stem: file for file in _cad_files(cell.parts_dir)} if cell.parts_dir is not None else {}
    known = cell.parts or (tuple(sorted(files)) if cell.parts_dir is not None else (SIMULATED_PART,))
    if name not in known:
        raise UnknownNameError(f"part: {name!r} is unknown, known are {', '.join(known) or 'none'}")
    if cell.parts_dir is None:
        return simulated_part(name)
    return load_part(files.get(name, cell.parts_dir / f"{name}{CAD_SUFFIXES[0]}"))


def _cad_files(folder: Path) -> list[Path]:
    """Return the CAD files of a folder. Of files with one name the preferred suffix comes last: it wins in a dict."""
    files = folder.iterdir() if folder.is_dir() else ()
    known = [file for file in files if file.suffix.lower() in CAD_SUFFIXES]
    return sorted(known, key=lambda file: -CAD_SUFFIXES.index(file.suffix.lower()))


def _recording_plan(job: RecordingJob) -> Plan:
    dataset = Dataset(job.root)
    scene = dataset.scene(job.object, job.scene)
    camera = DriverSettings(driver="replay", settings=job.driver_settings())
    views = scene.views()
    reference = views[0] if job.reference is None else scene.view(job.reference)
    return Plan(camera, dataset.part(job.object), tuple(np.eye(4).ravel()), reference, views)
