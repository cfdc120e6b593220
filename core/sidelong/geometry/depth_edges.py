"""Where neighbours of a depth map lie on two surfaces: a step between them that fits neither the step before nor the
one after. A steep slope and a crease are no edges; a limit on the step alone could not tell a slope of 80 degrees from
a jump of 4 mm (at 0.7 m)."""

from __future__ import annotations

from typing import Any

import numpy as np

from sidelong.types import BoolArray

EDGE_NOISE = 8.0
"""A step is an edge only if it is also this many times as odd as the median step: noise alone takes 1 step in 6,000."""


def depth_jumps(inverse: Any, axis: int, step: float) -> BoolArray:
    """Say between which neighbours along an axis depth jumps by more than ``step`` of itself.

    Parameters
    ----------
    inverse
        (H, W) 1/z, NaN where missing.
    axis
        0 for neighbours in a column, 1 for those in a row.
    step
        Relative to the depth; what a pixel spans is 1/f of it.

    Returns
    -------
    ndarray
        (H - 1, W) or (H, W - 1); False where a neighbour is missing, and where there is no other step to compare with.
    """
    before, after = neighbours(inverse, axis)
    steps = after - before
    bend_before, bend_after = neighbours(steps, axis)
    bend = np.abs(bend_after - bend_before)
    # how odd a step is against the neighbouring step that is more like it; NaN where neither is known
    odd = np.full_like(steps, np.nan)
    with_next, with_last = neighbours(odd, axis)
    with_last[...] = bend
    np.fmin(with_next, bend, out=with_next)
    return odd > np.maximum(step * np.minimum(before, after), EDGE_NOISE * typical(odd))


def neighbours(image: Any, axis: int) -> tuple[Any, Any]:
    """Return two views along an axis: without the last pixel, and without the first."""
    return (image[:-1], image[1:]) if axis == 0 else (image[:, :-1], image[:, 1:])


def typical(values: Any) -> float:
    """Return the median of what is known in every eighth row, 0 where nothing is."""
    some = values[::8]
    known = some[np.isfinite(some)]
    return float(np.median(known)) if known.size else 0.0
