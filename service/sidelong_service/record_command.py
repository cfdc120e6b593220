"""The commands ``sidelong record ...``: captures of the configured camera, for calibrations to be made from."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from pydantic import ValidationError

from sidelong.types import Projector
from sidelong_service.command import CommandError, ConfigFile, err, first_fields, out, plain_errors
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
WHITE_MS = "12,3,0.75"
FEWEST_EXPOSURES = 3


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
        exposures_s = _exposures_s(exposures_ms)
        if len(set(exposures_s)) < FEWEST_EXPOSURES:
            raise CommandError(f"--exposures-ms: {exposures_ms!r:.80} has fewer than {FEWEST_EXPOSURES} exposures")
        with CountedProgress(err) as progress:

            def show(done: int, total: int) -> None:
                progress.show("images", done, total)

            _record(config, root, object_name, view, lambda recorder: recorder.bracket(exposures_s, projector, show))


@record.command()
def white(
    root: Root,
    exposures_ms: Annotated[
        str, typer.Option("--exposures-ms", help="That of depth captures first; shorter ones measure highlights.")
    ] = WHITE_MS,
    object_name: Object = None,
    view: ViewName = None,
    config: ConfigFile = None,
) -> None:
    """Take images under the white pattern: with `record sprayed` for `sidelong calibrate material`."""
    with plain_errors():
        exposures_s = _exposures_s(exposures_ms)
        _record(config, root, object_name, view, lambda recorder: recorder.white(exposures_s))


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
    """Take one more capture of a matte plane: for `sidelong calibrate projector` and `noise`."""
    with plain_errors():
        _record(config, root, object_name, view, lambda recorder: recorder.plane(exposure_ms * 1e-3))


@record.command()
def repeats(
    root: Root,
    count: Annotated[int, typer.Option(min=5, max=40, help="Shots of the same scene.")] = 20,
    exposure_ms: Exposure = PROJECTOR_ON_MS,
    object_name: Object = None,
    view: ViewName = None,
    config: ConfigFile = None,
) -> None:
    """Take the depth of a scene at rest again and again: for `sidelong calibrate noise --repeats`."""
    with plain_errors(), CountedProgress(err) as progress:

        def show(done: int, total: int) -> None:
            progress.show("shots", done, total)

        _record(config, root, object_name, view, lambda recorder: recorder.repeats(exposure_ms * 1e-3, count, show))


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


@record.command("print-board")
def print_board(
    folder: Annotated[Path, typer.Argument(help="Where board.png, to print, and board.json go.")],
    squares: Annotated[str, typer.Option(help="Along x and y.")] = "11x8",
    square_mm: Annotated[float, typer.Option("--square-mm")] = 20.0,
    marker_mm: Annotated[float, typer.Option("--marker-mm")] = 15.0,
    dictionary: Annotated[str, typer.Option(help="ArUco dictionary of the markers.")] = "DICT_4X4_50",
) -> None:
    """Draw a ChArUco board in true scale, with the description that `record board` and `calibrate hand-eye` need."""
    from sidelong.calibration.hand_eye.board import BoardSettings, board_png
    from sidelong_service.artifacts import write_whole

    with plain_errors():
        x, _, y = squares.partition("x")
        about = {"square_m": square_mm * 1e-3, "marker_m": marker_mm * 1e-3, "dictionary": dictionary}
        try:
            board = BoardSettings.model_validate({"squares_x": int(x), "squares_y": int(y), **about})
        except ValidationError as error:
            raise CommandError(first_fields(error)) from error
        except ValueError as error:
            raise CommandError(f"--squares: {squares!r:.40} is not like 11x8") from error
        write_whole(folder / "board.png", board_png(board))
        write_whole(folder / "board.json", board.model_dump_json(indent=1).encode())
        for name in ("board.png", "board.json"):
            out.print(f"  {folder / name}", highlight=False, markup=False, soft_wrap=True)
        out.print(
            "print at 100 %, then measure it: an error of scale moves the camera by that share",
            highlight=False,
        )


def _record(
    config: Path | None,
    root: Path,
    object_name: str | None,
    view: str | None,
    take: Callable[[Recorder], tuple[Path, ...]],
) -> None:
    from sidelong.commissioning.recording import Recorder
    from sidelong_service.local import devices_at
    from sidelong_service.settings import NAME_PATTERN, load_settings

    if object_name is not None and not re.fullmatch(NAME_PATTERN, object_name):
        raise CommandError(f"--object: {object_name!r:.80} is no name of an object")
    with devices_at(load_settings(config).cell, view) as (camera, base_T_flange, base_T_camera):
        for file in take(Recorder(camera, base_T_flange, base_T_camera, root, object_name)):
            out.print(f"  {file}", highlight=False, markup=False, soft_wrap=True)


def _exposures_s(text: str) -> list[float]:
    """Read milliseconds divided by commas. Raises CommandError."""
    exposures: list[float] = []
    for each in filter(None, (part.strip() for part in text.split(","))):
        try:
            exposures.append(float(each) * 1e-3)
        except ValueError as error:
            raise CommandError(f"--exposures-ms: {each!r:.40} is no number") from error
    exposures = list(dict.fromkeys(exposures))
    if not exposures:
        raise CommandError(f"--exposures-ms: {text!r:.40} names none, needs at least one")
    return exposures
