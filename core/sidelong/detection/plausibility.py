"""How probable it is that an aligned pose is right: a logistic model on a few shares that mean the same for any part.

A pose is right within 15 degrees, modulo the part's symmetry, and a quarter of the diameter sideways. The coefficients
are those that ``python tests/benchmarks/bench_hypotheses.py --learn`` prints.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from sidelong.detection.features import Features
from sidelong.types import FloatArray

AT_ZERO = "at zero"
"""Name of the constant: the log-odds of a pose that nothing speaks for or against."""
WITHOUT_DEPTH: Mapping[str, float] = {
    AT_ZERO: -5.67, "silhouette": 2.67, "crease": 2.65, "around": 2.93, "inside": 2.08, "facing": 2.39,
}  # fmt: skip
WITH_DEPTH: Mapping[str, float] = {
    AT_ZERO: -3.88, "silhouette": 1.68, "crease": 1.63, "around": 2.35, "facing": 2.54,
    "fits": 3.43, "behind": -3.29, "before": -0.89, "flush": -2.43,
}  # fmt: skip


def log_odds(features: Features) -> FloatArray:
    """Return ln P / (1 - P) (K,) of poses with these features; without those of depth by a model of its own."""
    model = WITH_DEPTH if "fits" in features else WITHOUT_DEPTH
    count = len(features["silhouette"])
    terms = [weight * features[name] for name, weight in model.items() if name != AT_ZERO]
    return np.full(count, model[AT_ZERO]) + np.sum(terms, axis=0)


def probability(log_odds: FloatArray) -> FloatArray:
    """Return P (...) of log-odds (...)."""
    return 0.5 * (1.0 + np.tanh(0.5 * log_odds))
