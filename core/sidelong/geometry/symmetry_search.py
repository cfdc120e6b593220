"""The symmetry of a part, found from its mesh.

Every operation leaves the centroid of the surface in its place, and every axis is a principal axis of the surface or
lies where two moments are equal. So there are few directions to try: the principal axes; round the odd one out where
two moments are equal; everywhere where all three are. What seems to fit there is refined like a registration, and
counts only if every sample of the turned surface lies on the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from sidelong.errors import MeshError
from sidelong.geometry.mesh import Part
from sidelong.geometry.point_sets import GOLDEN_RAD, distinct_rows, hemisphere
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.symmetry import LARGEST_ORDER, SAME_TURN_RAD, Symmetry, group_from
from sidelong.types import BoolArray, FloatArray, IntArray

TOLERANCE = 0.015
"""Largest distance of the turned surface from the surface, as a share of how wide the part is across the axis. A turned
16-gon passes for round (0.010), a 12-gon (0.017) and a hexagon (0.067) do not; nor does a fitting whose ends differ in
length by 0.036."""
DECLARED_TOLERANCE = 0.05
"""The same for a declared symmetry: its owner may know better than the mesh, but not by this much."""

SAME_MOMENT = 0.1
"""Moments of inertia closer than this share may be equal: deviations within the tolerance move them by 4 times it."""
COARSE_SAMPLES, FINE_SAMPLES = 64, 4000
HEMISPHERE_DIRECTIONS = 825
RING_STEP_RAD, APART_RAD = float(np.deg2rad(3.0)), float(np.deg2rad(8.0))
STAGES = (32, 256, None)
"""How many samples are tried first, then, and in the end."""
CANDIDATES, REFINEMENTS, LONGEST_STEP_RAD = 40, 8, 0.1
ANY_ANGLES_RAD = GOLDEN_RAD * np.arange(1.0, 25.0)
"""They fall evenly into the period of any number of teeth."""


def find_symmetry(part: Part, tolerance: float = TOLERANCE) -> Symmetry:
    """Return the symmetry of a part: turns, a continuous axis or a ball, and mirror planes.

    Materials count: a face of another material breaks a symmetry as a hole would.

    Parameters
    ----------
    tolerance
        Largest distance of the turned surface from the surface, as a share of twice the largest distance of the surface
        from the axis (from the plane, of a mirror image).
    """
    surface = _Surface.of(part, tolerance)
    if surface.all_hold(Rotation.random(24, random_state=0).as_matrix()):
        return Symmetry(surface.centre_m, np.eye(3)[None], ball=True)
    odd, directions = _directions(surface)
    folds = [_fitted(surface, directions, 2 * np.pi / order) for order in (2, 3, 5)]
    axes = np.concatenate([odd, *folds])
    for axis in axes:
        if surface.all_hold(_about(axis, ANY_ANGLES_RAD)):
            return _continuous(surface, axis)
    rotations = _group(surface, axes)
    return Symmetry(surface.centre_m, rotations, planes=_planes(_fitted(surface, directions, None), rotations))


def checked_symmetry(part: Part, declared: Symmetry) -> Symmetry:
    """Return a declared symmetry.

    Raises
    ------
    MeshError
        The mesh contradicts it by more than ``DECLARED_TOLERANCE``.
    """
    surface = _Surface.of(part, DECLARED_TOLERANCE, declared.centre_m)
    worst = float(surface.deviation(_sampled(declared)).max(initial=0.0))
    if worst > DECLARED_TOLERANCE:
        raise MeshError(
            f"{part.name}: the mesh contradicts the declared symmetry by {worst:.3g} of its width across the axis, "
            f"limit {DECLARED_TOLERANCE:g}"
        )
    return declared


@dataclass(frozen=True, eq=False)
class _Surface:
    """A part's surface as samples about its centre, and rays against each of its materials."""

    centre_m: FloatArray
    samples: FloatArray
    material: IntArray
    scenes: Sequence[RayScene]
    moments: FloatArray
    principal_axes: FloatArray
    tolerance: float

    @staticmethod
    def of(part: Part, tolerance: float, centre_m: FloatArray | None = None) -> _Surface:
        centroid_m, moments = surface_moments(part)
        centre_m = centroid_m if centre_m is None else centre_m
        values, vectors = np.linalg.eigh(moments)
        points_m, material = _samples(part)
        centred = Part(part.name, part.vertices_m - centre_m, part.triangles, part.triangle_material, part.materials)
        scenes = [_only(centred, index) for index in range(len(part.materials))]
        return _Surface(centre_m, points_m - centre_m, material, scenes, values, vectors.T, tolerance)

    def offsets(self, operations: FloatArray, chosen: slice = slice(None)) -> tuple[FloatArray, FloatArray]:
        """Return (M, P, 3) from the surface to its turned samples, and the normals there, for operations (M, 3, 3)."""
        points = self.samples[chosen] @ np.swapaxes(operations, -1, -2)
        nearest, normals = np.empty_like(points), np.empty_like(points)
        for index, scene in enumerate(self.scenes):
            mine = self.material[chosen] == index
            nearest[:, mine], normals[:, mine] = scene.closest(points[:, mine])
        return points - nearest, normals

    def deviation(self, operations: FloatArray, chosen: slice = slice(None)) -> FloatArray:
        """Return the largest distance (M,) of the turned surface from the surface, as a share of the width."""
        farthest = np.linalg.norm(self.offsets(operations, chosen)[0], axis=2).max(axis=1)
        return farthest / self.width(operations)

    def width(self, operations: FloatArray) -> FloatArray:
        """Return twice the largest distance (M,) of the surface from what each operation leaves in its place."""
        _values, vectors = np.linalg.eigh(operations + np.swapaxes(operations, -1, -2))
        along_axis, along_normal = self.samples @ vectors[:, :, 2].T, self.samples @ vectors[:, :, 0].T
        from_axis = np.sqrt(np.maximum((self.samples**2).sum(axis=1)[:, None] - along_axis**2, 0))
        away = np.where(np.linalg.det(operations) > 0, from_axis, np.abs(along_normal))
        return np.maximum(2 * away.max(axis=0), np.finfo(float).tiny)

    def holds(self, operations: FloatArray, stages: Sequence[int | None] = STAGES) -> BoolArray:
        """Say which operations (M, 3, 3) map the surface onto itself; few samples rule out most that do not."""
        held = np.ones(len(operations), dtype=np.bool_)
        for count in stages:
            held[held] = self.deviation(operations[held], slice(count)) <= self.tolerance
        return held

    def all_hold(self, operations: FloatArray) -> bool:
        """Say whether all operations (M, 3, 3) map the surface onto itself."""
        return all((self.deviation(operations, slice(count)) <= self.tolerance).all() for count in STAGES)


