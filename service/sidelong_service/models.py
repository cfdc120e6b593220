"""What the HTTP interface takes and gives."""

from __future__ import annotations

import math
from datetime import datetime
from enum import StrEnum
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from sidelong.commissioning.tasks import Task
from sidelong.recipe import Recipe
from sidelong.types import DetectedObject, FloatArray, FusedView, PixelState, StateArray, Step, Stop
from sidelong_service.problems import Problem
from sidelong_service.settings import Name


class RunKind(StrEnum):
    """What may have the scan worker."""

    SCAN = "scan"
    CALIBRATION = "calibration"


class RunState(StrEnum):
    """Where a scan or a job stands. ``interrupted``: a process died under it."""

    ACCEPTED = "accepted"
    RUNNING = "running"
    STOPPING = "stopping"
    SUCCEEDED = "succeeded"
    STOPPED = "stopped"
    FAILED = "failed"
    INTERRUPTED = "interrupted"

    @property
    def ended(self) -> bool:
        """Whether nothing more happens to it."""
        return self not in (RunState.ACCEPTED, RunState.RUNNING, RunState.STOPPING)


class CellState(StrEnum):
    """Where the cell stands."""

    STARTING = "starting"
    IDLE = "idle"
    EXECUTING = "executing"
    STOPPING = "stopping"
    FAULT = "fault"


class _Request(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)


class RecordedScene(_Request):
    """Recorded views in the place of camera and arm."""

    dataset: Name = Field(description="id of a configured data set")
    object: Name
    scene: int = Field(ge=0, le=1_000_000)
    reference: Name | None = Field(default=None, description="view whose depth is completed; none: the first")


class ScanRequest(_Request):
    """Complete the depth of the reference view: of the configured cell, or of a recorded scene."""

    part: Name | None = Field(default=None, description="what lies in the configured cell")
    recording: RecordedScene | None = None
    recipe: Recipe = Recipe()

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.part is None) == (self.recording is None):
            raise ValueError("give either part, for the configured cell, or recording")
        return self


class CalibrationRequest(_Request):
    """Make a calibration from captures of a configured data set; ``recipe.calibrations`` names those it builds on."""

    dataset: Name = Field(description="id of a configured data set")
    object: Name | None = Field(default=None, description="whose captures; none: those of the device")
    task: Task
    recipe: Recipe = Recipe()


class _Answer(BaseModel):
    model_config = ConfigDict(frozen=True)


class Candidate(_Answer):
    """What the planner expects of a view, and why it could not be taken, if it could not.

    ``gain_share`` is the gain over the pixels still missing: what a threshold can be compared with on any image size.
    """

    view: str
    gain_px: float
    gain_share: float
    lost_px: dict[str, float]
    dropped: str | None


class PoseReport(_Answer):
    """Where an object is believed to be after a view: its most probable pose; all of them are in ``poses.json``.

    Poses are 4x4 matrices in metres, row by row: in the base frame, and in the left camera of the reference view. The
    sigmas are the largest over all directions, turns about the part's centre; none where no depth could tell.
    ``visible_fraction`` is the share of the object's silhouette that no other object hides; ``supporting_views`` have
    measured it.
    """

    base_T_object: tuple[tuple[float, ...], ...]
    camera_T_object: tuple[tuple[float, ...], ...]
    probability: float
    score: float
    hypotheses: int
    rotation_sigma_rad: float | None
    translation_sigma_m: float | None
    visible_fraction: float
    supporting_views: tuple[str, ...]

    @classmethod
    def of(cls, item: DetectedObject, base_T_camera: FloatArray) -> PoseReport:
        """Return the report of an object seen from ``base_T_camera`` (4, 4)."""
        best = item.hypotheses[0]
        sigmas = (None, None) if best.covariance is None else sigmas_of(best.covariance)
        return cls(
            base_T_object=rows_of(base_T_camera @ best.camera_T_object),
            camera_T_object=rows_of(best.camera_T_object),
            probability=best.probability,
            score=best.score,
            hypotheses=len(item.hypotheses),
            rotation_sigma_rad=sigmas[0],
            translation_sigma_m=sigmas[1],
            visible_fraction=item.visible_fraction,
            supporting_views=item.supporting_views,
        )


