"""The least squares of a photometric response, log radiances eliminated.

Debevec and Malik (1997) minimise ``sum w^2 [g(Z) - ln E - ln dt]^2 + lambda sum [w g''(z)]^2`` over the 256 values of
g and one ln E per pixel. Here each ln E is eliminated (Schur complement), which leaves one system in g whatever the
number of pixels. Two choices differ from the original:

- The penalty is on ``g'' + g'/z``, the departure from a power law Z ~ X^(1/gamma), instead of on g'': straight lines in
  ln z are free, so that strong smoothing bends neither a linear nor a gamma response at the dark end.
- Equations are tangents at the level the current fit predicts, instead of at the level observed. Noise in Z is then
  noise in Z, not an error in the argument of g, which biases g where g is steep (errors in variables).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import eigh, solve_triangular
from scipy.optimize import nnls

from sidelong.errors import CalibrationError
from sidelong.physics.response import LEVELS
from sidelong.types import FloatArray

SHAPES = 48
"""Smoothest response shapes in which the smoothing weight is chosen; the response itself has all 256 levels."""
DISCOUNT = 10.0
"""Equations that count as one when the smoothing weight is chosen and errors are stated: they share rounding and
imperfect weights; without the discount the fit follows noise. From 5 to 20 the error hardly changes, at 1 it
doubles."""
SMALLEST_STEP = 1e-5
"""Least rise of g between neighbouring levels, ln units."""
ROUNDING = 1e-12
"""Information below this share of the total is rounding."""
LEAST_RISE = 1e-9
"""Rise per level given to a flat stretch of an early g, so that it can be inverted."""
WEIGHTS = 10.0 ** np.arange(-11.0, 0.1, 0.2)
"""Smoothing weights tried, in units of the strongest shape's information."""


@dataclass(frozen=True, eq=False)
class Normal:
    """Normal equations in g alone: ``matrix`` (256, 256), ``rhs`` (256,), ``rest`` = sum of squares at g = 0.

    ``spare`` is the number of equations less the number of log radiances.
    """

    matrix: FloatArray
    rhs: FloatArray
    rest: float
    spare: int


@dataclass(frozen=True, eq=False)
class Solution:
    """A smoothed response: ``g`` (256,), 0 at level 255, the smoothing weight ``smoothness``, the noise ``sigma`` in
    the unit of w times g, the number of ``shapes`` effectively fitted."""

    g: FloatArray
    smoothness: float
    sigma: float
    shapes: float


@dataclass(frozen=True, eq=False)
class Rising:
    """Result of :func:`solve_rising`: ``g`` (256,), its ``variance`` over sigma^2 (256,), an upper bound of the
    ``condition`` of the scaled system, and the ``correction``: how far the demand to rise moved g at most, ln units."""

    g: FloatArray
    variance: FloatArray
    condition: float
    correction: float


def eliminate(levels: NDArray[np.intp], targets: FloatArray, weights: FloatArray) -> Normal:
    """Return the normal equations of ``w [g(level) - ln E - target]`` with every ln E eliminated.

    Parameters
    ----------
    levels
        (n, P) grey levels.
    targets
        (n, P) right-hand sides.
    weights
        (n, P) weights w, not squared; 0 leaves an equation out.
    """
    square = weights**2
    total = square.sum(axis=1)
    used = total > 0
    levels, targets, square, total = levels[used], targets[used], square[used], total[used, None]
    centred = targets - (square * targets).sum(axis=1, keepdims=True) / total
    one, other = np.triu_indices(levels.shape[1], k=1)
    pairs = LEVELS * levels[:, one] + levels[:, other]
    shared = square[:, one] * (square / total)[:, other]
    crossed = np.bincount(pairs.ravel(), shared.ravel(), LEVELS * LEVELS).reshape(LEVELS, LEVELS)
    own = np.bincount(levels.ravel(), (square - square**2 / total).ravel(), LEVELS)
    matrix = np.diag(own.astype(np.float64)) - crossed - crossed.T
    rhs = np.bincount(levels.ravel(), (square * centred).ravel(), LEVELS).astype(np.float64)
    spare = int(np.count_nonzero(square)) - len(total)
    return Normal(matrix, rhs, float((square * centred**2).sum()), spare)


@cache
def bending() -> FloatArray:
    """Return the operator g'' + g'/z (254, 256) at levels 1 to 254; zero on power laws, 0 standing for half a level."""
    s = log_levels()
    before, after = np.diff(s)[:-1], np.diff(s)[1:]
    scale = 2.0 / (before + after) / np.arange(1, LEVELS - 1) ** 2  # second derivative by ln z, over z^2
    rows = np.arange(LEVELS - 2)
    operator = np.zeros((LEVELS - 2, LEVELS))
    operator[rows, rows] = scale / before
    operator[rows, rows + 1] = -scale * (1 / before + 1 / after)
    operator[rows, rows + 2] = scale / after
    return operator


@cache
def _bends() -> tuple[FloatArray, FloatArray]:
    """Return the change of variables (255, 255) from power-law exponent and bends to g(0) to g(254), and its inverse.

    In these variables the penalty is the identity, so that the condition of the system tells of the images only.
    """
    operator = np.vstack([np.zeros(LEVELS - 1), bending()[:, :-1]])
    operator[0, -1] = 1 / (log_levels()[-2] - log_levels()[-1])
    return np.linalg.inv(operator).astype(np.float64), operator


