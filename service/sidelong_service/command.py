"""What all commands share: where they print, how they fail, and the options they have in common."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from pydantic import ValidationError
from rich.console import Console
from rich.markup import escape

from sidelong.commissioning.documents import Document, read_document
from sidelong.errors import SidelongError
from sidelong.recipe import Recipe
from sidelong_service.client import ClientError
from sidelong_service.problems import validation_problem

out = Console()
err = Console(stderr=True)

RecipeFile = Annotated[Path | None, typer.Option("--recipe", help="JSON file with settings of the scan.")]
ConfigFile = Annotated[Path | None, typer.Option("--config", help="YAML file with settings of the service.")]
Calibrations = Annotated[
    list[str] | None,
    typer.Option("--calibration", help="Calibration file to use, with --url also an id; may be repeated."),
]


class CommandError(Exception):
    """A command cannot do what it was asked for; the message says why."""


@contextmanager
def plain_errors() -> Generator[None]:
    """Show expected errors as one line and exit with 1."""
    try:
        yield
    except (CommandError, ClientError, SidelongError, OSError) as error:
        # paths may hold what rich takes for markup
        err.print("[bold red]error[/]:", escape(str(error)), highlight=False, soft_wrap=True)
        raise typer.Exit(1) from error


def recipe_of(file: Path | None, calibrations: Sequence[str] = ()) -> Recipe:
    """Read a recipe, the default one where there is no file, and name calibrations in it. Raises CommandError."""
    try:
        recipe = Recipe() if file is None else Recipe.model_validate_json(file.read_bytes())
    except ValidationError as error:
        raise CommandError(f"{file}: {first_fields(error)}") from error
    named = tuple(dict.fromkeys((*recipe.calibrations, *calibrations)))
    return recipe.model_copy(update={"calibrations": named})


def first_fields(error: ValidationError) -> str:
    """Return what is wrong with the first fields, in one line."""
    return validation_problem([dict(each) for each in error.errors()]).detail


def documents_of(given: Sequence[str] | None) -> tuple[Document, ...]:
    """Read calibration files. Raises CalibrationError."""
    return tuple(read_document(Path(each)) for each in given or ())


def ids_of(given: Sequence[str] | None) -> tuple[str, ...]:
    """Return ids of calibrations, those of files read from them. Raises CalibrationError."""
    return tuple(read_document(Path(each)).id if Path(each).is_file() else each for each in given or ())