def rows_of(matrix: FloatArray) -> tuple[tuple[float, ...], ...]:
    """Return a matrix row by row."""
    return tuple(tuple(float(value) for value in row) for row in matrix)


def sigmas_of(covariance: FloatArray) -> tuple[float, float]:
    """Return the largest standard deviations of turn (rad) and shift (m) of a (6, 6) covariance of a pose."""
    turn, shift = (math.sqrt(max(0.0, float(np.linalg.eigvalsh(block)[-1]))) for block in
                   (covariance[:3, :3], covariance[3:, 3:]))  # fmt: skip
    return turn, shift


class FusionReport(_Answer):
    """What the fusion made of the depth of a further view.

    ``refused`` says why it was left out; none: it was taken. ``shift_m`` and ``turn_rad`` are how far registration
    moved the view from where the arm says, ``base_T_camera`` (4x4, row by row) is where it is then, and the sigmas are
    how well that is known. ``agreement`` is the share of what the view and the reference both saw that neither
    contradicts; none where they share nothing. ``filled_px`` had no depth before; ``contradicted_px`` of the reference
    are contradicted since.
    """

    refused: str | None
    base_T_camera: tuple[tuple[float, ...], ...]
    shift_m: float
    turn_rad: float
    sigma_shift_m: float
    sigma_turn_rad: float
    shared_points: int
    agreement: float | None
    filled_px: int
    contradicted_px: int

    @classmethod
    def of(cls, fused: FusedView, base_T_reference: FloatArray) -> FusionReport:
        """Return the report of a view; ``base_T_reference`` (4, 4) is the camera at the reference view."""
        return cls(
            refused=fused.refused,
            base_T_camera=rows_of(base_T_reference @ fused.reference_T_view),
            shift_m=fused.shift_m,
            turn_rad=fused.turn_rad,
            sigma_shift_m=fused.sigma_shift_m,
            sigma_turn_rad=fused.sigma_turn_rad,
            shared_points=fused.shared_points,
            agreement=None if math.isnan(fused.agreement) else fused.agreement,
            filled_px=fused.filled_px,
            contradicted_px=fused.contradicted_px,
        )


def state_px_of(state: StateArray) -> dict[str, int]:
    """Return how many pixels (H, W) are in each state, by its name in lower case."""
    counts = np.bincount(state.ravel(), minlength=len(PixelState))
    return {each.name.lower(): int(counts[each]) for each in PixelState}


class ViewReport(_Answer):
    """One view of a scan: the gain expected and measured, the state after it, and what it cost.

    ``state_px`` counts the pixels of the reference view by what their depth rests on; ``fused`` is what the fusion made
    of this view, none at the reference. Scans of older versions have neither.
    """

    index: int
    view: str
    objects: int
    poses: tuple[PoseReport, ...] = ()
    predicted_gain_px: float
    measured_gain_px: float
    missing_px: int
    recovered_px: int
    completeness: float
    stage_s: dict[str, float]
    candidates: tuple[Candidate, ...]
    state_px: dict[str, int] = {}
    fused: FusionReport | None = None

    @property
    def refused(self) -> str | None:
        """Why the fusion left this view out, if it did."""
        return None if self.fused is None else self.fused.refused

    @classmethod
    def of(cls, step: Step, base_T_reference: FloatArray) -> ViewReport:
        """Return the report of a step; ``base_T_reference`` (4, 4) is the camera at the reference view."""
        return cls(
            index=step.index,
            view=step.view.name,
            objects=len(step.objects),
            poses=tuple(PoseReport.of(item, base_T_reference) for item in step.objects),
            predicted_gain_px=step.predicted_gain_px,
            measured_gain_px=step.measured_gain_px,
            missing_px=step.missing_px,
            recovered_px=step.recovered_px,
            completeness=step.completeness,
            stage_s=dict(step.stage_s),
            candidates=tuple(
                Candidate(
                    view=s.view.name,
                    gain_px=s.gain_px,
                    gain_share=s.gain_px / max(1, step.missing_px - step.recovered_px),
                    lost_px=dict(s.lost_px),
                    dropped=s.dropped,
                )
                for s in step.scores
            ),
            state_px=state_px_of(step.depth.state),
            fused=None if step.fused is None else FusionReport.of(step.fused, base_T_reference),
        )


