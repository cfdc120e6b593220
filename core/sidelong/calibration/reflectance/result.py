"""What a fit of reflectance says: values, intervals, which of them were measured, and what stands in for the others."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np

from sidelong.calibration.reflectance.model import MirrorGeometry, ReflectanceSamples
from sidelong.calibration.reflectance.solver import K_D, K_S, LOG_N, TILT, Point, Problem
from sidelong.physics.reflectance import Phong
from sidelong.physics.response import Response
from sidelong.types import BoolArray, FloatArray

NAMES = ("n", "k_d", "k_s")
INDEX = {"n": LOG_N, "k_d": K_D, "k_s": K_S}
N_STAND_IN = 10.0
"""A broad lobe: promises no highlight in places where none was seen."""
LARGEST_RATIO_N = 4.0
"""Upper over lower limit of n above which it is not called identified: the lobe's width is then unknown by half."""
LARGEST_WIDTH, LARGEST_SHARE_WIDTH = 0.5, 0.1
"""Width of an interval of k_d or k_s up to which it is called identified: over its value, or over k_d + k_s."""
CHI_SQUARED_95 = 7.815
"""95 % point for three parameters."""
LARGEST_CONDITION = 1e16
LARGE_TILT_DEG, LARGE_MISFIT, MANY_OUTLIERS, NEAR_MIRROR_DEG, MUCH_SATURATED = 0.5, 0.1, 0.05, 20.0, 0.3
"""What deserves a warning."""
NO_PEAK = 0.9
"""Share of saturated samples near the mirror direction above which the peak of the highlight was not measured."""


@dataclass(frozen=True)
class Parameter:
    """One fitted parameter.

    Attributes
    ----------
    value
        The estimate; where it is not identified a stand-in, or what ``note`` says.
    standard_error
        Of the estimate; 0 where it is a stand-in.
    low, high
        95 % interval, always of the measurement. Limits of the search where nothing bounds it.
    identified
        Whether the samples fix it.
    note
        Why not, and what stands in; empty where identified.
    """

    value: float
    standard_error: float
    low: float
    high: float
    identified: bool
    note: str = ""

    @property
    def stand_in(self) -> bool:
        """Whether the value was not measured."""
        return not self.identified


@dataclass(frozen=True, eq=False)
class ReflectanceFit:
    """Result of :func:`fit_reflectance`.

    Attributes
    ----------
    phong
        The reflectance to plan with; finite, stand-ins included.
    parameters
        By name: n, k_d, k_s.
    absorbing
        Nothing exceeded the noise: the upper limits of k_d and k_s are all that is known.
    tilt_rad, tilt_standard_error_rad
        (3,) common rotation of the normals that fits best; about the mean mirror direction it is held near 0.
    tilt_evidence
        Drop of twice the loss by the tilt: above 8 it is there (three parameters, 95 %).
    condition
        Of the correlation matrix of ln n, k_d, k_s; large where they are confounded. 1e16 at most.
    relative_misfit
        Share of the radiance that noise and normals leave unexplained: 0 where the model holds.
    residual_rms, relative_rms, residual_rms_grey
        Robust spread of radiance minus model over measured samples: in radiance, over the model, and in grey levels
        where the sensor was given.
    residual
        (N,) radiance minus model for each given sample; NaN where it was not usable.
    used, saturated, dark, outliers, unusable
        Counts of samples: fitted, of these censored above and below, outliers; given but unusable.
    alpha_rad
        Smallest and largest alpha of the used samples.
    converged, iterations
        Of the search.
    warnings
        What a reader of the values should know.
    """

    phong: Phong
    parameters: Mapping[str, Parameter]
    absorbing: bool
    tilt_rad: FloatArray
    tilt_standard_error_rad: FloatArray
    tilt_evidence: float
    condition: float
    relative_misfit: float
    residual_rms: float
    relative_rms: float
    residual_rms_grey: float | None
    residual: FloatArray
    used: int
    saturated: int
    dark: int
    outliers: int
    unusable: int
    alpha_rad: tuple[float, float]
    converged: bool
    iterations: int
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class Found:
    """The minimum: its problem, the relative misfit, covariances (6, 6) by scatter and by the loss."""

    problem: Problem
    point: Point
    misfit: float
    covariance: FloatArray
    by_loss: FloatArray


@dataclass(frozen=True, eq=False)
class Judged:
    """What is handed on: parameters with stand-ins, the fit beside them, whether nothing came back at all."""

    parameters: Mapping[str, Parameter]
    point: Point
    absorbing: bool


