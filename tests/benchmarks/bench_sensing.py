"""Kinds of sensing probability on simulated bins: honesty and completeness on parts the curve was not learned from.

    python tests/benchmarks/bench_sensing.py [--light table] [--seeds 11 12] [--rules] [--train curve.json]

Each bin is recorded once from the views of a dome. Poses are true, so that nothing but light and sensor matters. The
projector's intensity is fitted to a white capture with the sensor's response (``--light table``) or with a linear one
(``fitted``), or neither is known (``preset``). Curves are learned on the other parts. *Complete*: views are chosen
greedily by the sum of P over what is still missing, from every reference view; a pixel counts once a view has its
depth. ``--rules`` compares ways to join two cameras; ``--train`` writes the curve of all parts.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import minimize

from sidelong.calibration.projector.white_image import fit_intensity
from sidelong.calibration.sensing.fit import fit_sensing
from sidelong.calibration.sensing.samples import SensingSamples, samples_of
from sidelong.calibration.sensing.scores import scores_of
from sidelong.devices import CaptureRequest
from sidelong.geometry.mesh import Part
from sidelong.geometry.transforms import invert
from sidelong.physics.response import LEVELS, Response
from sidelong.physics.sensing import CurveSensing, PaperSensing, Sensing, SensingSettings
from sidelong.planning.candidates import DomeSettings, dome_views
from sidelong.planning.gain import Planner
from sidelong.planning.prior import believe
from sidelong.planning.shading import LightModel
from sidelong.recipe import Recipe, light_model
from sidelong.simulation.exposure import ExposureSettings
from sidelong.simulation.rig import rig_for
from sidelong.types import DetectedObject, Frame, Hypothesis, Projector
from sidelong_drivers.simulated import SimulatedCamera, SimulatedCameraSettings

COUNTS = {"tube_fitting": 10, "hex_screw": 12, "eye_bolt": 10, "gear": 8}
EXPOSURE_S = 0.012
RIG = rig_for()
VIEWS_ADDED = 3


@dataclass(frozen=True, eq=False)
class Bin:
    """Captures of one simulated bin, a white one from its first view, and the true poses."""

    part: Part
    frames: tuple[Frame, ...]
    white: Frame
    base_T_objects: tuple[np.ndarray, ...]


@dataclass(frozen=True, eq=False)
class Reference:
    """Pixels missing in one view in each other view: exposures (V, N, 2), whether reached and measured (V, N)."""

    exposure: np.ndarray
    reached: np.ndarray
    measured: np.ndarray


@dataclass(frozen=True, eq=False)
class Scene:
    """A bin under one model of its light."""

    part: str
    samples: SensingSamples
    references: tuple[Reference, ...]


def recorded(part: str, seed: int) -> Bin:
    camera = SimulatedCamera(SimulatedCameraSettings(part=part, seed=seed, count=COUNTS[part]))
    camera.open()
    views = dome_views((0.5, 0.0, 0.03), DomeSettings())
    dots, white = (
        CaptureRequest(kind, EXPOSURE_S, depth=kind is Projector.DOTS) for kind in (Projector.DOTS, Projector.WHITE)
    )
    frames = tuple(replace(camera.capture(dots, view.base_T_camera), view=view) for view in views)
    bright = replace(camera.capture(white, views[0].base_T_camera), view=views[0])
    return Bin(camera.part, frames, bright, tuple(camera.base_T_objects))


def sensor_response() -> Response:
    """The simulated sensor's response, as a bracket of exposures would give it."""
    knee = ExposureSettings().knee
    z = np.arange(LEVELS) / (LEVELS - 1)
    z[0] = 0.5 / (LEVELS - 1)
    return Response(np.log(knee * z / (1 + knee - z)))


def light_of(recording: Bin, kind: str) -> LightModel:
    light = light_model(Recipe(), recording.part)
    if kind == "preset":
        return light
    light = replace(light, response=sensor_response()) if kind == "table" else light
    fit = fit_intensity(recording.white, recording.base_T_objects, recording.part, RIG, light)
    return replace(light, intensity=fit.intensity)


