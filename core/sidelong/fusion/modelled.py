"""Completion by the CAD model: what must be there if the pose is right, where the pose is known well enough."""

from __future__ import annotations

import numpy as np

from sidelong.fusion.settings import ModelSettings
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.geometry.raycast import RayScene
from sidelong.types import DetectedObject, FloatArray

EDGE_ON = 1e-3
"""Cosine between line of sight and surface below which the depth says nothing."""


def modelled_depth(
    part: Part, camera: PinholeCamera, settings: ModelSettings, objects: tuple[DetectedObject, ...]
) -> tuple[FloatArray, FloatArray]:
    """Return the depth that the CAD model gives where its pose is certain, and its standard deviation.

    A pose is certain with at least ``least_probability``, a covariance, and depth of ``least_views`` that support it; a
    depth, if the covariance of its pose moves it by at most ``largest_sigma_m``. Poses that are less certain hide what
    lies behind.

    Returns
    -------
    depth_m, sigma_m
        (H, W) in the reference camera, NaN where nothing is certain.
    """
    poses = [item.hypotheses[0].camera_T_object for item in objects]
    seen = RayScene([(part, pose) for pose in poses]).render(camera, np.eye(4))
    sigma_m = np.full(seen.depth_m.shape, np.nan)
    for index, item in enumerate(objects):
        best = item.hypotheses[0]
        told = len(item.supporting_views) >= settings.least_views
        if best.probability < settings.least_probability or best.covariance is None or not told:
            continue
        rows, columns = np.nonzero(seen.instance == index)
        rays = camera.rays(columns.astype(np.float64), rows.astype(np.float64))
        normals = seen.normals_scene[rows, columns]
        centre = best.camera_T_object[:3, :3] @ part.centre_m + best.camera_T_object[:3, 3]
        arms = rays * seen.depth_m[rows, columns, None] - centre
        facing = np.abs((normals * rays).sum(axis=1))
        motion = np.concatenate([np.cross(arms, normals), normals], axis=1) / np.maximum(facing, EDGE_ON)[:, None]
        sigma_m[rows, columns] = np.sqrt(np.einsum("ni,ij,nj->n", motion, best.covariance, motion))
    certain = sigma_m <= settings.largest_sigma_m
    return np.where(certain, seen.depth_m, np.nan), np.where(certain, sigma_m, np.nan)