def model_of(samples: ReflectanceSamples, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return expected radiance (N,) and the variance the error of the normals brings, per squared light."""
    geometry, n = MirrorGeometry(samples, at[TILT]), float(np.exp(at[LOG_N]))
    model = samples.light * (at[K_D] * geometry.diffuse + at[K_S] * geometry.lobe(n).mean)
    return np.asarray(model, dtype=np.float64), geometry.variance(float(at[K_D]), float(at[K_S]), n)


def judged_by(found: Found, limits: Mapping[str, tuple[float, float]]) -> Judged:
    """Decide what is identified, put stand-ins where nothing is, and refit the rest beside them."""
    problem, best = found.problem, found.point
    nothing = problem.point(np.where(np.isin(np.arange(6), (K_D, K_S)), 0.0, best.at))
    absorbing = bool(2.0 * (nothing.loss - best.loss) <= CHI_SQUARED_95)
    if absorbing:
        limits = {name: (0.0 if name in ("k_d", "k_s") else low, high) for name, (low, high) in limits.items()}
    notes = _notes(problem, best, limits, absorbing)
    at, free = best.at.copy(), problem.free.copy()
    for name in (name for name in NAMES if notes[name]):
        low, high = limits[name]
        at[INDEX[name]] = np.log(np.clip(N_STAND_IN, low, high)) if name == "n" else low
        free[INDEX[name]] = False
    planned = problem.solve(at, free) if any(notes.values()) else best
    parameters: dict[str, Parameter] = {}
    for name in NAMES:
        (low, high), note, index = limits[name], notes[name], INDEX[name]
        value = float(np.exp(planned.at[index]) if name == "n" else planned.at[index])
        error = float(np.sqrt(found.covariance[index, index])) * (value if name == "n" else 1.0)
        note = f"{note}; {value:.3g} stands in" if note else ""
        parameters[name] = Parameter(value, 0.0 if note else error, min(low, value), max(high, value), not note, note)
    return Judged(MappingProxyType(parameters), planned, absorbing)


def _notes(problem: Problem, best: Point, limits: Mapping[str, tuple[float, float]], absorbing: bool) -> dict[str, str]:
    """Say per parameter why the samples do not fix it; empty where they do."""
    total = float(best.at[K_D] + best.at[K_S])
    alpha = problem.samples.alpha_rad
    nearest, widest = (float(np.rad2deg(each)) for each in (alpha.min(), alpha.max()))
    notes: dict[str, str] = dict.fromkeys(NAMES, "")
    for name in ("k_d", "k_s"):
        low, high = limits[name]
        if absorbing:
            notes[name] = f"nothing above the noise: {name} is at most {high:.2g}"
        elif high - low > max(LARGEST_WIDTH * float(best.at[INDEX[name]]), LARGEST_SHARE_WIDTH * total):
            why = f"its interval is {low:.2g} to {high:.2g}"
            if name == "k_d" and widest < 90.0:
                why = f"no normals beyond 90 degrees (alpha ends at {widest:.0f}), {why}"
            if name == "k_s" and (
                problem.samples.saturated[alpha < np.deg2rad(NEAR_MIRROR_DEG)].all() or nearest > NEAR_MIRROR_DEG
            ):
                why = f"no measured sample within {NEAR_MIRROR_DEG:g} degrees of the mirror direction, {why}"
            notes[name] = f"{name} not identifiable: {why}"
    low, high = limits["n"]
    if limits["k_s"][0] <= 0.0:
        kind = "absorbing" if absorbing else "no highlight looked at" if nearest > NEAR_MIRROR_DEG else "matte"
        notes["n"] = (
            f"{kind}: n not identifiable, k_s may be 0 and is at most {limits['k_s'][1]:.2g} if n is at most "
            f"{high:.3g}, above which a lobe falls between the samples"
        )
    elif high > LARGEST_RATIO_N * low:
        notes["n"] = f"n not identifiable: its interval is {low:.2g} to {high:.2g}"
    elif best.at[LOG_N] >= problem.upper[LOG_N] - 1e-3:
        notes["n"] = f"n not identifiable: the lobe is narrower than samples and normals resolve (n {high:.3g})"
    return notes


def report(
    samples: ReflectanceSamples,
    usable: BoolArray,
    found: Found,
    judged: Judged,
    sensor: tuple[Response, float] | None,
) -> ReflectanceFit:
    """Put all figures of a fit together; the residual is of the given samples, not of the thinned ones."""
    problem, at, parameters = found.problem, judged.point.at, judged.parameters
    fitted = problem.samples
    residual = np.full(len(samples), np.nan)
    residual[usable] = samples.radiance[usable] - model_of(samples[usable], at)[0]
    model, _ = model_of(fitted, at)
    measured = ~(fitted.saturated | fitted.dark)
    error = np.abs(fitted.radiance - model)[measured]
    alpha = fitted.alpha_rad
    return ReflectanceFit(
        phong=Phong(parameters["k_d"].value, parameters["k_s"].value, parameters["n"].value),
        parameters=_without_peak(parameters, found),
        absorbing=judged.absorbing,
        tilt_rad=at[TILT],
        tilt_standard_error_rad=np.sqrt(np.diag(found.covariance)[TILT]) * problem.free[TILT],
        tilt_evidence=_tilt_evidence(problem, found.point),
        condition=_condition(found.by_loss),
        relative_misfit=found.misfit,
        residual_rms=_robust_rms(error),
        relative_rms=_robust_rms(error / np.maximum(model[measured], 1e-12 + fitted.sigma[measured])),
        residual_rms_grey=None if sensor is None else _grey_rms(fitted.radiance[measured], model[measured], *sensor),
        residual=residual,
        used=len(fitted),
        saturated=int(fitted.saturated.sum()),
        dark=int(fitted.dark.sum()),
        outliers=int((np.abs(judged.point.residual) > problem.limit).sum()),
        unusable=int((~usable).sum()),
        alpha_rad=(float(alpha.min()), float(alpha.max())),
        converged=found.point.converged,
        iterations=found.point.iterations,
        warnings=_warnings(found, judged),
    )


def _clipped_peak(fitted: ReflectanceSamples) -> float:
    """Return the share of the samples near the mirror direction that are saturated."""
    near = fitted.alpha_rad < np.deg2rad(NEAR_MIRROR_DEG)
    return float(fitted.saturated[near].mean()) if near.any() else 0.0


def _without_peak(parameters: Mapping[str, Parameter], found: Found) -> Mapping[str, Parameter]:
    """Take back that n and k_s are identified where no peak was measured and the surface is no Phong surface.

    On a Phong surface the flanks of a lobe tell its peak; on another they tell of the flanks alone.
    """
    if _clipped_peak(found.problem.samples) <= NO_PEAK or found.misfit <= LARGE_MISFIT:
        return parameters
    note = "extrapolated from the flanks of a saturated highlight of no Phong surface: expose less to measure it"
    doubted = {
        name: replace(parameters[name], identified=False, note=note)
        for name in ("n", "k_s")
        if parameters[name].identified
    }
    return MappingProxyType({**parameters, **doubted})


def _robust_rms(error: FloatArray) -> float:
    return 1.4826 * float(np.median(error)) if error.size else 0.0


def _grey_rms(radiance: FloatArray, model: FloatArray, response: Response, exposure_s: float) -> float:
    seen, expected = (response.intensity(each, exposure_s) for each in (radiance, model))
    return _robust_rms(np.abs(seen - expected))


def _tilt_evidence(problem: Problem, best: Point) -> float:
    if problem.tilt_precision is None:
        return 0.0
    first = np.arange(6) < TILT.start
    still = problem.solve(np.where(first, best.at, 0.0), first)
    return max(2.0 * (still.loss - best.loss), 0.0)


def _condition(covariance: FloatArray) -> float:
    """Return the condition number of the correlation of ln n, k_d and k_s."""
    block = covariance[:3, :3]
    scale = np.sqrt(np.maximum(np.diag(block), 1e-300))
    return float(min(np.linalg.cond(block / np.outer(scale, scale)), LARGEST_CONDITION))


def _warnings(found: Found, judged: Judged) -> tuple[str, ...]:
    problem, fitted = found.problem, found.problem.samples
    tilt = found.point.at[TILT]
    certain = np.abs(tilt) > 3.0 * np.sqrt(np.diag(found.covariance)[TILT])
    tilt_deg = float(np.rad2deg(np.linalg.norm(np.where(certain, tilt, 0.0))))
    outliers = float((np.abs(judged.point.residual) > problem.limit).mean())
    nearest_deg = float(np.rad2deg(fitted.alpha_rad.min()))
    clipped = _clipped_peak(fitted)
    said = {
        f"the search ended after {found.point.iterations} steps without converging": not found.point.converged,
        f"all normals seem tilted by {tilt_deg:.1f} deg: check the calibration of cameras and projector": (
            tilt_deg > LARGE_TILT_DEG and _tilt_evidence(problem, found.point) > CHI_SQUARED_95
        ),
        f"{found.misfit:.0%} of the radiance is not explained by noise: the surface is no Phong surface, or the light "
        "model is off; intervals are of the best Phong surface": found.misfit > LARGE_MISFIT,
        f"{outliers:.0%} of the samples are outliers": outliers > MANY_OUTLIERS,
        "nothing exceeds the noise: a longer exposure would lower the upper limits": judged.absorbing,
        f"{clipped:.0%} of the samples within {NEAR_MIRROR_DEG:g} deg of the mirror direction are saturated: n and k_s "
        "come from the flanks of the highlight, expose less to measure its peak": clipped > MUCH_SATURATED,
        f"no sample within {NEAR_MIRROR_DEG:g} deg of the mirror direction, the nearest is at {nearest_deg:.0f} deg: a "
        "narrow highlight would not have been seen": nearest_deg > NEAR_MIRROR_DEG,
    }
    return tuple(text for text, applies in said.items() if applies)
