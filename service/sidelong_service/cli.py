"""The command ``sidelong``."""

from __future__ import annotations

from collections.abc import Generator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic import ValidationError
from rich.console import Console

from sidelong.errors import SidelongError
from sidelong.recipe import Recipe
from sidelong_service.client import ClientError, SidelongClient
from sidelong_service.console import ScanProgress, view_table
from sidelong_service.models import EventKind, RecordedScene, ScanRequest, ScanState
from sidelong_service.problems import validation_problem

app = typer.Typer(
    help="Next-best-view depth completion for shiny parts.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
out = Console()
err = Console(stderr=True)

Part = Annotated[str | None, typer.Option(help="Part in the configured cell.")]
RecipeFile = Annotated[Path | None, typer.Option("--recipe", help="JSON file with settings of the scan.")]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="YAML file with settings of the service.")]


class CommandError(Exception):
    """A command cannot do what it was asked for; the message says why."""


@contextmanager
def plain_errors() -> Generator[None]:
    """Show expected errors as one line and exit with 1."""
    try:
        yield
    except (CommandError, ClientError, SidelongError, OSError) as error:
        err.print(f"[bold red]error[/]: {error}", highlight=False, soft_wrap=True)
        raise typer.Exit(1) from error


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
    url: Annotated[str | None, typer.Option(help="Service that scans; none: this process.")] = None,
    config: ConfigFile = None,
    output: Annotated[Path, typer.Option(help="Folder for the files of the scan.")] = Path("sidelong-output"),
) -> None:
    """Run one scan, on a service or in this process, and show what each view gave."""
    with plain_errors():
        request = _request(part, dataset, object_name, scene, reference, recipe)
        if url is not None:
            with SidelongClient(url) as client:
                scan_on_service(client, request, output)
        else:
            _scan_here(request, config, output)


@app.command()
def demo(
    output: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("demo-output"),
    part: Annotated[str, typer.Option(help="What lies in the simulated bin.")] = "tube_fitting",
) -> None:
    """Start a service with the simulated cell, run a scan over HTTP, and show what it gave."""
    from sidelong_service.demo import running_service

    with plain_errors():
        out.print("starting the service with the simulated cell ...")
        with running_service(output / "service") as client:
            scan_on_service(client, ScanRequest(part=part), output)


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
    if ended.state is not ScanState.SUCCEEDED:
        why = f"{ended.problem.title}: {ended.problem.detail}" if ended.problem is not None else "it was stopped"
        raise CommandError(f"scan {ended.id} {ended.state}: {why}")


def _scan_here(request: ScanRequest, config: Path | None, output: Path) -> None:
    """Run a scan in this process; Ctrl-C stops the arm."""
    from sidelong_service.local import LocalScan
    from sidelong_service.settings import load_settings

    settings = load_settings(config)
    with ScanProgress(out) as progress:
        files: list[Path] = []

        def note(kind: EventKind, data: Mapping[str, Any]) -> None:
            progress.show(kind, data)
            if kind == "artifact":
                files.append(output / data["name"])

        reason = LocalScan(settings, request, output, note).run()
    _conclude(progress, files, str(reason))


def _conclude(progress: ScanProgress, files: list[Path], ending: str) -> None:
    if progress.views:
        out.print(view_table(progress.views))
    out.print(f"ended: {ending}", highlight=False)
    for file in files:
        out.print(f"  {file}", highlight=False, soft_wrap=True)


def _request(
    part: str | None, dataset: str | None, object_name: str | None, scene: int, reference: str | None, file: Path | None
) -> ScanRequest:
    if (part is None) == (dataset is None):
        raise CommandError("give either --part, for the configured cell, or --dataset with --object")
    if dataset is not None and object_name is None:
        raise CommandError("--dataset needs --object")
    try:
        recipe = Recipe() if file is None else Recipe.model_validate_json(file.read_bytes())
        if dataset is None or object_name is None:
            return ScanRequest(part=part, recipe=recipe)
        recording = RecordedScene(dataset=dataset, object=object_name, scene=scene, reference=reference)
        return ScanRequest(recording=recording, recipe=recipe)
    except ValidationError as error:
        source = f"{file}: " if file is not None else ""
        raise CommandError(source + validation_problem([dict(each) for each in error.errors()]).detail) from error
