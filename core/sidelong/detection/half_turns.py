"""Half turns of a part about its principal axes: poses that silhouettes and edges hardly tell apart."""

from __future__ import annotations

import numpy as np

from sidelong.geometry.mesh import Part
from sidelong.geometry.transforms import transform
from sidelong.types import FloatArray

DIFFERENT_RAD = np.deg2rad(20.0)
"""A half turn that the symmetry makes smaller than this shows the same part again."""


def half_turns(part: Part) -> FloatArray:
    """Return ``object_T_object`` (M, 4, 4), M up to 3: half turns about the part's centre that its symmetry has not."""
    corners = part.vertices_m[part.triangles]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    middle = corners.mean(axis=1)
    off_m = middle - np.average(middle, axis=0, weights=area)
    axes = np.linalg.eigh((off_m * area[:, None]).T @ off_m)[1].T
    turns = 2 * axes[:, :, None] * axes[:, None, :] - np.eye(3)
    different = part.symmetry.angle_rad(turns, np.eye(3)) > DIFFERENT_RAD
    poses = [transform(turn, part.centre_m - turn @ part.centre_m) for turn in turns[different]]
    return np.array(poses).reshape(-1, 4, 4)
