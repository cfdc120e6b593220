"""Settings of a scan, and the one place that chooses the parts a scene needs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Annotated, Protocol, Self

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from sidelong.detection.refinement_settings import RefinementSettings
from sidelong.detection.report import DetectionReport
from sidelong.detection.settings import DetectionSettings
from sidelong.fusion.settings import FusionSettings, ModelSettings
from sidelong.physics.sensing import SensingSettings
from sidelong.planning.light import DEFAULT_INTENSITY, LightSettings
from sidelong.planning.selection import Strategy, StrategyName, strategy_of
from sidelong.types import DetectedObject, FloatArray, GrayImage

if TYPE_CHECKING:  # the service reads recipes without open3d
    from sidelong.detection.refinement import DepthView
    from sidelong.geometry.camera_model import StereoRig
    from sidelong.geometry.mesh import Part
    from sidelong.planning.gain import LightModel

ExposureS = Annotated[FiniteFloat, Field(ge=1e-6, le=10)]
CalibrationId = Annotated[str, Field(pattern=r"^[a-z][a-z0-9-]{0,63}$")]


class PlanningSettings(BaseModel):
    """How views are chosen and when a scan ends."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    strategy: Annotated[StrategyName, Field(strict=False, description="nbv, random or max_distance")] = StrategyName.NBV
    seed: Annotated[int, Field(ge=0, lt=2**32, description="of the random strategy")] = 0
    max_views: Annotated[int, Field(ge=0, le=100, description="views after the reference view")] = 3
    gain_threshold_px: Annotated[FiniteFloat, Field(ge=0, description="end below this G, pixels")] = 0.0
    gain_threshold_share: Annotated[
        FiniteFloat, Field(ge=0, le=1, description="end below this G, share of the pixels still missing")
    ] = 0.01
    stride_px: Annotated[int, Field(ge=1, le=16, description="every how many-th row and column is scored")] = 3


