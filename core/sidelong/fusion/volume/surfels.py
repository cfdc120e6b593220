"""Each pixel of a depth map as a small plane, ready for voxels to look up."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sidelong.kernels import compiled, strips
from sidelong.types import Float32Array

INVERSE, RIGHT, DOWN, REACH, WEIGHT = range(5)
"""Last axis of ``Surfels.planes``."""
TILE = 8
"""Pixels along the side of a tile."""
NEAREST_M, FARTHEST_M = 0.01, 100.0
"""Depths outside count as missing."""
SHARPEST_M = np.float32(1e-6)
"""No depth counts for more than one with this standard deviation."""
BYTES_PER_PX = 4 * (2 + 1 + 5 + 1)
WINDOW, ALLIES = 2, 2
"""Pixels around one in which so many must agree with it, where so many are measured."""
CROWD, SPIKE = 4, np.float32(5)
"""Neighbours of its surface off whose plane a pixel must not lie by more than so many standard deviations."""


class Surfels(NamedTuple):
    """The pixels of a depth map as planes, and what they hide.

    Attributes
    ----------
    planes
        (H, W, 5): inverse depth at the pixel's centre (1/m, 0 where missing) and what it changes by one pixel to the
        right and one down; how far from the camera the plane is, in voxels; the information 1/sigma^2 of distances to
        it, 1/voxel^2.
    nearest
        (H, W) largest inverse depth of a pixel and its neighbours; infinite where one is missing.
    tile_nearest, tile_farthest
        Largest and smallest of these in each tile of 8x8 pixels.
    lens
        (4,) fx, fy, cx, cy.
    """

    planes: Float32Array
    nearest: Float32Array
    tile_nearest: Float32Array
    tile_farthest: Float32Array
    lens: Float32Array


def surfels_of(
    depth_m: Float32Array, sigma_m: Float32Array, lens: Float32Array, voxel_m: float, max_incidence_rad: float
) -> Surfels:
    """Return the surfels of a depth map (H, W); what has no positive depth, or no positive sigma below it, is missing.

    A pixel with fewer than ``ALLIES`` neighbours within ``WINDOW`` whose depth could be of the same surface is taken
    for an outlier, and counts as missing too; but not for want of neighbours. So does one far off the plane of its
    neighbours. ``lens`` is fx, fy, cx, cy.
    """
    height, width = depth_m.shape
    inverse = np.empty_like(depth_m)
    planes = np.empty((height, width, 5), dtype=np.float32)
    nearest = np.empty_like(depth_m)
    tiles = (-(-height // TILE), -(-width // TILE))
    tile_nearest, tile_farthest = np.empty(tiles, dtype=np.float32), np.empty(tiles, dtype=np.float32)
    # how much the depth may change with a step of one pixel, relative to the depth
    edge = np.float32(math.tan(max_incidence_rad) / lens[0])
    strips(lambda first, last: _fill_inverse(depth_m, sigma_m, inverse, first, last), height)
    strips(
        lambda first, last: _fill_planes(
            inverse, sigma_m, lens, edge, np.float32(1 / voxel_m), planes, nearest, first, last
        ),
        height,
    )
    strips(lambda first, last: _fill_tiles(nearest, tile_nearest, tile_farthest, first, last), tiles[0])
    return Surfels(planes, nearest, tile_nearest, tile_farthest, lens)


@compiled
def _fill_inverse(depth_m: Float32Array, sigma_m: Float32Array, inverse: Float32Array, first: int, last: int) -> None:
    for row in range(first, last):
        for column in range(depth_m.shape[1]):
            z, sigma = depth_m[row, column], sigma_m[row, column]
            usable = NEAREST_M <= z <= FARTHEST_M and 0 < sigma < z
            inverse[row, column] = np.float32(1) / z if usable else np.float32(0)


@compiled
def _fill_planes(
    inverse: Float32Array,
    sigma_m: Float32Array,
    lens: Float32Array,
    edge: np.float32,
    per_metre: np.float32,
    planes: Float32Array,
    nearest: Float32Array,
    first: int,
    last: int,
) -> None:
    """Fit a plane through each pixel's own depth to those of its eight neighbours that are not across a depth edge."""
    height, width = inverse.shape
    fx, fy, cx, cy = lens[0], lens[1], lens[2], lens[3]
    diagonal = np.float32(1.4142135)
    for row in range(first, last):
        for column in range(width):
            centre = inverse[row, column]
            planes[row, column, INVERSE] = 0
            nearest[row, column] = np.inf
            if centre == 0:
                continue
            front = centre
            whole = 0 < row < height - 1 and 0 < column < width - 1
            joined = 0
            x_sum = y_sum = step_sum = xx = xy = yy = x_step = y_step = np.float32(0)
            for down in range(-1 if row > 0 else 0, 2 if row < height - 1 else 1):
                for right in range(-1 if column > 0 else 0, 2 if column < width - 1 else 1):
                    other = inverse[row + down, column + right]
                    if other == 0:
                        whole = False
                        continue
                    front = max(front, other)
                    step = other - centre
                    limit = edge * min(other, centre)
                    if abs(step) <= (limit if right == 0 or down == 0 else diagonal * limit):
                        joined += 1
                        x, y = np.float32(right), np.float32(down)
                        x_sum += x
                        y_sum += y
                        step_sum += step
                        xx += x * x
                        xy += x * y
                        yy += y * y
                        x_step += x * step
                        y_step += y * step
            if whole:
                nearest[row, column] = front
            if joined < ALLIES and _outlier(inverse, row, column, edge):
                continue
            determinant = xx * yy - xy * xy
            if determinant > np.float32(0.5):
                gu = (yy * x_step - xy * y_step) / determinant
                gv = (xx * y_step - xy * x_step) / determinant
            else:
                gu = x_step / xx if xx > 0 else np.float32(0)
                gv = y_step / yy if yy > 0 else np.float32(0)
            sigma = max(sigma_m[row, column], SHARPEST_M) * centre * centre
            if joined >= CROWD and abs(step_sum - gu * x_sum - gv * y_sum) > SPIKE * sigma * np.float32(joined):
                continue
            # the plane is n P = 1: the length of n is one over its distance from the camera
            nx, ny = gu * fx, gv * fy
            nz = centre + gu * (cx - np.float32(column)) + gv * (cy - np.float32(row))
            reach = per_metre / math.sqrt(nx * nx + ny * ny + nz * nz)
            sigma *= reach / centre
            planes[row, column, INVERSE] = centre
            planes[row, column, RIGHT] = gu
            planes[row, column, DOWN] = gv
            planes[row, column, REACH] = reach
            planes[row, column, WEIGHT] = np.float32(1) / (sigma * sigma)


