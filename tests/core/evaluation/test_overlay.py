"""The overlay draws where the part's edges are, on the image, and nowhere else."""

from __future__ import annotations

import cv2
import numpy as np
import trimesh

from sidelong.evaluation.overlay import draw_overlay, edges
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import part_from_arrays
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import transform
from sidelong.types import DetectedObject, Hypothesis

CAMERA = PinholeCamera(160, 120, 200.0, 200.0, 79.5, 59.5)
IMAGE = np.full((120, 160), 40, dtype=np.uint8)


def box(side_m: float):
    mesh = trimesh.creation.box((side_m, side_m, side_m))
    return part_from_arrays("box", np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.intp))


def test_a_box_seen_from_the_front_shows_its_square_and_not_the_diagonals_of_its_triangles():
    """40 mm at 0.48 m before a focal length of 200 px: the square is 16.7 px wide."""
    seen = RayScene([(box(0.04), transform(np.eye(3), (0, 0, 0.5)))]).render(CAMERA, np.eye(4))
    lines = edges(seen)
    rows, columns = np.nonzero(lines)
    assert (np.ptp(rows), np.ptp(columns)) == (15, 15)
    assert lines.sum() == 4 * 15
    assert np.array_equal(lines[rows.min() + 1 : rows.max(), columns.min() + 1 : columns.max()].any(), np.bool_(False))


def test_a_crease_between_faces_is_drawn():
    turned = transform(cv2.Rodrigues(np.array([0.0, np.pi / 4, 0.0]))[0], (0, 0, 0.5))
    lines = edges(RayScene([(box(0.04), turned)]).render(CAMERA, np.eye(4)))
    assert lines[60, 78:82].any()


def drawn(pose: np.ndarray | None, name: str = "") -> np.ndarray:
    objects = () if pose is None else (DetectedObject((Hypothesis(pose, 90.0, 1.0),)),)
    picture = draw_overlay(IMAGE, box(0.04), CAMERA, objects, (name,) * len(objects))
    return cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)


def test_without_objects_the_whole_image_is_shown_magnified():
    picture = drawn(None)
    assert picture.shape == (8 * 120, 8 * 160, 3)
    assert (picture == picture[0, 0]).all()


def test_the_part_is_magnified_and_its_square_in_the_middle():
    """A window of 1.5 diameters (69 mm) at 0.5 m and f = 200 px; the front face stands at 0.48 m."""
    picture = drawn(transform(np.eye(3), (0.05, 0.0, 0.5)))
    window_px = 1.5 * 0.04 * np.sqrt(3) * 200 / 0.5
    scale = round(1200 / np.ceil(window_px))
    assert abs(picture.shape[1] / scale - window_px) < 2
    rows, columns = np.nonzero((picture != picture[0, 0]).any(axis=2))
    assert abs(np.ptp(rows) - scale * 0.04 / 0.48 * 200) < scale
    assert abs(rows.mean() - picture.shape[0] / 2) < scale
    assert 0 < columns.min() < columns.max() < picture.shape[1] - 1


def test_a_name_is_written():
    pose = transform(np.eye(3), (0.0, 0.0, 0.5))
    assert (drawn(pose, "3") != drawn(pose)).any()


def test_poses_behind_the_camera_and_outside_the_image_are_left_out():
    plain = drawn(None)
    assert np.array_equal(drawn(transform(np.eye(3), (0, 0, -0.5)), "1"), plain)
    assert (drawn(transform(np.eye(3), (2.0, 0, 0.5)), "1") == plain[0, 0]).all()
