"""Anything a camera and an arm could hand over: no exception, no warning, no NaN where there is a depth, nothing
measured lost.

Cameras of one pixel to 64x48, depths that are constant, noise, steps, far and near limits or of all sizes, any share of
them missing as NaN, 0, negative, infinite or absurd; poses from a nanometre to a kilometre apart, turned by anything.
"""

from __future__ import annotations

import numpy as np
import pytest

from sidelong.fusion.completion import LARGEST_DEPTH_M, LEAST_DEPTH_M, Completion
from sidelong.fusion.settings import EngineName, FusionSettings, RegistrationSettings
from sidelong.fusion.volume.settings import VolumeSettings
from sidelong.geometry.camera_model import LightProjector, PinholeCamera, StereoRig
from sidelong.geometry.transforms import rotation_about, transform
from sidelong.types import FloatArray, Frame, PixelState, Projector, View

SIZES = ((1, 1), (2, 3), (5, 4), (8, 8), (33, 20), (64, 48))
COARSE = VolumeSettings(region_m=((-0.2, -0.2, 0.3), (0.2, 0.2, 0.8)), voxel_m=5e-3, front_m=0.02, behind_m=0.02)


def any_rig(rng: np.random.Generator) -> StereoRig:
    width, height = SIZES[rng.integers(len(SIZES))]
    fx, fy = rng.choice([1.0, 50.0, 1e4], size=2)
    camera = PinholeCamera(width, height, float(fx), float(fy), width / 2, height / 2)
    return StereoRig(camera, camera, float(rng.choice([1e-3, 0.1, 2.0])), LightProjector(np.eye(4), 0.5, 0.5))


def any_depth(shape: tuple[int, int], rng: np.random.Generator) -> FloatArray:
    kinds = (
        np.full(shape, 0.5),
        rng.uniform(0.3, 1.0, shape),
        rng.uniform(0.49, 0.51, shape),
        np.full(shape, LARGEST_DEPTH_M),
        np.full(shape, LEAST_DEPTH_M),
        10.0 ** rng.uniform(-3, 2, shape),
        np.where(rng.random(shape) < 0.5, 0.5, 0.6),
    )
    depth_m = kinds[rng.integers(len(kinds))].copy()
    depth_m[rng.random(shape) < rng.choice([0.0, 0.3, 0.9])] = rng.choice([np.nan, 0.0, -1.0, np.inf, 1e38])
    return depth_m


def any_pose(rng: np.random.Generator) -> FloatArray:
    turn = rotation_about(rng.normal(size=3), float(rng.choice([0.0, 1e-6, 0.1, 3.0])))
    return transform(turn, rng.normal(size=3) * rng.choice([0.0, 1e-9, 0.01, 1.0, 1e3]))


@pytest.mark.parametrize("engine", EngineName)
@pytest.mark.parametrize("seed", range(60))
def test_whatever_comes_the_result_is_whole(seed: int, engine: EngineName) -> None:
    rng = np.random.default_rng(seed)
    rig = any_rig(rng)
    shape = (rig.left.height, rig.left.width)
    settings = FusionSettings(
        engine=engine,
        volume=COARSE,
        registration=RegistrationSettings() if rng.random() < 0.7 else None,
        least_agreement=float(rng.choice([0.0, 0.95])),
        max_views=int(rng.choice([2, 16])),
    )

    def frame(pose: FloatArray, depth_m: FloatArray) -> Frame:
        return Frame(View("v", pose), np.zeros(shape, dtype=np.uint8), None, depth_m, Projector.DOTS, 0.01)

    reference_m = any_depth(shape, rng)
    reference_m[0, 0] = 0.5
    completion = Completion(frame(np.eye(4), reference_m), rig, settings)
    for _ in range(4):
        fused = completion.add(frame(any_pose(rng), any_depth(shape, rng)))
        assert np.isfinite([fused.shift_m, fused.turn_rad, fused.sigma_shift_m, fused.sigma_turn_rad]).all()
        assert np.isfinite(fused.reference_T_view).all()
        assert fused.refused is None or fused.filled_px == 0
        depth = completion.depth
        told = depth.state != PixelState.MISSING
        np.testing.assert_array_equal(np.isfinite(depth.depth_m), told)
        assert (depth.depth_m[told] > 0).all()
        assert (depth.sigma_m[told] > 0).all()
        assert np.isfinite(depth.sigma_m[told]).all()
        kept = (depth.state == PixelState.MEASURED) | (depth.state == PixelState.CONTRADICTED)
        np.testing.assert_array_equal(depth.depth_m[kept], reference_m[kept])
        np.testing.assert_array_equal(kept, (reference_m >= LEAST_DEPTH_M) & (reference_m <= LARGEST_DEPTH_M))
