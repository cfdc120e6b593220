"""The commands ``sidelong record ...``: captures of the configured camera, for calibrations to be made from."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from sidelong.types import Projector
from sidelong_service.command import CommandError, ConfigFile, err, out, plain_errors
from sidelong_service.console import CountedProgress

if TYPE_CHECKING:
    from sidelong.commissioning.recording import Recorder

record = typer.Typer(
    name="record",
    help="Take captures with the configured camera, for `sidelong calibrate`. The arm moves only where --view says.",
    no_args_is_help=True,
)

Root = Annotated[Path, typer.Argument(help="Folder of the data set; made where there is none.")]
Object = Annotated[str | None, typer.Option("--object", help="Whose captures; none: those of the device.")]
ViewName = Annotated[str | None, typer.Option("--view", help="View of the cell to move to first; none: stay.")]
Exposure = Annotated[float, typer.Option("--exposure-ms", min=1e-3, max=1e4)]
Shown = Annotated[Projector, typer.Option(help="What the projector shows.")]
PROJECTOR_ON_MS, PROJECTOR_OFF_MS = 12.0, 200.0
BRACKET_MS = "3,6,12,25,50,100,200,400,800"


@record.command()
def bracket(
    root: Root,
    exposures_ms: Annotated[str, typer.Option("--exposures-ms", help="At least three, divided by commas.")] = (
        BRACKET_MS
    ),
    projector: Shown = Projector.OFF,
    object_name: Object = None,
    view: ViewName = None,
    config: ConfigFile = None,
) -> None:
    """Take an exposure bracket of the scene: for `sidelong calibrate response`."""
    with plain_errors():
        exposures_s = [_milliseconds(each) for each in exposures_ms.split(",") if each.strip()]
        with CountedProgress(err) as progress:

            def show(done: int, total: int) -> None:
                progress.show("images", done, total)

            _record(config, root, object_name, view, lambda recorder: recorder.bracket(exposures_s, projector, show))


@record.command()
def white(
    root: Root,
    exposure_ms: Exposure = PROJECTOR_ON_MS,
    object_name: Object = None,
    view: ViewName = None,
    config: ConfigFile = None,
) -> None:
    """Take images under the white pattern: with `record sprayed` for `sidelong calibrate material`."""
    with plain_errors():
        _record(config, root, object_name, view, lambda recorder: recorder.white(exposure_ms * 1e-3))


@record.command()
def sprayed(
    root: Root,
    exposure_ms: Exposure = PROJECTOR_ON_MS,
    object_name: Object = None,
    view: ViewName = None,
    config: ConfigFile = None,
) -> None:
    """Take the depth of the scene that `record white` has seen, once it is sprayed."""
    with plain_errors():
        _record(config, root, object_name, view, lambda recorder: recorder.sprayed(exposure_ms * 1e-3))


@record.command()
def plane(
    root: Root,
    exposure_ms: Exposure = PROJECTOR_ON_MS,
    object_name: Object = None,
    view: ViewName = None,
    config: ConfigFile = None,
) -> None:
    """Take one more capture of a matte plane: for `sidelong calibrate projector`."""
    with plain_errors():
        _record(config, root, object_name, view, lambda recorder: recorder.plane(exposure_ms * 1e-3))


@record.command()
def board(
    root: Root,
    board_file: Annotated[
        Path | None, typer.Option("--board", help="JSON file that describes the board; kept with the images.")
    ] = None,
    exposure_ms: Exposure = PROJECTOR_OFF_MS,
    projector: Shown = Projector.OFF,
    object_name: Object = None,
    view: ViewName = None,
    config: ConfigFile = None,
) -> None:
    """Take one more image of a board and the arm's pose: for `sidelong calibrate hand-eye`."""
    with plain_errors():
        if board_file is not None and not board_file.is_file():
            raise CommandError(f"--board: {board_file} is no file")

        def take(recorder: Recorder) -> tuple[Path, ...]:
            files = recorder.board(exposure_ms * 1e-3, projector)
            if board_file is not None:
                shutil.copyfile(board_file, files[0].with_name("board.json"))
            return files

        _record(config, root, object_name, view, take)


def _record(
    config: Path | None,
    root: Path,
    object_name: str | None,
    view: str | None,
    take: Callable[[Recorder], tuple[Path, ...]],
) -> None:
    from sidelong.commissioning.recording import Recorder
    from sidelong_service.local import devices_at
    from sidelong_service.settings import load_settings

    with devices_at(load_settings(config).cell, view) as (camera, base_T_flange, base_T_camera):
        for file in take(Recorder(camera, base_T_flange, base_T_camera, root, object_name)):
            out.print(f"  {file}", highlight=False, markup=False, soft_wrap=True)


def _milliseconds(text: str) -> float:
    try:
        return float(text) * 1e-3
    except ValueError as error:
        raise CommandError(f"--exposures-ms: {text!r:.40} is no number") from error
