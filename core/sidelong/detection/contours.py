"""The visible contours of a posed part, and its alignment to the edges of an image.

Contours are points on edges of the mesh where brightness is expected to step: silhouettes and creases alike. Alignment
is the classic search along the contour's normals (Harris, RAPID, 1990), with weighted Gauss-Newton steps in the pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sidelong.detection.settings import DetectionSettings
from sidelong.detection.shading import brightness
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part, simplified
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import invert, rotation_about
from sidelong.types import BoolArray, FloatArray, GrayImage, IntArray

MAX_TRIANGLES = 2500
POINT_SPACING = 0.05
"""Of the points on mesh edges, in diameters of the part."""
LIFT = 0.004
"""How far points are lifted before their visibility is tested, in diameters: the mesh was simplified."""
LEAST_STEP = 0.1
"""Contrast below which an edge is none: facets of a tessellated round are not seen one by one."""
SEARCH_SPANS = (0.07, 0.07, 0.05, 0.05, 0.035, 0.035, 0.025, 0.025)
"""Half-lengths of the search along the normals, one for each step, in diameters of the part on the image."""
FINE_SPANS = SEARCH_SPANS[4:]
SEARCH_STEPS = 6
DAMPING = 1e-3
LARGEST_TURN_RAD = 0.15


@dataclass(frozen=True, eq=False)
class ContourPoints:
    """Points and tangents (K, P, 3) in the object frame, and which are visible (K, P)."""

    points: FloatArray
    tangents: FloatArray
    visible: BoolArray


@dataclass(frozen=True, eq=False)
class Projected:
    """Points (K, P, 3) in the camera frame, their pixels (K, P, 2) and the contour's normals there (K, P, 2)."""

    points_camera: FloatArray
    uv: FloatArray
    normals: FloatArray