def surface_moments(part: Part) -> tuple[FloatArray, FloatArray]:
    """Return the centroid (3,) of the surface and its second moments (3, 3) about it, integrated exactly."""
    corners = part.vertices_m[part.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    area /= area.sum()
    centroid = area @ corners.mean(axis=1)
    corners = corners - centroid
    sums = corners.sum(axis=1)
    moments = np.einsum("f,fci,fcj->ij", area, corners, corners) + np.einsum("f,fi,fj->ij", area, sums, sums)
    return centroid, moments / 12


def _samples(part: Part) -> tuple[FloatArray, IntArray]:
    """Return points (P, 3) that miss no detail as large as the tolerance, in random order, and their materials (P,).

    Vertices, because details have them, and points spread over the area; one of each for every cell of a grid.
    """
    rng = np.random.default_rng(0)
    corners = part.vertices_m[part.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    spread = np.searchsorted(np.cumsum(area) / area.sum(), (np.arange(FINE_SAMPLES) + 0.5) / FINE_SAMPLES)
    shares = rng.dirichlet((1.0, 1.0, 1.0), FINE_SAMPLES)
    points = np.concatenate([corners.reshape(-1, 3), np.einsum("pc,pci->pi", shares, corners[spread])])
    material = np.concatenate([np.repeat(part.triangle_material, 3), part.triangle_material[spread]])
    cell_m = np.sqrt(area.sum() / 2 / FINE_SAMPLES)
    cells = np.column_stack([np.floor(points / cell_m).astype(np.intp), material])
    first = distinct_rows(cells)[0]
    order = rng.permutation(np.sort(first))
    return points[order], material[order]


def _only(part: Part, material: int) -> RayScene:
    mine = part.triangle_material == material
    if not mine.any():
        return RayScene([])
    shell = Part(part.name, part.vertices_m, part.triangles[mine], part.triangle_material[mine], part.materials)
    return RayScene([(shell, np.eye(4))])


def _directions(surface: _Surface) -> tuple[FloatArray, FloatArray]:
    """Return the axes (0 or 1, 3) that may be of any order, and directions (N, 3) near which all others must lie."""
    low, middle, high = surface.moments
    axes = surface.principal_axes
    low_pair, high_pair = (middle - low) < SAME_MOMENT * middle, (high - middle) < SAME_MOMENT * high
    if low_pair and high_pair:
        return axes[:0], np.concatenate([axes, hemisphere(HEMISPHERE_DIRECTIONS)])
    if not low_pair and not high_pair:
        return axes[:0], axes
    odd, across = (axes[2], axes[0]) if low_pair else (axes[0], axes[2])
    ring = _about(odd, np.arange(0, np.pi, RING_STEP_RAD)) @ across
    return odd[None], np.concatenate([odd[None], ring])


def _about(axis: ArrayLike, angles_rad: ArrayLike) -> FloatArray:
    """Return turns (N, 3, 3) about an axis."""
    angles, direction = np.asarray(angles_rad, dtype=np.float64), np.asarray(axis, dtype=np.float64)
    return Rotation.from_rotvec(angles[:, None] * direction).as_matrix()


def _turn_or_mirror(axes: FloatArray, angle_rad: float | None) -> FloatArray:
    """Return the turns (N, 3, 3) about axes (N, 3), or the mirror images across the planes they are normal to."""
    if angle_rad is None:
        return np.eye(3) - 2 * axes[:, :, None] * axes[:, None, :]
    return Rotation.from_rotvec(angle_rad * axes).as_matrix()


def _fitted(surface: _Surface, directions: FloatArray, angle_rad: float | None) -> FloatArray:
    """Return the axes (N, 3) near ``directions`` about which the turn (None: the mirror image) holds."""
    coarse = slice(COARSE_SAMPLES)
    offsets, _normals = surface.offsets(_turn_or_mirror(directions, angle_rad), coarse)
    misfit = np.linalg.norm(offsets, axis=2).mean(axis=1)
    near = np.abs(directions @ directions.T) > np.cos(APART_RAD)
    lowest = np.flatnonzero(misfit <= np.where(near, misfit, np.inf).min(axis=1))
    axes = directions[lowest[np.argsort(misfit[lowest], kind="stable")[:CANDIDATES]]]
    for _ in range(REFINEMENTS):
        axes = _refined(surface, axes, _turn_or_mirror(axes, angle_rad), coarse)
    return _distinct(axes[surface.holds(_turn_or_mirror(axes, angle_rad))])


def _refined(surface: _Surface, axes: FloatArray, operations: FloatArray, coarse: slice) -> FloatArray:
    """Turn each axis by one Gauss-Newton step towards where turned samples lie on the surface, point to plane.

    Turning the axis by w moves a turned sample R p by w x R p - R (w x p).
    """
    offsets, normals = surface.offsets(operations, coarse)
    points = surface.samples[coarse]
    turned = points @ np.swapaxes(operations, -1, -2)
    jacobian = np.cross(turned, normals) - np.cross(points, normals @ operations)
    gradient = np.einsum("mpi,mp->mi", jacobian, np.einsum("mpi,mpi->mp", offsets, normals))
    hessian = np.einsum("mpi,mpj->mij", jacobian, jacobian)
    # directions that the surface does not determine (a flip of a cylinder) are left alone
    inverse = np.asarray(np.linalg.pinv(hessian, rcond=1e-6, hermitian=True), dtype=np.float64)
    step = -np.einsum("mij,mj->mi", inverse, gradient)
    length = np.linalg.norm(step, axis=1, keepdims=True)
    step *= np.minimum(1.0, LONGEST_STEP_RAD / np.maximum(length, LONGEST_STEP_RAD))
    return np.einsum("mij,mj->mi", Rotation.from_rotvec(step).as_matrix(), axes)


def _distinct(axes: FloatArray) -> FloatArray:
    """Return axes (N, 3) without repetitions and opposites, the largest component positive."""
    kept: list[FloatArray] = []
    for axis in axes:
        if all(abs(axis @ other) < np.cos(SAME_TURN_RAD) for other in kept):
            kept.append(axis * np.sign(axis[np.argmax(np.abs(axis))]))
    return np.array(kept).reshape(-1, 3)


def _continuous(surface: _Surface, axis: FloatArray) -> Symmetry:
    """Return the symmetry of a surface of revolution."""
    axis = _distinct(axis[None])[0]
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    flip = _about(across / np.linalg.norm(across), [np.pi])
    rotations = np.concatenate([np.eye(3)[None], flip[surface.holds(flip)]])
    planes = axis[None][surface.holds(_turn_or_mirror(axis[None], None))]
    return Symmetry(surface.centre_m, rotations, axis=axis, planes=planes)


def _group(surface: _Surface, axes: FloatArray) -> FloatArray:
    """Return the largest group (S, 3, 3) of turns about these axes of which every one holds."""
    orders = np.arange(LARGEST_ORDER, 1, -1)
    turns = np.concatenate([np.zeros((0, 3, 3)), *(_about(axis, 2 * np.pi / orders) for axis in axes)])
    generators, group = np.zeros((0, 3, 3)), np.eye(3)[None]
    for index in np.flatnonzero(surface.holds(turns, STAGES[:2])):
        if (np.linalg.norm(group - turns[index], axis=(1, 2)) < SAME_TURN_RAD).any():
            continue
        axis, order = axes[index // len(orders)], int(orders[index % len(orders)])
        powers = _about(axis, 2 * np.pi / order * np.arange(order))
        if not surface.all_hold(powers[1:]):
            continue
        grown = group_from(np.concatenate([generators, turns[index][None]]))
        if grown is not None and (len(grown) == order or surface.all_hold(grown[1:])):
            generators, group = np.concatenate([generators, turns[index][None]]), grown
    return group


def _planes(normals: FloatArray, rotations: FloatArray) -> FloatArray:
    """Return the normals (P, 3) of all mirror planes that some of them (N, 3) make together with the turns."""
    products = (_turn_or_mirror(normals, None)[:, None] @ rotations).reshape(-1, 3, 3)
    # a product of a mirror image and a turn is a mirror image where it undoes itself, unless it inverts the centre
    itself = np.linalg.norm(products - np.swapaxes(products, -1, -2), axis=(1, 2)) < SAME_TURN_RAD
    mirrors = products[itself & (np.trace(products, axis1=1, axis2=2) > 0)]
    return _distinct(np.linalg.eigh(mirrors + np.swapaxes(mirrors, -1, -2))[1][:, :, 0])


def _sampled(symmetry: Symmetry) -> FloatArray:
    """Return operations (M, 3, 3) that stand for all of a symmetry's, mirror images too."""
    if symmetry.ball:
        return Rotation.random(24, random_state=0).as_matrix()
    turns = symmetry.rotations[1:]
    if symmetry.axis is not None:
        turns = (_about(symmetry.axis, ANY_ANGLES_RAD)[None] @ symmetry.rotations[:, None]).reshape(-1, 3, 3)
    return np.concatenate([turns, _turn_or_mirror(symmetry.planes, None)])
