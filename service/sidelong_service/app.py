"""The HTTP interface. This process imports neither open3d nor a vendor's client: see the README's map."""

from __future__ import annotations

import asyncio
import json
import logging
import sqlite3
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Annotated, Any
from uuid import uuid4

from fastapi import Depends, FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.openapi.utils import get_openapi
from fastapi.responses import FileResponse
from sse_starlette import EventSourceResponse
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from sidelong.errors import SidelongError
from sidelong_service.answers import ArtifactFile, LocalHosts, answer
from sidelong_service.calibration_routes import add_calibration_routes
from sidelong_service.calibration_store import CalibrationStore
from sidelong_service.events import PING_S, follow, sse
from sidelong_service.models import (
    Artifact,
    ArtifactList,
    CalibrationRequest,
    CellReport,
    JobEvent,
    Limit,
    Readiness,
    Scan,
    ScanEvent,
    ScanList,
    ScanRequest,
    StopReport,
)
from sidelong_service.problems import Problem, ServiceError, problem, problem_of, validation_problem
from sidelong_service.routing import (
    EVENTS,
    PROBLEM,
    Cursor,
    LastEvent,
    Service,
    TheService,
    body_of,
    described_body,
    documented,
)
from sidelong_service.settings import ServiceSettings
from sidelong_service.storage import Storage
from sidelong_service.storage_thread import StorageThread
from sidelong_service.supervisor import Supervisor

log = logging.getLogger(__name__)

DATABASE = "sidelong.sqlite"

_FILE: dict[str, Any] = {
    "description": "The file; a part of it where a Range was asked for",
    "content": {media_type: {} for media_type in ("application/json", "application/octet-stream", "image/png")},
}


def create_app(settings: ServiceSettings) -> FastAPI:
    """Return the application; its lifespan starts and ends the other processes."""

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncGenerator[None]:
        storage = StorageThread(settings.data_dir / DATABASE)
        await storage.open()
        calibrations = CalibrationStore(settings.data_dir / "calibrations")
        supervisor = Supervisor(settings, storage, calibrations, new_id=lambda: uuid4().hex)
        app.state.service = Service(settings, storage, calibrations, supervisor, asyncio.get_running_loop())
        await supervisor.start()
        try:
            yield
        finally:
            await supervisor.close()
            await storage.close()

    app = FastAPI(
        title="sidelong",
        version="1",
        summary="Next-best-view depth completion for shiny parts",
        lifespan=lifespan,
        # the usual pages load scripts from other hosts
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
    )
    app.add_middleware(LocalHosts, host=settings.host)
    _add_scan_routes(app)
    _add_cell_routes(app)
    add_calibration_routes(app)
    _add_problem_handlers(app)
    app.openapi = lambda: _openapi(app)
    return app


async def found_scan(scan_id: str, service: TheService) -> Scan:
    """Return the scan of the path."""
    scan = await service.storage.call(Storage.scan, scan_id)
    if scan is None:
        raise ServiceError(problem("not-found", f"There is no scan {scan_id!r:.80}."))
    return scan


FoundScan = Annotated[Scan, Depends(found_scan)]


def _add_scan_routes(app: FastAPI) -> None:
    @app.post(
        "/v1/scans",
        status_code=202,
        response_model=Scan,
        responses=documented(404, 409, 413, 415, 422, 503),
        openapi_extra=described_body(ScanRequest),
    )
    async def start_scan(
        wanted: Annotated[ScanRequest, Depends(body_of(ScanRequest))], service: TheService, response: Response
    ) -> Scan | None:
        """Accept a scan; it runs by itself, its course is told under the Location."""
        scan_id = await service.supervisor.submit(wanted)
        response.headers["Location"] = f"/v1/scans/{scan_id}"
        return await service.storage.call(Storage.scan, scan_id)

    @app.get("/v1/scans", response_model=ScanList, responses=documented(422))
    async def list_scans(
        service: TheService,
        limit: Limit = 50,
        cursor: Cursor = None,
    ) -> ScanList:
        """List scans, newest first."""
        return await service.storage.call(Storage.scans, limit, cursor)

    @app.get("/v1/scans/{scan_id}", response_model=Scan, responses=documented(404))
    async def show_scan(scan: FoundScan) -> Scan:
        """Show a scan with its views so far."""
        return scan

    @app.get(
        "/v1/scans/{scan_id}/events",
        response_class=EventSourceResponse,
        responses={200: EVENTS, **documented(404, 422)},
    )
    async def follow_scan(
        scan: FoundScan,
        service: TheService,
        last_event_id: LastEvent = 0,
    ) -> EventSourceResponse:
        """Tell the course of a scan, from the start or after ``Last-Event-ID``, until it has ended."""
        events = follow(service.storage, service.supervisor.bulletin, scan.id, last_event_id)
        return EventSourceResponse((sse(event) async for event in events), ping=PING_S)

    @app.get("/v1/scans/{scan_id}/artifacts", response_model=ArtifactList, responses=documented(404))
    async def list_artifacts(scan: FoundScan) -> ArtifactList:
        """List the files of a scan."""
        return ArtifactList(artifacts=scan.artifacts)

    @app.get(
        "/v1/scans/{scan_id}/artifacts/{name}",
        response_class=FileResponse,
        responses={200: _FILE, 206: _FILE, **documented(400, 404, 416)},
    )
    async def read_artifact(scan: FoundScan, name: str, service: TheService) -> FileResponse:
        """Read a file of a scan."""
        artifact = next((artifact for artifact in scan.artifacts if artifact.name == name), None)
        if artifact is None:
            raise ServiceError(problem("not-found", f"Scan {scan.id} has no file {name!r:.80}.", scan_id=scan.id))
        path = service.settings.data_dir / "scans" / scan.id / artifact.name
        _check_file(path, artifact, scan.id)
        headers = {"ETag": f'"{artifact.sha256}"', "X-Content-Type-Options": "nosniff"}
        return ArtifactFile(path, media_type=artifact.media_type, headers=headers)


