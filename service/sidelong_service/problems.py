"""Errors as RFC 9457 problem documents: in HTTP answers, and in scans that failed after they were accepted.

``KINDS`` is the whole table. ``type`` and ``code`` are stable: controllers branch on them, people read the rest.
"""

from __future__ import annotations

import errno
import sqlite3
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from pydantic import BaseModel, ConfigDict

from sidelong import errors

TYPE_PREFIX = "urn:sidelong:problem:"
MEDIA_TYPE = "application/problem+json"
LONGEST_VALUE = 80


@dataclass(frozen=True)
class Kind:
    """One row of the table: what is the same for all problems of this kind."""

    status: int
    code: int
    title: str
    retryable: bool
    operator_action: str


_NOTHING = "None; correct the request."
KINDS: Mapping[str, Kind] = MappingProxyType(
    {
        "bad-request": Kind(400, 1000, "The request cannot be read", False, _NOTHING),
        "validation": Kind(422, 1001, "A field is not valid", False, _NOTHING),
        "not-found": Kind(404, 1002, "There is no such resource", False, _NOTHING),
        "unknown-name": Kind(404, 1003, "There is no such data set, part, driver, scene or view", False, _NOTHING),
        "method-not-allowed": Kind(405, 1004, "The resource has no such method", False, _NOTHING),
        "too-large": Kind(413, 1005, "The request body is too large", False, _NOTHING),
        "media-type": Kind(415, 1006, "The request body must be application/json", False, _NOTHING),
        "host": Kind(421, 1007, "This service does not answer for that host name", False, _NOTHING),
        "range": Kind(416, 1008, "The range lies outside the file", False, _NOTHING),
        "settings": Kind(422, 1101, "A setting is out of its range", False, "Correct the recipe or the configuration."),
        "dataset": Kind(422, 1102, "The data set breaks its layout", False, "Repair or copy the data set again."),
        "image": Kind(422, 1103, "An image is missing or damaged", False, "Repair or copy the data set again."),
        "depth": Kind(422, 1104, "A depth map carries no measurement", False, "Check exposure, distance and target."),
        "pose": Kind(422, 1105, "A transform is not a rigid motion", False, "Repair the file or setting it names."),
        "mesh": Kind(422, 1106, "The CAD model cannot be used", False, "Export the CAD model again, closed, in mm."),
        "calibration": Kind(422, 1107, "The calibration cannot be made or used", False, "Follow what the detail says."),
        "cell-busy": Kind(409, 2001, "Another scan or job is active", True, "Wait for it to end, or stop it."),
        "not-ready": Kind(503, 2002, "The cell is not ready", True, "See the reasons; check the devices."),
        "detection": Kind(500, 3001, "The template matcher could not answer", False, "Report it with the scan's id."),
        "matcher-died": Kind(500, 3002, "The template matcher died or hung", True, "Start the scan again."),
        "device": Kind(503, 4000, "A device failed", True, "Check the device it names."),
        "device-unavailable": Kind(503, 4001, "A device cannot be opened", True, "Check its power and connection."),
        "device-timeout": Kind(504, 4002, "A device missed its deadline", True, "Check the device; start again."),
        "device-lost": Kind(503, 4003, "A device stopped answering", True, "Check its connection; start again."),
        "motion-refused": Kind(422, 4004, "A target is outside the limits", False, "Check limits and viewpoints."),
        "motion-stopped": Kind(409, 4005, "The motion was stopped", True, "Find out why; start again when it is safe."),
        "stop-unconfirmed": Kind(504, 4006, "The arm did not confirm the stop", True, "Press the emergency stop."),
        "internal": Kind(500, 5000, "Unexpected error", False, "Report it with the time and the service's log."),
        "worker-died": Kind(500, 5001, "The scan's process died", True, "Start the scan again."),
        "service-restarted": Kind(500, 5002, "The service ended during the scan", True, "Start the scan again."),
        "storage": Kind(
            507, 5003, "The data directory cannot be used", True, "Free disk space, check the data directory."
        ),
    }
)

