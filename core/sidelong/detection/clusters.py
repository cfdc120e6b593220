"""From matches to objects: which matches are one object, which poses are one hypothesis, which objects are real."""

from __future__ import annotations

import numpy as np

from sidelong.errors import SettingsError
from sidelong.types import BoolArray, FloatArray, IntArray


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


def distinct(rotations: FloatArray, distances_m: FloatArray, step_rad: float, limit: int) -> IntArray:
    """Return the first of each group of like poses (at most ``limit``), in order: probabilities count poses once.

    Poses are like where the turn between ``rotations`` (M, 3, 3) is below ``step_rad`` and the distances differ by a
    ratio below ``1 + step_rad``: both move the contour of a part by about the same.
    """
    kept: list[int] = []
    cosine = 1.0 + 2.0 * np.cos(step_rad)
    for index in range(len(rotations)):
        if len(kept) == limit:
            break
        traces = np.einsum("kij,ij->k", rotations[kept], rotations[index])
        ratio = np.abs(np.log(distances_m[kept] / distances_m[index]))
        if not ((traces > cosine) & (ratio < step_rad)).any():
            kept.append(index)
    return np.array(kept, dtype=np.intp)


def uncovered(pixels: list[FloatArray], cell_px: float, overlap: float) -> BoolArray:
    """Say which objects, best first, are covered by better ones by at most ``overlap`` of the smaller silhouette.

    Parameters
    ----------
    pixels
        For each object the pixels (Q, 2) of its silhouette, spaced by ``cell_px`` or less.
    cell_px
        Size of the cells on which silhouettes are compared.
    overlap
        Largest share 0..1.
    """
    kept = np.zeros(len(pixels), dtype=np.bool_)
    cells = [{(int(u), int(v)) for u, v in np.floor(found / cell_px)} for found in pixels]
    for index, mine in enumerate(cells):
        shares = (len(mine & cells[j]) / max(1, min(len(mine), len(cells[j]))) for j in np.flatnonzero(kept))
        kept[index] = len(mine) > 0 and all(share <= overlap for share in shares)
    return kept