def _check_file(path: Path, artifact: Artifact, scan_id: str) -> None:
    """Refuse a file that somebody removed or changed since the scan wrote it."""
    size_bytes = path.stat().st_size if path.is_file() and not path.is_symlink() else 0
    if size_bytes != artifact.size_bytes:
        trouble = f"File {artifact.name} of scan {scan_id} was removed or changed in the data directory"
        sizes = f"{size_bytes} bytes, {artifact.size_bytes} were written"
        raise ServiceError(problem("not-found", f"{trouble}: {sizes}.", scan_id=scan_id))


def _add_cell_routes(app: FastAPI) -> None:
    @app.get("/v1/cell", response_model=CellReport)
    async def show_cell(service: TheService) -> CellReport:
        """Show the cell, and whether a scan may start now."""
        return service.supervisor.cell()

    @app.post("/v1/cell/stop", response_model=StopReport, responses=documented(504))
    async def stop_cell(service: TheService) -> StopReport:
        """Stop the arm at once, and the active scan; harmless when repeated."""
        return StopReport(scan=await service.supervisor.stop())

    @app.get("/livez")
    async def live() -> dict[str, str]:
        """Say that the process answers."""
        return {"status": "alive"}

    @app.get("/readyz", response_model=Readiness, responses={503: {"model": Readiness}})
    async def ready(service: TheService, response: Response) -> Readiness:
        """Say whether a scan has all it needs."""
        readiness = await service.supervisor.readiness()
        response.status_code = 200 if readiness.ready else 503
        return readiness


def _add_problem_handlers(app: FastAPI) -> None:
    @app.exception_handler(ServiceError)
    async def on_service_error(_request: Request, error: ServiceError) -> Response:
        return answer(error.problem)

    @app.exception_handler(SidelongError)
    async def on_planner_error(_request: Request, error: SidelongError) -> Response:
        return answer(problem_of(error))

    @app.exception_handler(RequestValidationError)
    async def on_validation_error(_request: Request, error: RequestValidationError) -> Response:
        return answer(validation_problem(error.errors()))

    @app.exception_handler(HTTPException)
    async def on_http_error(request: Request, error: HTTPException) -> Response:
        kinds = {404: "not-found", 405: "method-not-allowed"}
        kind = kinds.get(error.status_code, "bad-request")
        return answer(problem(kind, f"{request.method} {request.url.path:.200}"), error.headers)

    @app.exception_handler(sqlite3.Error)
    async def on_storage_error(_request: Request, error: sqlite3.Error) -> Response:
        log.error("the database: %s", error)
        return answer(problem_of(error))

    @app.exception_handler(ClientDisconnect)
    async def on_disconnect(_request: Request, _error: ClientDisconnect) -> Response:
        # nobody hears it: the caller went before its body was here
        return answer(problem("bad-request", "The body ended early."))

    @app.exception_handler(Exception)
    async def on_unexpected_error(_request: Request, _error: Exception) -> Response:
        # the server logs the trace; the caller learns nothing of what is inside
        return answer(problem("internal", "An unexpected error; the service's log has its trace."))


def _openapi(app: FastAPI) -> dict[str, Any]:
    """Return the document with the models that the routes read and answer by themselves."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
        schemas = document.setdefault("components", {}).setdefault("schemas", {})
        for model in (ScanRequest, ScanEvent, CalibrationRequest, JobEvent, Problem):
            schema = model.model_json_schema(ref_template="#/components/schemas/{model}")
            schemas.update(schema.pop("$defs", {}))
            schemas[model.__name__] = schema
        _correct_responses(document)
        app.openapi_schema = json.loads(json.dumps(document))
    return app.openapi_schema or {}


def _correct_responses(document: dict[str, Any]) -> None:
    """Take out FastAPI's own validation error, which is never sent; any other status comes with a problem."""
    for operations in document["paths"].values():
        for operation in operations.values():
            responses = operation["responses"]
            if "HTTPValidationError" in json.dumps(responses.get("422")):
                del responses["422"]
            responses["default"] = PROBLEM
    for name in ("HTTPValidationError", "ValidationError"):
        document["components"]["schemas"].pop(name, None)
