"""The visible contours of a posed part, and the edges of an image.

Contours are points on edges of the mesh where brightness is expected to step: silhouettes and creases alike.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sidelong.detection.settings import DetectionSettings
from sidelong.detection.shading import brightness
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part, simplified
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import invert
from sidelong.types import BoolArray, FloatArray, GrayImage, IntArray

MAX_TRIANGLES = 2500
LIFT = 0.004
"""How far points are lifted before their visibility is tested, in diameters: the mesh was simplified."""
LEAST_STEP = 0.1
"""Contrast below which an edge is none: facets of a tessellated round are not seen one by one."""


@dataclass(frozen=True, eq=False)
class ContourPoints:
    """Points and tangents (K, P, 3) in the object frame, which are visible and which on the silhouette (K, P)."""

    points: FloatArray
    tangents: FloatArray
    visible: BoolArray
    silhouette: BoolArray


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
        self.strength: NDArray[np.float32] = (strength / (strength + noise))[..., 0]

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
        coarse = simplified(part, MAX_TRIANGLES)
        self._scene = RayScene([(coarse, np.eye(4))])
        corners = coarse.vertices_m[coarse.triangles]
        self._normals = coarse.triangle_normals.astype(np.float32)
        self._middles = corners.mean(axis=1).astype(np.float32)
        edges, self._faces = _shared_edges(coarse)
        self._start = coarse.vertices_m[edges[:, 0]]
        self._tangents = coarse.vertices_m[edges[:, 1]] - self._start
        self._length = np.linalg.norm(self._tangents, axis=1).astype(np.float32)
        self._outward = coarse.triangle_normals[self._faces].sum(axis=1)

    def select(self, camera_T_object: FloatArray, rng: np.random.Generator) -> ContourPoints:
        """Draw ``contour_points`` for each pose (K, 4, 4), in proportion to length times expected contrast."""
        eye = invert(camera_T_object)[:, :3, 3]
        cosine = self._cosines(eye.astype(np.float32))
        level = brightness(cosine, self._settings).astype(np.float32)
        contrast = np.abs(level[:, self._faces[:, 0]] - level[:, self._faces[:, 1]])
        contrast[contrast < LEAST_STEP] = 0.0
        share = np.cumsum(self._length * contrast, axis=1, dtype=np.float64)
        count = self._settings.contour_points
        drawn = (np.arange(count) + rng.random((len(eye), 1))) / count * share[:, -1:]
        chosen = np.stack([np.searchsorted(*each) for each in zip(share, drawn, strict=True)])
        chosen = np.minimum(chosen, len(self._length) - 1)
        upto, rows = np.take_along_axis(share, chosen, axis=1), np.arange(len(eye))[:, None]
        weight = (self._length[chosen] * contrast[rows, chosen]).astype(np.float64)
        along = np.clip(1.0 - (upto - drawn) / np.maximum(weight, 1e-12), 0.0, 1.0)
        points = self._start[chosen] + self._tangents[chosen] * along[..., None]
        hidden = self._scene.blocked(points + LIFT * self._diameter_m * self._outward[chosen], eye[:, None])
        away = cosine[rows[..., None], self._faces[chosen]] <= 0
        silhouette: BoolArray = away.any(axis=-1)
        return ContourPoints(points, self._tangents[chosen], ~hidden & (weight > 0), silhouette)

    def _cosines(self, eye: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the cosines (K, F) between the faces' normals and the directions to the viewer at (K, 3)."""
        # n . (eye - p) is the same all over a face, so its sign is exact: silhouettes depend on it
        height = eye @ self._normals.T - (self._normals * self._middles).sum(axis=1)
        squared = (eye**2).sum(axis=1)[:, None] - 2 * eye @ self._middles.T + (self._middles**2).sum(axis=1)
        return height / np.sqrt(np.maximum(squared, 1e-12))


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
