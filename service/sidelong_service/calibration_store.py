"""Calibration files in a folder: ``<id>.json``, and ``<id>.png`` for people."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from sidelong.commissioning.documents import Document, MaterialDocument, read_document, to_json
from sidelong.errors import CalibrationError, UnknownNameError
from sidelong_service.artifacts import write_whole
from sidelong_service.models import CalibrationList, CalibrationSummary


class CalibrationStore:
    """The calibrations of a service. A file that is put there by hand is one of them.

    Parameters
    ----------
    folder
        Made when the first calibration is written.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def read(self, calibration_id: str) -> Document:
        """Return a calibration.

        Raises
        ------
        UnknownNameError
            There is none with this id.
        CalibrationError
            Its file cannot be used, or holds another one.
        """
        path = self.folder / f"{calibration_id}.json"
        # an id is no path
        if path.name != f"{calibration_id}.json" or not _is_file(path):
            raise UnknownNameError(f"calibration {calibration_id!r:.80} is unknown")
        document = read_document(path)
        if document.id != calibration_id:
            raise CalibrationError(f"{path}: holds calibration {document.id}")
        return document

    def read_all(self, calibration_ids: Sequence[str]) -> tuple[Document, ...]:
        """Return calibrations. Raises as ``read``."""
        return tuple(self.read(each) for each in calibration_ids)

    def listed(self) -> CalibrationList:
        """Return what there is, newest first; files that cannot be used come last, with the reason."""
        found = [self._summary(path.stem) for path in sorted(self.folder.glob("*.json")) if path.is_file()]
        good = [each for each in found if each.created_at is not None]
        good.sort(key=lambda each: each.created_at or 0, reverse=True)  # pyright: ignore[reportArgumentType, reportCallIssue]
        return CalibrationList(calibrations=(*good, *(each for each in found if each.created_at is None)))

    def add(self, document: Document, picture: bytes) -> None:
        """Write a calibration, its picture first: one that is listed is whole. Raises OSError."""
        write_whole(self.folder / f"{document.id}.png", picture)
        write_whole(self.folder / f"{document.id}.json", to_json(document))

    def picture(self, calibration_id: str) -> Path:
        """Return the file of a calibration's picture. Raises UnknownNameError."""
        path = self.folder / f"{self.read(calibration_id).id}.png"
        if not path.is_file():
            raise UnknownNameError(f"calibration {calibration_id} has no picture")
        return path

    def _summary(self, calibration_id: str) -> CalibrationSummary:
        try:
            document = self.read(calibration_id)
        except CalibrationError as error:
            return CalibrationSummary(
                id=calibration_id,
                kind=None,
                material=None,
                device_serial=None,
                created_at=None,
                warnings=(),
                trouble=str(error),
            )
        return CalibrationSummary(
            id=document.id,
            kind=document.kind,
            material=document.material if isinstance(document, MaterialDocument) else None,
            device_serial=document.device_serial,
            created_at=document.created_at,
            warnings=document.warnings,
        )


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except OSError:  # a name longer than any file's
        return False
