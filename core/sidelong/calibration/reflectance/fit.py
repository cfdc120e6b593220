"""Phong reflectance of a material from samples: robust, with intervals, and honest about what was not measured.

The paper's two stages (:mod:`sidelong.calibration.reflectance.two_stages`) take logarithms of differences near zero and
are biased by noise. Here [n, k_d, k_s] are fitted to the radiance itself: weighted by noise and by the error of the
normals, saturated and dark samples as bounds, outliers bounded. Assumed: normals err by independent noise of known size
and by one common tilt, and their true directions are spread smoothly.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from sidelong.calibration.reflectance.model import ReflectanceSamples, expected_normals
from sidelong.calibration.reflectance.result import Found, ReflectanceFit, judged_by, model_of, report
from sidelong.calibration.reflectance.solver import (
    K_D,
    K_S,
    LOG_N,
    STANDARD_95,
    TILT,
    Point,
    Problem,
    first_guesses,
    profile_limits,
    search_bounds,
    tilt_prior,
)
from sidelong.errors import CalibrationError
from sidelong.physics.response import Response
from sidelong.types import BoolArray, FloatArray, IntArray

FEWEST_SAMPLES = 30
LEAST_SPREAD_RAD, LEAST_RATIO = np.deg2rad(5.0), 2.0
"""Range of alpha below which diffuse and specular light cannot be told apart, unless the largest is so many times the
smallest: all angles are small beside a mirror's lobe."""
GRAZING_COSINE = 0.05
DOUBTFUL, CHI_SQUARED_2 = 6.0, 5.991
"""Deviations of k_s up to which it is tested against 0, and the 95 % point for the two parameters of a lobe."""
LARGEST_SPREAD = 1.1
"""Spread over expectation beyond which a misfit of the model is assumed: chance reaches 1.05 in 3000 samples."""
WELL_KNOWN = 0.08
"""Relative standard error below which the loss is parabolic enough for an interval from the standard error."""


class ReflectanceSettings(BaseModel):
    """How samples are fitted."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    outlier_limit: FiniteFloat = Field(
        default=4.0, ge=1.0, le=100.0, description="standard deviations beyond which a residual is an outlier"
    )
    tilt_sigma_rad: FiniteFloat = Field(
        default=0.05, ge=0.0, le=0.3, description="prior of a tilt common to all normals; 0: there is none"
    )
    max_samples: int = Field(
        default=3000, ge=FEWEST_SAMPLES, le=100_000, description="more are thinned evenly in alpha"
    )
    seed: int = Field(default=0, ge=0, description="of the thinning")


DEFAULTS = ReflectanceSettings()


def fit_reflectance(
    samples: ReflectanceSamples,
    settings: ReflectanceSettings = DEFAULTS,
    sensor: tuple[Response, float] | None = None,
) -> ReflectanceFit:
    """Fit [n, k_d, k_s] of equation (5).

    Parameters
    ----------
    samples
        Measurements of one material.
    settings
        Robustness, prior of a tilt, number of samples.
    sensor
        Response and exposure (s) of the capture, to state the residual in grey levels as well.

    Raises
    ------
    CalibrationError
        Fewer than ``FEWEST_SAMPLES`` usable samples, all of them saturated, or all at one angle.
    """
    usable = usable_samples(samples)
    kept = samples[usable]
    _refuse(kept, len(samples))
    rng = np.random.default_rng(settings.seed)
    population = kept.normals[rng.permutation(len(kept))[:3000]]
    thinned = kept[_thinned(kept, settings.max_samples, rng)]
    thinned = replace(thinned, normals=expected_normals(thinned.normals, thinned.normal_sigma_rad, population))
    problem, point, misfit = _minimum(thinned, settings)
    covariance, by_loss = _covariances(problem, point)
    found = Found(problem, point, misfit, covariance, by_loss)
    return report(samples, usable, found, judged_by(found, _intervals(found)), sensor)


def usable_samples(samples: ReflectanceSamples) -> BoolArray:
    """Say which samples (N,) carry information: finite, lit, seen, not so grazing that the normal's error decides."""
    grazing = GRAZING_COSINE + 2.0 * samples.normal_sigma_rad
    vectors = (samples.to_light, samples.to_camera, samples.normals)
    finite = np.isfinite(np.concatenate(vectors, axis=1)).all(axis=1) & np.isfinite(samples.normal_sigma_rad)
    finite &= np.isfinite(samples.radiance) & (samples.sigma > 0) & np.isfinite(samples.sigma)
    finite &= np.isfinite(samples.light) & (samples.light > 0)
    facing = [np.einsum("ij,ij->i", each, samples.normals) > grazing for each in vectors[:2]]
    return finite & facing[0] & facing[1]


