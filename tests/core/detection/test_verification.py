"""What poses share when they are looked at together, against each of them by itself and against plain formulas."""

from __future__ import annotations

import numpy as np
from detection_scene import CAMERA, bracket, photograph, true_poses

from sidelong.detection.appearance import RIDGE, AppearanceModel, ReflectanceMaps
from sidelong.detection.clusters import distinct
from sidelong.detection.proposals import Starts
from sidelong.detection.settings import DetectionSettings
from sidelong.detection.verification import Evidence, Verifier, same_view
from sidelong.geometry.symmetry import no_symmetry
from sidelong.geometry.transforms import rotation_about
from sidelong.types import FloatArray


def turned_in_the_image(pose: FloatArray, angles_rad: list[float]) -> FloatArray:
    """Turn a pose about its own line of sight: the same side of the part is seen."""
    centre = pose[:3, :3] @ bracket().centre_m + pose[:3, 3]
    poses = np.stack([pose] * len(angles_rad))
    for each, angle_rad in zip(poses, angles_rad, strict=True):
        each[:3, :3] = rotation_about(centre, angle_rad) @ pose[:3, :3]
        each[:3, 3] = centre - each[:3, :3] @ bracket().centre_m
    return poses


def test_turns_in_the_image_and_distances_show_one_view_and_tilts_another():
    pose = true_poses()[0]
    turned = turned_in_the_image(pose, [0.0, 0.7, 2.9])
    centre = pose[:3, :3] @ bracket().centre_m + pose[:3, 3]
    further, tilted = pose.copy(), pose.copy()
    further[:3, 3] += 0.1 * centre
    tilted[:3, :3] = rotation_about(np.array([1.0, 0.0, 0.0]), 0.2) @ pose[:3, :3]
    view = same_view(np.stack([*turned, further, tilted]), bracket().centre_m)[1]
    assert len(set(view[:4])) == 1
    assert view[4] not in view[:4]


def test_poses_of_one_view_are_as_promising_together_as_alone():
    truths = true_poses()
    scene = Evidence(photograph(bracket(), truths, CAMERA), None)
    verifier = Verifier(bracket(), CAMERA, DetectionSettings())
    poses = np.concatenate([turned_in_the_image(truth, [0.0, 0.4, 1.9, 3.1]) for truth in truths])
    starts = Starts(poses, np.tile([0.3, 1.5], (len(poses), 1)))
    together = verifier.glance(starts, scene)[1]
    alone = np.concatenate([verifier.glance(starts[np.array([k])], scene)[1] for k in range(len(poses))])
    assert np.abs(together - alone).max() < 0.5  # the disc of pixels turns with the view
    assert (together.reshape(-1, 4).argmax(axis=1) == 0).all()  # the truth is the most promising


def test_maps_explain_what_least_squares_explains():
    surface = AppearanceModel(bracket(), CAMERA).surface(np.stack(true_poses()))
    rng = np.random.default_rng(0)
    grey = (20 * surface.normals[..., 0] + rng.normal(0, 5, surface.covered.shape)).astype(np.float32)
    grey -= grey.mean(axis=1, keepdims=True)
    around, inside = ReflectanceMaps(surface).explained(np.arange(len(grey)), grey)
    for k, (covered, values) in enumerate(zip(surface.covered, grey.astype(np.float64), strict=True)):
        x, y, z = surface.normals[k].astype(np.float64).T
        cubic = np.stack([x**i * y**j * z**m for m in (0, 1) for i in range(4) for j in range(4 - i - m)], axis=-1)
        part = cubic * covered[:, None]
        assert abs(around[k] - _share(np.column_stack([part, ~covered]), values)) < 1e-5
        assert abs(inside[k] - _share(part, (values - values[covered].mean()) * covered)) < 1e-5


def test_distinct_poses_are_those_of_the_trivial_symmetry():
    rng = np.random.default_rng(0)
    rotations = np.stack([rotation_about(rng.normal(size=3), rng.uniform(0, 3)) for _ in range(300)])
    distances_m = rng.uniform(0.6, 0.8, 300)
    kept = distinct(rotations, distances_m, 0.8, 300)
    np.testing.assert_array_equal(kept, distinct(rotations, distances_m, 0.8, 300, no_symmetry(np.zeros(3))))
    assert 20 < len(kept) < 280


def _share(basis: FloatArray, values: FloatArray) -> float:
    weights = np.linalg.solve(basis.T @ basis + RIDGE * np.eye(basis.shape[1]), basis.T @ values)
    return float(1 - np.sum((values - basis @ weights) ** 2) / np.sum(values**2))
