"""Depth maps of posed parts with noise that neighbouring pixels share, and poses beside the true ones."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.ndimage import uniform_filter
from scipy.spatial.transform import Rotation

from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import transform_points
from sidelong.types import FloatArray

CAMERA = PinholeCamera(320, 256, 700.0, 700.0, 159.5, 127.5)


def measured(
    part: Part,
    reference_T_objects: Sequence[FloatArray],
    rng: np.random.Generator,
    reference_T_camera: FloatArray | None = None,
    noise_m: float = 0.1e-3,
    window_px: int = 1,
    outliers: float = 0.0,
    camera: PinholeCamera = CAMERA,
) -> FloatArray:
    """Render depth with Gaussian noise that is the mean over a window, and outliers spread over the part's diameter."""
    pose = np.eye(4) if reference_T_camera is None else reference_T_camera
    depth_m = RayScene([(part, each) for each in reference_T_objects]).render(camera, pose).depth_m
    # the mean of w x w values has 1/w of their deviation
    noise = uniform_filter(rng.standard_normal(depth_m.shape), window_px) * window_px
    wrong = rng.random(depth_m.shape) < outliers
    spread_m = rng.uniform(-0.5, 0.5, depth_m.shape) * part.diameter_m
    return depth_m + np.where(wrong, spread_m, noise_m * noise)


def displaced(pose: FloatArray, part: Part, turn_rad: FloatArray, shift_m: FloatArray) -> FloatArray:
    """Turn a pose (4, 4) about the part's centre by a rotation vector, and shift it, along the camera's axes."""
    moved = pose.copy()
    moved[:3, :3] = Rotation.from_rotvec(turn_rad).as_matrix() @ pose[:3, :3]
    centre = transform_points(pose, part.centre_m) + shift_m
    moved[:3, 3] = centre - moved[:3, :3] @ part.centre_m
    return moved


def disturbed(pose: FloatArray, part: Part, turn_deg: float, shift_m: float, rng: np.random.Generator) -> FloatArray:
    """Displace a pose by so much in random directions."""
    axis, direction = rng.standard_normal((2, 3))
    axis, direction = axis / np.linalg.norm(axis), direction / np.linalg.norm(direction)
    return displaced(pose, part, np.deg2rad(turn_deg) * axis, shift_m * direction)


def error_twist(true: FloatArray, found: FloatArray, part: Part) -> FloatArray:
    """Return what ``displaced`` needs to get from ``found`` to ``true``: (6,) turn in rad, shift in metres."""
    turn = Rotation.from_matrix(true[:3, :3] @ found[:3, :3].T).as_rotvec()
    return np.concatenate([turn, transform_points(true, part.centre_m) - transform_points(found, part.centre_m)])


def average_distance_m(true: FloatArray, found: FloatArray, part: Part) -> float:
    """Return the mean distance of vertices under two poses: ADD (Hinterstoisser et al., 2012)."""
    vertices = part.vertices_m
    return float(np.linalg.norm(transform_points(true, vertices) - transform_points(found, vertices), axis=1).mean())
