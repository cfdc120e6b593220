"""The loops of the forward warp."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sidelong.kernels import compiled, inlined
from sidelong.types import BoolArray, Float32Array

Int32Array = NDArray[np.int32]

EDGE_TOLERANCE_PX = np.float32(1e-3)
"""Slack at the border of a tile: a pixel centre between two tiles that just touch must not fall through."""

OWN_PIXEL_PX = np.float32(0.5)

EDGE_ON_PX2 = np.float32(1e-6)
"""A pixel of the view that covers less of the reference image is seen edge-on, and shows no front."""

ALIKE = np.float32(0.85)
"""Correlation of the errors of neighbours: a matcher compares windows of 5 to 9 pixels."""

MOST_MAGNIFIED = np.float32(8)
"""A surface that the reference sees so much more aslant than the view did gives no depth worth having."""

FIRST_SAMPLES = 1 << 16
"""Of the list a thread starts with; it doubles when it is full."""


@compiled
def draw_tiles(
    inverse: Float32Array,
    sigma_m: Float32Array,
    holes: tuple[Int32Array, BoolArray],
    motion: Float32Array,
    pose_root: Float32Array,
    limits: Float32Array,
    first: int,
    last: int,
) -> tuple[Int32Array, Float32Array]:
    """Draw the tiles of rows ``first`` to ``last`` of a view at the holes they cover.

    Parameters
    ----------
    inverse, sigma_m
        (H, W) 1 / depth, NaN where missing, and standard deviation of the depth.
    holes
        (H', W') number of each hole in the reference image, -1 elsewhere; and whether a hole is near, with a margin.
    motion
        (9, 3): M, m, tau, c, R. A pixel with inverse depth q lies at ``M (u, v, 1) + m q`` in the reference image; a
        plane ``nu . X = 1`` of the view is ``1 + nu . tau`` times as far from the reference camera; c is where the
        view's camera is and R how it is turned.
    pose_root
        (6, 6) lower root of the covariance of the view's pose.
    limits
        Edge, half side of a tile (px), largest stretch (px), trust, trust at a rim, fx, fy, cx, cy.

    Returns
    -------
    hole
        (N,) number of the hole of each sample.
    sample
        (N, 3) depth in the reference camera, its variance, and the log-odds that it is no outlier.
    """
    height, width = inverse.shape
    index, near = holes
    margin = np.float32((near.shape[0] - index.shape[0]) // 2 + 0.5)
    edge, half, stretch, trust, rim_trust = limits[0], limits[1], limits[2], limits[3], limits[4]
    one = np.float32(1)
    hole = np.empty(FIRST_SAMPLES, dtype=np.int32)
    sample = np.empty((FIRST_SAMPLES, 3), dtype=np.float32)
    count = 0
    for row in range(first, last):
        for column in range(width):
            q = inverse[row, column]
            if not q > 0:
                continue
            z = motion[2, 0] * column + motion[2, 1] * row + motion[2, 2] + motion[3, 2] * q
            if not z > 0:
                continue
            scale = one / z
            u = (motion[0, 0] * column + motion[0, 1] * row + motion[0, 2] + motion[3, 0] * q) * scale
            v = (motion[1, 0] * column + motion[1, 1] * row + motion[1, 2] + motion[3, 1] * q) * scale
            near_u, near_v = u + margin, v + margin
            if not (near_u >= 0 and near_u < near.shape[1] and near_v >= 0 and near_v < near.shape[0]):
                continue
            if not near[int(near_v), int(near_u)]:
                continue
            left = inverse[row, column - 1] if column > 0 else np.float32(np.nan)
            right = inverse[row, column + 1] if column < width - 1 else np.float32(np.nan)
            above = inverse[row - 1, column] if row > 0 else np.float32(np.nan)
            below = inverse[row + 1, column] if row < height - 1 else np.float32(np.nan)
            rise_right, joined_right = _rise(left, q, right, edge)
            rise_down, joined_down = _rise(above, q, below, edge)
            joined = joined_right + joined_down
            if joined == 0 and (left > 0) + (right > 0) + (above > 0) + (below > 0) > 1:
                continue  # a spike: all around there is depth, and none is like it
            u_right, v_right, q_right = _along(motion, 0, rise_right, u, v, q, scale)
            u_down, v_down, q_down = _along(motion, 1, rise_down, u, v, q, scale)
            area = u_right * v_down - u_down * v_right
            reach_u, reach_v = half * (abs(u_right) + abs(u_down)), half * (abs(v_right) + abs(v_down))
            if not (area > EDGE_ON_PX2 and 2 * max(reach_u, reach_v) <= stretch):
                continue
            variance = np.float32(-1)
            for to_row in range(max(0, math.ceil(v - reach_v)), min(index.shape[0] - 1, math.floor(v + reach_v)) + 1):
                for to_column in range(
                    max(0, math.ceil(u - reach_u)), min(index.shape[1] - 1, math.floor(u + reach_u)) + 1
                ):
                    if index[to_row, to_column] < 0:
                        continue
                    along_u, along_v = np.float32(to_column) - u, np.float32(to_row) - v
                    along_right = (v_down * along_u - u_down * along_v) / area
                    along_down = (u_right * along_v - v_right * along_u) / area
                    across = _reach(left, q, edge, half) if along_right < 0 else _reach(right, q, edge, half)
                    upright = _reach(above, q, edge, half) if along_down < 0 else _reach(below, q, edge, half)
                    if abs(along_right) > across or abs(along_down) > upright:
                        continue
                    there = q * scale + q_right * along_right + q_down * along_down
                    if not there > 0:  # the rim of a patch close to the camera may reach behind it
                        continue
                    if variance < 0:
                        noise = sigma_m[row, column]
                        variance = _variance(
                            q, noise, rise_right, rise_down, column, row, u, v, z, motion, pose_root, limits
                        )
                    if not variance < np.inf:
                        continue
                    if count == len(hole):
                        hole, sample = _doubled(hole, sample)
                    hole[count] = index[to_row, to_column]
                    sample[count, 0] = one / there
                    sample[count, 1] = variance
                    sample[count, 2] = trust if joined == 4 else rim_trust
                    count += 1
    return hole[:count], sample[:count]


@compiled
def fill_trust(
    inverse: Float32Array, limits: tuple[np.float32, np.float32, np.float32], trust: Float32Array, first: int, last: int
) -> None:
    """Fill rows ``first`` to ``last`` with the log-odds that a depth is no outlier: less at rims, none for spikes.

    ``limits`` are the edge, and the log-odds of depths whose neighbours all join them and of others.
    """
    height, width = inverse.shape
    edge, inner_trust, rim_trust = limits
    for row in range(first, last):
        for column in range(width):
            q = inverse[row, column]
            left = inverse[row, column - 1] if column > 0 else np.float32(np.nan)
            right = inverse[row, column + 1] if column < width - 1 else np.float32(np.nan)
            above = inverse[row - 1, column] if row > 0 else np.float32(np.nan)
            below = inverse[row + 1, column] if row < height - 1 else np.float32(np.nan)
            joined = _rise(left, q, right, edge)[1] + _rise(above, q, below, edge)[1]
            if joined == 4:
                trust[row, column] = inner_trust
            elif joined == 0 and (left > 0) + (right > 0) + (above > 0) + (below > 0) > 1:
                trust[row, column] = 0
            else:
                trust[row, column] = rim_trust


@inlined
def _rise(before: np.float32, centre: np.float32, after: np.float32, edge: np.float32) -> tuple[np.float32, int]:
    """Return the mean step of 1/z to the neighbours that are not across a depth edge, and how many there are."""
    total, count = np.float32(0), 0
    if abs(centre - before) <= edge * min(centre, before):
        total += centre - before
        count += 1
    if abs(after - centre) <= edge * min(centre, after):
        total += after - centre
        count += 1
    return (total / np.float32(count) if count else total), count


@inlined
def _reach(neighbour: np.float32, centre: np.float32, edge: np.float32, half: np.float32) -> np.float32:
    """Return how far a tile reaches to a neighbour: over its own pixel alone where a depth edge lies between."""
    if abs(centre - neighbour) > edge * min(centre, neighbour):
        return OWN_PIXEL_PX + EDGE_TOLERANCE_PX
    return half + EDGE_TOLERANCE_PX


@inlined
def _along(
    motion: Float32Array,
    axis: int,
    rise: np.float32,
    u: np.float32,
    v: np.float32,
    q: np.float32,
    scale: np.float32,
) -> tuple[np.float32, np.float32, np.float32]:
    """Differentiate u', v' and 1 / z' along an axis of the view's image."""
    x, y, z = (
        motion[0, axis] + motion[3, 0] * rise,
        motion[1, axis] + motion[3, 1] * rise,
        motion[2, axis] + motion[3, 2] * rise,
    )
    return (x - u * z) * scale, (y - v * z) * scale, (rise - q * scale * z) * scale


@inlined
def _variance(
    q: np.float32,
    noise_m: np.float32,
    rise_right: np.float32,
    rise_down: np.float32,
    column: int,
    row: int,
    u: np.float32,
    v: np.float32,
    z: np.float32,
    motion: Float32Array,
    pose_root: Float32Array,
    limits: Float32Array,
) -> np.float32:
    """Return the variance of a tile's depth along the reference's line of sight: of noise, and of the view's pose.

    Both move the plane of the tile, ``nu . X = 1`` in the view; the line of sight meets it elsewhere, and where that is
    ``MOST_MAGNIFIED`` times as far as the view's own line of sight meets it, infinity is returned.
    """
    fx, fy, cx, cy = limits[5], limits[6], limits[7], limits[8]
    nu_x, nu_y = rise_right * fx, rise_down * fy
    nu_z = q - rise_right * (column - cx) - rise_down * (row - cy)
    farther = 1 + nu_x * motion[4, 0] + nu_y * motion[4, 1] + nu_z * motion[4, 2]
    if not farther * MOST_MAGNIFIED > z:
        return np.float32(np.inf)
    there_m = z / q  # z' = q_z / q
    per_plane = there_m / farther
    noise = noise_m * q * per_plane
    x, y = (u - cx) / fx * there_m - motion[5, 0], (v - cy) / fy * there_m - motion[5, 1]
    w = there_m - motion[5, 2]
    n_x = (motion[6, 0] * nu_x + motion[6, 1] * nu_y + motion[6, 2] * nu_z) * per_plane
    n_y = (motion[7, 0] * nu_x + motion[7, 1] * nu_y + motion[7, 2] * nu_z) * per_plane
    n_z = (motion[8, 0] * nu_x + motion[8, 1] * nu_y + motion[8, 2] * nu_z) * per_plane
    arm = (y * n_z - w * n_y, w * n_x - x * n_z, x * n_y - y * n_x, n_x, n_y, n_z)
    total = noise * noise
    for k in range(6):
        part = np.float32(0)
        for i in range(k, 6):
            part += pose_root[i, k] * arm[i]
        total += part * part
    return total


@inlined
def _doubled(hole: Int32Array, sample: Float32Array) -> tuple[Int32Array, Float32Array]:
    count = len(hole)
    more_hole, more_sample = np.empty(2 * count, dtype=np.int32), np.empty((2 * count, 3), dtype=np.float32)
    more_hole[:count], more_sample[:count] = hole, sample
    return more_hole, more_sample


@compiled
def average_fronts(
    lists: tuple[tuple[Int32Array, Float32Array], ...],
    band_m: np.float32,
    layer: tuple[Float32Array, Float32Array, Float32Array],
    first: int,
    last: int,
) -> None:
    """Average, at each of the holes ``first`` to ``last``, the samples within the band behind the nearest.

    ``layer`` (N,) each takes the depth, NaN where there is no sample, its variance, and the log-odds that it is no
    outlier.
    """
    depth_m, variance_m2, trust = layer
    count = np.zeros(last - first, dtype=np.int32)
    excess = np.zeros(last - first, dtype=np.float32)
    depth_m[first:last] = np.inf
    variance_m2[first:last] = 0
    trust[first:last] = 0
    for hole, sample in lists:
        for k in range(len(hole)):
            number = hole[k]
            if first <= number < last and sample[k, 0] < depth_m[number]:
                depth_m[number] = sample[k, 0]
    for hole, sample in lists:
        for k in range(len(hole)):
            number = hole[k]
            if not first <= number < last:
                continue
            # behind the nearest, so that rounding is that of the band and not that of the depth
            behind = sample[k, 0] - depth_m[number]
            if behind <= band_m:
                count[number - first] += 1
                excess[number - first] += behind
                variance_m2[number] += sample[k, 1]
                trust[number] = max(trust[number], sample[k, 2])
    for number in range(first, last):
        samples = count[number - first]
        if samples > 0:
            depth_m[number] += excess[number - first] / np.float32(samples)
            # the mean of what is nearly the same errs little less than each
            share = ALIKE + (1 - ALIKE) / np.float32(samples)
            variance_m2[number] *= share / np.float32(samples)
        else:
            depth_m[number] = np.nan
