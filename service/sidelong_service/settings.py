"""Settings of the service: a YAML file, environment variables over it, and defaults that run a simulated cell.

``SIDELONG_DATA_DIR=/var/lib/sidelong`` sets a field, ``SIDELONG_CELL__ARM__DRIVER=mock`` a nested one.
"""

from __future__ import annotations

import ipaddress
import json
from pathlib import Path
from typing import Annotated, Any, cast

import yaml
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat, JsonValue, ValidationError
from pydantic_settings import (
    BaseSettings,
    InitSettingsSource,
    PydanticBaseSettingsSource,
    SettingsConfigDict,
)
from pydantic_settings import (
    SettingsError as SourceError,
)

from sidelong.errors import SettingsError
from sidelong.planning.candidates import DomeSettings

SIMULATED_PART = "tube_fitting"
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$"
Name = Annotated[str, Field(pattern=NAME_PATTERN)]
"""Names of parts, data sets, objects and views: never a path."""


def _dome_from_json(value: Any) -> Any:
    """Read the dome as JSON: its strict model takes a list for a tuple only from there, and YAML has no tuples."""
    return DomeSettings.model_validate_json(json.dumps(value)) if isinstance(value, dict) else value


class DriverSettings(BaseModel):
    """A device: the name of its driver, and the driver's own settings."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    driver: Annotated[str, Field(min_length=1, description="entry point in sidelong.cameras or sidelong.arms")]
    settings: dict[str, JsonValue] = Field(default_factory=dict[str, JsonValue], description="of the driver")


class CellSettings(BaseModel):
    """A camera on an arm, what it may look for, and from where. The defaults are the simulated cell."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = Field(default="simulated cell", description="for people")
    simulated: bool = Field(default=True, description="whether nothing real moves")
    camera: DriverSettings = DriverSettings(driver="simulated")
    arm: DriverSettings = DriverSettings(driver="mock")
    flange_T_camera: tuple[FiniteFloat, ...] = Field(
        default=(1, 0, 0, -0.05059195, 0, 1, 0, -0.06, 0, 0, 1, 0.05, 0, 0, 0, 1),
        min_length=16,
        max_length=16,
        description="hand-eye transform, 4x4, row by row, metres; the default is the simulated camera's mount",
    )
    parts_dir: Path | None = Field(default=None, description="folder of CAD files; none: the simulated parts")
    parts: tuple[Name, ...] | None = Field(
        default=None,
        description=f"parts that may be asked for; none: all in parts_dir, else {SIMULATED_PART}, which lies in the "
        "simulated bin unless its camera is told otherwise",
    )
    target_m: tuple[FiniteFloat, FiniteFloat, FiniteFloat] = Field(
        default=(0.5, 0.0, 0.03), description="the point all views look at, base frame"
    )
    dome: Annotated[DomeSettings, BeforeValidator(_dome_from_json)] = DomeSettings()


class ServiceSettings(BaseSettings):
    """Everything the service is configured with."""

    model_config = SettingsConfigDict(
        frozen=True, extra="forbid", env_prefix="SIDELONG_", env_nested_delimiter="__"
    )  # fmt: skip

    host: str = Field(default="127.0.0.1", description="address to listen on; loopback only, there are no tokens yet")
    port: int = Field(default=8000, ge=1, le=65535)
    data_dir: Path = Field(default=Path("sidelong-data"), description="database, scans, trained templates")
    cell: CellSettings = CellSettings()
    datasets: dict[Name, Path] = Field(default_factory=dict[str, Path], description="recorded data: id and folder")


def load_settings(file: Path | None = None, **overrides: Any) -> ServiceSettings:
    """Read the settings: overrides that are not None, over environment variables, over the file, over defaults.

    Raises
    ------
    SettingsError
        The file cannot be read, or a field is unknown or out of its range; names file and field.
    """

    content = {} if file is None else _yaml(file)

    class FromFile(ServiceSettings):
        @classmethod
        def settings_customise_sources(
            cls,
            settings_cls: type[BaseSettings],
            init_settings: PydanticBaseSettingsSource,
            env_settings: PydanticBaseSettingsSource,
            dotenv_settings: PydanticBaseSettingsSource,
            file_secret_settings: PydanticBaseSettingsSource,
        ) -> tuple[PydanticBaseSettingsSource, ...]:
            return init_settings, env_settings, InitSettingsSource(settings_cls, content)

    source = str(file) if file is not None else "settings"
    given = {name: value for name, value in overrides.items() if value is not None}
    try:
        return FromFile(**given)
    except SourceError as error:
        raise SettingsError(f"environment: {error}: {error.__cause__}") from error
    except ValidationError as error:
        first = error.errors()[0]
        path = ".".join(str(part) for part in first["loc"])
        raise SettingsError(f"{source}: {path}: {first['msg']}, got {first['input']!r:.80}") from error


def _yaml(file: Path) -> dict[str, Any]:
    if not file.is_file():
        raise SettingsError(f"{file}: no such configuration file")
    try:
        content: Any = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise SettingsError(f"{file}: is not YAML: {' '.join(str(error).split())}") from error
    if content is None:
        return {}
    if not isinstance(content, dict):
        raise SettingsError(f"{file}: holds {type(content).__name__}, needs names with values")
    return {str(name): value for name, value in cast("dict[Any, Any]", content).items()}


def check_loopback(host: str) -> None:
    """Refuse to serve beyond this machine: whoever reaches the service moves the arm.

    Raises
    ------
    SettingsError
        The address is not a loopback address.
    """
    try:
        local = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        local = False
    if not local:
        raise SettingsError(
            f"host: {host!r} is not a loopback address; without access tokens the service listens on this machine only"
        )
