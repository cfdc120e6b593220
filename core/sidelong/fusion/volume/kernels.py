"""What a view tells the voxels: where surfaces are near, how far, and what it saw through."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from sidelong.fusion.volume.grid import BLOCK, CELL, CELLS, CHUNK, MOST_COUNTED, VOXELS, Grid
from sidelong.fusion.volume.surfels import DOWN, INVERSE, REACH, RIGHT, TILE, WEIGHT, Surfels
from sidelong.kernels import compiled
from sidelong.types import Float32Array, IntArray


class Band(NamedTuple):
    """How many voxels before and behind a surface learn of it, and the side of a voxel in metres; all float32."""

    front: np.float32
    behind: np.float32
    voxel_m: np.float32


RADIUS_M = 5e-3
"""A radius of curvature that parts commonly have. By it, the distance to the plane of a pixel is not that to the
surface where that is seen aslant: what a ray passes at ``d`` it meets ``d tan`` farther on, where it has bent away by
half the square of that over the radius."""
STEEPEST = 0.2
"""Cosine of incidence below which the band along a ray grows no longer."""


@compiled
def touch(
    surfels: Surfels, grid_T_camera: Float32Array, band: Band, marks: NDArray[np.bool_], first: int, last: int
) -> None:
    """Mark the blocks that the rays of rows ``first`` to ``last`` run through within the band about their depths.

    ``grid_T_camera`` (3, 4) maps metres to voxels.
    """
    T, lens = grid_T_camera, surfels.lens
    size_x, size_y, size_z = marks.shape
    block, half = np.float32(1 / BLOCK), np.float32(0.5)
    offset_x, offset_y, offset_z = (T[0, 3] + half) * block, (T[1, 3] + half) * block, (T[2, 3] + half) * block
    # how many blocks outside the region a depth can be and its band within
    apart = max(band.front, band.behind) * block / np.float32(STEEPEST)
    for row in range(first, last):
        y = (np.float32(row) - lens[3]) / lens[1]
        for column in range(surfels.planes.shape[1]):
            inverse = surfels.planes[row, column, INVERSE]
            if inverse == 0:
                continue
            x = (np.float32(column) - lens[2]) / lens[0]
            # of the ray, in blocks for each metre of depth
            dx = (T[0, 0] * x + T[0, 1] * y + T[0, 2]) * block
            dy = (T[1, 0] * x + T[1, 1] * y + T[1, 2]) * block
            dz = (T[2, 0] * x + T[2, 1] * y + T[2, 2]) * block
            depth = np.float32(1) / inverse
            at_x, at_y, at_z = dx * depth + offset_x, dy * depth + offset_y, dz * depth + offset_z
            if (
                min(at_x, at_y, at_z) < -apart
                or at_x > size_x + apart
                or at_y > size_y + apart
                or at_z > size_z + apart
            ):
                continue
            # what a voxel of distance is in depth
            per_voxel = np.float32(1) / max(
                inverse * surfels.planes[row, column, REACH], np.float32(STEEPEST) / band.voxel_m
            )
            nearest, extent = depth - band.front * per_voxel, (band.front + band.behind) * per_voxel
            steps = math.ceil(extent * math.sqrt(dx * dx + dy * dy + dz * dz) * 3) + 1
            last_block = -1
            for step in range(steps + 1):
                z = nearest + extent * np.float32(step) / np.float32(steps)
                i = math.floor(dx * z + offset_x)
                j = math.floor(dy * z + offset_y)
                k = math.floor(dz * z + offset_z)
                if i < 0 or j < 0 or k < 0 or i >= size_x or j >= size_y or k >= size_z:
                    continue
                this_block = (i * size_y + j) * size_z + k
                if this_block != last_block:
                    marks[i, j, k] = True
                    last_block = this_block


@compiled
def integrate(
    grid: Grid,
    touched: IntArray,
    surfels: Surfels,
    camera_T_grid: Float32Array,
    band: Band,
    step: int,
    first: int,
    last: int,
) -> None:
    """Give the voxels of blocks ``touched[first:last]`` (N, 3) the distance to the plane of the pixel they fall on.

    Voxels weigh less the farther behind the plane they lie. ``camera_T_grid`` (3, 4) maps voxels to metres.
    """
    T, lens, planes = camera_T_grid, surfels.lens, surfels.planes
    height, width = np.float32(planes.shape[0]), np.float32(planes.shape[1])
    half, one = np.float32(0.5), np.float32(1)
    fade = one / (band.behind - one)
    curvature = band.voxel_m / np.float32(2 * RADIUS_M)
    us, vs, zs = np.empty(VOXELS, np.float32), np.empty(VOXELS, np.float32), np.empty(VOXELS, np.float32)
    for index in range(first, last):
        i, j, k = touched[index, 0], touched[index, 1], touched[index, 2]
        slot = grid.slots[i, j, k]
        gx, gy, gz = np.float32(i * BLOCK), np.float32(j * BLOCK), np.float32(k * BLOCK)
        x0 = T[0, 0] * gx + T[0, 1] * gy + T[0, 2] * gz + T[0, 3]
        y0 = T[1, 0] * gx + T[1, 1] * gy + T[1, 2] * gz + T[1, 3]
        z0 = T[2, 0] * gx + T[2, 1] * gy + T[2, 2] * gz + T[2, 3]
        for voxel in range(VOXELS):  # without a branch, so that several are projected at once
            gx, gy, gz = np.float32(voxel >> 4), np.float32((voxel >> 2) & 3), np.float32(voxel & 3)
            z = z0 + T[2, 0] * gx + T[2, 1] * gy + T[2, 2] * gz
            per_z = one / z
            us[voxel] = lens[0] * (x0 + T[0, 0] * gx + T[0, 1] * gy + T[0, 2] * gz) * per_z + lens[2]
            vs[voxel] = lens[1] * (y0 + T[1, 0] * gx + T[1, 1] * gy + T[1, 2] * gz) * per_z + lens[3]
            zs[voxel] = z
        for voxel in range(VOXELS):
            u, v, z = us[voxel], vs[voxel], zs[voxel]
            if not (z > 0 and u > -half and v > -half and u < width - half and v < height - half):
                continue
            column, row = int(u + half), int(v + half)
            inverse = planes[row, column, INVERSE]
            if inverse == 0:
                continue
            inverse += planes[row, column, RIGHT] * (u - np.float32(column))
            inverse += planes[row, column, DOWN] * (v - np.float32(row))
            distance = (one - z * inverse) * planes[row, column, REACH]
            if distance > band.front or distance <= -band.behind:
                continue
            cosine = planes[row, column, INVERSE] * planes[row, column, REACH] * band.voxel_m
            bend = curvature * distance * distance * (one / (cosine * cosine) - one)
            weight = one / (one / planes[row, column, WEIGHT] + bend * bend)
            if distance < -one:
                weight *= (distance + band.behind) * fade
            grid.sums[slot, voxel, 0] += weight
            grid.sums[slot, voxel, 1] += weight * distance
            if grid.counts[slot, voxel, 0] < MOST_COUNTED:
                grid.counts[slot, voxel, 0] += 1
            if grid.counts[slot, voxel, 1] == 0 or grid.counts[slot, voxel, 1] > step + 1:
                grid.counts[slot, voxel, 1] = step + 1


@compiled
def see_through(grid: Grid, surfels: Surfels, camera_T_grid: Float32Array, band: Band, first: int, last: int) -> None:
    """Count, in chunks ``first`` to ``last``, one more view for cells that lie more than the band before all they hide.

    A pixel, all its neighbours, must be measured farther away: a lone outlier takes nothing away, and neither does a
    pixel beside a thin part.
    """
    T, lens = camera_T_grid, surfels.lens
    _, size_y, size_z = grid.chunks_through.shape
    height, width = np.float32(surfels.nearest.shape[0]), np.float32(surfels.nearest.shape[1])
    half, one, most = np.float32(0.5), np.float32(1), np.float32(1.5)
    us, vs, zs = np.empty(CELLS, np.float32), np.empty(CELLS, np.float32), np.empty(CELLS, np.float32)
    radius = np.float32(CHUNK * math.sqrt(3) / 2) * band.voxel_m
    margin = (band.front + np.float32(CELL * math.sqrt(3) / 2)) * band.voxel_m
    middle, cell_middle = np.float32((CHUNK - 1) / 2), np.float32((CELL - 1) / 2)
    for chunk in range(first, last):
        i, j, k = chunk // (size_y * size_z), chunk // size_z % size_y, chunk % size_z
        gx, gy, gz = np.float32(i * CHUNK), np.float32(j * CHUNK), np.float32(k * CHUNK)
        x0 = T[0, 0] * gx + T[0, 1] * gy + T[0, 2] * gz + T[0, 3]
        y0 = T[1, 0] * gx + T[1, 1] * gy + T[1, 2] * gz + T[1, 3]
        z0 = T[2, 0] * gx + T[2, 1] * gy + T[2, 2] * gz + T[2, 3]
        z = z0 + (T[2, 0] + T[2, 1] + T[2, 2]) * middle
        if not z > 2 * radius:
            continue
        u = lens[0] * (x0 + (T[0, 0] + T[0, 1] + T[0, 2]) * middle) / z + lens[2]
        v = lens[1] * (y0 + (T[1, 0] + T[1, 1] + T[1, 2]) * middle) / z + lens[3]
        spread = max(lens[0], lens[1]) * radius / (z - radius) * most + half
        if not (u > -spread and v > -spread and u < width + spread and v < height + spread):
            continue
        inside = u > spread and v > spread and u < width - one - spread and v < height - one - spread
        high, low = np.float32(0), np.float32(np.inf)
        for row in range(int(max(v - spread, half)) // TILE, int(min(v + spread, height - one)) // TILE + 1):
            for column in range(int(max(u - spread, half)) // TILE, int(min(u + spread, width - one)) // TILE + 1):
                high = max(high, surfels.tile_nearest[row, column])
                low = min(low, surfels.tile_farthest[row, column])
        if (z - radius + margin) * low >= one:  # all of it is hidden, or unknown
            continue
        if inside and (z + radius + margin) * high < one:
            if grid.chunks_through[i, j, k] < MOST_COUNTED:
                grid.chunks_through[i, j, k] += 1
            continue
        for cell in range(CELLS):
            gx = np.float32((cell >> 4) * CELL) + cell_middle
            gy = np.float32(((cell >> 2) & 3) * CELL) + cell_middle
            gz = np.float32((cell & 3) * CELL) + cell_middle
            z = z0 + T[2, 0] * gx + T[2, 1] * gy + T[2, 2] * gz
            per_z = one / z
            us[cell] = lens[0] * (x0 + T[0, 0] * gx + T[0, 1] * gy + T[0, 2] * gz) * per_z + lens[2]
            vs[cell] = lens[1] * (y0 + T[1, 0] * gx + T[1, 1] * gy + T[1, 2] * gz) * per_z + lens[3]
            zs[cell] = z
        for cell in range(CELLS):
            u, v = us[cell], vs[cell]
            if not (u > -half and v > -half and u < width - half and v < height - half):
                continue
            seen = (zs[cell] + margin) * surfels.nearest[int(v + half), int(u + half)] < one
            if seen and grid.cells_through[i, j, k, cell] < MOST_COUNTED:
                grid.cells_through[i, j, k, cell] += 1
