"""Calibration files: JSON documents, one a calibration, with what they came from and how far they may be trusted.

A document is never changed: its id is made of its content, so one that somebody edited is refused.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeAlias

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter, ValidationError

from sidelong.errors import CalibrationError
from sidelong.physics.depth_noise import DepthNoise
from sidelong.physics.response import LEVELS
from sidelong.physics.sensing import SensingCurve

FORMAT_VERSION = 1
ID_LENGTH = 12

Pose = Annotated[tuple[FiniteFloat, ...], Field(min_length=16, max_length=16)]
Triple = Annotated[tuple[FiniteFloat, ...], Field(min_length=3, max_length=3)]
Table = Annotated[tuple[FiniteFloat, ...], Field(min_length=LEVELS, max_length=LEVELS)]
Text = Annotated[str, Field(min_length=1, max_length=400)]


class _Part(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class InputFile(_Part):
    """A file that a calibration was made from: its name, and the SHA-256 of its content."""

    name: Text
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]


class Parameter(_Part):
    """A fitted number with its 95 % interval; ``note`` says why it could not be identified, where it could not."""

    value: FiniteFloat
    standard_error: FiniteFloat | None
    low: FiniteFloat
    high: FiniteFloat
    identifiable: bool
    note: str | None = None


class _Document(_Part):
    format: Literal["sidelong calibration"] = "sidelong calibration"
    version: Literal[1] = FORMAT_VERSION
    id: str = ""
    created_at: Annotated[AwareDatetime, Field(strict=False)] = Field(default_factory=lambda: datetime.now(UTC))
    device_serial: Text = Field(description="of the camera it is of")
    inputs: tuple[InputFile, ...] = Field(description="files it was made from")
    uses: tuple[Text, ...] = Field(default=(), description="ids of the calibrations it was made with")
    warnings: tuple[str, ...] = ()

    def sealed(self) -> Self:
        """Return the document with the id that its content gives it."""
        return self.model_copy(update={"id": self._content_id()})

    def is_whole(self) -> bool:
        """Say whether the content is the one the id was made of."""
        return self.id == self._content_id()

    def _content_id(self) -> str:
        content = self.model_dump(mode="json", exclude={"id"})
        digest = hashlib.sha256(json.dumps(content, sort_keys=True, allow_nan=False).encode()).hexdigest()
        return f"{content['kind'].replace('_', '-')}-{digest[:ID_LENGTH]}"


class ResponseDocument(_Document):
    """Response of the sensor: g(Z) in ln saturation exposures."""

    kind: Literal["response"] = "response"
    log_exposure: Table
    standard_error: Table
    exposures_s: tuple[FiniteFloat, ...]
    samples: int
    condition: FiniteFloat
    residual_rms_ln: FiniteFloat
    residual_rms_grey: FiniteFloat
    image_residuals_grey: dict[str, FiniteFloat]


class ProjectorDocument(_Document):
    """Light of the projector: intensity at 1 m (saturation exposures per second), vignetting cos^p, fall-off 1/d^q."""

    kind: Literal["projector"] = "projector"
    plane_k_d: FiniteFloat = Field(description="diffuse share of the plane, as stated")
    intensity: Parameter
    vignetting: Parameter
    fall_off_exponent: Parameter
    samples: int
    residual_rms_relative: FiniteFloat


class LightUsed(_Part):
    """The light that was reckoned with: k_d and k_s scale with 1 / intensity."""

    intensity: Annotated[FiniteFloat, Field(gt=0)]
    fall_off: bool
    vignetting: FiniteFloat


class MaterialDocument(_Document):
    """Phong reflectance of one material."""

    kind: Literal["material"] = "material"
    material: Text
    part: Text
    light: LightUsed
    k_d: Parameter
    k_s: Parameter
    n: Parameter
    absorbing: bool
    samples: int
    saturated: int
    dark: int
    residual_rms_relative: FiniteFloat | None
    residual_rms_grey: FiniteFloat | None


class Scores(_Part):
    """How well probabilities forecast depth: log-loss, Brier score, expected calibration error."""

    log_loss: FiniteFloat
    brier: FiniteFloat
    expected_calibration_error: FiniteFloat


class SensingDocument(_Document):
    """Probability of depth against exposure, and how it compares with the paper's exponential on the same pixels."""

    kind: Literal["sensing"] = "sensing"
    light: LightUsed
    curve: SensingCurve
    views: tuple[Text, ...]
    pixels: int
    held_out: bool = Field(description="whether the scores are of views that were left out, else of those fitted")
    scores: Scores
    exponential_scores: Scores


