"""The probability of depth against exposure, from the views of a recorded scene whose poses are known."""

from __future__ import annotations

from typing import Any

import numpy as np

from sidelong.calibration.sensing.fit import SensingFit, fit_sensing
from sidelong.calibration.sensing.samples import SensingSamples, samples_of
from sidelong.calibration.sensing.scores import Scores as ForecastScores
from sidelong.commissioning.documents import LightUsed, Scores, SensingDocument
from sidelong.commissioning.figures import png
from sidelong.commissioning.made import Captures, Made, Progress
from sidelong.commissioning.tasks import SensingTask
from sidelong.commissioning.white import lit_by_recording
from sidelong.devices import CaptureRequest
from sidelong.errors import CalibrationError
from sidelong.evaluation.reliability import Reliability, draw_on, told
from sidelong.physics.response import Response
from sidelong.physics.sensing import CurveSensing, PaperSensing
from sidelong.recipe import Recipe, light_model
from sidelong.recorded.dataset import Scene
from sidelong.types import FloatArray, Forecast, Projector


def make_sensing(task: SensingTask, captures: Captures, progress: Progress) -> Made:
    """Learn the curve from all views of a scene.

    Raises
    ------
    UnknownNameError, DatasetError, ImageError, PoseError, MeshError
        A name is unknown, a file is missing or cannot be used.
    CalibrationError
        The views cannot carry a curve, or calibrations do not fit the device.
    """
    if captures.object is None:
        raise CalibrationError("object: the curve is learned on a scene of parts, name the object")
    scene = captures.dataset.scene(captures.object, task.scene)
    part = captures.dataset.part(captures.object)
    recipe = lit_by_recording(captures.settings(), captures.dataset, captures.object, part)
    samples = _samples(scene, recipe, progress)
    response = recipe.light.response()
    fit = fit_sensing(samples, response)
    light = recipe.light
    document = SensingDocument(
        device_serial=captures.dataset.serial,
        inputs=captures.hashed(scene.depth_files),
        uses=captures.used("response", "projector", "material"),
        warnings=fit.warnings,
        light=LightUsed(intensity=light.intensity or 0.0, fall_off=light.fall_off, vignetting=light.vignetting),
        curve=fit.curve,
        views=scene.names,
        pixels=fit.pixels,
        held_out=fit.held_out is not None,
        scores=_scores(fit.held_out or fit.inside),
        exponential_scores=_scores(fit.exponential_held_out or fit.exponential_inside),
    ).sealed()
    ours, papers = document.scores, document.exponential_scores
    summary = (
        f"{fit.pixels} pixels of {len(scene.names)} views, log-loss {ours.log_loss:.3f}, the exponential's best "
        f"{papers.log_loss:.3f}, expected calibration error {ours.expected_calibration_error:.3f} against "
        f"{papers.expected_calibration_error:.3f}"
    )
    return Made(document, draw_sensing(fit, samples, response), summary)


def _samples(scene: Scene, recipe: Recipe, progress: Progress) -> SensingSamples:
    """Predict each view, and look up what it measured."""
    rig, part = scene.dataset.rig, scene.dataset.part(scene.object)
    light = light_model(recipe, part)
    request = CaptureRequest(Projector.DOTS, recipe.depth_exposure_s, depth=True)
    views = scene.views()
    found: list[SensingSamples] = []
    for done, view in enumerate(views):
        progress("views", done, len(views))
        found.append(samples_of([scene.frame(view, request)], scene.base_T_objects, part, rig, light))
    progress("views", len(views), len(views))
    return SensingSamples(
        exposure=np.concatenate([each.exposure for each in found]),
        valid=np.concatenate([each.valid for each in found]),
        group=np.repeat(np.arange(len(found)), [len(each) for each in found]),
        weight=np.concatenate([each.weight for each in found]),
    )


def _scores(scores: ForecastScores) -> Scores:
    return Scores(log_loss=scores.log_loss, brier=scores.brier, expected_calibration_error=scores.ece)


def draw_sensing(fit: SensingFit, samples: SensingSamples, response: Response) -> bytes:
    """Draw the curve with what was counted, and the reliability of curve and exponential; return a PNG."""
    from matplotlib.figure import Figure

    figure: Any = Figure(figsize=(15, 5.2), dpi=100, layout="constrained")
    grid = figure.add_gridspec(2, 3, height_ratios=(3, 1))
    _draw_curve(figure.add_subplot(grid[0, 0]), figure.add_subplot(grid[1, 0]), fit, response)
    kinds = {"curve": CurveSensing(fit.curve, 0.0), "best exponential": PaperSensing(fit.exponential, response)}
    for column, (name, kind) in enumerate(kinds.items(), start=1):
        above = figure.add_subplot(grid[0, column])
        below = figure.add_subplot(grid[1, column], sharex=above)
        forecast = Forecast(kind.probability(samples.exposure), samples.weight, samples.valid)
        report = Reliability().add(forecast).report()
        draw_on(above, below, report)
        above.set_title(f"{name}, on the views it was fitted to\n{told(report)}", fontsize=10)
    return png(figure)


def _draw_curve(above: Any, below: Any, fit: SensingFit, response: Response) -> None:
    middles = (fit.log_edges[1:] + fit.log_edges[:-1]) / 2
    some = fit.count > 0
    reach = 1.96 * np.nan_to_num(fit.standard_error[some])
    above.errorbar(middles[some], fit.frequency[some], yerr=reach, fmt=".", capsize=2, label="measured, 95 %")
    log_exposure: FloatArray = np.linspace(float(fit.log_edges[0]) - 0.5, float(fit.log_edges[-1]) + 0.5, 400)
    exposure = np.exp(log_exposure)
    above.plot(log_exposure, fit.curve.at(exposure), color="black", label="curve")
    paper = PaperSensing(fit.exponential, response).probability(exposure[:, None])
    above.plot(log_exposure, paper, color="grey", linestyle="--", label="best exponential")
    above.axvline(0.0, color="red", linewidth=0.8)
    above.set_ylim(0, 1)
    above.set_ylabel("share of pixels with depth")
    above.legend(fontsize=8)
    above.set_title(f"{fit.pixels} pixels; red: the sensor clips", fontsize=10)
    below.bar(middles, fit.count, np.diff(fit.log_edges) * 0.9)
    below.set_ylabel("pixels")
    below.set_xlabel("ln exposure, as predicted")