class EdgeField:
    """Direction of the gradient at each pixel, its length 0..1: near 1 on an edge, small in noise."""

    def __init__(self, image: GrayImage, blur_px: float = 1.5) -> None:
        import cv2

        smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), blur_px)
        along_u = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125)
        along_v = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125)
        gradient = np.dstack([along_u, along_v])
        strength = np.linalg.norm(gradient, axis=-1, keepdims=True)
        noise = max(1.5 * float(np.median(strength)), 0.5)
        self._field = gradient / (strength + noise)

    def agreement(self, uv: FloatArray, normals: FloatArray) -> FloatArray:
        """Return |gradient . normal| (K, ...) at pixels (K, ..., 2); 0 outside the image."""
        import cv2

        remap: Any = cv2.remap  # its stub forbids the None that means: coordinates are in one array
        where = uv.reshape(len(uv), -1, 2).astype(np.float32)
        sampled = remap(self._field, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        return np.abs((sampled.reshape(uv.shape).astype(np.float64) * normals).sum(axis=-1))


class ContourModel:
    """The contours of one part."""

    def __init__(self, part: Part, settings: DetectionSettings) -> None:
        self._settings = settings
        self._diameter_m = part.diameter_m
        self._centre_m = part.centre_m
        coarse = simplified(part, MAX_TRIANGLES)
        self._scene = RayScene([(coarse, np.eye(4))])
        edges, faces = _shared_edges(coarse)
        start, end = coarse.vertices_m[edges[:, 0]], coarse.vertices_m[edges[:, 1]]
        length = np.linalg.norm(end - start, axis=1)
        count = np.maximum(1, np.ceil(length / (POINT_SPACING * part.diameter_m))).astype(np.intp)
        row = np.repeat(np.arange(len(edges)), count)
        along = (np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[row]
        self._points = start[row] + (end - start)[row] * along[:, None]
        self._tangents = (end - start)[row]
        self._weight = (length / count)[row]
        self._normals = coarse.triangle_normals[faces[row]]
        self._offsets = (self._normals * self._points[:, None]).sum(axis=-1)
        self._outward = self._normals.sum(axis=1)

    def select(self, camera_T_object: FloatArray, rng: np.random.Generator) -> ContourPoints:
        """Draw ``contour_points`` for each pose (K, 4, 4), in proportion to length times expected contrast."""
        eye = invert(camera_T_object)[:, :3, 3]
        # n . (eye - p) as one matrix product: most of the time of a detection is spent here
        height = (eye @ self._normals.reshape(-1, 3).T).reshape(len(eye), -1, 2) - self._offsets
        distance = np.linalg.norm(eye[:, None] - self._points, axis=-1)
        level = brightness(height / distance[..., None], self._settings)
        contrast = np.abs(level[..., 0] - level[..., 1])
        share = np.cumsum(self._weight * np.where(contrast >= LEAST_STEP, contrast, 0.0), axis=1)
        count = self._settings.contour_points
        drawn = (np.arange(count) + rng.random((len(eye), 1))) / count * share[:, -1:]
        chosen = np.empty(drawn.shape, dtype=np.intp)
        for row, (cumulated, wanted) in enumerate(zip(share, drawn, strict=True)):
            chosen[row] = np.searchsorted(cumulated, wanted)
        chosen = np.minimum(chosen, len(self._points) - 1)
        lifted = self._points[chosen] + LIFT * self._diameter_m * self._outward[chosen]
        hidden = self._scene.blocked(lifted, eye[:, None])
        return ContourPoints(self._points[chosen], self._tangents[chosen], ~hidden)

    def agreement(self, field: EdgeField, camera: PinholeCamera, camera_T_object: FloatArray) -> FloatArray:
        """Return how well the contours of poses (K, 4, 4) lie on edges, 0..1 (K,)."""
        contour = self.select(camera_T_object, np.random.default_rng(0))
        seen = project(contour, camera, camera_T_object)
        agreement = field.agreement(seen.uv, seen.normals) * contour.visible
        # few visible points prove little: a quarter of the points is the least divisor
        return agreement.sum(axis=1) / np.maximum(contour.visible.sum(axis=1), self._settings.contour_points / 4)

    def align(
        self,
        field: EdgeField,
        camera: PinholeCamera,
        camera_T_object: FloatArray,
        limits_m: FloatArray,
        spans: Sequence[float] = SEARCH_SPANS,
    ) -> FloatArray:
        """Move poses (K, 4, 4) so that their contours lie on edges; return them, (K, 4, 4).

        The centres of the parts stay between the distances ``limits_m`` (K, 2). ``spans`` are the half-lengths of the
        search, one for each step, in diameters of the part on the image.
        """
        rng = np.random.default_rng(0)
        poses = camera_T_object.copy()
        contour = self.select(poses, rng)
        for step, span in enumerate(spans):
            if step == len(spans) // 2:
                contour = self.select(poses, rng)
            seen = project(contour, camera, poses)
            reach_px = span * camera.fx * self._diameter_m / poses[:, 2, 3]
            shift_px, weight = _search(field, seen, reach_px)
            twist = _twist(seen, camera, poses, shift_px, weight * contour.visible, self._diameter_m)
            poses = self._kept_between(_moved(poses, twist), limits_m)
        return poses

    def _kept_between(self, poses: FloatArray, limits_m: FloatArray) -> FloatArray:
        """Scale poses along their lines of sight until their centres lie between the limits."""
        centre_m = poses[:, :3, :3] @ self._centre_m + poses[:, :3, 3]
        wanted_m = np.clip(centre_m[:, 2], limits_m[:, 0], limits_m[:, 1])
        poses[:, :3, 3] += centre_m * (wanted_m / centre_m[:, 2] - 1.0)[:, None]
        return poses


def project(contour: ContourPoints, camera: PinholeCamera, camera_T_object: FloatArray) -> Projected:
    """Project contour points by poses (K, 4, 4)."""
    rotation = np.swapaxes(camera_T_object[:, :3, :3], 1, 2)
    points = contour.points @ rotation + camera_T_object[:, None, :3, 3]
    tangents = contour.tangents @ rotation
    x, y, z = np.moveaxis(points, -1, 0)
    # derivative of the projection along the tangent, times z squared
    along_u = camera.fx * (tangents[..., 0] * z - x * tangents[..., 2])
    along_v = camera.fy * (tangents[..., 1] * z - y * tangents[..., 2])
    normals = np.stack([-along_v, along_u], axis=-1)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    return Projected(points, camera.project(points), normals)


def _shared_edges(part: Part) -> tuple[IntArray, IntArray]:
    """Return vertex pairs (E, 2) and the two triangles (E, 2) of each edge that two triangles share."""
    triangles = part.triangles
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(triangles)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    first = np.flatnonzero((edges[1:] == edges[:-1]).all(axis=1))
    return edges[first], np.stack([owner[first], owner[first + 1]], axis=1)


def _search(field: EdgeField, seen: Projected, reach_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return, for each point, how far along its normal the best edge lies (K, P) px and its weight (K, P)."""
    steps = np.arange(-SEARCH_STEPS, SEARCH_STEPS + 1) / SEARCH_STEPS
    offsets = reach_px[:, None, None] * steps
    where = seen.uv[:, :, None] + offsets[..., None] * seen.normals[:, :, None]
    response = field.agreement(where, seen.normals[:, :, None])
    # nearer edges win over slightly better ones further off
    best = (response * (1.0 - 0.4 * np.abs(steps))).argmax(axis=-1)
    inner = np.clip(best, 1, 2 * SEARCH_STEPS - 1)
    before, peak, after = (np.take_along_axis(response, (inner + k)[..., None], -1)[..., 0] for k in (-1, 0, 1))
    curvature = before - 2 * peak + after
    bends = (curvature < -1e-6) & (inner == best)
    parabola = np.where(bends, 0.5 * (before - after) / np.where(bends, curvature, -1.0), 0.0)
    share = steps[best] + np.clip(parabola, -0.5, 0.5) / SEARCH_STEPS
    weight = np.take_along_axis(response, best[..., None], -1)[..., 0] / (1.0 + (2.0 * share) ** 2)
    return share * reach_px[:, None], weight


def _twist(
    seen: Projected, camera: PinholeCamera, poses: FloatArray, shift_px: FloatArray, weight: FloatArray, size_m: float
) -> FloatArray:
    """Return the damped Gauss-Newton step (K, 6): rotation about the object's origin (rad), translation (m)."""
    x, y, z = np.moveaxis(seen.points_camera, -1, 0)
    u, v = seen.normals[..., 0] * camera.fx / z, seen.normals[..., 1] * camera.fy / z
    by_translation = np.stack([u, v, -(u * x + v * y) / z], axis=-1)
    by_rotation = np.cross(seen.points_camera - poses[:, None, :3, 3], by_translation)
    # half the part's size makes metres comparable to radians
    scale_m = size_m / 2
    jacobian = np.concatenate([by_rotation, by_translation * scale_m], axis=-1)
    weighted = jacobian * weight[..., None]
    normal: FloatArray = np.swapaxes(weighted, 1, 2) @ jacobian
    damping: FloatArray = DAMPING * np.trace(normal, axis1=1, axis2=2) / 6 + 1e-9
    right: FloatArray = np.einsum("kpi,kp->ki", weighted, shift_px)
    solved: Any = np.linalg.solve(normal + damping[:, None, None] * np.eye(6), right[..., None])
    step: FloatArray = solved[..., 0]
    step[:, 3:] *= scale_m
    return step


def _moved(poses: FloatArray, twist: FloatArray) -> FloatArray:
    """Return poses (K, 4, 4) turned and shifted by ``twist`` (K, 6), the turn limited."""
    moved = poses.copy()
    moved[:, :3, 3] += twist[:, 3:]
    for pose, turn in zip(moved, twist[:, :3], strict=True):
        angle = float(np.linalg.norm(turn))
        if angle > 1e-9:
            pose[:3, :3] = rotation_about(turn, min(angle, LARGEST_TURN_RAD)) @ pose[:3, :3]
    # an object cannot pass through the camera, whatever its neighbourhood suggests
    moved[:, 2, 3] = np.clip(moved[:, 2, 3], 0.7 * poses[:, 2, 3], 1.4 * poses[:, 2, 3])
    return moved