def seen(recording: Bin, light: LightModel) -> Scene:
    samples = samples_of(recording.frames, recording.base_T_objects, recording.part, RIG, light, stride_px=3)
    references = tuple(reference_of(recording, light, frame) for frame in recording.frames)
    return Scene(recording.part.name, samples, references)


def reference_of(recording: Bin, light: LightModel, frame: Frame) -> Reference:
    camera_T_base = invert(frame.view.base_T_camera)
    objects = [DetectedObject((Hypothesis(camera_T_base @ pose, 100.0, 1.0),)) for pose in recording.base_T_objects]
    missing = ~np.isfinite(frame.depth_m)
    belief = believe(objects, recording.part, RIG.left, frame.view.base_T_camera, missing, stride_px=3)
    planner = Planner(belief, recording.part, RIG, light)
    others = [other for other in recording.frames if other is not frame]
    predictions = [planner.predict(other.view) for other in others]
    return Reference(
        np.stack([each.exposure for each in predictions]),
        np.stack([each.reached for each in predictions]),
        np.stack([each.measured(other.depth_m) for each, other in zip(predictions, others, strict=True)]),
    )


def completeness(references: Sequence[Reference], sensing: Sensing) -> np.ndarray:
    """Mean share (VIEWS_ADDED,) of the missing pixels that greedily chosen views measure, and the forecast's share."""
    rows = []
    for reference in references:
        p = probability(reference, sensing)
        missing, left, row, promised = np.ones(p.shape[1], np.bool_), list(range(len(p))), [], 0.0
        for _ in range(VIEWS_ADDED):
            best = max(left, key=lambda view: float(p[view] @ missing))
            left.remove(best)
            promised += float(p[best] @ missing)
            missing &= ~reference.measured[best]
            row.append(1.0 - missing.mean())
        rows.append([*row, promised / max(1, (~missing).sum())])
    return np.mean(rows, axis=0)


def at_random(references: Sequence[Reference], draws: int = 40) -> np.ndarray:
    rng = np.random.default_rng(0)
    orders = [(each, rng.permutation(len(each.measured))) for each in references for _ in range(draws)]
    return np.mean(
        [[each.measured[o[: k + 1]].any(axis=0).mean() for k in range(VIEWS_ADDED)] for each, o in orders], axis=0
    )


def probability(reference: Reference, sensing: Sensing) -> np.ndarray:
    views, points, cameras = reference.exposure.shape
    p = sensing.probability(reference.exposure.reshape(-1, cameras)).reshape(views, points)
    return np.where(reference.reached, p, 0.0)


def joined(parts: Sequence[SensingSamples]) -> SensingSamples:
    """Put scenes together, each counting the same, each a group."""
    return SensingSamples(
        np.concatenate([each.exposure for each in parts]),
        np.concatenate([each.valid for each in parts]),
        np.concatenate([np.full(len(each), k) for k, each in enumerate(parts)]),
        np.concatenate([np.full(len(each), sum(map(len, parts)) / len(parts) / len(each)) for each in parts]),
    )


def forecast_scores(scene: Scene, sensing: Sensing):
    p = np.concatenate([probability(each, sensing).ravel() for each in scene.references])
    return scores_of(p, np.concatenate([each.measured.ravel() for each in scene.references]))


def compare(scenes: Sequence[Scene], response: Response) -> None:
    """Write a row for each part and kind: scores of the forecast, promised over measured, completeness."""
    say(f"{'kind':22s}{'part':14s} log-loss  brier    ECE  promised/measured  complete after 1, 2, 3 views")
    for kind in ("random", "exponential, default", "exponential, fitted", "curve", "curve, all of it"):
        rows = []
        for part in COUNTS:
            mine, others = ([s for s in scenes if (s.part == part) is here] for here in (True, False))
            if mine:
                rows.append(np.mean([row_of(kind, scene, others, response) for scene in mine], axis=0))
                write_row(kind, part, rows[-1])
        write_row(kind, "mean", np.mean(rows, axis=0))


def row_of(kind: str, scene: Scene, others: Sequence[Scene], response: Response) -> np.ndarray:
    if kind == "random":
        return np.array([*[np.nan] * 4, *at_random(scene.references)])
    sensing = sensing_of(kind, tuple(others), response)
    scores, complete = forecast_scores(scene, sensing), completeness(scene.references, sensing)
    return np.array([scores.log_loss, scores.brier, scores.ece, complete[-1], *complete[:-1]])


