"""From what a request names to what a worker can do: data sets by their id, calibrations by theirs."""

from __future__ import annotations

from pathlib import Path

from sidelong.errors import UnknownNameError
from sidelong_service.messages import CapturesJob, CellJob, Job, RecordingJob, ScanJob
from sidelong_service.models import CalibrationRequest, ScanRequest
from sidelong_service.settings import ServiceSettings


def job_of(request: ScanRequest | CalibrationRequest, settings: ServiceSettings) -> Job:
    """Return the job of a request. Raises UnknownNameError where it names no configured data set."""
    return scan_job(request, settings) if isinstance(request, ScanRequest) else captures_job(request, settings)


def scan_job(request: ScanRequest, settings: ServiceSettings) -> ScanJob:
    """Return the job of a scan. Raises UnknownNameError where it names no configured data set."""
    recording = request.recording
    if recording is None:
        return CellJob(cell=settings.cell, part=request.part or "")
    root = _data_set(recording.dataset, settings)
    return RecordingJob(
        root=root, object=recording.object, scene=recording.scene, reference=recording.reference
    )  # fmt: skip


def captures_job(request: CalibrationRequest, settings: ServiceSettings) -> CapturesJob:
    """Return the job of a calibration. Raises UnknownNameError where it names no configured data set."""
    return CapturesJob(root=_data_set(request.dataset, settings), object=request.object, task=request.task)


def _data_set(name: str, settings: ServiceSettings) -> Path:
    root = settings.datasets.get(name)
    if root is None:
        known = ", ".join(sorted(settings.datasets)) or "none"
        raise UnknownNameError(f"dataset: {name!r} is unknown, known are {known}")
    return root.resolve()
