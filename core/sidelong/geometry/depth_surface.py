"""A depth map as a surface: points, normals and triangles between neighbours that lie on one surface.

Normals are means over the triangles around each point, and over those around them: on recorded and simulated depth that
is as near to the truth as a plane through a window of 5 pixels, and no window has to be thrown away at an edge, because
no triangle crosses one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from sidelong.errors import ImageError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.depth_edges import depth_jumps, neighbours
from sidelong.geometry.transforms import transform_points
from sidelong.types import BoolArray, FloatArray, IntArray

EDGE_STEP = 1.0
"""Odd step of depth that is an edge, over what a pixel spans (z/f). On exact depth of heaps at 320x256 px it leaves a
quarter of the triangles that would bridge an edge by more than 1 mm, and takes 0.03 % of the right ones."""
MAX_INCIDENCE_RAD = 1.3
"""Triangles that are seen more nearly edge-on are left out: they are jumps more often than surface."""
ROUNDS = 3
"""How often normals are averaged with those around them. Median error on the parts, recorded at 1280x1024 px, with 0,
1, 2, 3, 6 rounds: 20.7, 18.6, 17.6, 17.0, 16.1 degrees; on parts of few pixels more rounds wipe out their shape."""


@dataclass(frozen=True, eq=False)
class Surface:
    """Points that were measured, and triangles between them.

    Attributes
    ----------
    points_m, normals
        (N, 3) each; normals are unit vectors, turned to the camera. A point of no triangle has the direction to it.
    pixels
        (N, 2) row and column that each point was seen at.
    triangles
        (M, 3) indices of points, counter-clockwise as the camera sees them.
    """

    points_m: FloatArray
    normals: FloatArray
    pixels: IntArray
    triangles: IntArray

    def moved(self, a_T_b: FloatArray) -> Surface:
        """Return a surface in frame b in frame a."""
        normals = self.normals @ a_T_b[:3, :3].T
        return replace(self, points_m=transform_points(a_T_b, self.points_m), normals=normals)

    def connected(self) -> Surface:
        """Return the surface without the points that belong to no triangle."""
        used = np.zeros(len(self.points_m), dtype=np.bool_)
        used[self.triangles] = True
        number = np.cumsum(used) - 1
        return Surface(self.points_m[used], self.normals[used], self.pixels[used], number[self.triangles])


def depth_surface(depth_m: FloatArray, camera: PinholeCamera, max_incidence_rad: float = MAX_INCIDENCE_RAD) -> Surface:
    """Return the surface of a depth map in the camera frame: a point for each pixel that has depth.

    Three neighbours of a square of four make a triangle if no step between them is an edge and the triangle is not seen
    edge-on. A square is cut along the diagonal whose ends are nearer in 1/z, which is affine on a plane.

    Parameters
    ----------
    depth_m
        (H, W) along the optical axis; what is not a positive, finite length counts as missing.
    camera
        Its intrinsics.
    max_incidence_rad
        Largest angle between a triangle's normal and the line of sight.

    Raises
    ------
    ImageError
        The map does not have the camera's size.
    """
    if depth_m.shape != (camera.height, camera.width):
        raise ImageError(f"depth: the map is {depth_m.shape}, the camera has {camera.height, camera.width}")
    present = np.isfinite(depth_m) & (depth_m > 0)
    points = camera.pixel_rays()[present] * depth_m[present][:, None]
    inverse = np.divide(1.0, depth_m, out=np.full(depth_m.shape, np.nan), where=present)
    triangles = _between_neighbours(inverse, present, camera)
    areas = _areas(points, triangles)
    facing = _facing(points, triangles, areas) >= np.cos(max_incidence_rad)
    triangles, areas = triangles[facing], areas[facing]
    return Surface(points, _normals(points, triangles, areas), np.argwhere(present), triangles)


def _between_neighbours(inverse: FloatArray, present: BoolArray, camera: PinholeCamera) -> IntArray:
    """Return triangles (M, 3) of points, numbered row by row, that no edge crosses."""
    with np.errstate(invalid="ignore"):
        in_row, in_column = _linked(inverse, 1, EDGE_STEP / camera.fx), _linked(inverse, 0, EDGE_STEP / camera.fy)
        falling_first = np.abs(inverse[:-1, :-1] - inverse[1:, 1:]) <= np.abs(inverse[:-1, 1:] - inverse[1:, :-1])
    top, bottom = neighbours(in_row, 0)
    left, right = neighbours(in_column, 1)
    # with two sides left there is one triangle; with more the diagonal decides
    few = top.astype(np.int8) + bottom + left + right < 3
    falling, rising = few | falling_first, few | ~falling_first
    number = np.cumsum(present).reshape(present.shape) - 1
    upper, lower = neighbours(number, 0)
    (a, b), (c, d) = neighbours(upper, 1), neighbours(lower, 1)
    kinds = (
        (falling & left & bottom, (a, c, d)),
        (falling & top & right, (a, d, b)),
        (rising & left & top, (a, c, b)),
        (rising & bottom & right, (b, c, d)),
    )
    return np.concatenate([np.stack([corner[there] for corner in corners], axis=1) for there, corners in kinds])


def _linked(inverse: FloatArray, axis: int, step: float) -> BoolArray:
    """Say which neighbours along an axis both have depth and no edge between them."""
    before, after = neighbours(inverse, axis)
    # the small step in the middle of a bar of two pixels is odd as well: it lies between two large ones
    small = np.abs(after - before) <= step * np.minimum(before, after)
    return small | (np.isfinite(after - before) & ~depth_jumps(inverse, axis, step))


def _areas(points: FloatArray, triangles: IntArray) -> FloatArray:
    """Return the normal (M, 3) of each triangle, as long as twice its area."""
    first, second, third = (points[triangles[:, corner]] for corner in range(3))
    return np.cross(second - first, third - first)


def _facing(points: FloatArray, triangles: IntArray, areas: FloatArray) -> FloatArray:
    """Return the cosine (M,) of the angle between each triangle's normal and the way to the camera."""
    middles = sum(points[triangles[:, corner]] for corner in range(3))
    scale = np.linalg.norm(areas, axis=1) * np.linalg.norm(middles, axis=1)
    return -np.einsum("ij,ij->i", areas, middles) / scale


def _normals(points: FloatArray, triangles: IntArray, areas: FloatArray) -> FloatArray:
    """Return the unit normal (N, 3) of each point: the mean of the triangles around it, weighted by area, smoothed."""
    sums = _at_points(areas, triangles, len(points))
    for _ in range(ROUNDS):
        sums = _at_points(sums[triangles].sum(axis=1), triangles, len(points))
    alone = ~sums.any(axis=1)
    sums[alone] = -points[alone]
    return sums / np.linalg.norm(sums, axis=1, keepdims=True)


def _at_points(vectors: FloatArray, triangles: IntArray, count: int) -> FloatArray:
    """Return the sum (N, 3) of the vectors (M, 3) of the triangles around each point."""
    corners, sums = triangles.ravel(), np.zeros((count, 3))
    for axis in range(3):
        sums[:, axis] = np.bincount(corners, np.repeat(vectors[:, axis], 3), count)
    return sums