def _refuse(kept: ReflectanceSamples, given: int) -> None:
    if len(kept) < FEWEST_SAMPLES:
        raise CalibrationError(
            f"samples: {len(kept)} of {given} are lit, seen and finite, needs {FEWEST_SAMPLES}: use a capture that "
            "shows more of the material"
        )
    if kept.saturated.all():
        raise CalibrationError(f"samples: all {len(kept)} are saturated, needs some that are not: expose less")
    spread = float(np.ptp(kept.alpha_rad))
    if spread < LEAST_SPREAD_RAD and kept.alpha_rad.max() < LEAST_RATIO * kept.alpha_rad.min():
        raise CalibrationError(
            f"samples: alpha spans {np.rad2deg(spread):.2g} deg, needs {np.rad2deg(LEAST_SPREAD_RAD):.2g} deg to tell "
            "diffuse from specular light: show curved or differently turned surfaces"
        )


def _thinned(samples: ReflectanceSamples, most: int, rng: np.random.Generator) -> IntArray:
    """Choose at most ``most`` samples, evenly over alpha as far as there are any."""
    if len(samples) <= most:
        return np.arange(len(samples))
    order = rng.permutation(len(samples))
    bins = (samples.alpha_rad[order] / np.deg2rad(4.0)).astype(np.intp)
    rank = np.empty(len(order), dtype=np.intp)
    for each in np.unique(bins):
        rank[bins == each] = np.arange(int((bins == each).sum()))
    return np.sort(order[np.argsort(rank, kind="stable")[:most]])


def _minimum(samples: ReflectanceSamples, settings: ReflectanceSettings) -> tuple[Problem, Point, float]:
    """Refine the best starts with deviations that follow the fit; return the best, and the model's relative misfit."""
    lower, upper = search_bounds(samples, settings.tilt_sigma_rad)
    prior = tilt_prior(samples, settings.tilt_sigma_rad)
    found: list[tuple[float, Problem, Point, float]] = []
    for at in first_guesses(samples, settings.outlier_limit, float(np.exp(upper[LOG_N]))):
        sd = np.hypot(samples.sigma, 0.1 * np.abs(samples.radiance))
        misfit, iterations = 0.0, 0
        for last in (False, False, False, True):
            problem = Problem(samples, sd, settings.outlier_limit, prior, lower, upper)
            point = problem.solve(at, problem.free)
            at, iterations = point.at, iterations + point.iterations
            if not last:
                sd, misfit = _deviation(samples, at)
        found.append((point.loss + float(np.log(sd).sum()), problem, replace(point, iterations=iterations), misfit))
    _, problem, point, misfit = min(found, key=lambda each: each[0])
    return problem, point, misfit


def _deviation(samples: ReflectanceSamples, at: FloatArray) -> tuple[FloatArray, float]:
    """Return the standard deviation (N,) of radiance minus model, and the relative misfit it needs to explain it."""
    model, variance = model_of(samples, at)
    variance = np.square(samples.sigma) + np.square(samples.light) * variance
    measured = ~(samples.saturated | samples.dark)
    if measured.sum() < FEWEST_SAMPLES:
        return np.asarray(np.sqrt(variance), dtype=np.float64), 0.0
    error = (samples.radiance - model)[measured]

    def spread(misfit: float, chosen: BoolArray) -> float:
        sd = np.sqrt(variance[measured] + np.square(misfit * model[measured]))
        return 1.4826 * float(np.median(np.abs(error / sd)[chosen]))

    bright = model[measured] >= np.median(model[measured])
    low, high = 0.0, 1.0
    if spread(0.0, bright) > LARGEST_SPREAD:
        for _ in range(12):
            middle = (low + high) / 2.0
            low, high = (middle, high) if spread(middle, bright) > 1.0 else (low, middle)
    excess = max(1.0, spread(low, np.ones_like(bright)))
    return np.asarray(excess * np.sqrt(variance + np.square(low * model)), dtype=np.float64), low