KIND_OF_ERROR: Mapping[type[BaseException], str] = MappingProxyType(
    {
        errors.SettingsError: "settings",
        errors.UnknownNameError: "unknown-name",
        errors.DatasetError: "dataset",
        errors.ImageError: "image",
        errors.DepthError: "depth",
        errors.PoseError: "pose",
        errors.MeshError: "mesh",
        errors.CalibrationError: "calibration",
        errors.InputError: "validation",
        errors.MatcherDiedError: "matcher-died",
        errors.DetectionError: "detection",
        errors.DeviceUnavailableError: "device-unavailable",
        errors.DeviceTimeoutError: "device-timeout",
        errors.DeviceLostError: "device-lost",
        errors.MotionRefusedError: "motion-refused",
        errors.MotionStoppedError: "motion-stopped",
        errors.DeviceError: "device",
        OSError: "storage",
        sqlite3.Error: "storage",
    }
)


class FieldProblem(BaseModel):
    """What is wrong with one field: its path with dots, the value as text, the limit in the message."""

    model_config = ConfigDict(frozen=True)

    field: str
    message: str
    value: str | None = None


class Problem(BaseModel):
    """An RFC 9457 problem document.

    Attributes
    ----------
    type, title, status, detail
        As in RFC 9457; ``status`` is the status a request would have got, where a scan carries the problem.
    code
        Number for controllers that have no strings.
    retryable
        Whether the same request may succeed later, unchanged.
    operator_action
        What a person at the cell does next.
    scan_id, job_id, device, errors, reasons
        The scan, job, device, fields or conditions it is about, where there are any.
    """

    model_config = ConfigDict(frozen=True)

    type: str
    title: str
    status: int
    detail: str
    code: int
    retryable: bool
    operator_action: str
    scan_id: str | None = None
    job_id: str | None = None
    device: str | None = None
    errors: tuple[FieldProblem, ...] | None = None
    reasons: tuple[str, ...] | None = None


class ServiceError(Exception):
    """Carries a problem to the handler that answers with it."""

    def __init__(self, problem: Problem) -> None:
        super().__init__(f"{problem.title}: {problem.detail}")
        self.problem = problem


def problem(kind: str, detail: str, **extra: Any) -> Problem:
    """Return a problem of a kind in ``KINDS``."""
    row = KINDS[kind]
    return Problem(
        type=TYPE_PREFIX + kind,
        title=row.title,
        status=row.status,
        detail=detail,
        code=row.code,
        retryable=row.retryable,
        operator_action=row.operator_action,
        **extra,
    )


def problem_of(error: BaseException) -> Problem:
    """Return the problem that tells of an exception; of an unexpected one it says nothing but that it happened."""
    kind = next((KIND_OF_ERROR[base] for base in type(error).__mro__ if base in KIND_OF_ERROR), "internal")
    if kind == "internal":
        return problem(kind, "An unexpected error; the service's log has its trace.")
    if isinstance(error, OSError):
        name = errno.errorcode.get(error.errno or 0, type(error).__name__)
        return problem(kind, f"{error.filename or 'a file'}: {error.strerror or 'cannot be written'} ({name})")
    if isinstance(error, sqlite3.Error):
        return problem(kind, f"the database: {error}")
    return problem(kind, str(error), device=error.device if isinstance(error, errors.DeviceError) else None)


def validation_problem(found: Iterable[Mapping[str, Any]]) -> Problem:
    """Return the problem for pydantic's list of errors; values are shown as short text, NaN and all."""
    fields = tuple(_field_problem(error) for error in found)
    detail = "; ".join(_told(field) for field in fields[:3])
    more = f"; and {len(fields) - 3} more" if len(fields) > 3 else ""
    return problem("validation", detail + more, errors=fields)


def _told(field: FieldProblem) -> str:
    got = "" if field.value is None else f", got {field.value}"
    return f"{field.field}: {field.message}{got}"


def _field_problem(error: Mapping[str, Any]) -> FieldProblem:
    path = ".".join(str(part) for part in error["loc"]) or "body"
    value = error.get("input")
    # the whole body says nothing about one of its fields
    text = None if isinstance(value, dict | list | None) else repr(value)[:LONGEST_VALUE]
    return FieldProblem(field=path, message=error["msg"], value=text)
