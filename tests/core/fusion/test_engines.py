"""The volumetric engine behind the completion: what holds for one engine holds for the other."""

from __future__ import annotations

import numpy as np
import pytest
from fusion_scene import CAMERA, OTHERS, REFERENCE, RIG, bin_scene, blobs, frame_of, well_measured
from pydantic import ValidationError

from sidelong.errors import SettingsError
from sidelong.fusion.completion import Completion
from sidelong.fusion.settings import EngineName, FusionSettings
from sidelong.fusion.volume.settings import VolumeSettings
from sidelong.types import BoolArray, FloatArray, PixelState

SHAPE = (CAMERA.height, CAMERA.width)
REGION_M = ((-0.17, -0.17, -0.02), (0.17, 0.17, 0.08))
SETTINGS = FusionSettings(engine=EngineName.VOLUME, volume=VolumeSettings(region_m=REGION_M))


@pytest.fixture(scope="module")
def truth() -> FloatArray:
    return bin_scene().render(CAMERA, REFERENCE).depth_m


@pytest.fixture(scope="module")
def holes(truth: FloatArray) -> BoolArray:
    """Smooth patches within the region."""
    points = CAMERA.pixel_rays() * truth[..., None] @ REFERENCE[:3, :3].T + REFERENCE[:3, 3]
    inside = (np.abs(points[..., :2]) < 0.165).all(axis=-1)
    return blobs(truth.shape, share=0.3, seed=1) & inside


@pytest.fixture(scope="module")
def others() -> list[FloatArray]:
    scene, noise = bin_scene(), np.random.default_rng(2)
    return [scene.render(CAMERA, pose).depth_m + 1e-4 * noise.normal(size=SHAPE) for pose in OTHERS]


def completed(truth: FloatArray, holes: BoolArray, others: list[FloatArray], settings: FusionSettings) -> Completion:
    completion = Completion(frame_of(np.where(holes, np.nan, truth), REFERENCE), RIG, settings)
    for depth_m, pose in zip(others, OTHERS[: len(others)], strict=True):
        assert completion.add(frame_of(depth_m, pose)).refused is None
    return completion


def test_hidden_pixels_come_back_and_measured_ones_stay(
    truth: FloatArray, holes: BoolArray, others: list[FloatArray]
) -> None:
    completion = completed(truth, holes, others, SETTINGS)
    depth = completion.depth
    kept = np.isfinite(truth) & ~holes
    np.testing.assert_array_equal(depth.depth_m[kept], truth[kept])
    well = np.any([well_measured(truth, d, pose) for d, pose in zip(others, OTHERS, strict=True)], axis=0)
    error_m = np.abs(depth.depth_m - truth)
    asked = holes & well
    assert (error_m[asked] < 2e-3).mean() > 0.97
    assert np.sqrt(np.mean(error_m[asked & (error_m < 2e-3)] ** 2)) < 0.2e-3
    told = depth.state == PixelState.COMPLETED
    np.testing.assert_array_equal(np.isfinite(depth.sigma_m), np.isfinite(depth.depth_m))
    assert set(np.unique(depth.source[told])) <= {0, 1, 2, 3}
    assert (depth.source[depth.state == PixelState.MISSING] == -1).all()


def test_the_scene_has_a_mesh_of_what_the_reference_does_not_see_too(
    truth: FloatArray, holes: BoolArray, others: list[FloatArray]
) -> None:
    """Every corner lies on a surface of the bin; some of them are hidden from the reference."""
    scene = completed(truth, holes, others, SETTINGS).scene
    assert scene is not None
    mesh = scene.mesh()
    nearest, normals = bin_scene().closest(mesh.points_m)
    off_m = np.linalg.norm(mesh.points_m - nearest, axis=1)
    assert np.quantile(off_m, 0.9) < 0.5e-3
    assert np.median((mesh.normals * normals).sum(axis=1)) > 0.99
    assert completed(truth, holes, others[:0], FusionSettings()).scene is None


def test_both_engines_agree(truth: FloatArray, holes: BoolArray, others: list[FloatArray]) -> None:
    depths = [completed(truth, holes, others, each).depth for each in (SETTINGS, FusionSettings())]
    both = (depths[0].state == PixelState.COMPLETED) & (depths[1].state == PixelState.COMPLETED)
    assert both.sum() > 0.9 * holes.sum()
    apart_m = np.abs(depths[0].depth_m - depths[1].depth_m)[both]
    assert np.median(apart_m) < 0.1e-3
    assert np.quantile(apart_m, 0.95) < 0.5e-3


def test_a_region_that_does_not_fit_is_refused_with_its_size(truth: FloatArray) -> None:
    large = FusionSettings(engine=EngineName.VOLUME, volume=VolumeSettings(max_bytes=20_000_000))
    with pytest.raises(SettingsError, match=r"need \d+ bytes at least, limit max_bytes 20000000"):
        Completion(frame_of(truth, REFERENCE), RIG, large)
    with pytest.raises(ValidationError, match="voxel_m"):
        VolumeSettings(voxel_m=0.0)


def test_settings_from_json_are_taken() -> None:
    read = FusionSettings.model_validate({"engine": "volume", "volume": {"region_m": [[0, 0, 0], [1, 1, 1.5]]}})
    assert read.volume.region_m == ((0, 0, 0), (1, 1, 1.5))
    assert FusionSettings.model_validate_json(read.model_dump_json()) == read