class Setup(_Answer):
    """What a scan runs with; ``recipe`` holds the settings in effect, those filled in from the cell or the data too."""

    part: str
    repairs: tuple[str, ...] = ()
    """What was mended in the CAD model."""
    camera: str
    arm: str
    width_px: int
    height_px: int
    candidates: int
    left_out: tuple[str, ...]
    recipe: dict[str, Any]


class Artifact(_Answer):
    """A file a scan has made."""

    name: str
    media_type: str
    size_bytes: int
    sha256: str


class ScanSummary(_Answer):
    """A scan in the list."""

    id: str
    state: RunState
    phase: str | None
    finish_reason: Stop | None
    part: str | None
    recording: RecordedScene | None
    created_at: datetime
    started_at: datetime | None
    ended_at: datetime | None


class Scan(ScanSummary):
    """A scan with all it knows.

    ``views`` are in the order taken, the reference view first; ``problem`` says why a scan failed; ``recipe`` is as it
    was asked for.
    """

    problem: Problem | None
    recipe: dict[str, Any]
    setup: Setup | None
    views: tuple[ViewReport, ...]
    artifacts: tuple[Artifact, ...]


class ScanList(_Answer):
    """Scans, newest first; ``next_cursor`` asks for older ones."""

    scans: tuple[ScanSummary, ...]
    next_cursor: int | None


class ArtifactList(_Answer):
    """The files of a scan."""

    artifacts: tuple[Artifact, ...]


class CalibrationJob(_Answer):
    """A calibration in the making; ``calibrations`` are the ids of what it has made."""

    id: str
    state: RunState
    phase: str | None
    created_at: datetime
    started_at: datetime | None
    ended_at: datetime | None
    request: dict[str, Any]
    problem: Problem | None
    calibrations: tuple[str, ...]


class JobList(_Answer):
    """Calibration jobs, newest first; ``next_cursor`` asks for older ones."""

    jobs: tuple[CalibrationJob, ...]
    next_cursor: int | None


class CalibrationSummary(_Answer):
    """A calibration file in the data directory. One that cannot be used is listed with ``trouble``."""

    id: str
    kind: str | None
    material: str | None
    device_serial: str | None
    created_at: datetime | None
    warnings: tuple[str, ...]
    trouble: str | None = None


class CalibrationList(_Answer):
    """Calibrations, newest first."""

    calibrations: tuple[CalibrationSummary, ...]


class CellReport(_Answer):
    """The cell, and whether a scan may start now."""

    name: str
    mode: Literal["simulated", "real"]
    state: CellState
    camera: str
    arm: str
    active_scan: str | None
    active_job: str | None
    may_start: bool
    reasons: tuple[str, ...]


class StopReport(_Answer):
    """The arm confirmed the stop; ``scan`` is the one that ends by it."""

    stopped: Literal[True] = True
    scan: str | None


class Readiness(_Answer):
    """What the service needs for a scan; each is ``ready`` or says what is wrong."""

    ready: bool
    arm: str
    worker: str
    storage: str


EventKind = Literal["state", "phase", "progress", "setup", "view", "artifact", "calibration"]


class _Event(_Answer):
    id: int
    kind: EventKind
    at: datetime
    data: dict[str, Any]


class ScanEvent(_Event):
    """One line in the life of a scan, numbered over all scans and jobs."""

    scan: str


class JobEvent(_Event):
    """One line in the life of a job, numbered over all scans and jobs."""

    job: str


Limit = Annotated[int, Field(ge=1, le=200)]
