"""Which matches are one object, which poses one hypothesis, and how probable each hypothesis is."""

from __future__ import annotations

import numpy as np

from sidelong.errors import SettingsError
from sidelong.geometry.symmetry import Symmetry
from sidelong.types import FloatArray, IntArray


def softmax(scores: FloatArray, temperature: float) -> FloatArray:
    """Return P(q_k) = exp(s_k / T) / sum_j exp(s_j / T), (K,): the probabilities of equation (13).

    The largest score is subtracted first, so scores of any size are safe; equal scores give equal probabilities.

    Raises
    ------
    SettingsError
        The temperature is not positive.
    """
    if not temperature > 0:
        raise SettingsError(f"temperature: is {temperature}, must be greater than 0")
    if len(scores) == 0:
        return np.zeros(0)
    weights = np.exp((scores - scores.max()) / temperature)
    return weights / weights.sum()


def cluster(uv: FloatArray, radius_px: FloatArray, max_clusters: int) -> list[IntArray]:
    """Gather matches (M, 2), best first, around the best that is left; return the members of each cluster.

    Parameters
    ----------
    uv
        (M, 2) projected centres, best match first.
    radius_px
        (M,) how far a match gathers others: a share of its own size.
    max_clusters
        Stop there.
    """
    left = np.ones(len(uv), dtype=np.bool_)
    clusters: list[IntArray] = []
    while left.any() and len(clusters) < max_clusters:
        seed = int(left.argmax())
        near = left & (np.linalg.norm(uv - uv[seed], axis=1) <= radius_px[seed])
        clusters.append(np.flatnonzero(near))
        left &= ~near
    return clusters


def distinct(
    rotations: FloatArray, distances_m: FloatArray, step_rad: float, limit: int, symmetry: Symmetry | None = None
) -> IntArray:
    """Return the first of each group of like poses (at most ``limit``), in order: probabilities count poses once.

    Poses are like where the turn between ``rotations`` (M, 3, 3), modulo the symmetry if there is one, is below
    ``step_rad`` and the distances differ by a ratio below ``1 + step_rad``: both move the contour of a part by about
    the same.
    """
    left = np.arange(len(rotations))
    flat = rotations.reshape(len(rotations), 9)
    kept: list[int] = []
    while len(left) and len(kept) < limit:
        first = int(left[0])
        kept.append(first)
        if symmetry is None:
            # the trace of A' B is 1 + 2 cos of the turn between them, and the sum of the products of their elements
            near = flat[left] @ flat[first] > 1.0 + 2.0 * np.cos(step_rad)
        else:
            near = symmetry.angle_rad(rotations[left], rotations[first]) < step_rad
        alike = near & (np.abs(np.log(distances_m[left] / distances_m[first])) < step_rad)
        alike[0] = True
        left = left[~alike]
    return np.array(kept, dtype=np.intp)
