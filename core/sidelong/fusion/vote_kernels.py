"""The loops in which views vote for and against depths of the reference view.

A depth is a point on a line of sight of the reference. Another view supports it where it measured that very surface,
and speaks against it where it saw clear through it to something farther away. What it measured nearer hides the point,
and what it did not measure says nothing: shiny surfaces give no depth either way.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sidelong.kernels import compiled, inlined
from sidelong.types import BoolArray, Float32Array

Int32Array = NDArray[np.int32]

BOTH = np.float32(math.sqrt(2.0))
"""The view that is asked errs about as much as the depth in question."""

RELIEF_PX, NEAREST_RELIEF_PX = 32, 8
"""How far around a pixel is looked at to tell whether it lies in a plane."""

MOST_ODDS = np.float32(50)
"""No more log-odds are kept: what many views have settled can still be voted out by a dozen others."""


@inlined
def verdict(
    views: Float32Array,
    motions: Float32Array,
    number: int,
    u: int,
    v: int,
    depth_m: np.float32,
    tolerance_m: np.float32,
) -> int:
    """Say what view ``number`` makes of a depth of the reference's pixel: 1 measured it, -1 saw through it, 0 neither.

    Parameters
    ----------
    views
        (V, H, W) depth maps, NaN where missing.
    motions
        (V, 4, 3) rows of M and m from the reference to each view, as in :func:`warp_kernels.draw_tiles`.
    """
    motion = motions[number]
    q = np.float32(1) / depth_m
    z = motion[2, 0] * u + motion[2, 1] * v + motion[2, 2] + motion[3, 2] * q
    if not z > 0:
        return 0
    x = (motion[0, 0] * u + motion[0, 1] * v + motion[0, 2] + motion[3, 0] * q) / z
    y = (motion[1, 0] * u + motion[1, 1] * v + motion[1, 2] + motion[3, 1] * q) / z
    height, width = views.shape[1], views.shape[2]
    if not (x >= 0 and x <= width - 1 and y >= 0 and y <= height - 1):
        return 0
    column, row = int(x + np.float32(0.5)), int(y + np.float32(0.5))
    expected_m = z * depth_m
    gap = views[number, row, column] - expected_m
    if abs(gap) <= tolerance_m:
        return 1
    if not gap > 0:  # nearer, or not measured
        return 0
    # beside an edge a ray may pass; it saw through the point only where all around is farther
    for near_row in range(max(row - 1, 0), min(row + 2, height)):
        for near_column in range(max(column - 1, 0), min(column + 2, width)):
            if not views[number, near_row, near_column] - expected_m > tolerance_m:
                return 0
    return -1


@compiled
def vote_on_measured(
    depth_m: Float32Array,
    sigma_m: Float32Array,
    views: Float32Array,
    motions: Float32Array,
    limits: Float32Array,
    odds: Float32Array,
    first: int,
    last: int,
) -> None:
    """Add the vote of view 0 on rows ``first`` to ``last`` of a depth map to ``odds`` (H, W).

    ``limits``: tolerance in standard deviations and in metres at least, weight of a vote.
    """
    spread, least_m, weight = limits[0], limits[1], limits[2]
    for row in range(first, last):
        for column in range(depth_m.shape[1]):
            z = depth_m[row, column]
            if z > 0:
                tolerance = max(least_m, spread * BOTH * sigma_m[row, column])
                odds[row, column] += weight * verdict(views, motions, 0, column, row, z, tolerance)


@compiled
def mark_hidden(
    depth_m: Float32Array,
    reference: tuple[Float32Array, Float32Array, BoolArray],
    motion: Float32Array,
    limits: Float32Array,
    hidden: BoolArray,
    first: int,
    last: int,
) -> None:
    """Mark the reference's depths that lie behind what a view measured on the same line of sight.

    Rows ``first`` to ``last`` of the view's depth map (H, W) are gone through. ``reference`` is depth, its standard
    deviation, and which depths are unlike all around them; ``limits`` as for :func:`vote_on_measured`. Strips may mark
    the same pixel: they write the same.
    """
    reference_m, sigma_m, spike = reference
    height, width = reference_m.shape
    for row in range(first, last):
        for column in range(depth_m.shape[1]):
            q = np.float32(1) / depth_m[row, column]
            if not q > 0:
                continue
            z = motion[2, 0] * column + motion[2, 1] * row + motion[2, 2] + motion[3, 2] * q
            if not z > 0:
                continue
            x = (motion[0, 0] * column + motion[0, 1] * row + motion[0, 2] + motion[3, 0] * q) / z
            y = (motion[1, 0] * column + motion[1, 1] * row + motion[1, 2] + motion[3, 1] * q) / z
            if not (x >= 1 and x <= width - 2 and y >= 1 and y <= height - 2):
                continue
            u, v = int(x + np.float32(0.5)), int(y + np.float32(0.5))
            behind_m = z / q + max(limits[1], limits[0] * BOTH * sigma_m[v, u])
            if not reference_m[v, u] > behind_m:
                continue
            # beside an edge a line of sight may pass: all around must lie behind, if the depth is like what is around
            clear = True
            if spike[v, u]:
                hidden[v, u] = True
                continue
            for near_v in range(v - 1, v + 2):
                for near_u in range(u - 1, u + 2):
                    clear &= not reference_m[near_v, near_u] <= behind_m
            if clear:
                hidden[v, u] = True


@compiled
def count_verdicts(
    depth_m: Float32Array,
    sigma_m: Float32Array,
    views: Float32Array,
    motions: Float32Array,
    limits: Float32Array,
    stride: int,
) -> tuple[int, int]:
    """Count how many depths, every ``stride``-th row and column, view 0 measured as well, and how many it saw through.

    Depths of a wide plane are left out: they agree wherever a view is slid along it. ``limits`` as for
    :func:`vote_on_measured`.
    """
    supported, seen_through = 0, 0
    for row in range(RELIEF_PX, depth_m.shape[0] - RELIEF_PX, stride):
        for column in range(RELIEF_PX, depth_m.shape[1] - RELIEF_PX, stride):
            if depth_m[row, column] > 0 and _stands_out(depth_m, row, column, limits[1]):
                tolerance = max(limits[1], limits[0] * BOTH * sigma_m[row, column])
                vote = verdict(views, motions, 0, column, row, depth_m[row, column], tolerance)
                supported += vote > 0
                seen_through += vote < 0
    return supported, seen_through


@inlined
def _stands_out(depth_m: Float32Array, row: int, column: int, height_m: np.float32) -> bool:
    """Say whether what is around a pixel, in any of three distances, is off its plane by more than a height."""
    z = depth_m[row, column]
    apart = RELIEF_PX
    while apart >= NEAREST_RELIEF_PX:
        # 1/z is affine on a plane; where a depth is missing this is NaN, which is not more
        along = 1 / depth_m[row, column - apart] + 1 / depth_m[row, column + apart] - 2 / z
        across = 1 / depth_m[row - apart, column] + 1 / depth_m[row + apart, column] - 2 / z
        if abs(along) * z * z > height_m or abs(across) * z * z > height_m:
            return True
        apart //= 2
    return False


@compiled
def settle(
    layers: tuple[Float32Array, Float32Array, Float32Array],
    alike: Float32Array,
    pixels: Int32Array,
    views: tuple[Float32Array, Float32Array, Int32Array],
    limits: Float32Array,
    result: tuple[Float32Array, Float32Array, Float32Array, Int32Array],
    first: int,
    last: int,
) -> None:
    """Settle on one depth for holes ``first`` to ``last``.

    From the nearest depth on, those that agree within their uncertainty make up one surface, at their weighted mean. It
    is taken if the log-odds of its members, less the weight of each view that saw through it, are positive; else the
    next surface behind it is tried.

    Parameters
    ----------
    layers
        (L, N) each: depth, variance and trust of each layer at each hole, NaN depth where it says nothing.
    alike
        (L,) how many layers see the same errors: each counts for that part of one.
    pixels
        (N, 2) column and row of each hole.
    views
        (V, H, W) depth maps, (V, 4, 3) motions, and (L,) which view a layer comes from, -1 where from many.
    limits
        Tolerance in standard deviations; in metres at least, for one surface; for a view to see through it; weight of a
        vote against.
    result
        (N,) each: depth, variance, log-odds, and the first layer of those averaged, -1 where missing.
    """
    depths, _, _ = layers
    maps, motions, view_of = views
    mean_out, variance_out, odds_out, layer_out = result
    member = np.zeros(len(alike), dtype=np.bool_)
    for hole in range(first, last):
        mean_out[hole], variance_out[hole], odds_out[hole], layer_out[hole] = np.nan, np.nan, 0, -1
        passed_m = np.float32(-1)  # what lies nearer has been voted out
        while True:
            start = _nearest_beyond(depths, len(alike), hole, passed_m)
            if start < 0:
                break
            mean, variance, odds = _gather(layers, alike, hole, start, passed_m, limits, member)
            tolerance = max(limits[2], limits[0] * BOTH * np.float32(math.sqrt(variance)))
            against = np.float32(0)
            for k in range(len(alike)):
                against += np.float32(0) if member[k] else limits[3] / alike[k]
            for k in range(len(alike)):
                # once all that is left cannot turn it, nothing is asked any more
                if 0 < odds <= against and view_of[k] >= 0 and not member[k]:
                    against -= limits[3] / alike[k]
                    column, row = pixels[hole, 0], pixels[hole, 1]
                    if verdict(maps, motions, view_of[k], column, row, mean, tolerance) < 0:
                        odds -= limits[3] / alike[k]
            if odds > 0:
                mean_out[hole], variance_out[hole], odds_out[hole] = mean, variance, min(odds, MOST_ODDS)
                layer_out[hole] = _first_of(member)
                break
            passed_m = depths[start, hole]
            for k in range(len(alike)):
                if member[k]:
                    passed_m = max(passed_m, depths[k, hole])


@inlined
def _nearest_beyond(depths: Float32Array, count: int, hole: int, passed_m: np.float32) -> int:
    """Return the layer with the nearest depth beyond ``passed_m``, -1 where there is none."""
    start = -1
    for k in range(count):
        if depths[k, hole] > passed_m and (start < 0 or depths[k, hole] < depths[start, hole]):
            start = k
    return start


@inlined
def _gather(
    layers: tuple[Float32Array, Float32Array, Float32Array],
    alike: Float32Array,
    hole: int,
    start: int,
    passed_m: np.float32,
    limits: Float32Array,
    member: BoolArray,
) -> tuple[np.float32, np.float32, np.float32]:
    """Mark the layers that agree with layer ``start`` and return their mean depth, its variance and their log-odds.

    Twice: those that agree with the nearest depth, then those that agree with their mean.
    """
    depths, variances, trusts = layers
    mean, variance, odds = depths[start, hole], variances[start, hole], np.float32(0)
    others = 0
    for k in range(len(alike)):
        member[k] = k == start
        others += k != start and depths[k, hole] > passed_m
    if others == 0:
        return mean, variance * alike[start], trusts[start, hole] / alike[start]
    for _ in range(2):
        information, excess, odds = np.float32(0), np.float32(0), np.float32(0)
        origin = mean
        for k in range(len(alike)):
            off = depths[k, hole] - origin
            reach = max(limits[1], limits[0] * np.float32(math.sqrt(variances[k, hole] + variance)))
            member[k] = depths[k, hole] > passed_m and abs(off) <= reach
            if member[k]:
                weight = 1 / (variances[k, hole] * alike[k])
                information += weight
                excess += weight * off
                odds += trusts[k, hole] / alike[k]
        if information > 0:
            mean, variance = origin + excess / information, 1 / information
    return mean, variance, odds


@inlined
def _first_of(member: BoolArray) -> int:
    for k in range(len(member)):
        if member[k]:
            return k
    return -1
