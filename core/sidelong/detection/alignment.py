"""Alignment of poses with the edges of an image and, where it was measured, with depth.

Edges: the classic search along the contour's normals (Harris, RAPID, 1990). Depth: point to plane along the lines of
sight, projective association (Blais and Levine 1995). Both give one system of normal equations for a damped
Gauss-Newton step: contours tell the turn in the image plane and the place, depth the distance and the tilts that
contours hardly see.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from sidelong.detection.appearance import AppearanceModel, Look, Surface
from sidelong.detection.contours import ContourModel, EdgeField, Projected, project
from sidelong.detection.depth_evidence import offsets, residuals
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.types import FloatArray, IntArray, RealArray

SPANS = (0.07, 0.06, 0.05, 0.04, 0.03, 0.025)
"""Half-lengths of the search along the normals, one for each step, in diameters of the part on the image."""
REACHES = (0.2, 0.15, 0.1, 0.07, 0.05, 0.04)
"""How far a measured depth may differ from the expected one and still pull, one for each step, in diameters."""
RESELECT = 3
"""Steps after which the visible contour and surface are looked up anew."""
SEARCH_STEPS = 6
DEPTH_WEIGHT = 1.0
"""Of a depth against a contour point, both as shifts on the image."""
DAMPING = 1e-3
LARGEST_TURN_RAD = 0.15


@dataclass(frozen=True, eq=False)
class _Equations:
    """Normal equations of K poses: matrix (K, 6, 6), right side (K, 6), px^2; turns in rad, shifts in radii."""

    matrix: FloatArray
    right: FloatArray

    def __add__(self, other: _Equations) -> _Equations:
        return _Equations(self.matrix + other.matrix, self.right + other.right)


class Aligner:
    """Aligns poses of one part in images of one camera; ``distance_ratio`` is that of neighbouring templates."""

    def __init__(
        self,
        part: Part,
        camera: PinholeCamera,
        contours: ContourModel,
        appearance: AppearanceModel,
        distance_ratio: float,
    ) -> None:
        self._half_step = np.sqrt(distance_ratio) - 1.0
        self._camera = camera
        self._centre_m = part.centre_m
        self._diameter_m = part.diameter_m
        self._contours = contours
        self._appearance = appearance

    def align(
        self, camera_T_object: FloatArray, limits_m: FloatArray, edges: EdgeField, depth_m: FloatArray | None
    ) -> FloatArray:
        """Move poses (K, 4, 4) so that their contours lie on edges and their surface where it was measured.

        Parameters
        ----------
        camera_T_object
            (K, 4, 4) within about half a step between templates of the truth, at the measured distance if there is.
        limits_m
            (K, 2) least and largest distance of the parts' centres.
        edges
            Of the image.
        depth_m
            (H, W), NaN where missing; None where it was not measured.
        """
        rng = np.random.default_rng(0)
        contour, surface = self._contours.select(camera_T_object, rng), self._surface(camera_T_object, depth_m)
        poses = camera_T_object
        for step, (span, reach) in enumerate(zip(SPANS, REACHES, strict=True)):
            if step == RESELECT:
                contour, surface = self._contours.select(poses, rng), self._surface(poses, depth_m)
            seen = project(contour, self._camera, poses)
            span_px = span * self._camera.fx * self._diameter_m / poses[:, 2, 3]
            shift_px, weight = _search(edges, seen, span_px)
            equations = self._of_contour(poses, seen, shift_px, weight * contour.visible)
            if surface is not None and depth_m is not None:
                look = self._appearance.seen(surface, poses)
                equations += self._of_depth(poses, look, residuals(look, depth_m), reach * self._diameter_m)
            poses = self._kept_between(self._moved(poses, equations), limits_m)
        return poses

    def at_measured_distance(self, surface: Surface, poses: FloatArray, depth_m: FloatArray | None) -> FloatArray:
        """Return poses (K, 4, 4) with these surfaces, moved along their lines of sight to where enough was measured."""
        if depth_m is None:
            return poses
        look = self._appearance.seen(surface, poses)
        # templates stand at steps of distance: half a step may be more than the part is thick
        reach_m = np.maximum(self._diameter_m / 2, self._half_step * self._centres(poses)[:, 2:])
        return self._along_sight(poses, offsets(residuals(look, depth_m), look.covered, reach_m))

    def _surface(self, poses: FloatArray, depth_m: FloatArray | None) -> Surface | None:
        return None if depth_m is None else self._appearance.surface(poses)

    def _of_contour(self, poses: FloatArray, seen: Projected, shift_px: RealArray, weight: RealArray) -> _Equations:
        x, y, z = seen.points_camera
        u, v = seen.normals * self._camera.fx / z
        by_shift = np.stack([u, v, -(u * x + v * y) / z])
        return self._equations(poses, seen.points_camera, by_shift, shift_px, weight)

    def _of_depth(self, poses: FloatArray, look: Look, residual_m: FloatArray, reach_m: float) -> _Equations:
        camera = self._camera
        z = np.nan_to_num(look.depth_m)
        u, v = np.moveaxis(look.uv, -1, 0)
        x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
        normals = np.moveaxis(look.normals, -1, 0)
        scale = (camera.fx / poses[:, 2, 3]).astype(np.float32)[:, None]
        off_m = np.nan_to_num((x * normals[0] + y * normals[1] + normals[2]) * residual_m)
        share = np.where(np.isfinite(residual_m), np.abs(residual_m) / reach_m, 1.0)
        weight = DEPTH_WEIGHT * np.maximum(1.0 - share**2, 0.0) ** 2  # Tukey's
        return self._equations(poses, np.stack([x * z, y * z, z]), normals * scale, off_m * scale, weight)

    def _equations(
        self, poses: FloatArray, points: RealArray, by_shift: RealArray, wanted_px: RealArray, weight: RealArray
    ) -> _Equations:
        """Sum up points (3, K, P), derivatives (3, K, P) of their shift along a normal, the shift and weight (K, P)."""
        x, y, z = points - self._centres(poses).T[..., None].astype(np.float32)
        a, b, c = by_shift
        jacobian = np.empty((len(poses), 6, points.shape[-1]), dtype=np.float32)
        for row, derivative in enumerate((y * c - z * b, z * a - x * c, x * b - y * a)):
            jacobian[:, row] = derivative
            # half the part's size makes metres comparable to radians
            jacobian[:, row + 3] = by_shift[row] * (self._diameter_m / 2)
        weighted = jacobian * weight[:, None].astype(np.float32)
        matrix = weighted @ np.swapaxes(jacobian, 1, 2)
        right = (weighted @ wanted_px[..., None].astype(np.float32))[..., 0]
        return _Equations(matrix.astype(np.float64), right.astype(np.float64))

    def _moved(self, poses: FloatArray, equations: _Equations) -> FloatArray:
        """Take the damped Gauss-Newton step: a turn about the part's centre, at most the largest, and a shift."""
        damping = DAMPING * np.trace(equations.matrix, axis1=1, axis2=2) / 6 + 1e-9
        system = equations.matrix + damping[:, None, None] * np.eye(6)
        # a pose at the camera or behind it has no equations: it stays where it is
        sound = np.isfinite(system).all(axis=(1, 2)) & np.isfinite(equations.right).all(axis=1)
        system = np.where(sound[:, None, None], system, np.eye(6))
        right = np.where(sound[:, None], equations.right, 0.0)
        solved: Any = np.linalg.solve(system, right[..., None])
        turn, shift = solved[:, :3, 0], solved[:, 3:, 0] * (self._diameter_m / 2)
        angle = np.linalg.norm(turn, axis=1, keepdims=True)
        turn *= np.minimum(1.0, LARGEST_TURN_RAD / np.maximum(angle, 1e-12))
        before = self._centres(poses)
        after = before + shift
        # an object cannot pass through the camera, whatever its neighbourhood suggests
        after[:, 2] = np.clip(after[:, 2], 0.7 * before[:, 2], 1.4 * before[:, 2])
        moved = poses.copy()
        moved[:, :3, :3] = Rotation.from_rotvec(turn).as_matrix() @ poses[:, :3, :3]
        moved[:, :3, 3] = after - moved[:, :3, :3] @ self._centre_m
        return moved

    def _along_sight(self, poses: FloatArray, further_m: FloatArray) -> FloatArray:
        """Move poses along their lines of sight by a depth (K,)."""
        centre_m = self._centres(poses)
        moved = poses.copy()
        moved[:, :3, 3] += centre_m * (further_m / centre_m[:, 2])[:, None]
        return moved

    def _kept_between(self, poses: FloatArray, limits_m: FloatArray) -> FloatArray:
        distance_m = self._centres(poses)[:, 2]
        return self._along_sight(poses, np.clip(distance_m, limits_m[:, 0], limits_m[:, 1]) - distance_m)

    def _centres(self, poses: FloatArray) -> FloatArray:
        return poses[:, :3, :3] @ self._centre_m + poses[:, :3, 3]


