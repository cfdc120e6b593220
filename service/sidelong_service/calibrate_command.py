"""The commands ``sidelong calibrate ...``: from recorded captures to a calibration file and its picture."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError

from sidelong.commissioning.tasks import (
    HandEyeTask,
    MaterialTask,
    NoiseTask,
    ProjectorTask,
    ResponseTask,
    SensingTask,
    Task,
)
from sidelong_service.client import SidelongClient
from sidelong_service.command import (
    Calibrations,
    CommandError,
    RecipeFile,
    documents_of,
    err,
    first_fields,
    ids_of,
    out,
    plain_errors,
    recipe_of,
)
from sidelong_service.console import CountedProgress
from sidelong_service.messages import CapturesJob, Settings
from sidelong_service.models import CalibrationRequest, EventKind, RunState

calibrate = typer.Typer(
    name="calibrate",
    help="Make calibration files from recorded captures. The layout is drawn in core/sidelong/recorded/captures.py.",
    no_args_is_help=True,
)

DataSet = Annotated[str, typer.Argument(help="Folder of a data set; with --url the id of one that the service has.")]
Object = Annotated[str | None, typer.Option("--object", help="Whose captures; none: those of the device.")]
Url = Annotated[str | None, typer.Option(help="Service that calibrates; none: this process.")]
Output = Annotated[Path, typer.Option(help="Folder for the files.")]
HERE = Path("sidelong-calibrations")


@calibrate.command()
def response(
    dataset: DataSet,
    object_name: Object = None,
    output: Output = HERE,
    url: Url = None,
) -> None:
    """Fit the response of the sensor to an exposure bracket."""
    _make(ResponseTask(), dataset, object_name, output=output, url=url)


@calibrate.command()
def projector(
    dataset: DataSet,
    plane_k_d: Annotated[
        float, typer.Option(help="Diffuse share of the plane, 0..1; only its product with the intensity counts.")
    ],
    object_name: Object = None,
    calibration: Calibrations = None,
    output: Output = HERE,
    url: Url = None,
) -> None:
    """Fit the projector's intensity, vignetting and fall-off to white images of a matte plane."""
    try:
        task = ProjectorTask(plane_k_d=plane_k_d)
    except ValidationError as error:
        raise typer.BadParameter(first_fields(error)) from error
    _make(task, dataset, object_name, calibration, output=output, url=url)


@calibrate.command()
def material(
    dataset: DataSet,
    object_name: Object = None,
    name: Annotated[str | None, typer.Option("--material", help="One of the part's; none: each that is seen.")] = None,
    calibration: Calibrations = None,
    recipe: RecipeFile = None,
    output: Output = HERE,
    url: Url = None,
) -> None:
    """Fit the reflectance of a part's materials to white images and the depth of the same scene, sprayed."""
    _make(MaterialTask(material=name), dataset, object_name, calibration, recipe=recipe, output=output, url=url)


@calibrate.command()
def sensing(
    dataset: DataSet,
    object_name: Object = None,
    scene: Annotated[int, typer.Option(min=0)] = 1,
    calibration: Calibrations = None,
    recipe: RecipeFile = None,
    output: Output = HERE,
    url: Url = None,
) -> None:
    """Learn the probability of depth against exposure from the views of a recorded scene."""
    _make(SensingTask(scene=scene), dataset, object_name, calibration, recipe=recipe, output=output, url=url)


@calibrate.command("hand-eye")
def hand_eye(
    dataset: DataSet,
    object_name: Object = None,
    arm: Annotated[str | None, typer.Option(help="Model of the arm, for the file.")] = None,
    output: Output = HERE,
    url: Url = None,
) -> None:
    """Find where the camera sits on the flange from images of a board."""
    _make(HandEyeTask(arm=arm), dataset, object_name, output=output, url=url)


@calibrate.command()
def noise(
    dataset: DataSet,
    object_name: Object = None,
    repeats: Annotated[
        bool, typer.Option("--repeats", help="From repeated shots of one scene: a lower bound.")
    ] = False,
    output: Output = HERE,
    url: Url = None,
) -> None:
    """Fit the noise of depth to captures of a flat plate, at several tilts and distances."""
    _make(NoiseTask(method="repeats" if repeats else "plate"), dataset, object_name, output=output, url=url)


def _make(
    task: Task,
    dataset: str,
    object_name: str | None,
    calibration: list[str] | None = None,
    *,
    recipe: Path | None = None,
    output: Path,
    url: str | None,
) -> None:
    with plain_errors():
        named = recipe_of(recipe, ids_of(calibration))
        if url is None:
            settings = Settings(recipe=named, documents=documents_of(calibration))
            _make_here(task, Path(dataset), object_name, settings, output)
            return
        try:
            request = CalibrationRequest(dataset=dataset, object=object_name, task=task, recipe=named)
        except ValidationError as error:
            raise CommandError(first_fields(error)) from error
        with SidelongClient(url) as client:
            _make_on_service(client, request, output)


class _Shown:
    """Shows what happens to a calibration, and keeps the ids of what was made."""

    def __init__(self, progress: CountedProgress) -> None:
        self._progress = progress
        self.made: list[str] = []

    def note(self, kind: EventKind, data: Mapping[str, Any]) -> None:
        """Show an event."""
        if kind == "progress":
            self._progress.show(data["work"], data["done"], data["total"])
        elif kind == "calibration":
            self.made.append(data["id"])
            self._progress.note(f"{data.get('material') or data['kind']}: {data['summary']}")
            for warning in data["warnings"]:
                self._progress.note(f"  warning: {warning}")

    def check_cancelled(self) -> None:
        """Go on: here Ctrl-C ends a calibration."""


def _make_here(task: Task, root: Path, object_name: str | None, settings: Settings, output: Path) -> None:
    from sidelong_service.calibrating import CalibrationRun
    from sidelong_service.calibration_store import CalibrationStore

    job = CapturesJob(root=root, object=object_name, task=task)
    progress = CountedProgress(err)
    shown = _Shown(progress)
    try:
        with progress:
            CalibrationRun(job, settings, CalibrationStore(output), shown).run()
    finally:  # what was made before an end stays
        for each in shown.made:
            _tell(output / f"{each}.json", output / f"{each}.png")


def _make_on_service(client: SidelongClient, request: CalibrationRequest, output: Path) -> None:
    """Have a service make a calibration and fetch its files. Ctrl-C cancels the job."""
    accepted = client.start_job(request)
    out.print(f"job {accepted.id}", highlight=False)
    with CountedProgress(err) as progress:
        shown = _Shown(progress)
        try:
            for event in client.job_events(accepted.id):
                shown.note(event.kind, event.data)
        except KeyboardInterrupt:
            client.cancel_job(accepted.id)
            raise
    for each in shown.made:
        _tell(*client.download_calibration(each, output))
    ended = client.job(accepted.id)
    if ended.state is not RunState.SUCCEEDED:
        why = f"{ended.problem.title}: {ended.problem.detail}" if ended.problem is not None else "it was cancelled"
        raise CommandError(f"job {ended.id} {ended.state}: {why}")


def _tell(*files: Path) -> None:
    for file in files:
        out.print(f"  {file}", highlight=False, markup=False, soft_wrap=True)
