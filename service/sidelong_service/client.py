"""A typed client of the HTTP interface."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self, TypeVar

import httpx
from pydantic import BaseModel, ValidationError

from sidelong_service.models import (
    Artifact,
    ArtifactList,
    CalibrationJob,
    CalibrationList,
    CalibrationRequest,
    CellReport,
    JobEvent,
    Readiness,
    Scan,
    ScanEvent,
    ScanList,
    ScanRequest,
    StopReport,
)
from sidelong_service.problems import Problem

Answer = TypeVar("Answer", bound=BaseModel)

CONNECT_S = 5.0
READ_S = 60.0
"""Longer than the event stream is ever silent."""


class ClientError(Exception):
    """The service cannot be reached, or answers what this client does not understand."""


class ProblemError(ClientError):
    """The service answered with a problem."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(f"{problem.title}: {problem.detail}")
        self.problem = problem


class SidelongClient:
    """Talks to one service. A context manager.

    Parameters
    ----------
    url
        Of the service, such as ``http://127.0.0.1:8000``.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        self._http = httpx.Client(base_url=url, timeout=httpx.Timeout(READ_S, connect=CONNECT_S))

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def start(self, request: ScanRequest) -> Scan:
        """Start a scan. Raises ProblemError where it is not accepted."""
        content = request.model_dump_json(exclude_unset=True)
        headers = {"Content-Type": "application/json"}
        return self._ask(Scan, "POST", "/v1/scans", content=content, headers=headers)

    def scan(self, scan_id: str) -> Scan:
        """Return a scan."""
        return self._ask(Scan, "GET", f"/v1/scans/{scan_id}")

    def scans(self, limit: int = 50, cursor: int | None = None) -> ScanList:
        """Return the newest scans, or those before a cursor."""
        query = {"limit": limit} | ({} if cursor is None else {"cursor": cursor})
        return self._ask(ScanList, "GET", "/v1/scans", params=query)

    def events(self, scan_id: str, after: int = 0) -> Iterator[ScanEvent]:
        """Yield the events of a scan after the given one, as they come, until it has ended."""
        yield from (ScanEvent.model_validate(event) for event in self._stream(f"/v1/scans/{scan_id}/events", after))

    def artifacts(self, scan_id: str) -> tuple[Artifact, ...]:
        """Return the names of a scan's files."""
        return self._ask(ArtifactList, "GET", f"/v1/scans/{scan_id}/artifacts").artifacts

    def download(self, scan_id: str, name: str, folder: Path) -> Path:
        """Fetch a file of a scan into a folder and return its path."""
        return self._fetch(f"/v1/scans/{scan_id}/artifacts/{name}", folder / name)

    def start_job(self, request: CalibrationRequest) -> CalibrationJob:
        """Start a calibration. Raises ProblemError where it is not accepted."""
        content = request.model_dump_json(exclude_unset=True)
        headers = {"Content-Type": "application/json"}
        return self._ask(CalibrationJob, "POST", "/v1/jobs", content=content, headers=headers)

    def job(self, job_id: str) -> CalibrationJob:
        """Return a calibration job."""
        return self._ask(CalibrationJob, "GET", f"/v1/jobs/{job_id}")

    def job_events(self, job_id: str, after: int = 0) -> Iterator[JobEvent]:
        """Yield the events of a job after the given one, as they come, until it has ended."""
        yield from (JobEvent.model_validate(event) for event in self._stream(f"/v1/jobs/{job_id}/events", after))

    def cancel_job(self, job_id: str) -> CalibrationJob:
        """Ask a job to end."""
        return self._ask(CalibrationJob, "POST", f"/v1/jobs/{job_id}/cancel")

    def calibrations(self) -> CalibrationList:
        """Return what calibrations there are, newest first."""
        return self._ask(CalibrationList, "GET", "/v1/calibrations")

    def download_calibration(self, calibration_id: str, folder: Path) -> tuple[Path, Path]:
        """Fetch a calibration file and its picture into a folder and return their paths."""
        path = f"/v1/calibrations/{calibration_id}"
        return (
            self._fetch(path, folder / f"{calibration_id}.json"),
            self._fetch(f"{path}/picture", folder / f"{calibration_id}.png"),
        )

    def stop(self) -> StopReport:
        """Stop the arm and the active scan. Raises ProblemError where the arm did not confirm."""
        return self._ask(StopReport, "POST", "/v1/cell/stop")

    def cell(self) -> CellReport:
        """Return the state of the cell."""
        return self._ask(CellReport, "GET", "/v1/cell")

    def wait_until_ready(self, timeout_s: float) -> Readiness:
        """Return when the service has all it needs. Raises ClientError, which says what it lacks, after the time."""
        deadline_s = time.monotonic() + timeout_s
        lacking = "no answer"
        while time.monotonic() < deadline_s:
            try:
                response = self._http.get("/readyz")
                readiness = Readiness.model_validate_json(response.content)
            except (httpx.HTTPError, ValidationError):
                time.sleep(0.05)
                continue
            if readiness.ready:
                return readiness
            lacking = f"arm: {readiness.arm}, worker: {readiness.worker}, storage: {readiness.storage}"
            time.sleep(0.05)
        raise ClientError(f"{self._url}: the service is not ready after {timeout_s:g} s ({lacking})")

    def _stream(self, path: str, after: int) -> Iterator[Any]:
        try:
            with self._http.stream("GET", path, headers={"Last-Event-ID": str(after)}) as response:
                if response.is_error:
                    response.read()
                    raise self._error(response)
                for line in response.iter_lines():
                    if line.startswith("data:"):
                        yield json.loads(line.removeprefix("data:"))
        except httpx.HTTPError as error:
            raise self._unreachable(error) from error

    def _fetch(self, path: str, target: Path) -> Path:
        response = self._send("GET", path)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(response.content)
        return target

    def _ask(self, kind: type[Answer], method: str, path: str, **options: Any) -> Answer:
        response = self._send(method, path, **options)
        try:
            return kind.model_validate_json(response.content)
        except ValidationError as error:
            raise ClientError(f"{self._url}: {path} answered what this client does not understand") from error

    def _send(self, method: str, path: str, **options: Any) -> httpx.Response:
        try:
            response = self._http.request(method, path, **options)
        except httpx.HTTPError as error:
            raise self._unreachable(error) from error
        if response.is_error:
            raise self._error(response)
        return response

    def _error(self, response: httpx.Response) -> ClientError:
        try:
            return ProblemError(Problem.model_validate_json(response.content))
        except ValidationError:
            return ClientError(f"{self._url}: answered {response.status_code} without a problem document")

    def _unreachable(self, error: httpx.HTTPError) -> ClientError:
        return ClientError(f"{self._url}: cannot be reached: {error or type(error).__name__}")
