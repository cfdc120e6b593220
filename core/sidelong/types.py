"""What the stages of a scan hand to each other.

Frames are written ``a_T_b``: the 4x4 matrix that maps coordinates in b to coordinates in a. Units are SI, missing
depth is NaN, ``pixels`` are integer (row, column) pairs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum, StrEnum
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
RealArray: TypeAlias = NDArray[np.floating[Any]]
"""Of either precision."""
Float32Array: TypeAlias = NDArray[np.float32]
"""Inside kernels, where its rounding is known to be small."""
IntArray: TypeAlias = NDArray[np.intp]
BoolArray: TypeAlias = NDArray[np.bool_]
GrayImage: TypeAlias = NDArray[np.uint8]
StateArray: TypeAlias = NDArray[np.uint8]
"""Of :class:`PixelState`."""


class Projector(StrEnum):
    """What the projector shows during a capture."""

    OFF = "off"
    WHITE = "white"
    DOTS = "dots"


class Stop(StrEnum):
    """Why a scan ended as it should."""

    GAIN_BELOW_THRESHOLD = "gain_below_threshold"
    MAX_VIEWS = "max_views"
    NOTHING_MISSING = "nothing_missing"
    NO_OBJECTS = "no_objects"
    """Something lies there, but nothing that can be told for the part."""
    EMPTY_SCENE = "empty_scene"
    NO_REACHABLE_VIEW = "no_reachable_view"


@dataclass(frozen=True, eq=False)
class View:
    """A place for the camera: ``base_T_camera`` (4, 4), left rectified camera in the base frame, metres."""

    name: str
    base_T_camera: FloatArray


@dataclass(frozen=True, eq=False)
class Frame:
    """One capture.

    Attributes
    ----------
    view
        Where the camera was, as read back from the arm.
    left, right
        Rectified 8-bit images (H, W); ``right`` is None where the source has none.
    depth_m
        Depth along the optical axis of the left camera (H, W), NaN where nothing was measured; None where the capture
        was not asked for depth.
    projector
        What it showed in the images, not what was asked for.
    exposure_s
        Applied exposure: of the depth map where there is one, else of the images.
    started_s, ended_s
        Monotonic clock.
    """

    view: View
    left: GrayImage
    right: GrayImage | None
    depth_m: FloatArray | None
    projector: Projector
    exposure_s: float
    started_s: float = 0.0
    ended_s: float = 0.0


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """One pose an object may have.

    Attributes
    ----------
    camera_T_object
        (4, 4) in the left camera of the reference view.
    score
        The detector's, 0..100.
    probability
        0..1, given the object.
    covariance
        (6, 6) of a small turn (rad, about the part's centre) followed by a small shift (m), both along the axes of that
        camera; None where nothing was measured that could tell. Directions that no depth determines keep the variance
        of detection.
    """

    camera_T_object: FloatArray
    score: float
    probability: float
    covariance: FloatArray | None = None


@dataclass(frozen=True, eq=False)
class DetectedObject:
    """An object of the reference image.

    Attributes
    ----------
    hypotheses
        Poses it may have, most probable first; probabilities sum to 1.
    visible_fraction
        Share 0..1 of the silhouette of its most probable pose that no other object hides in the reference view.
    supporting_views
        Names of the views whose depth refined it, in the order they were taken; none before refinement.
    """

    hypotheses: tuple[Hypothesis, ...]
    visible_fraction: float = 1.0
    supporting_views: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Prior:
    """What one hypothesis of one object says of the pixels that have no depth: D_k and N_k of equation (13).

    Attributes
    ----------
    object_index
        Position in the list of detected objects.
    probability
        Of the hypothesis, given the object.
    weight
        How many image pixels each entry stands for (stride squared).
    pixels
        (N, 2) row and column in the reference image.
    points_base, normals_base
        (N, 3) surface points in metres and outward unit normals in the base frame.
    material
        (N,) index into the part's materials.
    base_T_object
        (4, 4) the hypothesis itself.
    """

    object_index: int
    probability: float
    weight: float
    pixels: IntArray
    points_base: FloatArray
    normals_base: FloatArray
    material: IntArray
    base_T_object: FloatArray


@dataclass(frozen=True, eq=False)
class Score:
    """What the planner expects of one candidate view.

    Attributes
    ----------
    view
        The candidate.
    gain_px
        G_i of equation (13): expected number of missing pixels the view measures.
    lost_px
        Expected pixels lost, by reason: outside, hidden, shadow, dark, saturated. With the gain they add up to the
        missing pixels that hypotheses explain.
    dropped
        Why the candidate cannot be taken (already taken, unreachable ...); None where it can.
    """

    view: View
    gain_px: float
    lost_px: Mapping[str, float] = field(default_factory=dict[str, float])
    dropped: str | None = None


@dataclass(frozen=True, eq=False)
class Forecast:
    """What the planner promised of a view beside what the view gave, one row for each point of its belief.

    Attributes
    ----------
    probability
        (N,) that the view measures the pixel; their sum over ``weight`` is the predicted gain.
    weight
        (N,) how many pixels a point stands for, times the probability of its hypothesis.
    measured
        (N,) whether the pixel has depth since this view.
    """

    probability: FloatArray
    weight: FloatArray
    measured: BoolArray


class PixelState(IntEnum):
    """What the depth of a pixel of the reference view rests on."""

    MISSING = 0
    """No view gave depth."""
    MEASURED = 1
    """The reference view measured it; it is kept to the bit."""
    COMPLETED = 2
    """Another view measured it."""
    CONTRADICTED = 3
    """The reference view measured it, but others saw through that point, or measured something before it."""
    DOUBTFUL = 4
    """Another view measured it, well behind the part that is believed there: likely ground seen past the part."""
    MODELLED = 5
    """No view gave depth; the CAD model at a certain pose says what must be there."""


@dataclass(frozen=True, eq=False)
class CompletedDepth:
    """The depth of the reference view as all views show it, (H, W) each.

    Attributes
    ----------
    depth_m
        Along the optical axis of the reference camera, NaN where missing.
    sigma_m
        Its standard deviation, NaN where missing; of those contradicted or doubtful it means nothing.
    source
        Index of the step that measured each pixel, the lowest where several did; -1 where missing or modelled.
    state
        :class:`PixelState` of each pixel, uint8.
    """

    depth_m: FloatArray
    sigma_m: FloatArray
    source: IntArray
    state: StateArray

    @property
    def trusted(self) -> BoolArray:
        """Pixels whose depth was measured and is neither contradicted nor doubtful."""
        return (self.state == PixelState.MEASURED) | (self.state == PixelState.COMPLETED)

    @property
    def trusted_m(self) -> FloatArray:
        """Depth where it is trusted, NaN elsewhere."""
        return np.where(self.trusted, self.depth_m, np.nan)


@dataclass(frozen=True, eq=False)
class SceneSurface:
    """Surfaces of a whole scene as triangles.

    Attributes
    ----------
    points_m, normals
        (N, 3) corners and outward unit normals there, in the base frame.
    sigma_m
        (N,) standard deviation along the normal.
    triangles
        (M, 3) counter-clockwise as seen from outside.
    """

    points_m: FloatArray
    normals: FloatArray
    sigma_m: FloatArray
    triangles: IntArray


class SceneModel(Protocol):
    """What all views say of the whole scene, not of what the reference view sees alone."""

    def mesh(self) -> SceneSurface:
        """Return its surfaces as they are known now."""
        ...


@dataclass(frozen=True, eq=False)
class FusedView:
    """What the fusion made of one further view.

    Attributes
    ----------
    reference_T_view
        (4, 4) where it is, after registration.
    refused
        Why its depth was left out; None where it was taken.
    shift_m, turn_rad
        How far registration moved it from where the arm says.
    sigma_shift_m, sigma_turn_rad
        Standard deviation of where it is after that, all three directions together.
    shared_points
        Points of the view on surface that the reference measured too: what registration rests on.
    agreement
        Of the depths that the reference or the view could contradict, the share that is not; NaN where there are none.
    filled_px
        Pixels that had no depth before and have one now.
    contradicted_px
        Measured pixels of the reference that are contradicted now and were not before.
    """

    reference_T_view: FloatArray
    refused: str | None
    shift_m: float
    turn_rad: float
    sigma_shift_m: float
    sigma_turn_rad: float
    shared_points: int
    agreement: float
    filled_px: int = 0
    contradicted_px: int = 0


@dataclass(frozen=True, eq=False)
class Step:
    """What a scan knows after a view. The first step is the reference view.

    Attributes
    ----------
    index
        0 for the reference view, then 1, 2, ...
    view
        Where the camera was.
    frame
        The depth capture of this view.
    objects
        What was detected in the reference view.
    depth
        The reference view's, as it is completed now.
    missing_px
        Pixels on the detected objects that had no depth in the reference view.
    recovered_px
        How many of those have depth now that was measured and is not doubtful.
    predicted_gain_px, measured_gain_px
        Gain of this view: G of equation (13) beforehand, newly completed target pixels afterwards, less those it
        disproved; 0 at the reference.
    scores
        All candidates, as scored before the next move; empty where the scan ended before scoring.
    stage_s
        Seconds spent in each stage (capture, detect, score, move, fuse) since the step before.
    stop
        Why the scan ended, on the last step; None before it.
    left_out
        Terms of the model that were left out, each with the reason.
    forecast
        What was promised of this view, point by point, beside what it gave; None at the reference.
    fused
        What the fusion made of this view; None at the reference.
    scene
        The whole scene, where the fusion models it; it goes on to learn from the views of later steps.
    """

    index: int
    view: View
    frame: Frame
    objects: tuple[DetectedObject, ...]
    depth: CompletedDepth
    missing_px: int
    recovered_px: int
    predicted_gain_px: float
    measured_gain_px: float
    scores: tuple[Score, ...]
    stage_s: Mapping[str, float]
    stop: Stop | None
    left_out: tuple[str, ...] = ()
    forecast: Forecast | None = None
    fused: FusedView | None = None
    scene: SceneModel | None = None

    @property
    def completeness(self) -> float:
        """Recovered over missing pixels, 0..1; 1 where nothing was missing."""
        return self.recovered_px / self.missing_px if self.missing_px else 1.0
