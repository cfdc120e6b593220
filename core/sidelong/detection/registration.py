"""Registration of poses to measured points: robust point-to-plane steps against the CAD surface itself.

Each point is drawn to the tangent plane of the nearest point of the surface (Chen and Medioni, 1992) with Tukey's
weight, whose kernel shrinks from step to step (graduated non-convexity, Blake and Zisserman, 1987). Directions that no
point resists are left alone (slippable motions, Gelfand et al., 2003). All poses are worked on at once, in the frame of
the object: its surface then needs one search structure, whatever the poses.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from sidelong.detection.refinement_settings import RefinementSettings
from sidelong.geometry.mesh import Part
from sidelong.geometry.raycast import RayScene
from sidelong.types import BoolArray, FloatArray, IntArray

LARGEST_STEP = 0.15
"""Turn (rad), and shift in radii of the part, of one step: tangent planes say nothing of what lies further off."""
LEAST_SLOPE = 0.1
"""Mean slope of Tukey's score below which a variance is not believed to grow further."""
REDRAWN = 8
"""Steps after which points are drawn anew: fewer and fewer lie within the kernel."""


@dataclass(frozen=True, eq=False)
class Cloud:
    """Measured points, in random order: the first are a sample of all.

    Attributes
    ----------
    points
        (N, 3) in the reference camera, metres.
    towards
        (N, 3) unit vectors from the points to the camera that measured them.
    view
        (N,) which view measured them.
    cell
        (N,) points of equal number share their noise.
    """

    points: FloatArray
    towards: FloatArray
    view: IntArray
    cell: IntArray


@dataclass(frozen=True, eq=False)
class Registered:
    """Poses after registration.

    Attributes
    ----------
    poses
        (K, 4, 4) in the reference camera.
    determined
        (K,) whether enough points carry the pose; the others are where they were.
    covariance
        (K, 6, 6) as in :class:`sidelong.types.Hypothesis`; meaningless where not determined.
    inliers
        (K, V) how many points of each view carry the pose.
    """

    poses: FloatArray
    determined: BoolArray
    covariance: FloatArray
    inliers: IntArray