class PoseResidual(_Part):
    """How far one pose disagrees: reprojection rms, and place and turn of the board; ``used`` says if it counts."""

    px: FiniteFloat
    m: FiniteFloat
    rad: FiniteFloat
    used: bool


class HandEyeDocument(_Document):
    """Where the left rectified camera sits on the flange."""

    kind: Literal["hand_eye"] = "hand_eye"
    flange_T_camera: Pose
    base_T_board: Pose
    arm: Text | None
    poses: int
    smallest_singular_value: FiniteFloat
    residual_rms_px: FiniteFloat
    residuals: dict[str, PoseResidual]
    translation_error_m: Triple = Field(description="standard errors along the flange's axes")
    rotation_error_rad: Triple = Field(description="standard errors about the flange's axes")


class NoiseDocument(_Document):
    """Noise of depth: errors on a flat plate, or what differs between repeated shots, which is a lower bound."""

    kind: Literal["noise"] = "noise"
    method: Literal["plate", "repeats"]
    noise: DepthNoise = Field(description="numbers to use: defaults stand in for what was not identified")
    parameters: dict[str, Parameter] = Field(description="each of them as it was estimated")
    image_px: tuple[int, int] = Field(strict=False, description="width and height: noise is in pixels of this image")
    captures: int
    pixels: int


Document: TypeAlias = Annotated[
    ResponseDocument | ProjectorDocument | MaterialDocument | SensingDocument | HandEyeDocument | NoiseDocument,
    Field(discriminator="kind"),
]
DOCUMENT: TypeAdapter[Document] = TypeAdapter(Document)


def hashed(files: Sequence[Path], root: Path) -> tuple[InputFile, ...]:
    """Return names (below ``root``) and hashes of files. Raises OSError."""
    return tuple(
        InputFile(
            name=str(file.relative_to(root)) if file.is_relative_to(root) else file.name,
            sha256=hashlib.sha256(file.read_bytes()).hexdigest(),
        )
        for file in files
    )


def to_json(document: Document) -> bytes:
    """Return the content of a calibration file."""
    return json.dumps(document.model_dump(mode="json"), indent=1, allow_nan=False).encode()


def read_document(path: Path) -> Document:
    """Read a calibration file.

    Raises
    ------
    CalibrationError
        It is missing, no calibration, of a later version, or was changed after it was written; names file and field.
    """
    try:
        content = path.read_bytes()
        version = _version(content)
        if version not in (None, FORMAT_VERSION):
            raise CalibrationError(f"{path}: its version is {version!r:.40}, this program reads {FORMAT_VERSION}")
        document = DOCUMENT.validate_json(content)
    except FileNotFoundError as error:
        raise CalibrationError(f"{path}: no such calibration file") from error
    except OSError as error:
        raise CalibrationError(f"{path}: cannot be read: {error.strerror}") from error
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"])) or "document"
        raise CalibrationError(f"{path}: {field}: {first['msg']}, got {first['input']!r:.60}") from error
    if not document.is_whole():
        raise CalibrationError(f"{path}: was changed after it was written, its content does not give id {document.id}")
    return document


def _version(content: bytes) -> Any:
    try:
        about: Any = json.loads(content)
    except (ValueError, RecursionError):
        return None  # what is wrong with it the validation says
    return about.get("version") if isinstance(about, dict) else None  # pyright: ignore[reportUnknownVariableType, reportUnknownMemberType]
