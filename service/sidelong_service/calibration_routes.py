"""Routes of calibrations: jobs that make them, and the files they have made."""

from __future__ import annotations

import asyncio
from typing import Annotated, Any

from fastapi import Depends, FastAPI, Response
from fastapi.responses import FileResponse
from sse_starlette import EventSourceResponse

from sidelong.commissioning.documents import to_json
from sidelong_service.answers import ArtifactFile
from sidelong_service.events import PING_S, follow, sse
from sidelong_service.models import CalibrationJob, CalibrationList, CalibrationRequest, JobList, Limit
from sidelong_service.problems import ServiceError, problem
from sidelong_service.routing import EVENTS, Cursor, LastEvent, TheService, body_of, described_body, documented
from sidelong_service.storage import Storage

_DOCUMENT: dict[str, Any] = {"description": "The calibration file", "content": {"application/json": {}}}
_PICTURE: dict[str, Any] = {"description": "What a person can judge it by", "content": {"image/png": {}}}


async def found_job(job_id: str, service: TheService) -> CalibrationJob:
    """Return the job of the path."""
    job = await service.storage.call(Storage.job, job_id)
    if job is None:
        raise ServiceError(problem("not-found", f"There is no job {job_id!r:.80}."))
    return job


FoundJob = Annotated[CalibrationJob, Depends(found_job)]


def add_calibration_routes(app: FastAPI) -> None:
    """Add the routes of jobs and of calibration files."""
    _add_job_routes(app)
    _add_file_routes(app)


def _add_job_routes(app: FastAPI) -> None:
    @app.post(
        "/v1/jobs",
        status_code=202,
        response_model=CalibrationJob,
        responses=documented(404, 409, 413, 415, 422, 503),
        openapi_extra=described_body(CalibrationRequest),
    )
    async def start_job(
        wanted: Annotated[CalibrationRequest, Depends(body_of(CalibrationRequest))],
        service: TheService,
        response: Response,
    ) -> CalibrationJob | None:
        """Accept a calibration; it is made by itself, its course is told under the Location."""
        job_id = await service.supervisor.submit(wanted)
        response.headers["Location"] = f"/v1/jobs/{job_id}"
        return await service.storage.call(Storage.job, job_id)

    @app.get("/v1/jobs", response_model=JobList, responses=documented(422))
    async def list_jobs(service: TheService, limit: Limit = 50, cursor: Cursor = None) -> JobList:
        """List jobs, newest first."""
        return await service.storage.call(Storage.jobs, limit, cursor)

    @app.get("/v1/jobs/{job_id}", response_model=CalibrationJob, responses=documented(404))
    async def show_job(job: FoundJob) -> CalibrationJob:
        """Show a job with the calibrations it has made."""
        return job

    @app.get(
        "/v1/jobs/{job_id}/events",
        response_class=EventSourceResponse,
        responses={200: EVENTS, **documented(404, 422)},
    )
    async def follow_job(job: FoundJob, service: TheService, last_event_id: LastEvent = 0) -> EventSourceResponse:
        """Tell the course of a job, from the start or after ``Last-Event-ID``, until it has ended."""
        events = follow(service.storage, service.supervisor.bulletin, job.id, last_event_id)
        return EventSourceResponse((sse(event) async for event in events), ping=PING_S)

    @app.post(
        "/v1/jobs/{job_id}/cancel",
        status_code=202,
        response_model=CalibrationJob,
        responses=documented(404),
    )
    async def cancel_job(job: FoundJob, service: TheService) -> CalibrationJob:
        """Ask a job to end; harmless when repeated, or after its end."""
        service.supervisor.cancel(job.id)
        return job


def _add_file_routes(app: FastAPI) -> None:
    @app.get("/v1/calibrations", response_model=CalibrationList)
    async def list_calibrations(service: TheService) -> CalibrationList:
        """List the calibration files, newest first."""
        return await asyncio.to_thread(service.calibrations.listed)

    @app.get(
        "/v1/calibrations/{calibration_id}",
        response_class=Response,
        responses={200: _DOCUMENT, **documented(404, 422)},
    )
    async def read_calibration(calibration_id: str, service: TheService) -> Response:
        """Read a calibration file."""
        document = await asyncio.to_thread(service.calibrations.read, calibration_id)
        return Response(to_json(document), media_type="application/json")

    @app.get(
        "/v1/calibrations/{calibration_id}/picture",
        response_class=FileResponse,
        responses={200: _PICTURE, **documented(404, 422)},
    )
    async def read_picture(calibration_id: str, service: TheService) -> FileResponse:
        """Read the picture of a calibration."""
        path = await asyncio.to_thread(service.calibrations.picture, calibration_id)
        return ArtifactFile(path, media_type="image/png", headers={"X-Content-Type-Options": "nosniff"})
