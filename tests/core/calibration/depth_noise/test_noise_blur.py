"""How far noise reaches from pixel to pixel, and the window of normals that suits it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from sidelong.calibration.depth_noise.blur import noise_blur_px
from sidelong.calibration.normals import informative_normals
from sidelong.simulation.rig import rig_for
from sidelong.types import FloatArray

CAMERA = rig_for(640, 512).left


def noisy_sphere(sigma_m: float, blur_px: float, radius_m: float = 0.2) -> tuple[FloatArray, FloatArray]:
    """Return depth (H, W) of a sphere with blurred noise, and its true normals."""
    rays = CAMERA.pixel_rays()
    centre = np.array([0.12, 0.0, 0.8])
    a, b = (rays**2).sum(axis=-1), rays @ centre
    under = b**2 - a * (centre @ centre - radius_m**2)
    depth_m = np.where(under > 0, (b - np.sqrt(np.maximum(under, 0.0))) / a, np.nan)
    normals = (rays * depth_m[..., None] - centre) / radius_m
    noise = np.random.default_rng(0).normal(size=depth_m.shape)
    noise = cv2.GaussianBlur(noise, (0, 0), blur_px) if blur_px else noise
    return depth_m + sigma_m * noise / noise.std(), normals


@pytest.mark.parametrize("blur_px", [0.5, 1.0, 1.4, 2.0, 3.0])
def test_the_blur_of_noise_is_found_on_a_curved_surface_with_an_edge(blur_px: float) -> None:
    depth_m, _ = noisy_sphere(2e-4, blur_px)
    depth_m[100:120] = np.nan
    assert noise_blur_px(depth_m) == pytest.approx(blur_px, abs=0.1, rel=0.1)


def test_white_noise_has_no_blur() -> None:
    assert noise_blur_px(noisy_sphere(2e-4, 0.0)[0]) < 0.3


@pytest.mark.parametrize(
    "depth_m",
    [np.full((20, 20), np.nan), np.full((512, 640), 0.7), np.full((3, 5), 0.7)],
    ids=["empty", "flat", "tiny"],
)
def test_where_nothing_can_be_told_there_is_none(depth_m: FloatArray) -> None:
    assert noise_blur_px(depth_m) == 0.0


def test_noise_takes_a_larger_window_and_its_errors_are_as_stated() -> None:
    depth_m, truth = noisy_sphere(3e-4, 1.4)
    found, settings = informative_normals(depth_m, CAMERA, np.isfinite(depth_m))
    assert settings.window_px > 5
    cosine = np.einsum("...i,...i", found.normals_camera, truth)
    error = np.arccos(np.clip(cosine, -1.0, 1.0)) / found.sigma_rad
    assert 0.7 < np.sqrt(np.nanmean(error**2)) < 1.4


def test_a_small_part_without_noise_takes_a_small_window() -> None:
    depth_m, _ = noisy_sphere(2e-6, 0.0, radius_m=0.008)
    _, settings = informative_normals(depth_m, CAMERA, np.isfinite(depth_m))
    assert settings.window_px == 5
