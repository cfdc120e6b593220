"""The visible contours of a posed part, and the edges of an image.

Contours are points on edges of the mesh where brightness is expected to step: silhouettes and creases alike.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sidelong.detection.settings import DetectionSettings
from sidelong.detection.shading import brightness
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part, simplified
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import invert
from sidelong.types import BoolArray, FloatArray, GrayImage, IntArray, RealArray

MAX_TRIANGLES = 2500
LIFT = 0.004
"""How far points are lifted before their visibility is tested, in diameters: the mesh was simplified."""
LEAST_STEP = 0.1
"""Contrast below which an edge is none: facets of a tessellated round are not seen one by one."""


@dataclass(frozen=True, eq=False)
class ContourPoints:
    """Points and tangents (K, P, 3) in the object frame, which are visible and which on the silhouette (K, P)."""

    points: NDArray[np.float32]
    tangents: NDArray[np.float32]
    visible: BoolArray
    silhouette: BoolArray

    def __getitem__(self, view: IntArray) -> ContourPoints:
        return ContourPoints(self.points[view], self.tangents[view], self.visible[view], self.silhouette[view])


@dataclass(frozen=True, eq=False)
class Projected:
    """Points (3, K, P) in the camera frame, their pixels (2, K, P) and the contour's normals there (2, K, P)."""

    points_camera: NDArray[np.float32]
    uv: NDArray[np.float32]
    normals: NDArray[np.float32]

    def beside(self, along_px: RealArray) -> NDArray[np.float32]:
        """Return the pixels (2, K, P, S) that lie so far (K, 1, S) along the normals."""
        return np.asarray(self.uv[..., None] + self.normals[..., None] * along_px.astype(np.float32), dtype=np.float32)


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

    def agreement(self, uv: NDArray[np.float32], normals: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return |gradient . normal| (K, ...) at pixels (2, K, ...) with normals (2, K, ...); 0 outside the image."""
        import cv2

        u, v = uv.reshape(2, uv.shape[1], -1)
        sampled = cv2.remap(self._field, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)
        sampled = sampled.reshape(*uv.shape[1:], 2)
        response = np.abs(sampled[..., 0] * normals[0] + sampled[..., 1] * normals[1])
        return np.asarray(response, dtype=np.float32)


class ContourModel:
    """The contours of one part."""

    def __init__(self, part: Part, settings: DetectionSettings) -> None:
        self._settings = settings
        coarse = simplified(part, MAX_TRIANGLES)
        self._scene = RayScene([(coarse, np.eye(4))])
        corners = coarse.vertices_m[coarse.triangles]
        self._normals = coarse.triangle_normals.astype(np.float32)
        self._middles = corners.mean(axis=1).astype(np.float32)
        edges, self._faces = _shared_edges(coarse)
        start, end = coarse.vertices_m[edges[:, 0]], coarse.vertices_m[edges[:, 1]]
        self._start, self._tangents = start.astype(np.float32), (end - start).astype(np.float32)
        self._length = np.linalg.norm(self._tangents, axis=1)
        self._lift_m = (LIFT * part.diameter_m * coarse.triangle_normals[self._faces].sum(axis=1)).astype(np.float32)

    def select(self, camera_T_object: FloatArray, rng: np.random.Generator) -> ContourPoints:
        """Draw ``contour_points`` for each pose (K, 4, 4), in proportion to length times expected contrast."""
        eye = invert(camera_T_object)[:, :3, 3]
        cosine = self._cosines(eye.astype(np.float32))
        weight = self._length * self._contrast(cosine)
        share = np.cumsum(weight, axis=1, dtype=np.float64)
        count = self._settings.contour_points
        drawn = (np.arange(count) + rng.random((len(eye), 1))) / count * share[:, -1:]
        chosen = np.empty(drawn.shape, dtype=np.intp)
        for row, (upto, wanted) in enumerate(zip(share, drawn, strict=True)):
            chosen[row] = np.searchsorted(upto, wanted)
        chosen = np.minimum(chosen, len(self._length) - 1)
        rows = np.arange(len(eye))[:, None]
        weight = weight[rows, chosen].astype(np.float64)
        along = np.clip(1.0 - (share[rows, chosen] - drawn) / np.maximum(weight, 1e-12), 0.0, 1.0)
        tangents = self._tangents[chosen]
        points = self._start[chosen] + tangents * along[..., None].astype(np.float32)
        hidden = self._scene.blocked(points + self._lift_m[chosen], eye[:, None])
        one, other = np.moveaxis(self._faces[chosen], -1, 0)
        silhouette = np.minimum(cosine[rows, one], cosine[rows, other]) <= 0
        return ContourPoints(points, tangents, ~hidden & (weight > 0), silhouette)

    def _contrast(self, cosine: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return how much the two faces of each edge are expected to differ, (K, E)."""
        level = brightness(cosine, self._settings)
        contrast = np.abs(np.take(level, self._faces[:, 0], axis=1) - np.take(level, self._faces[:, 1], axis=1))
        contrast[contrast < LEAST_STEP] = 0.0
        return contrast

    def _cosines(self, eye: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the cosines (K, F) between the faces' normals and the directions to the viewer at (K, 3)."""
        # n . (eye - p) is the same all over a face, so its sign is exact: silhouettes depend on it
        height = eye @ self._normals.T - (self._normals * self._middles).sum(axis=1)
        squared = (eye**2).sum(axis=1)[:, None] - 2 * eye @ self._middles.T + (self._middles**2).sum(axis=1)
        return height / np.sqrt(np.maximum(squared, 1e-12))


def project(contour: ContourPoints, camera: PinholeCamera, camera_T_object: FloatArray) -> Projected:
    """Project contour points by poses (K, 4, 4); the pixels of points not in front are NaN."""
    rotation = camera_T_object[:, :3, :3].astype(np.float32)
    shift = camera_T_object[:, :3, 3].T[..., None].astype(np.float32)
    points = np.moveaxis(rotation @ np.swapaxes(contour.points, 1, 2), 1, 0) + shift
    tangents = np.moveaxis(rotation @ np.swapaxes(contour.tangents, 1, 2), 1, 0)
    x, y, z = points
    ahead = np.where(z > 0, z, np.float32(np.nan))
    uv = np.stack([camera.fx * (x / ahead) + camera.cx, camera.fy * (y / ahead) + camera.cy])
    # derivative of the projection along the tangent, times z squared
    along_u = camera.fx * (tangents[0] * z - x * tangents[2])
    along_v = camera.fy * (tangents[1] * z - y * tangents[2])
    normals = np.stack([-along_v, along_u]) / np.maximum(np.hypot(along_u, along_v), np.float32(1e-12))
    return Projected(points, uv, normals)


def _shared_edges(part: Part) -> tuple[IntArray, IntArray]:
    """Return vertex pairs (E, 2) and the two triangles (E, 2) of each edge that two triangles share."""
    triangles = part.triangles
    edges = np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)
    owner = np.tile(np.arange(len(triangles)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, owner = edges[order], owner[order]
    first = np.flatnonzero((edges[1:] == edges[:-1]).all(axis=1))
    return edges[first], np.stack([owner[first], owner[first + 1]], axis=1)
