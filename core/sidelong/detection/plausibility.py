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
    AT_ZERO: -6.68, "silhouette": 2.62, "silhouette_beside": -1.24, "crease": 3.51,
    "around": 2.95, "inside": 2.06, "facing": 2.95,
}  # fmt: skip
WITH_DEPTH: Mapping[str, float] = {
    AT_ZERO: -4.80, "silhouette": 1.47, "crease": 2.49, "around": 2.34, "inside": 1.75, "facing": 2.85,
    "fits": 2.56, "behind": -4.60, "before": -1.72, "flush": -1.68,
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
