"""Depth by the CAD model: only where the pose is certain, and with the uncertainty that the pose gives it."""

from __future__ import annotations

import numpy as np
import pytest

from sidelong.fusion.modelled import modelled_depth
from sidelong.fusion.settings import ModelSettings
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import rotation_about, transform
from sidelong.simulation.parts import simulated_part
from sidelong.types import DetectedObject, FloatArray, Hypothesis

CAMERA = PinholeCamera(width=160, height=128, fx=270.0, fy=270.0, cx=79.1, cy=63.8)
PART = simulated_part("gear")
POSE = transform(rotation_about((1, 0.4, 0), 0.5), (0.0, 0.0, 0.4))
SETTINGS = ModelSettings()


def found(
    pose: FloatArray = POSE, probability: float = 1.0, sigma: float = 1e-4, views: tuple[str, ...] = ("top", "side")
) -> DetectedObject:
    return DetectedObject((Hypothesis(pose, 90.0, probability, sigma**2 * np.eye(6)),), supporting_views=views)


def test_a_certain_pose_gives_the_depth_of_the_mesh() -> None:
    depth_m, sigma_m = modelled_depth(PART, CAMERA, SETTINGS, (found(),))
    rendered_m = RayScene([(PART, POSE)]).render(CAMERA, np.eye(4)).depth_m
    given = np.isfinite(depth_m)
    np.testing.assert_array_equal(depth_m[given], rendered_m[given])
    assert given.sum() > 0.8 * np.isfinite(rendered_m).sum()
    np.testing.assert_array_equal(np.isfinite(sigma_m), given)
    assert (sigma_m[given] <= SETTINGS.largest_sigma_m).all()


@pytest.mark.parametrize("direction", range(6))
def test_sigma_is_how_far_an_error_of_the_pose_moves_the_depth(direction: int) -> None:
    """Moved by one standard deviation in one direction, depth changes by sigma, away from the part's edges."""
    size = 1e-4
    covariance = np.zeros((6, 6))
    covariance[direction, direction] = size**2
    item = DetectedObject((Hypothesis(POSE, 90.0, 1.0, covariance),), supporting_views=("top", "side"))
    depth_m, sigma_m = modelled_depth(PART, CAMERA, ModelSettings(largest_sigma_m=0.01), (item,))
    moved = POSE.copy()
    if direction < 3:
        centre = POSE[:3, :3] @ PART.centre_m + POSE[:3, 3]
        turn = rotation_about(np.eye(3)[direction], size)
        moved = transform(turn, centre - turn @ centre) @ POSE
    else:
        moved[direction - 3, 3] += size
    there_m = RayScene([(PART, moved)]).render(CAMERA, np.eye(4)).depth_m
    off = np.abs(np.abs(there_m - depth_m) - sigma_m)
    assert np.nanmedian(off) < 1e-6
    assert np.nanquantile(off, 0.9) < 0.05 * size


@pytest.mark.parametrize(
    "item",
    [found(probability=0.5), found(sigma=5e-3), found(views=("top",)), DetectedObject((Hypothesis(POSE, 90.0, 1.0),))],
)
def test_a_pose_that_is_not_certain_gives_nothing(item: DetectedObject) -> None:
    depth_m, sigma_m = modelled_depth(PART, CAMERA, SETTINGS, (item,))
    assert np.isnan(depth_m).all()
    assert np.isnan(sigma_m).all()


def test_what_is_not_certain_hides_what_lies_behind() -> None:
    nearer = POSE.copy()
    nearer[2, 3] -= 0.1
    depth_m, _ = modelled_depth(PART, CAMERA, SETTINGS, (found(), found(nearer, probability=0.5)))
    alone_m, _ = modelled_depth(PART, CAMERA, SETTINGS, (found(),))
    hidden = np.isfinite(RayScene([(PART, nearer)]).render(CAMERA, np.eye(4)).depth_m)
    assert np.isnan(depth_m[hidden]).all()
    np.testing.assert_array_equal(depth_m[~hidden], alone_m[~hidden])


def test_no_objects_give_nothing() -> None:
    assert np.isnan(modelled_depth(PART, CAMERA, SETTINGS, ())[0]).all()
