"""What a task works with, and what it gives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from sidelong.calibration.reflectance.result import Parameter as FittedParameter
from sidelong.commissioning.applied import calibrated
from sidelong.commissioning.documents import Document, InputFile, Parameter, hashed
from sidelong.recipe import Recipe
from sidelong.recorded.captures import CalibrationCaptures
from sidelong.recorded.dataset import Dataset

Progress: TypeAlias = Callable[[str, int, int], None]
"""Called with (work, done, total)."""


@dataclass(frozen=True, eq=False)
class Captures:
    """Where captures are, and what is known already.

    Attributes
    ----------
    dataset
        The recorded data.
    object
        Whose captures are looked for first; None for those of the device.
    recipe
        Light and sensing where no calibration tells.
    documents
        Calibrations to build on.
    """

    dataset: Dataset
    object: str | None
    recipe: Recipe
    documents: tuple[Document, ...]

    @property
    def recorded(self) -> CalibrationCaptures:
        """Reads the captures."""
        return CalibrationCaptures(self.dataset, self.object)

    def settings(self) -> Recipe:
        """Return the recipe with the calibrations in it. Raises CalibrationError."""
        return calibrated(self.recipe, self.documents, self.dataset.serial)

    def used(self, *kinds: str) -> tuple[str, ...]:
        """Return the ids of those calibrations that are of some kinds."""
        return tuple(document.id for document in self.documents if document.kind in kinds)

    def hashed(self, files: tuple[Path, ...]) -> tuple[InputFile, ...]:
        """Return names and hashes of files."""
        return hashed(files, self.dataset.root)


@dataclass(frozen=True, eq=False)
class Made:
    """A calibration: its document, a picture (PNG) a person can judge it by, and one line that sums it up."""

    document: Document
    picture: bytes
    summary: str


def parameter(fitted: FittedParameter) -> Parameter:
    """Return a fitted parameter as a calibration file has it."""
    return Parameter(
        value=fitted.value,
        standard_error=fitted.standard_error if fitted.identified else None,
        low=fitted.low,
        high=fitted.high,
        identifiable=fitted.identified,
        note=fitted.note or None,
    )
