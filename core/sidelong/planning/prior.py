"""What the hypotheses say of the pixels that have no depth: D_k and N_k of equations (12) and (13)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.geometry.raycast import RayScene, Rendering
from sidelong.geometry.transforms import invert, rotate, transform_points
from sidelong.types import BoolArray, DetectedObject, FloatArray, Prior

NEGLIGIBLE_PROBABILITY = 1e-3
"""Hypotheses below it are left out: together they move the gain by less than the pixels' own noise."""


@dataclass(frozen=True, eq=False)
class Belief:
    """What is believed of the scene, seen from the reference view.

    Attributes
    ----------
    priors
        One for each hypothesis that matters.
    target
        (H, W) pixels on the most probable hypotheses that had no depth: what the scan is to complete.
    surface_m
        (H, W) depth of the most probable hypotheses, NaN where none is.
    base_T_objects
        Most probable pose of each object.
    """

    priors: tuple[Prior, ...]
    target: BoolArray
    surface_m: FloatArray
    base_T_objects: tuple[FloatArray, ...]


def believe(
    objects: Sequence[DetectedObject],
    part: Part,
    camera: PinholeCamera,
    base_T_camera: FloatArray,
    missing: BoolArray,
    stride_px: int = 1,
) -> Belief:
    """Infer depth and normal of the missing pixels from pose hypotheses and the CAD model.

    Parameters
    ----------
    objects
        Detected objects with their hypotheses; none gives an empty belief.
    part
        CAD model.
    camera, base_T_camera
        Reference view.
    missing
        (H, W) pixels without depth.
    stride_px
        Every stride-th row and column is used for the gain and stands for stride squared pixels.
    """
    base_T_objects = tuple(base_T_camera @ item.hypotheses[0].camera_T_object for item in objects)
    front = RayScene([(part, base_T_object) for base_T_object in base_T_objects]).render(camera, base_T_camera)
    target = missing & (front.instance >= 0)
    part_alone = RayScene([(part, np.eye(4))])
    grid = np.zeros_like(missing)
    grid[stride_px // 2 :: stride_px, stride_px // 2 :: stride_px] = True
    priors: list[Prior] = []
    for index, item in enumerate(objects):
        for hypothesis in item.hypotheses:
            if hypothesis.probability < NEGLIGIBLE_PROBABILITY:
                continue
            base_T_object = base_T_camera @ hypothesis.camera_T_object
            prior = _prior_of(part, part_alone, (camera, base_T_camera, base_T_object), missing & grid, (front, index))
            priors.append(Prior(index, hypothesis.probability, float(stride_px**2), *prior, base_T_object))
    return Belief(tuple(priors), target, front.depth_m, base_T_objects)


def _prior_of(
    part: Part,
    part_alone: RayScene,
    poses: tuple[PinholeCamera, FloatArray, FloatArray],
    wanted: BoolArray,
    behind: tuple[Rendering, int],
):
    """Return pixels, points, normals and material where this pose alone shows, and no other object stands before it."""
    camera, base_T_camera, base_T_object = poses
    object_T_camera = invert(base_T_object) @ base_T_camera
    rows, columns = np.nonzero(_window(wanted, part, camera, invert(object_T_camera)))
    rays = camera.rays(columns.astype(np.float64), rows.astype(np.float64))
    hits = part_alone.cast(object_T_camera[:3, 3], rotate(object_T_camera, rays))
    front, index = behind
    others_depth = np.where(front.instance == index, np.nan, front.depth_m)[rows, columns]
    # the ray that grazes from inside the mesh would show a back face; a camera inside a part sees nothing
    outside = np.einsum("ij,ij->i", hits.normals, rotate(object_T_camera, rays)) < 0
    seen = np.isfinite(hits.distance) & outside & ~(others_depth < hits.distance)
    points_camera = rays[seen] * hits.distance[seen, None]
    return (
        np.stack([rows[seen], columns[seen]], axis=1),
        transform_points(base_T_camera, points_camera),
        rotate(base_T_object, hits.normals[seen]),
        part.triangle_material[hits.triangle[seen]],
    )


def _window(wanted: BoolArray, part: Part, camera: PinholeCamera, camera_T_object: FloatArray) -> BoolArray:
    """Keep only the wanted pixels inside the bounding box of the projected part; all where it reaches the camera."""
    uv = camera.project(transform_points(camera_T_object, part.vertices_m))
    if np.isnan(uv).any():
        return wanted
    (u0, v0), (u1, v1) = np.floor(uv.min(axis=0)), np.ceil(uv.max(axis=0)) + 1
    rows = slice(int(np.clip(v0, 0, camera.height)), int(np.clip(v1, 0, camera.height)))
    columns = slice(int(np.clip(u0, 0, camera.width)), int(np.clip(u1, 0, camera.width)))
    kept = np.zeros_like(wanted)
    kept[rows, columns] = wanted[rows, columns]
    return kept
