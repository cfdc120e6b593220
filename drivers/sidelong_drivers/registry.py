"""Drivers by name: entry points ``sidelong.cameras`` and ``sidelong.arms``, those of other packages included."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Any

from pydantic import ValidationError

from sidelong.devices import Arm, Camera
from sidelong.errors import DeviceUnavailableError, SettingsError, UnknownNameError

CAMERAS, ARMS = "sidelong.cameras", "sidelong.arms"


def create_camera(name: str, settings: Mapping[str, Any]) -> Camera:
    """Return the named camera, not yet open.

    Raises
    ------
    UnknownNameError
        No driver has this name.
    SettingsError
        A setting is unknown or out of its range.
    DeviceUnavailableError
        The driver's code cannot be imported.
    """
    return _create("camera", CAMERAS, name, settings)


def create_arm(name: str, settings: Mapping[str, Any]) -> Arm:
    """Return the named arm, not yet open. Raises as ``create_camera``."""
    return _create("arm", ARMS, name, settings)


def _create(kind: str, group: str, name: str, settings: Mapping[str, Any]) -> Any:
    found = entry_points(group=group)
    if name not in found.names:
        known = ", ".join(sorted(found.names)) or "none"
        raise UnknownNameError(f"{kind} driver: {name!r} is unknown, known are {known}")
    try:
        driver: Any = found[name].load()
    except ImportError as error:
        raise DeviceUnavailableError(f"{kind} driver {name!r}", f"cannot be imported: {error}") from error
    try:
        return driver(driver.Settings.model_validate(dict(settings)))
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(str(part) for part in first["loc"]) or "settings"
        raise SettingsError(f"{kind} driver {name!r}: {field}: {first['msg']}, got {first['input']!r:.80}") from error