class Surface(Protocol):
    """What nearest points are asked of."""

    def closest(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return nearest points of the surface and outward normals (..., 3) for points (..., 3)."""
        ...


class NearestGrid:
    """Nearest surface points of the centres of cells: a table instead of a search (Mitra et al., 2004, d2-tree).

    Exact where the surface is flat, off by about a cell at its edges. That blur also widens the basin of registration.
    """

    def __init__(self, surface: Surface, low_m: FloatArray, high_m: FloatArray, cells: int) -> None:
        self.cell_m = float((high_m - low_m).max()) / cells
        self._low_m = low_m
        self._count = np.maximum(np.ceil((high_m - low_m) / self.cell_m), 1).astype(np.intp)
        steps = np.indices([int(count) for count in self._count]).reshape(3, -1).T
        self._planes = np.concatenate(surface.closest(low_m + (steps + 0.5) * self.cell_m), axis=-1)

    def closest(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return what is nearest to the cells of points (..., 3); those outside the grid get its outermost cells."""
        steps = np.clip((points - self._low_m) / self.cell_m, 0, self._count - 1).astype(np.intp)
        x, y, z = np.moveaxis(steps, -1, 0)
        planes = self._planes[(x * self._count[1] + y) * self._count[2] + z]
        return planes[..., :3], planes[..., 3:]


@dataclass(frozen=True, eq=False)
class _Drawn:
    """Points drawn for each pose: positions in the cloud (K, M), and whether they lie near the part at all (K, M)."""

    index: IntArray
    near: BoolArray


@dataclass(frozen=True, eq=False)
class _Planes:
    """Distances to tangent planes (K, M), derivatives (K, M, 6), Tukey's weights and slopes of his score (K, M).

    All in the frame of the object and in metres: a turn counts as what it moves a point one radius from the centre.
    """

    residual: FloatArray
    jacobian: FloatArray
    weight: FloatArray
    slope: FloatArray

    def eigen(self, slippery: float) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return eigenvalues (K, 6) and vectors (K, 6, 6) of the normal matrix, and which are firm (K, 6)."""
        normal: FloatArray = np.swapaxes(self.jacobian * self.weight[..., None], 1, 2) @ self.jacobian
        values, vectors = np.linalg.eigh(normal)
        return values, vectors, (values > slippery * values[:, -1:]) & (values > 0)

    def variance(self, cell: IntArray) -> FloatArray:
        """Return the variance (K,) of a residual, for use with the inverse of the normal matrix.

        That of an M-estimator (Huber, 1981, section 7.6), times how many inliers share a cell (K, M).
        """
        total = np.maximum(self.weight.sum(axis=1), 1e-300)
        spread = ((self.weight * self.residual) ** 2).sum(axis=1) / total
        slope = np.maximum(self.slope.sum(axis=1) / total, LEAST_SLOPE)
        inlier = self.weight > 0
        cells = np.array([len(np.unique(mine[used])) for mine, used in zip(cell, inlier, strict=True)])
        return spread / slope**2 * inlier.sum(axis=1) / np.maximum(cells, 1)


class Registration:
    """Registers poses of one part to measured points."""

    def __init__(self, part: Part, settings: RefinementSettings) -> None:
        self._settings = settings
        self._centre_m = part.centre_m
        self._radius_m = part.diameter_m / 2
        self.reach_m = settings.wide_kernel * part.diameter_m
        """How far points may be from a hypothesis to draw it."""
        self._fine_m = min(settings.fine_kernel_m, self.reach_m)
        self._surface = RayScene([(part, np.eye(4))])
        low_m, high_m = part.vertices_m.min(axis=0), part.vertices_m.max(axis=0)
        self._grid = NearestGrid(self._surface, low_m - self.reach_m, high_m + self.reach_m, settings.grid_cells)
        prior_m = (np.deg2rad(settings.prior_turn_deg) * self._radius_m, settings.prior_shift_m)
        self._prior_m2 = np.repeat(np.square(prior_m), 3)

    def approach(self, poses: FloatArray, cloud: Cloud) -> FloatArray:
        """Bring poses (K, 4, 4) from afar to the points; those that too few points carry stay where they are."""
        s = self._settings
        cell_m = min(max(self._grid.cell_m, self._fine_m), self.reach_m)
        coarse = np.geomspace(self.reach_m, cell_m, s.coarse_steps).tolist()
        exact = np.geomspace(cell_m, self._fine_m, s.exact_steps).tolist()
        moved, drawn = poses, None
        for step, kernel_m in enumerate(coarse):
            if drawn is None or step % REDRAWN == 0:
                drawn = self._draw(moved, cloud, s.coarse_points, kernel_m)
            moved = self._step(moved, cloud, drawn, self._grid, kernel_m)
        drawn = self._draw(moved, cloud, s.coarse_points, cell_m)
        for kernel_m in exact:
            moved = self._step(moved, cloud, drawn, self._surface, kernel_m)
        inlier = self._planes(moved, cloud, drawn, self._grid, cell_m).weight > 0
        determined = inlier.sum(axis=1) >= s.least_points
        return np.where(determined[:, None, None], moved, poses)

    def settle(self, poses: FloatArray, cloud: Cloud, views: int) -> Registered:
        """Move poses (K, 4, 4) that are nearly right to where all points want them, and say how well that is known.

        ``views`` is how many there are in all.
        """
        s = self._settings
        drawn, moved = self._draw(poses, cloud, s.fine_points, self._fine_m), poses
        for _ in range(s.fine_steps):
            moved = self._step(moved, cloud, drawn, self._surface, self._fine_m)
        planes = self._planes(moved, cloud, drawn, self._surface, self._fine_m)
        view = np.where(planes.weight > 0, cloud.view[drawn.index], -1)
        inliers = np.stack([(view == index).sum(axis=1) for index in range(views)], axis=-1)
        determined = inliers.sum(axis=1) >= s.least_points
        moved = np.where(determined[:, None, None], moved, poses)
        return Registered(moved, determined, self._covariance(moved, planes, cloud.cell[drawn.index]), inliers)

    def _draw(self, poses: FloatArray, cloud: Cloud, limit: int, kernel_m: float) -> _Drawn:
        """Draw for each pose the first points that may lie on it.

        They are within the kernel of its surface, as far as the grid can say, and their rays meet it: else the ground
        that is seen beside a part draws it.
        """
        points = _seen_from(poses, cloud.points)
        nearest, _ = self._grid.closest(points)
        near = ((points - nearest) ** 2).sum(axis=-1) < (kernel_m + self._grid.cell_m) ** 2
        pose, point = np.nonzero(near)
        towards = (poses[pose, :3, :3].swapaxes(1, 2) @ cloud.towards[point, :, None])[..., 0]
        near[pose, point] = self._seen_along(points[pose, point], towards)[2]
        index = np.argsort(~near, axis=1, kind="stable")[:, :limit]
        return _Drawn(index, np.take_along_axis(near, index, axis=1))

    def _planes(self, poses: FloatArray, cloud: Cloud, drawn: _Drawn, surface: Surface, kernel_m: float) -> _Planes:
        points = _seen_from(poses, cloud.points[drawn.index])
        towards = cloud.towards[drawn.index] @ poses[:, :3, :3]
        nearest, normals = surface.closest(points)
        if surface is self._surface:  # while poses are far off, backs are near to ground beside the part, not to sheets
            behind = drawn.near & ((normals * towards).sum(axis=-1) <= 0)
            nearest[behind], normals[behind], _ = self._seen_along(points[behind], towards[behind])
        offset = points - nearest
        # by the whole distance: a point beside a face lies in its plane and says nothing of it
        share = (offset**2).sum(axis=-1) / kernel_m**2
        inlier = drawn.near & (share < 1) & ((normals * towards).sum(axis=-1) > 0)
        weight = np.where(inlier, (1 - share) ** 2, 0.0)
        slope = np.where(inlier, (1 - share) * (1 - 5 * share), 0.0)
        arm = np.cross(points - self._centre_m, normals) / self._radius_m
        return _Planes((offset * normals).sum(axis=-1), np.concatenate([arm, normals], axis=-1), weight, slope)

    def _seen_along(self, points: FloatArray, towards: FloatArray) -> tuple[FloatArray, FloatArray, BoolArray]:
        """Return what the rays of points (N, 3) meet first and its normals, and which rays meet anything (N,).

        A camera measures fronts: where a back is nearer, the other side of a sheet, a point belongs to what its ray
        meets (reverse calibration, Blais and Levine, 1995). A ray that misses gives a point far from its own.
        """
        before = points + 4 * self._radius_m * towards
        hits = self._surface.cast(before, -towards)
        met = hits.instance >= 0
        along = np.where(met, hits.distance, 0.0)[:, None]
        return before - along * towards, np.where(met[:, None], hits.normals, 0.0), met

    def _step(self, poses: FloatArray, cloud: Cloud, drawn: _Drawn, surface: Surface, kernel_m: float) -> FloatArray:
        """Take one Gauss-Newton step along the firm directions."""
        planes = self._planes(poses, cloud, drawn, surface, kernel_m)
        values, vectors, firm = planes.eigen(self._settings.slippery)
        firm &= (planes.weight > 0).sum(axis=1, keepdims=True) >= self._settings.least_points
        gradient: FloatArray = (planes.weight * planes.residual)[:, None] @ planes.jacobian @ vectors
        along = np.divide(gradient[:, 0], values, out=np.zeros_like(values), where=firm)
        return self._moved(poses, (vectors @ along[..., None])[..., 0] / self._radius_m)

    def _moved(self, poses: FloatArray, twist: FloatArray) -> FloatArray:
        """Turn poses about the part's centre and shift it: ``twist`` (K, 6) in rad and radii, object's axes."""
        size = np.linalg.norm(twist.reshape(-1, 2, 3), axis=-1).max(axis=-1, keepdims=True)
        twist = twist * np.minimum(1.0, LARGEST_STEP / np.maximum(size, 1e-300))
        rotation = poses[:, :3, :3]
        centre = self._centre_m + twist[:, 3:] * self._radius_m
        centre_camera = (rotation @ centre[..., None])[..., 0] + poses[:, :3, 3]
        turned = rotation @ Rotation.from_rotvec(twist[:, :3]).as_matrix()
        moved = poses.copy()
        moved[:, :3, :3] = turned
        moved[:, :3, 3] = centre_camera - turned @ self._centre_m
        return moved

    def _covariance(self, poses: FloatArray, planes: _Planes, cell: IntArray) -> FloatArray:
        """Return (K, 6, 6) of turn and shift along the camera's axes; slippery directions have that of detection."""
        values, vectors, firm = planes.eigen(self._settings.slippery)
        measured = np.divide(planes.variance(cell)[:, None], values, out=np.zeros_like(values), where=firm)
        slippery = vectors * ~firm[:, None]
        unknown = slippery @ np.swapaxes(slippery, 1, 2)
        covariance = (vectors * measured[:, None]) @ np.swapaxes(vectors, 1, 2) + unknown * self._prior_m2 @ unknown
        to_camera = np.zeros((len(poses), 6, 6))
        to_camera[:, :3, :3] = poses[:, :3, :3] / self._radius_m
        to_camera[:, 3:, 3:] = poses[:, :3, :3]
        rotated = to_camera @ covariance @ np.swapaxes(to_camera, 1, 2)
        return (rotated + np.swapaxes(rotated, 1, 2)) / 2


def _seen_from(poses: FloatArray, points: FloatArray) -> FloatArray:
    """Map points (N, 3) or (K, N, 3) of the camera into the object frames of poses (K, 4, 4)."""
    return (points - poses[:, None, :3, 3]) @ poses[:, :3, :3]
