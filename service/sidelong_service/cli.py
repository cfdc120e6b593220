"""The command ``sidelong``."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic import ValidationError
from rich.console import Console

from sidelong.commissioning.documents import Document
from sidelong.errors import SidelongError
from sidelong.planning.selection import StrategyName
from sidelong.recipe import Recipe
from sidelong_service.bop_command import bop
from sidelong_service.calibrate_command import calibrate
from sidelong_service.client import SidelongClient
from sidelong_service.command import (
    Calibrations,
    CommandError,
    ConfigFile,
    RecipeFile,
    documents_of,
    err,
    first_fields,
    ids_of,
    out,
    plain_errors,
    recipe_of,
)
from sidelong_service.console import (
    DEPTH_TABLE_WIDTH,
    CountedProgress,
    ScanProgress,
    comparison_table,
    depth_table,
    pose_table,
    view_table,
)
from sidelong_service.models import EventKind, RecordedScene, RunState, ScanRequest
from sidelong_service.record_command import record

if TYPE_CHECKING:  # open3d and what needs it wait for the commands that use them
    from sidelong.evaluation.cases import Case
    from sidelong.evaluation.compare import Row, Run
    from sidelong_service.comparison import Comparison

app = typer.Typer(
    help="Next-best-view depth completion for shiny parts.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.add_typer(bop)
app.add_typer(calibrate)
app.add_typer(record)

Part = Annotated[str | None, typer.Option(help="Part in the configured cell.")]

FOLDER_ID = "folder"
"""Id of a data set that is given by its folder: requests name ids, never paths."""


@app.command()
def serve(
    config: ConfigFile = None,
    host: Annotated[str | None, typer.Option(help="Loopback address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(min=1, max=65535)] = None,
    data: Annotated[Path | None, typer.Option(help="Folder of database and scans.")] = None,
) -> None:
    """Run the HTTP service until it gets Ctrl-C or SIGTERM."""
    from sidelong_service.server import serve as run
    from sidelong_service.settings import load_settings

    with plain_errors():
        settings = load_settings(config, host=host, port=port, data_dir=data)
        err.print(f"sidelong: http://{settings.host}:{settings.port}, data in {settings.data_dir}", highlight=False)
        run(settings)


@app.command()
def scan(
    part: Part = None,
    dataset: Annotated[
        str | None, typer.Option(help="Id of a configured data set; without --url also its folder.")
    ] = None,
    object_name: Annotated[str | None, typer.Option("--object", help="Object of the data set.")] = None,
    scene: Annotated[int, typer.Option(min=0)] = 1,
    reference: Annotated[str | None, typer.Option(help="View whose depth is completed.")] = None,
    recipe: RecipeFile = None,
    calibration: Calibrations = None,
    url: Annotated[str | None, typer.Option(help="Service that scans; none: this process.")] = None,
    config: ConfigFile = None,
    output: Annotated[Path, typer.Option(help="Folder for the files of the scan.")] = Path("sidelong-output"),
) -> None:
    """Run one scan, on a service or in this process, and show what each view gave."""
    with plain_errors():
        folder = Path(dataset) if dataset is not None and url is None and Path(dataset).is_dir() else None
        source = FOLDER_ID if folder is not None else dataset
        request = _request(part, source, object_name, scene, reference, recipe_of(recipe, ids_of(calibration)))
        if url is not None:
            with SidelongClient(url) as client:
                scan_on_service(client, request, output)
        else:
            _scan_here(request, documents_of(calibration), config, folder, output)


@app.command()
def demo(
    output: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("demo-output"),
    part: Annotated[str, typer.Option(help="What lies in the simulated bin.")] = "tube_fitting",
) -> None:
    """Start a service with the simulated cell, run a scan over HTTP, and show what it gave."""
    from sidelong_service.demo import running_service

    with plain_errors():
        out.print("starting the service with the simulated cell ...")
        with running_service(output / "service", part) as client:
            scan_on_service(client, ScanRequest(part=part), output)


REFINED = {"on": (True,), "off": (False,), "both": (False, True)}


@app.command()
def compare(
    dataset: Annotated[Path, typer.Argument(help="Folder of a data set in ROBI's layout.")],
    object_name: Annotated[str | None, typer.Option("--object", help="Object; none: all.")] = None,
    scene: Annotated[int | None, typer.Option(min=0, help="Scene; none: all.")] = None,
    references: Annotated[str, typer.Option(help="'all', or positions or names of views: 0,5,10.")] = "all",
    views: Annotated[int, typer.Option(min=1, max=100, help="Views added to each reference view.")] = 3,
    strategies: Annotated[str, typer.Option(help="Of nbv, random, max_distance.")] = "nbv,random,max_distance",
    seeds: Annotated[int, typer.Option(min=1, max=1000, help="Runs of the random strategy.")] = 5,
    true_poses: Annotated[bool, typer.Option("--true-poses", help="Leave out detection; take the true poses.")] = False,
    poses: Annotated[bool, typer.Option("--poses", help="Judge the poses as well (the paper's Table 2).")] = False,
    depth: Annotated[
        bool, typer.Option("--depth", help="Judge the errors of the depth and its sigma as well.")
    ] = False,
    refinement: Annotated[str, typer.Option(help="Of poses by depth: on, off (as the paper), or both.")] = "on",
    recipe: RecipeFile = None,
    calibration: Calibrations = None,
    config: ConfigFile = None,
    json_file: Annotated[Path | None, typer.Option("--json", help="File for all rows.")] = None,
    plot: Annotated[Path, typer.Option(help="File for the plot, PNG.")] = Path("sidelong-comparison.png"),
) -> None:
    """Compare strategies on recorded scenes: completeness after each view, and against seconds."""
    from sidelong.evaluation.cases import cases_of
    from sidelong.recorded.dataset import Dataset
    from sidelong_service.comparison import Comparison
    from sidelong_service.settings import load_settings

    with plain_errors():
        names = None if references == "all" else [name for name in references.split(",") if name]
        settings = recipe_of(recipe, ids_of(calibration))
        planning = settings.planning.model_copy(update={"max_views": views})
        recorded = Dataset(dataset)
        comparison = Comparison(
            dataset=recorded,
            cases=cases_of(recorded, object_name, scene, names),
            runs=_runs(strategies, seeds, refinement),
            recipe=settings.model_copy(update={"planning": planning}),
            cache_dir=load_settings(config).data_dir / "templates",
            true_poses=true_poses,
            documents=documents_of(calibration),
            poses=poses,
            depth=depth,
        )
        _compare(comparison, json_file, plot)


def _compare(comparison: Comparison, json_file: Path | None, plot: Path) -> None:
    """Run a comparison and show it; Ctrl-C and a scene that cannot be used keep what there is."""
    from sidelong_service.artifacts import write_whole

    rows: list[Row] = []
    total = len(comparison.cases) * comparison.rows_each
    ended_by: KeyboardInterrupt | SidelongError | None = None
    with CountedProgress(err) as progress:

        def skip(case: Case, why: str) -> None:
            nonlocal total
            total -= comparison.rows_each
            progress.note(f"left out: {case.object} scene {case.scene} {case.reference}: {why}")

        def train(done: int, pictures: int) -> None:
            progress.show("training templates", done, pictures)

        try:
            for row in comparison.rows(skip, train):
                rows.append(row)
                progress.show(f"{row.object} scene {row.scene}", len(rows), total)
        except (KeyboardInterrupt, SidelongError) as error:
            ended_by = error
    if json_file is not None:
        write_whole(json_file, json.dumps([row.model_dump(mode="json") for row in rows], indent=1).encode())
    if rows:
        _show_comparison(rows, plot)
    if json_file is not None:
        out.print(f"  {json_file}", highlight=False, markup=False, soft_wrap=True)
    if isinstance(ended_by, SidelongError):
        raise ended_by
    if ended_by is not None:
        raise typer.Exit(130)
    if not rows:
        raise CommandError(f"{comparison.dataset.root}: no reference view could be compared")


def _show_comparison(rows: list[Row], plot: Path) -> None:
    from sidelong.evaluation.tradeoff import draw, summarise, summarise_depth, summarise_poses
    from sidelong_service.artifacts import write_whole

    points = summarise(rows)
    out.print(comparison_table(points))
    judged = summarise_poses(rows)
    if judged:
        out.print(pose_table(judged))
    errors = summarise_depth(rows)
    for on_parts in (True, False) if errors else ():
        # a file or a pipe is taken to be 80 wide, which cuts this table
        wide = out if out.is_terminal else Console(width=DEPTH_TABLE_WIDTH)
        wide.print(depth_table(errors, on_parts=on_parts))
    write_whole(plot, draw(points, f"{', '.join(dict.fromkeys(row.object for row in rows))}: {len(rows)} rows"))
    out.print(f"  {plot}", highlight=False, markup=False, soft_wrap=True)


def _runs(strategies: str, seeds: int, refinement: str) -> tuple[Run, ...]:
    from sidelong.evaluation.compare import Run

    if refinement not in REFINED:
        raise CommandError(f"--refinement: {refinement!r} given, known are {', '.join(REFINED)}")

    known = [name.value for name in StrategyName]
    wanted = [name for name in strategies.split(",") if name]
    unknown = [name for name in wanted if name not in known]
    if unknown or not wanted:
        raise CommandError(f"--strategies: {', '.join(unknown) or 'none'} given, known are {', '.join(known)}")
    return tuple(
        Run(StrategyName(name), seed, refined)
        for name in dict.fromkeys(wanted)
        for refined in REFINED[refinement]
        for seed in range(seeds if name == StrategyName.RANDOM else 1)
    )


def scan_on_service(client: SidelongClient, request: ScanRequest, output: Path) -> None:
    """Run a scan over HTTP, show it, and fetch its files. Ctrl-C stops it.

    Raises
    ------
    ClientError
        The service cannot be reached or does not accept the scan.
    CommandError
        The scan did not succeed.
    """
    accepted = client.start(request)
    out.print(f"scan {accepted.id}", highlight=False)
    with ScanProgress(out) as progress:
        try:
            for event in client.events(accepted.id):
                progress.show(event.kind, event.data)
        except KeyboardInterrupt:
            client.stop()
            raise
    ended = client.scan(accepted.id)
    files = [client.download(ended.id, artifact.name, output) for artifact in ended.artifacts]
    _conclude(progress, files, str(ended.finish_reason or ended.state))
    if ended.state is not RunState.SUCCEEDED:
        why = f"{ended.problem.title}: {ended.problem.detail}" if ended.problem is not None else "it was stopped"
        raise CommandError(f"scan {ended.id} {ended.state}: {why}")


def _scan_here(
    request: ScanRequest, documents: tuple[Document, ...], config: Path | None, folder: Path | None, output: Path
) -> None:
    """Run a scan in this process, of the data set in ``folder`` if there is one; Ctrl-C stops the arm."""
    from sidelong_service.local import LocalScan
    from sidelong_service.settings import load_settings

    settings = load_settings(config)
    if folder is not None:
        settings = settings.model_copy(update={"datasets": {FOLDER_ID: folder}})
    elif request.recording is not None and request.recording.dataset not in settings.datasets:
        known = ", ".join(sorted(settings.datasets)) or "none"
        raise CommandError(f"dataset: {request.recording.dataset!r} is neither a folder nor known, known are {known}")
    with ScanProgress(out) as progress:
        files: list[Path] = []

        def note(kind: EventKind, data: Mapping[str, Any]) -> None:
            progress.show(kind, data)
            if kind == "artifact":
                files.append(output / data["name"])

        reason = LocalScan(settings, request, documents, output, note).run()
    _conclude(progress, files, str(reason))


def _conclude(progress: ScanProgress, files: list[Path], ending: str) -> None:
    if progress.views:
        out.print(view_table(progress.views))
    out.print(f"ended: {ending}", highlight=False)
    for file in files:
        out.print(f"  {file}", highlight=False, markup=False, soft_wrap=True)


def _request(
    part: str | None, dataset: str | None, object_name: str | None, scene: int, reference: str | None, recipe: Recipe
) -> ScanRequest:
    if (part is None) == (dataset is None):
        raise CommandError("give either --part, for the configured cell, or --dataset with --object")
    if dataset is not None and object_name is None:
        raise CommandError("--dataset needs --object")
    try:
        if dataset is None or object_name is None:
            return ScanRequest(part=part, recipe=recipe)
        recording = RecordedScene(dataset=dataset, object=object_name, scene=scene, reference=reference)
        return ScanRequest(recording=recording, recipe=recipe)
    except ValidationError as error:
        raise CommandError(first_fields(error)) from error