@compiled
def _outlier(inverse: Float32Array, row: int, column: int, edge: np.float32) -> bool:
    """Say whether a pixel has neighbours but too few that could be of its surface."""
    height, width = inverse.shape
    centre = inverse[row, column]
    measured, allies = 0, 0
    for down in range(max(row - WINDOW, 0), min(row + WINDOW + 1, height)):
        for right in range(max(column - WINDOW, 0), min(column + WINDOW + 1, width)):
            other = inverse[down, right]
            if other == 0 or (down == row and right == column):
                continue
            measured += 1
            if abs(other - centre) <= edge * min(other, centre):
                allies += 1
    return allies < min(measured, ALLIES)


@compiled
def _fill_tiles(
    nearest: Float32Array, tile_nearest: Float32Array, tile_farthest: Float32Array, first: int, last: int
) -> None:
    height, width = nearest.shape
    for tile_row in range(first, last):
        for tile_column in range(tile_nearest.shape[1]):
            high, low = np.float32(0), np.float32(np.inf)
            for row in range(tile_row * TILE, min(tile_row * TILE + TILE, height)):
                for column in range(tile_column * TILE, min(tile_column * TILE + TILE, width)):
                    high, low = max(high, nearest[row, column]), min(low, nearest[row, column])
            tile_nearest[tile_row, tile_column], tile_farthest[tile_row, tile_column] = high, low