def _covariances(problem: Problem, point: Point) -> tuple[FloatArray, FloatArray]:
    """Return the covariance (6, 6) by the scatter of groups (sandwich, HC3), and that by the loss.

    Where a parameter carries no information, a variance of 1e12 stands for infinity.
    """
    information = problem.information(point)
    inverse: FloatArray = np.asarray(np.linalg.inv(information + np.diag(np.where(problem.free, 1e-12, 1e12))), float)
    leverage = np.einsum("ij,jk,ik->i", point.jacobian, inverse, point.jacobian)
    residual = problem.pull(point) / np.maximum(1.0 - leverage, 0.25)
    score = point.jacobian * residual[:, None]
    _, group = np.unique(problem.samples.group, return_inverse=True)
    summed = np.stack([np.bincount(group, column) for column in score.T], axis=1)
    scatter = summed.T @ summed * len(summed) / max(len(summed) - 6, 1)
    if problem.tilt_precision is not None:
        scatter[TILT, TILT] += problem.tilt_precision
    covariance = inverse @ scatter @ inverse
    # a few samples carry a narrow lobe, and their scatter may be small by chance: never below what the noise makes
    spread = np.maximum(np.diag(covariance), 1e-12 * np.diag(inverse) + 1e-300)
    widen = np.sqrt(np.maximum(np.diag(inverse) / spread, 1.0))
    return covariance * np.outer(widen, widen), inverse


def _intervals(found: Found) -> dict[str, tuple[float, float]]:
    """Return the 95 % intervals by name. Where k_s may be 0, any n may be."""
    problem, best = found.problem, found.point
    low, high = _limits(found, K_S)
    if low > 0 and best.at[K_S] < DOUBTFUL * np.sqrt(found.covariance[K_S, K_S]):
        # without a lobe n means nothing: a lobe of two parameters must earn more than one of known width
        matte = problem.solve(np.where(np.arange(6) == K_S, 0.0, best.at), problem.free & (np.arange(6) != K_S))
        low = 0.0 if 2.0 * (matte.loss - best.loss) <= CHI_SQUARED_2 * _inflation(found, K_S) else low
    ends = np.exp([problem.lower[LOG_N], problem.upper[LOG_N]])
    n = (float(ends[0]), float(ends[1])) if low <= 0 else _limits(found, LOG_N)
    return {"n": n, "k_d": _limits(found, K_D), "k_s": (low, high)}


def _inflation(found: Found, index: int) -> float:
    """Return the variance of a parameter by the scatter of the samples over that by the loss."""
    return float(np.clip(found.covariance[index, index] / found.by_loss[index, index], 0.25, 100.0))


def _limits(found: Found, index: int) -> tuple[float, float]:
    """Return the 95 % interval of a parameter: by its standard error where that is small, else by the profile."""
    problem, best, covariance = found.problem, found.point, found.covariance
    value, error = float(best.at[index]), float(np.sqrt(covariance[index, index]))
    known = error if index == LOG_N else error / value if value > 0 else np.inf
    k_s, k_s_error = best.at[K_S], np.sqrt(covariance[K_S, K_S])
    if known < WELL_KNOWN and k_s_error < WELL_KNOWN * k_s:
        if index == LOG_N:
            return float(np.exp(value - STANDARD_95 * error)), float(np.exp(value + STANDARD_95 * error))
        return float(value * np.exp(-STANDARD_95 * known)), float(value * np.exp(STANDARD_95 * known))
    step = float(np.clip(STANDARD_95 * error, 1e-6 * problem.upper[index], 1.0 if index == LOG_N else np.inf))
    low, high = profile_limits(problem, best, index, _inflation(found, index), step)
    return (float(np.exp(low)), float(np.exp(high))) if index == LOG_N else (low, high)
