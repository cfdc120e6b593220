"""Noise from repeated shots: what changes is found, what does not cannot be, and what moved is refused."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from noise_scene import FB, RIG, SIZE, blurred, plane_px

from sidelong.calibration.depth_noise.repeats import noise_from_repeats
from sidelong.errors import CalibrationError
from sidelong.physics.depth_noise import DepthNoise
from sidelong.types import FloatArray

SHOTS = 8


def hill_px() -> FloatArray:
    """Return the disparity (H, W) of a scene with slopes from 0 to 0.4 px per px, and a gap."""
    v, u = np.indices(SIZE)
    scene_px = plane_px(0.7, 0.0, 0.0) + 0.2 * 80 * np.sin(u / 40) / 2 + 0.0 * v
    scene_px[200:212] = np.nan
    return scene_px


def shots(
    noise_px: float, slope_px: float = 0.0, fixed_px: float = 0.0, jumps: float = 0.0, count: int = SHOTS
) -> dict[str, FloatArray]:
    """Return shots whose noise changes, on top of errors that do not."""
    random, scene_px = np.random.default_rng(5), hill_px()
    scene_px = scene_px + fixed_px * blurred(random, 1.1)
    gradient = np.nan_to_num(np.hypot(*np.gradient(hill_px())))
    sigma_px = np.hypot(noise_px, slope_px * gradient)
    found: dict[str, FloatArray] = {}
    for index in range(count):
        off_px = np.where(random.random(SIZE) < jumps, 20.0, sigma_px * blurred(random, 1.2))
        found[f"DEPTH_{index}"] = FB / (scene_px + off_px)
    return found


@pytest.mark.parametrize("noise_px", [0.05, 0.2])
def test_what_changes_from_shot_to_shot_is_found(noise_px: float) -> None:
    fit = noise_from_repeats(shots(noise_px, slope_px=0.5, jumps=5e-3), RIG)
    at = fit.parameters
    disparity_px = at["disparity_px"]
    assert disparity_px.high - disparity_px.low < 0.3 * noise_px
    assert disparity_px.low < noise_px < disparity_px.high
    # the gradients of a noisy map are too steep
    assert at["slope_px"].value == pytest.approx(0.5, rel=0.2)
    assert at["outlier_share"].value == pytest.approx(5e-3, rel=0.2)
    assert fit.captures == SHOTS
    assert any("a lower bound" in warning for warning in fit.warnings)


def test_noise_that_stays_leaves_the_number_to_each_map() -> None:
    fit = noise_from_repeats(shots(0.01, fixed_px=0.06), RIG)
    found = fit.parameters["disparity_px"]
    assert not found.identified
    assert found.low < 0.01 < found.high
    assert found.value == pytest.approx(0.06, rel=0.3)
    assert "they differ by 0.01 px only" in found.note
    assert fit.noise.disparity_px is None
    assert fit.noise.slope_px == DepthNoise().slope_px


def test_a_camera_that_warms_up_is_told() -> None:
    drifting = {name: FB / (FB / depth_m + 0.05 * index) for index, (name, depth_m) in enumerate(shots(0.05).items())}
    fit = noise_from_repeats(drifting, RIG)
    assert any(warning.startswith("depth drifts by 0.1") for warning in fit.warnings)


def few() -> dict[str, FloatArray]:
    return shots(0.05, count=4)


def moved() -> dict[str, FloatArray]:
    found = shots(0.05)
    return found | {"DEPTH_3": np.roll(found["DEPTH_3"], 40, axis=1)}


def copied() -> dict[str, FloatArray]:
    found = shots(0.05)
    return found | {"DEPTH_6": found["DEPTH_1"].copy()}


def of_another_size() -> dict[str, FloatArray]:
    found = shots(0.05)
    return found | {"DEPTH_2": found["DEPTH_2"][:-1]}


def stored_in_steps() -> dict[str, FloatArray]:
    found = shots(1e-4)
    return {name: np.round(depth_m, 3) + (np.indices(SIZE)[0] == row) * 1e-3
            for row, (name, depth_m) in enumerate(found.items())}  # fmt: skip


def empty() -> dict[str, FloatArray]:
    return {name: np.where(np.indices(SIZE)[0] % 64 == index, depth_m, np.nan)
            for index, (name, depth_m) in enumerate(shots(0.05).items())}  # fmt: skip


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (dict, r"0 shots of the scene, limits 5 to 40"),
        (few, r"4 shots of the scene, limits 5 to 40"),
        (moved, r"DEPTH_3: half of its depths are .* px of disparity off .*the scene or the camera moved"),
        (copied, r"DEPTH_6: is the same as DEPTH_1 to the last bit"),
        (of_another_size, r"DEPTH_2: the depth map is \(511, 640\), the camera has \(512, 640\)"),
        (stored_in_steps, r"half of the depths are the same in all shots"),
        (empty, r"0 px are measured in 80% of the shots, needs 5000"),
    ],
)
def test_what_are_no_repeats_of_one_scene_is_refused(make: Callable[[], dict[str, FloatArray]], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        noise_from_repeats(make(), RIG)