class Recipe(BaseModel):
    """All settings of a scan; the defaults run the simulated cell."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    detection: DetectionSettings = DetectionSettings()
    refinement: RefinementSettings | None = Field(
        default=RefinementSettings(),
        description="of poses, by the depth of every view; null: as detected, as in the paper",
    )
    planning: PlanningSettings = PlanningSettings()
    light: LightSettings = LightSettings()
    sensing: SensingSettings = SensingSettings()
    fusion: FusionSettings = FusionSettings()
    image_exposure_s: ExposureS = Field(default=0.2, description="of the image that detection reads, projector off")
    depth_exposure_s: ExposureS = Field(default=0.012, description="of the depth captures")
    move_deadline_s: Annotated[FiniteFloat, Field(gt=0, le=600, description="for one move")] = 30.0
    calibrations: tuple[CalibrationId, ...] = Field(
        default=(), max_length=32, strict=False, description="ids of those that go before what the settings say"
    )


class Detector(Protocol):
    """Finds objects in the projector-off image of the reference view."""

    @property
    def last_report(self) -> DetectionReport | None:
        """What the last detection did, and why it found nothing if it did not; None where none was needed."""
        ...

    def detect(self, image: GrayImage, depth_m: FloatArray | None = None) -> tuple[DetectedObject, ...]:
        """Return the objects, none where nothing was found; ``depth_m`` (H, W) was measured from the same place."""
        ...

    def close(self) -> None:
        """Release what it holds."""
        ...


@dataclass(frozen=True)
class GivenObjects:
    """Stands in for a detector where the poses are known already: detection is left out."""

    objects: tuple[DetectedObject, ...]

    @property
    def last_report(self) -> DetectionReport | None:
        """None: nothing was detected."""
        return None

    def detect(self, image: GrayImage, depth_m: FloatArray | None = None) -> tuple[DetectedObject, ...]:
        """Return the given objects, whatever the image."""
        return self.objects

    def close(self) -> None:
        """Nothing is held."""


class PoseRefiner(Protocol):
    """Brings the poses of one scan into line with the depth of every view."""

    def add(self, view: DepthView) -> None:
        """Take in the depth of one more view; the reference view comes first."""
        ...

    def refine(self, objects: tuple[DetectedObject, ...]) -> tuple[DetectedObject, ...]:
        """Return the objects as all views show them; the same tuple where nothing is to be changed."""
        ...


class AsDetected:
    """Stands in for a refiner where poses are to stay as they are: refinement is left out."""

    def add(self, view: DepthView) -> None:
        """Nothing is kept."""

    def refine(self, objects: tuple[DetectedObject, ...]) -> tuple[DetectedObject, ...]:
        """Return the objects as they are."""
        return objects


@dataclass(frozen=True, eq=False)
class Stages:
    """The parts of a scan, chosen once.

    Attributes
    ----------
    part, rig
        What is looked for, and with which cameras.
    detector, strategy
        Stages that keep a state of their own.
    new_refiner
        Makes the refiner of one scan.
    modelled
        Depth of the reference view that the CAD model gives where poses are certain, and its standard deviation; None
        where that is left out.
    light
        From geometry to the probability of depth; its exposure is replaced by the applied one.
    left_out
        Terms that are not computed, each with the reason.
    """

    part: Part
    rig: StereoRig
    detector: Detector
    new_refiner: Callable[[], PoseRefiner]
    modelled: Callable[[tuple[DetectedObject, ...]], tuple[FloatArray, FloatArray] | None]
    strategy: Strategy
    light: LightModel
    left_out: tuple[str, ...]

    def close(self) -> None:
        """Release the detector's child process."""
        self.detector.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def build_stages(
    recipe: Recipe,
    part: Part,
    rig: StereoRig,
    cache_dir: Path,
    *,
    objects: tuple[DetectedObject, ...] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Stages:
    """Choose the parts a scene needs.

    Parameters
    ----------
    recipe
        Settings.
    part, rig
        What is looked for, and with which cameras.
    cache_dir
        Where trained templates are kept.
    objects
        Poses that are known already; detection is left out.
    progress
        Called with (done, total) while templates are trained.

    Raises
    ------
    SettingsError
        A material of the part has no reflectance, or a setting does not fit the part.
    """
    detector = GivenObjects(objects) if objects is not None else _trained(recipe, part, rig, cache_dir, progress)
    strategy = strategy_of(recipe.planning.strategy, recipe.planning.seed)
    left_out = _left_out(recipe, part, given=objects is not None)
    new_refiner = _refining(recipe.refinement, part, rig) if objects is None else AsDetected
    modelled = _modelling(recipe.fusion.model, part, rig)
    _prepare_fusion(recipe.fusion)
    return Stages(part, rig, detector, new_refiner, modelled, strategy, light_model(recipe, part), left_out)


def light_model(recipe: Recipe, part: Part) -> LightModel:
    """Return what turns geometry into the probability of depth. Raises SettingsError as ``build_stages``."""
    from sidelong.planning.gain import LightModel

    return LightModel(
        reflectances=recipe.light.reflectances(part.materials),
        intensity=recipe.light.intensity or DEFAULT_INTENSITY,
        fall_off=recipe.light.fall_off,
        shadows=recipe.light.shadows,
        exposure_s=recipe.depth_exposure_s,
        response=recipe.light.response(),
        sensing=recipe.sensing,
        vignetting=recipe.light.vignetting,
    )


def _trained(
    recipe: Recipe, part: Part, rig: StereoRig, cache_dir: Path, progress: Callable[[int, int], None] | None
) -> Detector:
    from sidelong.detection.detector import TemplateDetector

    detector = TemplateDetector(part, rig.left, recipe.detection, cache_dir)
    detector.prepare(progress)
    return detector


def _refining(settings: RefinementSettings | None, part: Part, rig: StereoRig) -> Callable[[], PoseRefiner]:
    if settings is None:
        return AsDetected
    from sidelong.detection.refinement import Refiner

    return partial(Refiner, part, rig.left, settings)


def _modelling(
    settings: ModelSettings | None, part: Part, rig: StereoRig
) -> Callable[[tuple[DetectedObject, ...]], tuple[FloatArray, FloatArray] | None]:
    if settings is None:
        return lambda objects: None
    from sidelong.fusion.modelled import modelled_depth

    return partial(modelled_depth, part, rig.left, settings)


def _prepare_fusion(settings: FusionSettings) -> None:
    from sidelong.fusion.completion import prepare

    prepare(settings)


def _left_out(recipe: Recipe, part: Part, *, given: bool) -> tuple[str, ...]:
    """Name the terms that are not computed, each with the reason."""
    terms = {
        "detection and refinement: left out, the poses are given": given,
        "refinement of poses: left out, refinement is null": recipe.refinement is None and not given,
        "completion by the CAD model: left out, fusion.model is null": recipe.fusion.model is None,
        "registration of the arm's poses: left out, fusion.registration is null": recipe.fusion.registration is None,
        "second camera: left out, sensing.stereo is off": not recipe.sensing.stereo,
        "light fall-off: left out, light.fall_off is off": not recipe.light.fall_off,
        "projector vignetting: left out, light.vignetting is 0": recipe.light.vignetting == 0,
        "occlusion by other parts: left out, light.shadows is not 'all'": recipe.light.shadows != "all",
        "occlusion by the own part: left out, light.shadows is 'none'": recipe.light.shadows == "none",
        "score of all candidates: left out, the strategy does not compare them": (
            recipe.planning.strategy is not StrategyName.NBV
        ),
        f"response of the sensor: left out, not calibrated, gamma {recipe.light.gamma:g} stands in": (
            recipe.light.response_table is None
        ),
        "sensing curve: left out, none was learned, equation (7) stands in": recipe.sensing.curve is None,
        "ambient light: left out, the projector outshines it (paper, equation (1))": True,
        "inter-reflection: left out, not modelled yet": True,
    }
    stand_ins = (
        f"reflectance of {name}: left out, none is known, {recipe.light.stand_in} stands in"
        for name in recipe.light.unknown(part.materials)
    )
    return (*(term for term, applies in terms.items() if applies), *stand_ins)
