"""Robust least squares for Phong reflectance: bounded loss, censored samples, bounds, profiles of the loss.

Parameters are the vector [ln n, k_d, k_s, tilt (3)]; ``tilt`` is a common rotation of all normals, held near 0 by a
prior.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr

from sidelong.calibration.reflectance.model import MirrorGeometry, ReflectanceSamples
from sidelong.types import BoolArray, FloatArray

LOG_N, K_D, K_S, TILT = 0, 1, 2, slice(3, 6)
LIMITS_N = (0.02, 1e7)
"""Glossiness searched: outside, a lobe differs from a constant or from a mirror by less than any camera resolves."""
LARGEST_SHARE = 1e3
"""Bound of k_d and k_s, over the largest radiance per light of the samples."""
NEAREST = 3
NEAR_RAD = np.deg2rad(20.0)
STIFFNESS = 20.0
"""How much smaller the prior's tilt about the mean mirror direction is."""
ITERATIONS = 30
SMALLEST_DROP = 1e-7
"""Relative drop of the loss at which the search ends."""
START_SAMPLES = 600
START_GRID: FloatArray = np.geomspace(0.1, 1e6, 49)
STANDARD_95 = 1.959964


def tilt_prior(samples: ReflectanceSamples, sigma_rad: float) -> FloatArray | None:
    """Return the precision (3, 3) of the prior of a common tilt, stiff about the mean mirror direction; None for 0.

    A turn about that direction hardly moves any highlight: what the data seem to say of it is their other errors.
    """
    if sigma_rad == 0:
        return None
    axis = (samples.to_light + samples.to_camera).mean(axis=0)
    axis /= np.linalg.norm(axis)
    return (np.eye(3) + (STIFFNESS**2 - 1.0) * np.outer(axis, axis)) / sigma_rad**2


def search_bounds(samples: ReflectanceSamples, tilt_sigma_rad: float) -> tuple[FloatArray, FloatArray]:
    """Return the bounds (6,) of the parameters that these samples can tell apart.

    A lobe that falls between the samples, or is far narrower than the error of the normals, may be as high as one
    likes. So n ends where the fourth nearest sample gets a twentieth of the peak (a ten thousandth where it is far:
    nothing then speaks against a lobe), or where a lobe is a seventh as wide as the error of the mirror ray.
    """
    nearest = float(np.partition(samples.alpha_rad, NEAREST)[NEAREST])
    width_squared = max(nearest**2, 0.5 * float(np.median(np.square(samples.normal_sigma_rad))))
    left = 0.05 if nearest < NEAR_RAD else 1e-4
    highest_n = float(np.clip(-2.0 * np.log(left) / max(width_squared, 1e-12), 1.0, LIMITS_N[1]))
    lit = samples.light > 0
    share = LARGEST_SHARE * max(float((samples.radiance[lit] / samples.light[lit]).max()), 1e-12)
    share = max(share, LARGEST_SHARE * float(np.median(samples.sigma[lit] / samples.light[lit])))
    tilt = [3.0 * tilt_sigma_rad] * 3
    upper = np.array([np.log(highest_n), share, share, *tilt])
    return np.array([np.log(LIMITS_N[0]), 0.0, 0.0, *(-each for each in tilt)]), upper


@dataclass(frozen=True, eq=False)
class Point:
    """Where the search stands: parameters (6,), loss, residuals (N,) in standard deviations, Jacobian (N, 6)."""

    at: FloatArray
    loss: float
    residual: FloatArray
    jacobian: FloatArray
    converged: bool = False
    iterations: int = 0