LEARNED: dict[tuple[str, tuple[Scene, ...]], Sensing] = {}


def sensing_of(kind: str, others: tuple[Scene, ...], response: Response) -> Sensing:
    """Return a kind; what is learned is learned from the other parts, once."""
    if kind == "exponential, default":
        return PaperSensing(SensingSettings(), response)
    if (kind, others) not in LEARNED:
        fit = fit_sensing(joined([each.samples for each in others]), response)
        share = SensingSettings().least_share if kind == "curve" else 0.0
        fitted = PaperSensing(fit.exponential, response)
        LEARNED[kind, others] = fitted if kind.endswith("fitted") else CurveSensing(fit.curve, share)
    return LEARNED[kind, others]


def write_row(kind: str, part: str, row: np.ndarray) -> None:
    shares = "  ".join(f"{100 * each:5.1f}" for each in row[4:])
    say(f"{kind:22s}{part:14s}{row[0]:9.3f}{row[1]:7.3f}{row[2]:7.3f}{row[3]:19.2f}  {shares}")


def compare_rules(scenes: Sequence[Scene]) -> None:
    """Fit f freely (16 knots) under each rule by maximum likelihood; write the log-loss on parts left out."""
    knots = np.linspace(-4.0, 3.0, 16)
    rules: dict[str, Callable[[np.ndarray], np.ndarray]] = {
        "min f": lambda each: each.min(axis=1),
        "product": lambda each: each.prod(axis=1),
        "f of the darker": lambda each: each[:, 0],
    }
    for name, rule in rules.items():
        losses = []
        for part in COUNTS:
            mine, others = (joined([s.samples for s in scenes if (s.part == part) is here]) for here in (True, False))
            logits = fitted_logits(others, knots, rule)
            losses.append(loss(logits, mine, knots, rule))
        say(
            f"{name:16s} log-loss on parts left out {np.mean(losses):.4f}  "
            + "  ".join(f"{each:.4f}" for each in losses)
        )


def fitted_logits(samples: SensingSamples, knots: np.ndarray, rule: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    thin = samples[np.arange(0, len(samples), 5)]
    return minimize(lambda x: loss(x, thin, knots, rule), np.zeros(len(knots)), method="L-BFGS-B").x


def loss(
    logits: np.ndarray, samples: SensingSamples, knots: np.ndarray, rule: Callable[[np.ndarray], np.ndarray]
) -> float:
    log_x = np.sort(np.log(np.maximum(samples.exposure, 1e-9)), axis=1)
    p = np.clip(rule(1.0 / (1.0 + np.exp(-np.interp(log_x, knots, logits)))), 1e-3, 1 - 1e-3)
    surprise = -np.log(np.where(samples.valid, p, 1 - p))
    return float(np.average(surprise, weights=samples.weight))


def say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--light", choices=("table", "fitted", "preset"), default="table")
    parser.add_argument("--seeds", type=int, nargs="+", default=[11, 12])
    parser.add_argument("--rules", action="store_true")
    parser.add_argument("--train", type=Path, help="file for the curve of all parts")
    asked = parser.parse_args()
    started_s = time.perf_counter()
    scenes = []
    for part in COUNTS:
        for seed in asked.seeds:
            recording = recorded(part, seed)
            light = light_of(recording, asked.light)
            scenes.append(seen(recording, light))
            say(
                f"{part} {seed}: {len(scenes[-1].samples)} px, intensity {light.intensity:.0f}, "
                f"{time.perf_counter() - started_s:.0f} s"
            )
    response = sensor_response() if asked.light == "table" else Response.gamma()
    if asked.rules:
        compare_rules(scenes)
    elif asked.train is None:
        compare(scenes, response)
    else:
        fit = fit_sensing(joined([each.samples for each in scenes]), response)
        say(f"curve, inside   {fit.inside}\ncurve, left out {fit.held_out}")
        say(f"{fit.exponential}, left out {fit.exponential_held_out}\n{'; '.join(fit.warnings)}")
        asked.train.write_text(fit.curve.model_dump_json(indent=1))


if __name__ == "__main__":
    main()