def log_levels() -> FloatArray:
    """Return ln z of the levels (256,), ln 0.5 for level 0."""
    return np.log(np.r_[0.5, np.arange(1.0, LEVELS)])


@cache
def _shapes() -> FloatArray:
    """Return the power law and the next smoothest shapes (256, SHAPES), of unit penalty each and 0 at level 255."""
    bend = bending()[:, :-1]
    plain = np.maximum(np.arange(LEVELS - 1.0), 1.0) ** 2  # information of evenly hit levels of a linear sensor
    _, vectors = eigh(bend.T @ bend, np.diag(plain), subset_by_index=[0, SHAPES - 1])
    bent = bend @ vectors[:, 1:]
    root = np.linalg.cholesky(bent.T @ bent)
    shapes = np.zeros((LEVELS, SHAPES))
    shapes[:, 0] = log_levels() - log_levels()[-1]
    shapes[:-1, 1:] = np.linalg.solve(root, vectors[:, 1:].T).T
    return shapes


def smooth(normal: Normal, most_shapes: float) -> Solution:
    """Choose the smoothing weight by restricted maximum likelihood and solve in the smoothest shapes.

    Parameters
    ----------
    normal
        From :func:`eliminate`.
    most_shapes
        Limit of the effective number of shapes.

    Raises
    ------
    CalibrationError
        The equations say nothing of g.

    Notes
    -----
    With e the eigenvalues of the information on the shapes, the restricted likelihood of a weight l is
    ``-n/2 ln(S(l)) - 1/2 sum ln(1 + e/l)``, S the penalised sum of squares and n the equations to spare.
    """
    shapes = _shapes()
    information, pull = shapes.T @ normal.matrix @ shapes, shapes.T @ normal.rhs
    slope = information[0, 0]
    if not slope > ROUNDING * np.trace(information):
        raise CalibrationError("bracket: no pixel changes its grey level with exposure: grey levels are not linked")
    lever = information[0, 1:] / slope
    values, vectors = np.linalg.eigh(information[1:, 1:] - np.outer(lever, information[0, 1:]))
    values = np.maximum(values, 0.0)
    pulls = vectors.T @ (pull[1:] - lever * pull[0])
    weights = values[-1] * WEIGHTS[:, None]
    squares = normal.rest - pull[0] ** 2 / slope - (pulls**2 / (values + weights)).sum(axis=1)
    squares = np.maximum(squares, 1e-12 * normal.rest)
    score = (normal.spare - 1) / DISCOUNT * np.log(squares) + np.log1p(values / weights).sum(axis=1)
    effective = 1 + (values / (values + weights)).sum(axis=1)
    score[:-1][effective[:-1] > most_shapes] = np.inf
    best = int(np.argmin(score))
    bends = vectors @ (pulls / (values + weights[best]))
    g = shapes @ np.r_[(pull[0] - information[0, 1:] @ bends) / slope, bends]
    sigma = float(np.sqrt(squares[best] / max(normal.spare - 1, 1)))
    return Solution(g, float(weights[best, 0]), sigma, float(effective[best]))


def solve_rising(normal: Normal, smoothness: float) -> Rising:
    """Solve all 256 levels with g(255) = 0, and again under the demand to rise where the free solution does not.

    Raises
    ------
    CalibrationError
        The system is singular in float64.
    """
    basis, operator = _bends()
    system = basis.T @ normal.matrix[:-1, :-1] @ basis
    system[1:, 1:] += smoothness * np.eye(LEVELS - 2)
    scale = 1 / np.sqrt(np.diag(system))
    scaled = system * scale * scale[:, None]
    try:
        upper = np.linalg.cholesky(scaled).T
    except np.linalg.LinAlgError as error:
        raise CalibrationError("bracket: the condition number is infinite: grey levels are not linked") from error
    half = solve_triangular(upper, np.eye(LEVELS - 1), check_finite=False)
    # 1-norm times the trace of the inverse: an upper bound, close where the condition is bad
    condition = float(np.linalg.norm(scaled, 1) * (half**2).sum())
    root = (basis * scale) @ half  # times its transpose: the inverse of the system in g
    pull = half.T @ (scale * (basis.T @ normal.rhs[:-1]))
    g = np.r_[root @ pull, 0.0]
    variance = np.r_[(root**2).sum(axis=1), 0.0]
    if (np.diff(g) >= SMALLEST_STEP).all():
        return Rising(g, variance, condition, 0.0)
    # in the steps d of g the demand is a bound: g(z) = -(d(z) + ... + d(254))
    steps_to_g = -np.triu(np.ones((LEVELS - 1, LEVELS - 1)))
    factor = (upper / scale) @ operator @ steps_to_g
    steps = nnls(factor, pull - factor.sum(axis=1) * SMALLEST_STEP)[0] + SMALLEST_STEP
    rising = np.r_[steps_to_g @ steps, 0.0]
    return Rising(rising, variance, condition, float(np.abs(rising - g).max()))
