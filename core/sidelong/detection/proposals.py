"""From matches of templates to poses worth verifying: which matches are one object, which are one pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sidelong.detection.clusters import cluster, distinct
from sidelong.detection.depth_evidence import DistanceBounds
from sidelong.detection.matcher_process import Matches
from sidelong.detection.settings import DetectionSettings
from sidelong.detection.templates import TemplateSet
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.types import FloatArray, IntArray

CLUSTERS_PER_OBJECT = 3
"""False clusters are dropped after alignment only: so many more than objects are looked at."""
POSES_PER_CLUSTER = 48
"""The right template often is far from the best match: on a gear's face the hundredth."""
PLACE = 0.05
"""Matches nearer to each other than this share of the diameter get the same bounds."""


@dataclass(frozen=True, eq=False)
class Starts:
    """Poses (K, 4, 4) before alignment, and how near and far (K, 2) their centres may be, in metres."""

    poses: FloatArray
    limits_m: FloatArray

    def __getitem__(self, chosen: slice | IntArray) -> Starts:
        return Starts(self.poses[chosen], self.limits_m[chosen])

    @staticmethod
    def joined(parts: Sequence[Starts]) -> Starts:
        """Concatenate; none gives none."""
        return Starts(
            np.concatenate([np.zeros((0, 4, 4)), *(part.poses for part in parts)]),
            np.concatenate([np.zeros((0, 2)), *(part.limits_m for part in parts)]),
        )


def propose(
    matches: Matches,
    templates: TemplateSet,
    bounds: DistanceBounds,
    settings: DetectionSettings,
    scene: tuple[Part, PinholeCamera],
) -> list[Starts]:
    """Return the distinct poses of each cluster of matches, best match first."""
    part, camera = scene
    scale = templates.focal_px / np.array([camera.fx, camera.fy])
    # (centre + 1/2) / scale - 1/2 moves pixel centres between the sizes
    uv = (matches.centre_px + 0.5) / scale - 0.5
    distance_m, rotation = templates.distance_m[matches.row], templates.axis_R_object[matches.row]
    diameter_px = camera.fx * part.diameter_m / distance_m
    near_m, far_m = _bounded(bounds, uv, diameter_px)
    half_step = np.sqrt(settings.distance_ratio)
    possible = (distance_m * half_step >= near_m) & (distance_m / half_step <= far_m)
    row = matches.row[possible]
    uv, distance_m, rotation, near_m, far_m, diameter_px = (
        each[possible] for each in (uv, distance_m, rotation, near_m, far_m, diameter_px)
    )
    distance_m = np.clip(distance_m, near_m, far_m)
    step_rad = np.radians(settings.pose_step_deg)
    clusters: list[Starts] = []
    for members in cluster(uv, settings.cluster_radius * diameter_px, CLUSTERS_PER_OBJECT * settings.max_objects):
        # one template matches at many places next to each other: its best place stands for them
        members = members[np.sort(np.unique(row[members], return_index=True)[1])]
        kept = members[distinct(rotation[members], distance_m[members], step_rad, POSES_PER_CLUSTER)]
        poses = poses_on_rays(uv[kept], camera, rotation[kept], distance_m[kept], part.centre_m)
        clusters.append(Starts(poses, np.stack([near_m[kept], far_m[kept]], axis=-1)))
    return clusters


def poses_on_rays(
    uv: FloatArray, camera: PinholeCamera, axis_R_object: FloatArray, distance_m: FloatArray, centre_m: FloatArray
) -> FloatArray:
    """Return ``camera_T_object`` (K, 4, 4) of templates found with their centres at pixels (K, 2).

    The rotations (K, 3, 3) turn with the rays. Off the axis a pinhole image grows by 1/cos along the radius and not
    across it; the distances (K,) take the geometric mean.
    """
    rays = camera.rays(uv[:, 0], uv[:, 1])
    x, y, z = (rays / np.linalg.norm(rays, axis=1, keepdims=True)).T
    # the least turn that takes the axis to the ray: I + [v] + [v]^2 / (1 + z) with v = axis x ray
    nothing = np.zeros_like(x)
    turn = np.stack([nothing, nothing, x, nothing, nothing, y, -x, -y, nothing], axis=-1).reshape(-1, 3, 3)
    rotation = (np.eye(3) + turn + turn @ turn / (1.0 + z)[:, None, None]) @ axis_R_object
    poses = np.tile(np.eye(4), (len(uv), 1, 1))
    poses[:, :3, :3] = rotation
    poses[:, :3, 3] = rays * (distance_m / np.sqrt(z))[:, None] - rotation @ centre_m
    return poses


def _bounded(bounds: DistanceBounds, uv: FloatArray, diameter_px: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the least and largest distance (M,), (M,) of matches; many of them lie at the same place."""
    cell = np.rint(uv / (PLACE * diameter_px[:, None])).astype(np.int64)
    size = np.unique(diameter_px, return_inverse=True)[1]
    places = (cell[:, 0] << 40) + (cell[:, 1] << 16) + size
    first, place = np.unique(places, return_index=True, return_inverse=True)[1:]
    near_m, far_m = bounds.at(uv[first], diameter_px[first] / 2)
    return near_m[place], far_m[place]