@dataclass(frozen=True, eq=False)
class Problem:
    """Loss of parameters over samples.

    Attributes
    ----------
    samples
        N measurements, all finite.
    sd
        (N,) standard deviation of radiance minus model.
    limit
        Residuals beyond this many standard deviations are outliers.
    tilt_precision
        (3, 3) inverse covariance of the prior of the common tilt; None holds it at 0.
    lower, upper
        (6,) bounds of the parameters, see :func:`search_bounds`.
    """

    samples: ReflectanceSamples
    sd: FloatArray
    limit: float
    tilt_precision: FloatArray | None
    lower: FloatArray
    upper: FloatArray

    def point(self, at: FloatArray) -> Point:
        """Evaluate loss, residuals and Jacobian."""
        samples, (log_n, k_d, k_s) = self.samples, at[:3]
        geometry = MirrorGeometry(samples, at[TILT])
        lobe = geometry.lobe(float(np.exp(log_n)))
        light = samples.light
        by = np.empty((len(light), 6))
        by[:, LOG_N], by[:, K_D], by[:, K_S] = k_s * lobe.by_log_n, geometry.diffuse, lobe.mean
        by[:, TILT] = k_d * geometry.diffuse_by_tilt + k_s * lobe.by_tilt
        residual, slope = self._residual(light * (k_d * geometry.diffuse + k_s * lobe.mean))
        # parabolic inside; beyond, a tail that levels off: light by way of another surface must not pull for ever
        beyond = np.maximum(np.abs(residual) - self.limit, 0.0) / self.limit
        inside = np.minimum(np.abs(residual), self.limit)
        loss = float((0.5 * np.square(inside) - self.limit**2 * np.expm1(-beyond)).sum())
        if self.tilt_precision is not None:
            loss += 0.5 * float(at[TILT] @ self.tilt_precision @ at[TILT])
        return Point(at, loss, residual, (slope * light)[:, None] * by)

    def gradient(self, point: Point) -> FloatArray:
        """Return the derivative of the loss, (6,)."""
        gradient = point.jacobian.T @ self.pull(point)
        if self.tilt_precision is not None:
            gradient[TILT] += self.tilt_precision @ point.at[TILT]
        return gradient

    def pull(self, point: Point) -> FloatArray:
        """Return the derivative of the loss by each residual, (N,)."""
        beyond = np.maximum(np.abs(point.residual) - self.limit, 0.0) / self.limit
        return np.clip(point.residual, -self.limit, self.limit) * np.exp(-beyond)

    def information(self, point: Point) -> FloatArray:
        """Return the Gauss-Newton matrix (6, 6) of the samples within the limit, the prior included."""
        inner = point.jacobian[np.abs(point.residual) <= self.limit]
        matrix = inner.T @ inner
        if self.tilt_precision is not None:
            matrix[TILT, TILT] += self.tilt_precision
        return matrix

    @property
    def free(self) -> BoolArray:
        """(6,) parameters to search."""
        return np.array([True, True, True, *[self.tilt_precision is not None] * 3])

    def solve(self, start: FloatArray, free: BoolArray, iterations: int = ITERATIONS) -> Point:
        """Minimise the loss from ``start`` over the ``free`` parameters, within their bounds (Levenberg-Marquardt)."""
        lower, upper = self.lower, self.upper
        point, damping, done, count = self.point(np.clip(start, lower, upper)), 1e-3, False, 0
        while count < iterations and not done:
            count += 1
            gradient, matrix = self.gradient(point), self.information(point)
            # a parameter on its bound that wants to leave the allowed side stays for this step
            stuck = ((point.at <= lower) & (gradient > 0)) | ((point.at >= upper) & (gradient < 0))
            moving = np.flatnonzero(free & ~stuck)
            if not moving.size:
                done = True
                break
            matrix, gradient = matrix[np.ix_(moving, moving)], gradient[moving]
            scale = np.diag(matrix) + 1e-12 * (1.0 + np.trace(matrix))
            for _ in range(12):
                step = np.linalg.solve(matrix + np.diag(damping * scale), -gradient)
                at = point.at.copy()
                at[moving] += step
                at[LOG_N] = np.clip(at[LOG_N], point.at[LOG_N] - 1.5, point.at[LOG_N] + 1.5)
                trial = self.point(np.clip(at, lower, upper))
                if trial.loss <= point.loss:
                    break
                damping = max(damping, 1e-6) * 6.0
            else:
                done = True
                break
            done = point.loss - trial.loss <= SMALLEST_DROP * (1.0 + trial.loss)
            point, damping = trial, damping / 10.0
        return Point(point.at, point.loss, point.residual, point.jacobian, done, count)

    def _residual(self, model: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return residuals (N,) and their derivative by the model; censored ones as in a Tobit regression.

        Half the square of a censored residual is minus the log probability that the sample lies beyond its limit.
        """
        samples = self.samples
        residual, slope = (model - samples.radiance) / self.sd, 1.0 / self.sd
        censored = np.flatnonzero(samples.saturated | samples.dark)
        side = np.where(samples.saturated[censored], -1.0, 1.0)
        z = side * residual[censored]
        log_share = log_ndtr(-z)
        size = np.sqrt(-2.0 * log_share)
        # inverse Mills ratio
        pull = np.exp(-0.5 * z * z - log_share) / np.sqrt(2.0 * np.pi)
        residual[censored] = side * size
        slope[censored] *= pull / np.maximum(size, 1e-150)
        return residual, slope


def first_guesses(samples: ReflectanceSamples, limit: float, highest_n: float, count: int = 2) -> list[FloatArray]:
    """Return the best starts (6,), best first: local minima of the loss over a grid of n, the shares solved for each.

    The shares are linear given n, so a grid over n alone cannot miss the basin (variable projection).
    """
    thin = samples[np.linspace(0, len(samples) - 1, min(len(samples), START_SAMPLES)).astype(np.intp)]
    geometry = MirrorGeometry(thin, np.zeros(3))
    # a tenth of the radiance stands for the flanks' share of the normals' error, unknown before the fit
    sd = np.hypot(thin.sigma, 0.1 * np.abs(thin.radiance))
    diffuse = thin.light * geometry.diffuse
    grid = START_GRID[max(highest_n, START_GRID[1]) >= START_GRID]
    losses, shares = np.empty(len(grid)), np.empty((len(grid), 2))
    for row, n in enumerate(grid):
        columns = np.stack([diffuse, thin.light * geometry.lobe(float(n)).mean], axis=1)
        shares[row], losses[row] = _robust_shares(columns, thin, sd, limit)
    padded = np.concatenate([[np.inf], losses, [np.inf]])
    dips = np.flatnonzero((losses <= padded[:-2]) & (losses <= padded[2:]))
    best = dips[np.argsort(losses[dips], kind="stable")][:count]
    return [np.array([np.log(grid[row]), *shares[row], 0.0, 0.0, 0.0]) for row in best]


def _robust_shares(
    columns: FloatArray, samples: ReflectanceSamples, sd: FloatArray, limit: float
) -> tuple[FloatArray, float]:
    """Return the non-negative shares (2,) and their Huber loss, by reweighting; censored samples count one side."""
    weight = 1.0 / np.square(sd)
    shares, residual = np.zeros(2), np.zeros(len(sd))
    for _ in range(6):
        shares = _non_negative(columns, samples.radiance, weight)
        model = columns @ shares
        kept = (samples.saturated & (model >= samples.radiance)) | (samples.dark & (model <= samples.radiance))
        residual = np.where(kept, 0.0, (model - samples.radiance) / sd)
        # a limit that is kept still holds its place a little: without it the samples beyond would drop out and in
        held = np.where(kept, 1e-3, 1.0)
        weight = held * np.minimum(1.0, limit / np.maximum(np.abs(residual), 1e-9)) / np.square(sd)
    size = np.abs(residual)
    return shares, float(np.where(size <= limit, 0.5 * size**2, limit * (size - 0.5 * limit)).sum())


def _non_negative(columns: FloatArray, values: FloatArray, weight: FloatArray) -> FloatArray:
    """Solve weighted least squares in two unknowns that must not be negative."""
    matrix, right = columns.T @ (weight[:, None] * columns), columns.T @ (weight * values)
    determinant = matrix[0, 0] * matrix[1, 1] - matrix[0, 1] ** 2
    if determinant > 1e-12 * matrix[0, 0] * matrix[1, 1]:
        both = np.asarray(np.linalg.solve(matrix, right), dtype=np.float64)
        if (both >= 0).all():
            return both
    single = np.maximum(right, 0.0) / np.maximum(np.diag(matrix), 1e-300)
    drops = single * right
    return np.where(np.arange(2) == int(np.argmax(drops)), single, 0.0)


def profile_limits(problem: Problem, best: Point, index: int, inflation: float, step: float) -> tuple[float, float]:
    """Return where the loss, minimised over the other parameters, has risen by half the 95 % point of chi squared.

    Parameters
    ----------
    problem, best
        The loss and its minimum.
    index
        Of the parameter.
    inflation
        Factor on the rise: variance of the parameter by the scatter of the samples over that by the loss.
    step
        First step away from the minimum, a guess of the interval's half width.
    """
    free = problem.free.copy()
    free[index] = False

    def rise(start: FloatArray, value: float) -> tuple[float, FloatArray]:
        at = start.copy()
        at[index] = value
        point = problem.solve(at, free, iterations=6)
        return float(np.sqrt(2.0 * max(point.loss - best.loss, 0.0) / inflation)), point.at

    low = _crossing(rise, best.at, index, -step, float(problem.lower[index]))
    return low, _crossing(rise, best.at, index, step, float(problem.upper[index]))


def _crossing(
    rise: Callable[[FloatArray, float], tuple[float, FloatArray]],
    start: FloatArray,
    index: int,
    step: float,
    end: float,
) -> float:
    """Walk from the minimum until the rise passes ``STANDARD_95``, then close in; ``end`` where it never does."""
    inside, at = (float(start[index]), 0.0), start
    outside: tuple[float, float] | None = None
    for _ in range(12):
        value = inside[0] + step
        value = float(min(value, end) if step > 0 else max(value, end))
        height, at = rise(at, value)
        if height > STANDARD_95:
            outside = (value, height)
            break
        inside, step = (value, height), 2.0 * step
        if value == end:
            return end
    if outside is None:
        return end
    for _ in range(4):
        (near, low), (far, high) = inside, outside
        share = (STANDARD_95 - low) / max(high - low, 1e-12)
        value = near + min(max(share, 0.05), 0.95) * (far - near)
        height, at = rise(at, value)
        if abs(height - STANDARD_95) < 0.02:
            return value
        if height < STANDARD_95:
            inside = (value, height)
        else:
            outside = (value, height)
    # the outer end: an interval may be a little too wide, not too narrow
    return outside[0]
