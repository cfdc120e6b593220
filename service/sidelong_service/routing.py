"""What routes share: the service they work with, bodies read as strict JSON, and how answers are documented."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from typing import Annotated, Any, TypeVar, cast

from fastapi import Depends, Header, Query, Request
from pydantic import BaseModel, ValidationError

from sidelong_service.calibration_store import CalibrationStore
from sidelong_service.problems import MEDIA_TYPE, ServiceError, problem, validation_problem
from sidelong_service.settings import ServiceSettings
from sidelong_service.storage_thread import StorageThread
from sidelong_service.supervisor import Supervisor

LARGEST_BODY = 256 * 1024

PROBLEM: dict[str, Any] = {
    "description": "A problem",
    "content": {MEDIA_TYPE: {"schema": {"$ref": "#/components/schemas/Problem"}}},
}
EVENTS: dict[str, Any] = {
    "description": "Server-sent events: id, event (its kind) and data (the event as JSON)",
    "content": {"text/event-stream": {"schema": {"type": "string"}}},
}

Body = TypeVar("Body", bound=BaseModel)
Cursor = Annotated[int | None, Query(ge=1, lt=2**63)]
LastEvent = Annotated[int, Header(alias="last-event-id", ge=0, lt=2**63)]


@dataclass(frozen=True, eq=False)
class Service:
    """What the routes work with."""

    settings: ServiceSettings
    storage: StorageThread
    calibrations: CalibrationStore
    supervisor: Supervisor
    loop: asyncio.AbstractEventLoop


def service_of(request: Request) -> Service:
    """Return what the lifespan made."""
    return cast("Service", request.app.state.service)


TheService = Annotated[Service, Depends(service_of)]


def body_of(model: type[Body]) -> Callable[[Request], Awaitable[Body]]:
    """Return what reads a body as strict JSON: NaN, 1e999, booleans for numbers and unknown fields are errors."""

    async def read(request: Request) -> Body:
        media_type = request.headers.get("content-type", "").partition(";")[0].strip().lower()
        if media_type != "application/json":
            raise ServiceError(problem("media-type", f"The body's media type is {media_type or 'not given'!r}."))
        body = bytearray()
        async for chunk in request.stream():
            body += chunk
            if len(body) > LARGEST_BODY:
                raise ServiceError(problem("too-large", f"The body has more than {LARGEST_BODY} bytes."))
        try:
            return model.model_validate_json(bytes(body))
        except ValidationError as error:
            raise ServiceError(validation_problem(cast("Any", error.errors()))) from error

    return read


def described_body(model: type[BaseModel]) -> dict[str, Any]:
    """Return what tells the OpenAPI document of a body that ``body_of`` reads."""
    schema = {"$ref": f"#/components/schemas/{model.__name__}"}
    return {"requestBody": {"required": True, "content": {"application/json": {"schema": schema}}}}


def documented(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return the documentation of problems a route may answer with."""
    return dict.fromkeys(statuses, PROBLEM)
