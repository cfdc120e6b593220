"""The volumetric engine on a bin with parts and on wires: the figures asked for, with noise, holes and outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import trimesh
from fusion_scene import OTHERS, REFERENCE, bin_scene, blobs, part_of

from sidelong.fusion.volume.march import VolumeView
from sidelong.fusion.volume.volume import Volume
from sidelong.geometry.camera_model import LightProjector, PinholeCamera, StereoRig
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import invert, rotation_about, transform, transform_points
from sidelong.physics.depth_noise import DepthNoise
from sidelong.types import BoolArray, FloatArray

CAMERA = PinholeCamera(width=640, height=512, fx=1083.0, fy=1083.0, cx=318.2, cy=254.7)
RIG = StereoRig(CAMERA, CAMERA, 0.1, LightProjector(np.eye(4), 0.5, 0.4))
REGION = ((-0.13, -0.11, -0.01), (0.13, 0.11, 0.09))
POSES = (REFERENCE, *OTHERS)
NOISE = DepthNoise(disparity_px=0.03, slope_px=0.15, rim_px=0.1)
"""0.14 mm on the ground."""


@dataclass(frozen=True, eq=False)
class Fused:
    """What the volume made of the reference's holes, the truth, and which of them another view measured to 1 mm."""

    seen: VolumeView
    truth_m: FloatArray
    holes: BoolArray
    measured: BoolArray

    @property
    def error_m(self) -> FloatArray:
        return self.seen.depth_m - self.truth_m


def fused(scene: RayScene, alike_px: float, outliers: float) -> Fused:
    truths = [scene.render(CAMERA, pose).depth_m for pose in POSES]
    volume = Volume(CAMERA, REGION)
    measured = np.zeros(truths[0].shape, dtype=bool)
    holes = blobs(truths[0].shape, share=0.3, seed=1) & within_region(truths[0])
    for step, (truth_m, pose) in enumerate(zip(truths, POSES, strict=True)):
        lost = holes if step == 0 else blobs(truth_m.shape, share=0.3, seed=10 + step)
        depth_m, sigma_m = captured(np.where(lost, np.nan, truth_m), alike_px, outliers, seed=step)
        volume.add(depth_m, sigma_m, pose, step)
        if step:
            measured |= shows(truths[0], depth_m, pose)
    return Fused(volume.render(REFERENCE, holes), truths[0], holes, holes & measured)


def captured(depth_m: FloatArray, alike_px: float, outliers: float, seed: int) -> tuple[FloatArray, FloatArray]:
    """Return a depth map with noise, alike among neighbours, and outliers; and the noise's standard deviation."""
    from scipy.ndimage import gaussian_filter

    random = np.random.default_rng(seed)
    sigma_m = NOISE.sigma_m(depth_m, RIG).astype(np.float64)
    noise = random.normal(size=depth_m.shape)
    if alike_px:
        noise = gaussian_filter(noise, alike_px)
    noisy_m = depth_m + sigma_m * noise / noise.std()
    stray = random.random(depth_m.shape) < outliers
    noisy_m[stray] += random.uniform(-0.02, 0.02, stray.sum())
    return noisy_m, sigma_m


def within_region(truth_m: FloatArray) -> BoolArray:
    points = transform_points(REFERENCE, CAMERA.pixel_rays() * truth_m[..., None])
    low, high = np.array(REGION)
    return ((points > low + 0.002) & (points < high - 0.002)).all(axis=-1)


def shows(truth_m: FloatArray, depth_m: FloatArray, base_T_view: FloatArray) -> BoolArray:
    """Say which surface points of the reference another view measured, to 1 mm, on the pixel they fall on."""
    points = transform_points(REFERENCE, CAMERA.pixel_rays() * truth_m[..., None])
    points_view = transform_points(invert(base_T_view), points)
    uv = CAMERA.project(points_view)
    shown = CAMERA.contains(uv)
    column, row = np.rint(uv[shown]).astype(np.intp).T
    shown[shown] = np.abs(depth_m[row, column] - points_view[..., 2][shown]) < 1e-3
    return shown


@pytest.mark.parametrize(("alike_px", "outliers"), [(0.0, 0.0), (0.0, 0.01), (1.0, 0.01)])
def test_hidden_pixels_of_a_bin_come_back_with_a_deviation_that_can_be_believed(
    alike_px: float, outliers: float
) -> None:
    """Errors of neighbours independent, or alike as a matcher's windows make them."""
    result = fused(bin_scene(), alike_px, outliers)
    assert result.measured.sum() > 0.8 * result.holes.sum()
    error_m = result.error_m[result.measured]
    recovered = np.abs(error_m) < 2e-3
    assert recovered.mean() >= 0.97
    assert np.sqrt(np.mean(error_m[recovered] ** 2)) <= 0.2e-3
    completed = np.isfinite(result.seen.depth_m)
    assert (np.abs(result.error_m[completed]) > 2e-3).mean() <= 0.03
    near = completed & (np.abs(result.error_m) < 2e-3)
    normalised = result.error_m[near] / result.seen.sigma_m[near]
    assert 0.8 <= normalised.std() <= 1.25
    assert 0.92 <= (np.abs(normalised) < 1.96).mean() <= 0.98
    assert set(np.unique(result.seen.source)) <= {-1, 0, 1, 2, 3}


def test_what_is_wrong_lies_behind_space_nobody_saw() -> None:
    """Ground seen past parts that no view measured: without it, few completed pixels are wrong."""
    result = fused(bin_scene(), 0.0, 0.01)
    completed = np.isfinite(result.seen.depth_m)
    farther, right = completed & (result.error_m > 2e-3), completed & (np.abs(result.error_m) < 2e-3)
    behind = result.seen.unseen_m > 0.012
    assert behind[farther].mean() > 0.7
    assert behind[right].mean() < 0.2
    kept = completed & ~behind
    assert (np.abs(result.error_m[kept]) > 2e-3).mean() <= 0.015


def test_wires_of_one_millimetre_come_back() -> None:
    """A pixel is 0.65 mm: of what another view measured of them, at least 60 % is recovered."""
    floor = part_of("floor", trimesh.creation.box((0.6, 0.6, 0.02)))
    wire = part_of("wire", trimesh.creation.cylinder(radius=0.5e-3, height=0.15, sections=24))
    posed = [(floor, transform(np.eye(3), (0.0, 0.0, -0.01)))]
    for index in range(9):
        turn = rotation_about((0, 0, 1), index * np.pi / 9) @ rotation_about(
            (0, 1, 0), np.pi / 2 + 0.05 * (index % 3 - 1)
        )
        posed.append((wire, transform(turn, (0.02 * (index - 4), 0.01 * (index * 5 % 9 - 4), 0.02 + 0.004 * index))))
    result = fused(RayScene(posed), 0.0, 0.01)
    above = transform_points(REFERENCE, CAMERA.pixel_rays() * result.truth_m[..., None])[..., 2] > 0.005
    asked = result.measured & above
    assert asked.sum() > 300
    assert (np.abs(result.error_m[asked]) < 2e-3).mean() >= 0.6