def _search(edges: EdgeField, seen: Projected, span_px: FloatArray) -> tuple[RealArray, RealArray]:
    """Return, for each point, how far along its normal the best edge lies (K, P) px and its weight (K, P)."""
    steps = np.arange(-SEARCH_STEPS, SEARCH_STEPS + 1, dtype=np.float32) / np.float32(SEARCH_STEPS)
    span = span_px.astype(np.float32)[:, None]
    response = edges.agreement(seen.beside(span[..., None] * steps), seen.normals[..., None])
    # nearer edges win over slightly better ones further off
    best: IntArray = np.argmax(response * (1.0 - 0.4 * np.abs(steps)), axis=-1)
    flat, start = response.reshape(-1), np.arange(0, response.size, len(steps)).reshape(best.shape)
    inner = start + np.clip(best, 1, 2 * SEARCH_STEPS - 1)
    before, peak, after = flat[inner - 1], flat[inner], flat[inner + 1]
    curvature = before - 2 * peak + after
    bends = (curvature < -1e-6) & (inner == start + best)
    parabola = np.where(bends, 0.5 * (before - after) / np.where(bends, curvature, -1.0), 0.0)
    share = steps[best] + np.clip(parabola, -0.5, 0.5) / SEARCH_STEPS
    weight = flat[start + best] / (1.0 + (2.0 * share) ** 2)
    return share * span, weight
