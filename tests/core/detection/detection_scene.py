"""A small part of known pose, shaded like metal, rendered without the code under test's templates."""

from __future__ import annotations

import numpy as np
import trimesh

from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import rotation_about, transform
from sidelong.types import FloatArray, GrayImage

CAMERA = PinholeCamera(320, 256, 420.0, 420.0, 159.5, 127.5)


def bracket() -> Part:
    """An L of 60 x 40 x 16 mm with a step: no symmetry but its mirror plane's."""
    outline = [(0, 0), (60, 0), (60, 16), (36, 16), (36, 24), (16, 24), (16, 40), (0, 40)]
    faces = [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5), (0, 5, 6), (0, 6, 7)]
    mesh = trimesh.creation.extrude_triangulation(np.array(outline, dtype=float), np.array(faces), height=16.0)
    vertices = (np.asarray(mesh.vertices) - (25.0, 15.0, 8.0)) * 1e-3
    return part_from_arrays("bracket", vertices, np.asarray(mesh.faces, dtype=np.intp))


def true_poses() -> list[FloatArray]:
    """Two brackets that lie apart, between the views, turns and distances of the templates."""
    tilt = rotation_about((1, 0.3, 0), 0.5)
    return [
        transform(rotation_about((0, 0, 1), 0.7) @ tilt, (-0.09, -0.03, 0.68)),
        transform(rotation_about((0, 0, 1), 2.9) @ tilt, (0.08, 0.04, 0.72)),
    ]


def photograph(part: Part, poses: list[FloatArray], camera: PinholeCamera, seed: int = 0) -> GrayImage:
    """Ambient light, a lamp from the side with a glint, shot noise, 8 bits, on a dark ground."""
    seen = RayScene([(part, pose) for pose in poses]).render(camera, np.eye(4))
    lamp = np.array([0.25, -0.35, -0.9]) / np.linalg.norm([0.25, -0.35, -0.9])
    cosine = np.clip(np.nan_to_num(seen.normals_scene @ lamp), 0, 1)
    grey = np.where(seen.instance >= 0, 30 + 110 * cosine + 80 * cosine**30, 18.0)
    rng = np.random.default_rng(seed)
    return np.clip(np.round(rng.poisson(grey * 8) / 8), 0, 255).astype(np.uint8)
