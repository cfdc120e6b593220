"""A bin with parts of closed form and of the simulated cell, seen without noise; holes are punched afterwards."""

from __future__ import annotations

import numpy as np
import trimesh

from sidelong.geometry.camera_model import LightProjector, PinholeCamera, StereoRig
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import invert, look_at, rotation_about, transform, transform_points
from sidelong.simulation.parts import simulated_part
from sidelong.types import BoolArray, FloatArray, Frame, Projector, View

CAMERA = PinholeCamera(width=640, height=512, fx=541.5, fy=541.5, cx=318.2, cy=254.7)
RIG = StereoRig(CAMERA, CAMERA, 0.1, LightProjector(np.eye(4), 0.5, 0.4))
REFERENCE = look_at((0.0, 0.0, 0.7), (0.0, 0.0, 0.0))
OTHERS = tuple(
    look_at((0.35 * np.cos(turn), 0.35 * np.sin(turn), 0.6), (0.0, 0.0, 0.0), roll_rad=roll)
    for turn, roll in ((0.3, 0.0), (2.2, 1.0), (4.1, -2.0))
)


def part_of(name: str, mesh: trimesh.Trimesh) -> Part:
    return part_from_arrays(name, np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.intp))


def bin_scene() -> RayScene:
    """Eight tube fittings, a ball and a block on a floor."""
    floor = part_of("floor", trimesh.creation.box((0.6, 0.6, 0.02)))
    ball = part_of("ball", trimesh.creation.icosphere(subdivisions=4, radius=0.03))
    block = part_of("block", trimesh.creation.box((0.05, 0.03, 0.04)))
    fitting = simulated_part("tube_fitting")
    posed = [
        (floor, transform(np.eye(3), (0.0, 0.0, -0.01))),
        (ball, transform(np.eye(3), (0.03, 0.02, 0.03))),
        (block, transform(rotation_about((0, 0, 1), 0.5), (-0.05, 0.06, 0.02))),
    ]
    for index in range(8):
        turn = index * np.pi / 4
        rotation = rotation_about((0, 0, 1), 2.0 * turn) @ rotation_about((0, 1, 0), np.pi / 2 + 0.15 * index)
        posed.append((fitting, transform(rotation, (0.11 * np.cos(turn), 0.11 * np.sin(turn), 0.02))))
    return RayScene(posed)


def blobs(shape: tuple[int, int], share: float, seed: int) -> BoolArray:
    """Return smooth random patches that cover this share of an image, as lost depth does."""
    from scipy.ndimage import gaussian_filter

    smooth = gaussian_filter(np.random.default_rng(seed).normal(size=shape), 8.0)
    return smooth > np.quantile(smooth, 1.0 - share)


def frame_of(depth_m: FloatArray | None, base_T_camera: FloatArray, name: str = "v") -> Frame:
    shape = (CAMERA.height, CAMERA.width)
    image = np.zeros(shape, dtype=np.uint8)
    return Frame(View(name, base_T_camera), image, None, depth_m, Projector.DOTS, 0.01)


def well_measured(truth_m: FloatArray, depth_m: FloatArray, base_T_view: FloatArray) -> BoolArray:
    """Say which surface points of the reference view another view measured, to 1 mm, on all four pixels around it."""
    points_base = transform_points(REFERENCE, CAMERA.pixel_rays() * truth_m[..., None])
    points_view = transform_points(invert(base_T_view), points_base)
    uv = CAMERA.project(points_view)
    well = CAMERA.contains(uv) & CAMERA.contains(uv + 1.0) & CAMERA.contains(uv - 1.0)
    column, row = np.floor(uv[well]).astype(np.intp).T
    expected = points_view[..., 2][well]
    around = np.stack([depth_m[row + j, column + i] for j in (0, 1) for i in (0, 1)])
    well[well] = (np.abs(around - expected) < 1e-3).all(axis=0)
    return well
