"""Rays against posed parts. The only caller of Open3D's ray tracing.

Precision: Open3D traces in float32, about 1e-7 of the coordinates: 0.1 um at 1 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.geometry.transforms import rotate, transform_points
from sidelong.types import BoolArray, FloatArray, IntArray

SURFACE_OFFSET_M = 0.35e-3
"""How far visibility rays start above the surface, along the normal: meshes and poses are not exact."""


@dataclass(frozen=True, eq=False)
class Hits:
    """Where rays met the scene; all arrays have the shape of the rays.

    Attributes
    ----------
    distance
        In lengths of the ray's direction; infinity where nothing was hit.
    instance
        Position of the part in the scene's list, -1 for none.
    triangle
        Triangle of that part, -1 for none.
    normals
        (..., 3) outward unit normals in the scene frame; NaN for none.
    """

    distance: FloatArray
    instance: IntArray
    triangle: IntArray
    normals: FloatArray


@dataclass(frozen=True, eq=False)
class Rendering:
    """What a camera sees of a scene.

    Attributes
    ----------
    depth_m
        (H, W) along the optical axis, NaN where nothing is.
    instance, triangle
        (H, W) as in :class:`Hits`.
    normals_scene
        (H, W, 3) outward unit normals in the scene frame; NaN where nothing is.
    """

    depth_m: FloatArray
    instance: IntArray
    triangle: IntArray
    normals_scene: FloatArray


class RayScene:
    """Parts at poses ``scene_T_object``, ready for rays. An empty scene hits nothing."""

    def __init__(self, parts: Sequence[tuple[Part, FloatArray]]) -> None:
        import open3d as o3d

        self._core = o3d.core
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self._normals = np.concatenate(
            [np.zeros((0, 3)), *(rotate(scene_T_object, part.triangle_normals) for part, scene_T_object in parts)]
        )
        self._first_triangle = np.cumsum([0, *(len(part.triangles) for part, _ in parts)])
        for part, scene_T_object in parts:
            self._scene.add_triangles(
                self._tensor(transform_points(scene_T_object, part.vertices_m)),
                o3d.core.Tensor(np.ascontiguousarray(part.triangles.astype(np.uint32))),
            )

    def _tensor(self, values: FloatArray) -> Any:
        return self._core.Tensor(np.ascontiguousarray(values.astype(np.float32)))

    def cast(self, origins: FloatArray, directions: FloatArray) -> Hits:
        """Find the first hit of each ray.

        Parameters
        ----------
        origins, directions
            (..., 3), broadcast against each other; directions need no unit length.
        """
        origins, directions = np.broadcast_arrays(origins, directions)
        shape = directions.shape[:-1]
        if not len(self._normals) or directions.size == 0:
            nowhere = np.full(shape, -1, dtype=np.intp)
            return Hits(np.full(shape, np.inf), nowhere, nowhere.copy(), np.full((*shape, 3), np.nan))
        answer = self._scene.cast_rays(self._tensor(np.concatenate([origins, directions], axis=-1)))
        distance = answer["t_hit"].numpy().astype(np.float64)
        hit = np.isfinite(distance)
        instance = np.where(hit, answer["geometry_ids"].numpy().astype(np.int64), -1)
        triangle = np.where(hit, answer["primitive_ids"].numpy().astype(np.int64), -1)
        normals = np.full((*shape, 3), np.nan)
        normals[hit] = self._normals[self._first_triangle[instance[hit]] + triangle[hit]]
        return Hits(distance, instance, triangle, normals)

    def blocked(self, origins: FloatArray, targets: FloatArray) -> BoolArray:
        """Say which segments (..., 3) to (..., 3) meet the scene; start them ``SURFACE_OFFSET_M`` above a surface."""
        origins, targets = np.broadcast_arrays(origins, targets)
        shape = origins.shape[:-1]
        if not len(self._normals) or origins.size == 0:
            return np.zeros(shape, dtype=np.bool_)
        rays = self._tensor(np.concatenate([origins, targets - origins], axis=-1))
        return self._scene.test_occlusions(rays, tnear=0.0, tfar=1.0).numpy()

    def closest(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the nearest points of all surfaces to points (..., 3), and the outward unit normals there, (..., 3).

        On an edge the normal is that of one of its triangles. In an empty scene both are NaN.
        """
        if not len(self._normals) or points.size == 0:
            return np.full(points.shape, np.nan), np.full(points.shape, np.nan)
        answer = self._scene.compute_closest_points(self._tensor(points))
        triangle = answer["primitive_ids"].numpy() + self._first_triangle[answer["geometry_ids"].numpy()]
        return answer["points"].numpy().astype(np.float64), self._normals[triangle]

    def render(self, camera: PinholeCamera, scene_T_camera: FloatArray) -> Rendering:
        """Render depth, part, triangle and normal for each pixel centre of ``camera`` at ``scene_T_camera``."""
        hits = self.cast(scene_T_camera[:3, 3], rotate(scene_T_camera, camera.pixel_rays()))
        # directions are scaled to z = 1, so the distance is the depth along the optical axis
        depth_m = np.where(np.isfinite(hits.distance), hits.distance, np.nan)
        return Rendering(depth_m, hits.instance, hits.triangle, hits.normals)
