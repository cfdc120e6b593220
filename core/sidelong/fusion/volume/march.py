"""Rays through the voxels, to the first surface they meet from outside."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from sidelong.fusion.volume.grid import BLOCK, CELL, Grid, read_voxel, slot_of, views_through
from sidelong.kernels import compiled
from sidelong.types import BoolArray, FloatArray, IntArray

NEAR = 2.0
"""Voxels from a surface within which a ray looks between the voxels."""
LEAST_SHARE = 0.1
"""Of the eight voxels around a place, weighted as they are between them, that must be known."""
SHARED = 0.8
"""Correlation of the errors of voxels next to each other: they mostly know of a surface from the same pixels, and
pixels next to each other were matched by the same windows."""
GRAZING = 0.2
"""Cosine of incidence below which the standard deviation along the ray grows no longer."""


class VolumeView(NamedTuple):
    """What a camera sees of a volume.

    Attributes
    ----------
    depth_m, sigma_m
        (H, W) depth along the optical axis and its standard deviation, NaN where nothing was found or wanted.
    source
        (H, W) lowest step that measured the surface there, -1 for none.
    unseen_m
        (H, W) how much of the depth before the surface no view saw to be free. Where it is much, something that nobody
        measured may hide the surface: far more of what is wrong lies there than of what is right.
    """

    depth_m: FloatArray
    sigma_m: FloatArray
    source: IntArray
    unseen_m: FloatArray


class Ray(NamedTuple):
    """A ray.

    Attributes
    ----------
    origin
        (3,) where it starts, voxels.
    direction
        (3,) where it goes, voxels for each metre of depth.
    inverse
        (3,) one over that.
    pace
        (1,) voxels it passes in each metre of depth.
    """

    origin: FloatArray
    direction: FloatArray
    inverse: FloatArray
    pace: FloatArray


@compiled
def march(
    grid: Grid,
    grid_T_camera: FloatArray,
    lens: FloatArray,
    least: float,
    wanted: BoolArray,
    seen: VolumeView,
    first: int,
    last: int,
) -> None:
    """Fill rows ``first`` to ``last`` of what is seen, where it is wanted and a ray hits.

    ``grid_T_camera`` (3, 4) maps metres to voxels; ``lens`` is fx, fy, cx, cy.
    """
    ray = Ray(grid_T_camera[:, 3].copy(), np.empty(3), np.empty(3), np.empty(1))
    corners = np.empty((8, 2))
    for row in range(first, last):
        for column in range(wanted.shape[1]):
            if not wanted[row, column]:
                continue
            x, y = (column - lens[2]) / lens[0], (row - lens[3]) / lens[1]
            point(ray, grid_T_camera, x, y)
            depth, sigma, step = first_hit(grid, ray, least, corners)
            if depth > 0:
                seen.depth_m[row, column], seen.sigma_m[row, column] = depth, sigma
                seen.source[row, column] = step
                seen.unseen_m[row, column] = unseen(grid, ray, depth, least)


@compiled
def first_hit(grid: Grid, ray: Ray, least: float, corners: FloatArray) -> tuple[float, float, int]:
    """Return depth, its standard deviation and the step where a ray meets a surface from outside; depth 0 for nowhere.

    A ray that leaves a surface from behind is inside a part whose front nobody saw: what it would meet next is hidden,
    and it hits nothing. ``corners`` (8, 2) is room to work in.
    """
    voxel = 1 / ray.pace[0]
    depth, end = clipped(grid, ray)
    before, before_depth = np.nan, depth
    while depth < end:
        x, y, z = place(ray, depth)
        i, j, k = nearest_voxel(x, y, z)
        if slot_of(grid, i, j, k) < 0:
            depth, before = block_exit(ray, depth, i, j, k), np.nan
            continue
        information, distance, _ = read_voxel(grid, i, j, k, least)
        if information <= 0 or abs(distance) > NEAR:
            depth, before = depth + voxel * max(distance - NEAR + 0.5, 1.0), np.nan
            continue
        distance, _, _ = sample(grid, x, y, z, least, corners)
        if before > 0 and distance <= 0:
            slope = (before - distance) / (depth - before_depth)
            return crossing(grid, ray, before_depth + before / slope, slope, least, corners)
        if before < 0 and distance > 0:
            return 0.0, 0.0, -1
        before, before_depth = distance, depth
        depth += voxel
    return 0.0, 0.0, -1


@compiled
def crossing(
    grid: Grid, ray: Ray, depth: float, slope: float, least: float, corners: FloatArray
) -> tuple[float, float, int]:
    """Return the depth of the surface near a depth, its standard deviation and step.

    ``slope`` is by how much the distance to it falls with each metre of depth.
    """
    x, y, z = place(ray, depth)
    distance, information, step = sample(grid, x, y, z, least, corners)
    if not information > 0:
        return 0.0, 0.0, -1
    pace = ray.pace[0]
    depth += min(max(distance / slope, -0.5 / pace), 0.5 / pace)
    return depth, 1 / (math.sqrt(information) * max(slope, GRAZING * pace)), step - 1


@compiled
def unseen(grid: Grid, ray: Ray, depth: float, least: float) -> float:
    """Return how much of the depth before a hit lies in space of the region that no view saw to be free."""
    start, _ = clipped(grid, ray)
    stride = CELL / ray.pace[0]
    size_x, size_y, size_z = grid.slots.shape
    total, at = 0.0, depth - stride / 2
    while at > start:
        x, y, z = place(ray, at)
        i, j, k = nearest_voxel(x, y, z)
        i, j, k = (
            min(max(i, 0), size_x * BLOCK - 1),
            min(max(j, 0), size_y * BLOCK - 1),
            min(max(k, 0), size_z * BLOCK - 1),
        )
        if views_through(grid, i, j, k) == 0 and not read_voxel(grid, i, j, k, least)[1] > 0:
            total += stride
        at -= stride
    return total


@compiled
def sample(grid: Grid, x: float, y: float, z: float, least: float, corners: FloatArray) -> tuple[float, float, int]:
    """Return the distance at a place between voxels, its information, and step + 1 of the known voxel nearest to it.

    Trilinear in the eight voxels around. Where some are unknown, the mean of the others stands for their centroid, and
    is carried to the place along the differences between those that are known. ``corners`` (8, 2) is room to work in.
    """
    x0, y0, z0 = math.floor(x), math.floor(y), math.floor(z)
    fx, fy, fz = x - x0, y - y0, z - z0
    known, nearest, largest = 0, 0, 0.0
    total = squares = distance = information = cx = cy = cz = 0.0
    for corner in range(8):
        a, b, c = corner >> 2, (corner >> 1) & 1, corner & 1
        corners[corner, 0], corners[corner, 1], step = read_voxel(grid, x0 + a, y0 + b, z0 + c, least)
        if corners[corner, 0] <= 0:
            continue
        share = (fx if a else 1 - fx) * (fy if b else 1 - fy) * (fz if c else 1 - fz)
        known += 1
        total += share
        squares += share * share
        information += share * corners[corner, 0]
        distance += share * corners[corner, 1]
        cx, cy, cz = cx + share * a, cy + share * b, cz + share * c
        if share > largest:
            largest, nearest = share, step
    if total < LEAST_SHARE:
        return np.nan, 0.0, 0
    distance /= total
    if known < 8:
        distance += (fx - cx / total) * difference(corners, 4)
        distance += (fy - cy / total) * difference(corners, 2)
        distance += (fz - cz / total) * difference(corners, 1)
    information /= total * (SHARED + (1 - SHARED) * squares / (total * total))
    return distance, information, nearest


@compiled
def difference(corners: FloatArray, axis: int) -> float:
    """Return the mean step along an axis between corners that are both known; 0 without any."""
    total, count = 0.0, 0
    for corner in range(8):
        if corner & axis == 0 and corners[corner, 0] > 0 and corners[corner | axis, 0] > 0:
            total += corners[corner | axis, 1] - corners[corner, 1]
            count += 1
    return total / count if count else 0.0


@compiled
def point(ray: Ray, grid_T_camera: FloatArray, x: float, y: float) -> None:
    """Let a ray go through a place of the image, as at z = 1."""
    for axis in range(3):
        ray.direction[axis] = grid_T_camera[axis, 0] * x + grid_T_camera[axis, 1] * y + grid_T_camera[axis, 2]
        ray.inverse[axis] = 1 / ray.direction[axis]
    ray.pace[0] = math.sqrt(ray.direction[0] ** 2 + ray.direction[1] ** 2 + ray.direction[2] ** 2)


@compiled
def place(ray: Ray, depth: float) -> tuple[float, float, float]:
    """Return where a ray is at a depth, in voxels."""
    origin, direction = ray.origin, ray.direction
    return origin[0] + direction[0] * depth, origin[1] + direction[1] * depth, origin[2] + direction[2] * depth


@compiled
def nearest_voxel(x: float, y: float, z: float) -> tuple[int, int, int]:
    """Return the voxel a place lies in."""
    return math.floor(x + 0.5), math.floor(y + 0.5), math.floor(z + 0.5)


@compiled
def block_exit(ray: Ray, depth: float, i: int, j: int, k: int) -> float:
    """Return the depth just behind where a ray leaves the block of a voxel it is in."""
    least = np.inf
    for axis in range(3):
        voxel = i if axis == 0 else (j if axis == 1 else k)
        bound = (voxel >> 2) * BLOCK - 0.5 + (BLOCK if ray.direction[axis] > 0 else 0)
        if ray.direction[axis] != 0:
            least = min(least, (bound - ray.origin[axis]) * ray.inverse[axis])
    # a thousandth of a voxel: rounding must not leave it where it is
    return max(least, depth) + 1e-3 / ray.pace[0]


@compiled
def clipped(grid: Grid, ray: Ray) -> tuple[float, float]:
    """Return the depths between which a ray is in the region, before the camera; an empty range where it misses it."""
    near, far = 0.0, np.inf
    for axis in range(3):
        high = grid.slots.shape[axis] * BLOCK - 0.5
        if ray.direction[axis] == 0:
            if not -0.5 <= ray.origin[axis] <= high:
                return 0.0, 0.0
            continue
        a = (-0.5 - ray.origin[axis]) * ray.inverse[axis]
        b = (high - ray.origin[axis]) * ray.inverse[axis]
        near, far = max(near, min(a, b)), min(far, max(a, b))
    return near + 1e-3 / ray.pace[0], far
