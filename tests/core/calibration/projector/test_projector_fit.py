"""The projector from a matte plane: closed forms, what one distance cannot tell, planes that are none."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from scipy.stats import binom

from sidelong.calibration.projector.fit import ProjectorFit, fit_projector
from sidelong.calibration.projector.matte_plane import PlaneCapture, ProjectorFitSettings
from sidelong.calibration.reflectance.samples import ProjectorLight
from sidelong.errors import CalibrationError
from sidelong.geometry.camera_model import LightProjector, PinholeCamera, StereoRig
from sidelong.geometry.mesh import part_from_arrays
from sidelong.geometry.transforms import invert, look_at, rotation_about, transform, transform_points
from sidelong.physics.response import Response
from sidelong.simulation.lighting import LightSettings
from sidelong.simulation.rig import rig_for
from sidelong.simulation.sensor import ActiveStereoSensor, SensorSettings
from sidelong.types import Projector

CAMERA = PinholeCamera(160, 128, 150.0, 150.0, 79.5, 63.5)
PROJECTOR = LightProjector(transform(rotation_about((0, 1, 0), 0.05), (0.05, 0.0, 0.0)), 0.5, 0.42)
RIG = StereoRig(CAMERA, CAMERA, 0.1, PROJECTOR)
LINEAR = Response.gamma(1.0)
K_D, EXPOSURE_S = 0.7, 0.004


def plane(distance_m: float, tilt_rad: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Depth of a plane at a distance along the axis, tilted about the image's y axis; its normal."""
    normal = np.array([np.sin(tilt_rad), 0.0, -np.cos(tilt_rad)])
    return normal[2] * distance_m / (CAMERA.pixel_rays() @ normal), normal


Light = tuple[float, float, float]


def radiance_of(distance_m: float, light: Light, tilt_rad: float = 0.0, shine: float = 0.0) -> np.ndarray:
    """Radiance (H, W) of the plane under light of (intensity, vignetting, fall-off)."""
    intensity, p, q = light
    depth, normal = plane(distance_m, tilt_rad)
    points = CAMERA.pixel_rays() * depth[..., None]
    in_projector = transform_points(invert(PROJECTOR.left_T_projector), points)
    distance = np.linalg.norm(in_projector, axis=-1)
    to_light = (PROJECTOR.left_T_projector[:3, 3] - points) / distance[..., None]
    value = intensity * K_D * (to_light @ normal) * np.maximum(in_projector[..., 2] / distance, 0.0) ** p / distance**q
    half = to_light - points / np.linalg.norm(points, axis=-1, keepdims=True)
    cosine = half @ normal / np.linalg.norm(half, axis=-1)
    value = value * (1.0 + shine * np.maximum(2.0 * cosine**2 - 1.0, 0.0) ** 60)
    return np.where(PROJECTOR.lights(in_projector), value, 0.0)


def seen(
    distance_m: float,
    light: Light = (60.0, 1.5, 2.0),
    tilt_rad: float = 0.0,
    rng: np.random.Generator | None = None,
    room: float = 0.0,
    shine: float = 0.0,
    exposure_s: float = EXPOSURE_S,
) -> PlaneCapture:
    """A capture of the plane; with a generator noise of a grey level, and of 0.2 mm in depth."""
    depth, _ = plane(distance_m, tilt_rad)
    grey = LINEAR.intensity(radiance_of(distance_m, light, tilt_rad, shine) + room, exposure_s)
    if rng is not None:
        grey = np.clip(grey + rng.normal(size=grey.shape), 0, 255)
        depth = depth + 2e-4 * rng.normal(size=depth.shape)
    return PlaneCapture(f"at {distance_m} m", np.rint(grey).astype(np.uint8), exposure_s, depth)


def fit(*captures: PlaneCapture, k_d: float | None = K_D, **limits: float) -> ProjectorFit:
    return fit_projector(captures, RIG, LINEAR, k_d, ProjectorFitSettings.model_validate(limits))


@settings(max_examples=12)
@given(intensity=st.floats(40.0, 90.0), p=st.floats(0.0, 4.0), tilt=st.floats(-0.3, 0.3))
def test_light_comes_back_from_two_distances(intensity: float, p: float, tilt: float) -> None:
    found = fit(*(seen(each, (intensity, p, 2.0), tilt) for each in (0.7, 1.0)))
    assert found.intensity.value == pytest.approx(intensity, rel=4e-3)
    assert found.vignetting.value == pytest.approx(p, abs=0.04)
    assert found.fall_off_exponent.value == pytest.approx(2.0, abs=0.03)
    assert found.fall_off_exponent.identified
    assert found.intensity.identified
    assert found.relative_rms < 0.02
    assert found.plane_rms_m == pytest.approx((0.0, 0.0), abs=1e-6)


def test_the_fit_and_the_light_of_the_samples_are_the_same_formula() -> None:
    """What is fitted here is what incident light is made of there."""
    capture = seen(0.8, (60.0, 2.5, 2.0))
    light = ProjectorLight(60.0, True, 2.5)
    depth, normal = plane(0.8)
    points = CAMERA.pixel_rays() * depth[..., None]
    in_projector = transform_points(invert(PROJECTOR.left_T_projector), points)
    to_light = PROJECTOR.left_T_projector[:3, 3] - points
    cosine = to_light @ normal / np.linalg.norm(to_light, axis=-1)
    lit = PROJECTOR.lights(in_projector)
    expected = LINEAR.intensity(K_D * light.incident(in_projector) * cosine, EXPOSURE_S)
    assert capture.left[lit] == pytest.approx(expected[lit], abs=0.51)


def test_least_squares_of_scipy_on_grey_levels_agrees() -> None:
    captures = [seen(each, rng=np.random.default_rng(3)) for each in (0.7, 1.0)]
    found = fit(*captures)

    def residual(at: np.ndarray) -> np.ndarray:
        light = (float(at[0]), float(at[1]), float(at[2]))
        models = [255.0 * EXPOSURE_S * radiance_of(each, light) for each in (0.7, 1.0)]
        return np.concatenate(
            [(m - c.left)[(c.left > 10) & (c.left < 250)] for m, c in zip(models, captures, strict=True)]
        )

    brute = least_squares(residual, (50.0, 1.0, 1.8))
    assert found.vignetting.value == pytest.approx(brute.x[1], abs=0.05)
    assert found.fall_off_exponent.value == pytest.approx(brute.x[2], abs=0.05)


def test_one_plane_that_faces_the_projector_does_not_tell_fall_off_from_vignetting() -> None:
    one = fit(seen(0.8, (60.0, 1.5, 2.0)))
    exponent = one.fall_off_exponent
    assert not exponent.identified
    assert exponent.value == 2.0
    assert "differ by a factor of 1.00, needs 1.2" in exponent.note
    assert "act alike" in exponent.note
    assert one.vignetting.value == pytest.approx(1.5, abs=0.04)
    # indeed another pair of exponents leaves the same picture
    other = fit(seen(0.8, (60.0, 2.5, 1.0)))
    assert other.vignetting.value == pytest.approx(1.5, abs=0.15)
    # two distances tell
    pair = fit(*(seen(each, (60.0, 2.5, 1.0)) for each in (0.7, 1.0)))
    assert pair.fall_off_exponent.value == pytest.approx(1.0, abs=0.03)
    assert any("light falls as 1/d^1.0" in each for each in pair.warnings)
    assert pair.condition < one.condition


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    trials, held = 40, np.zeros(2)
    for seed in range(trials):
        rng = np.random.default_rng(seed)
        found = fit(seen(0.7, rng=rng), seen(1.0, rng=rng))
        pairs = ((found.vignetting, 1.5), (found.fall_off_exponent, 2.0))
        held += [each.low <= truth <= each.high for each, truth in pairs]
    assert held.min() >= binom.ppf(1e-4, trials, 0.95)


def test_intensity_without_the_planes_share_is_not_claimed() -> None:
    found = fit(seen(0.7), seen(1.0), k_d=None)
    assert found.intensity.value == pytest.approx(60.0 * K_D, rel=4e-3)
    assert not found.intensity.identified
    assert "intensity times share" in found.intensity.note


def test_a_narrow_view_does_not_fix_vignetting() -> None:
    capture = seen(0.8, rng=np.random.default_rng(0))
    mask = np.zeros(capture.left.shape, dtype=bool)
    mask[58:72, 82:96] = True
    found = fit(replace(capture, mask=mask), fewest_pixels=100)
    assert not found.vignetting.identified
    assert found.vignetting.low <= 1.5 <= found.vignetting.high
    assert "vignetting not identifiable" in found.vignetting.note


def test_light_that_rises_off_the_axis_is_reported_as_none() -> None:
    found = fit(*(seen(each, (40.0, -0.5, 2.0)) for each in (0.7, 1.0)))
    assert found.vignetting.value == 0.0
    assert found.vignetting.low == 0.0
    assert np.isfinite(found.intensity.standard_error)


def test_the_room_is_subtracted() -> None:
    lit = [seen(each, room=20.0) for each in (0.7, 1.0)]
    dark = np.rint(LINEAR.intensity(np.full(lit[0].left.shape, 20.0), 0.02)).astype(np.uint8)
    found = fit(*(replace(each, off=dark, off_exposure_s=0.02) for each in lit))
    assert found.intensity.value == pytest.approx(60.0, rel=0.01)
    assert found.fall_off_exponent.value == pytest.approx(2.0, abs=0.05)
    assert fit(*lit).fall_off_exponent.value < 1.7


def test_the_residual_map_shows_where_the_light_differs() -> None:
    capture = seen(0.8)
    dimmed = capture.left.astype(float)
    dimmed[60:70, 60:80] *= 0.8
    found = fit(replace(capture, left=np.rint(dimmed).astype(np.uint8)), most_pixels=20_000)
    inside = found.residual[0][60:70, 60:80]
    assert np.nanmedian(inside) == pytest.approx(np.log(0.8), abs=0.03)
    assert np.nanmedian(np.abs(found.residual[0])) < 0.01
    assert found.residual[0].shape == capture.left.shape


def test_surfaces_that_are_no_matte_plane_are_refused() -> None:
    capture = seen(0.8)
    bent = capture.depth_m + 0.02 * np.square((np.arange(160) - 80) / 80.0)[None, :]
    step = capture.depth_m - 0.03 * (np.arange(160) < 60)[None, :]
    for depth in (bent, step):
        with pytest.raises(
            CalibrationError, match=r"at 0\.8 m: its depth deviates from a plane by .* mm rms, limit 2\.00"
        ):
            fit(replace(capture, depth_m=depth))
    few_strays = np.where(np.random.default_rng(0).uniform(size=bent.shape) < 0.02, 0.5, capture.depth_m)
    assert fit(replace(capture, depth_m=few_strays)).vignetting.value == pytest.approx(1.5, abs=0.05)
    with pytest.raises(CalibrationError, match=r"matte plane: it shines, a highlight .* limit 5%"):
        fit(seen(0.8, shine=0.5))
    assert fit(seen(0.8, shine=0.01)).highlight < 0.03


def test_captures_that_cannot_be_used_are_refused_with_the_number() -> None:
    capture = seen(0.8)
    cases = [
        ((), K_D, "0 captures, needs at least 1"),
        ((seen(0.8, exposure_s=0.4),), K_D, "are at grey level 250 or above"),
        ((seen(0.8, exposure_s=1e-5),), K_D, "at 10 or below: change the exposure"),
        ((replace(capture, exposure_s=0.0),), K_D, "its exposure is 0.0 s"),
        ((replace(capture, depth_m=capture.depth_m * np.nan),), K_D, "0 pixels of the plane have depth, needs 500"),
        ((replace(capture, left=capture.left[1:]),), K_D, r"the image has shape \(127, 160\)"),
        ((replace(capture, off=capture.left[1:], off_exposure_s=1.0),), K_D, r"the off image has shape \(127, 160\)"),
        ((replace(capture, off=capture.left),), K_D, "the exposure of its off image is None s"),
        ((capture,), 0.0, "plane_k_d: is 0.0"),
        ((capture,), 1.5, "plane_k_d: is 1.5"),
        ((capture,), np.nan, "plane_k_d: is nan"),
    ]
    for captures, k_d, why in cases:
        with pytest.raises(CalibrationError, match=why):
            fit(*captures, k_d=k_d)


# the simulated cell


@cache
def simulated(height_m: float, material: str, exposure_s: float) -> PlaneCapture:
    import trimesh

    box = trimesh.creation.box((1.4, 1.4, 0.02))
    slab = part_from_arrays("slab", np.array(box.vertices) - (0, 0, 0.01), np.array(box.faces), materials=(material,))
    base_T_camera = look_at((0.02, 0.0, height_m), (0.05, 0.02, 0.0))
    light = LightSettings(projector_intensity=180.0, projector_vignetting=2.0)
    sensor = ActiveStereoSensor(rig_for(320, 256), [(slab, np.eye(4))], SensorSettings(light=light))
    white = sensor.capture(base_T_camera, Projector.WHITE, exposure_s, depth=False).left
    off = sensor.capture(base_T_camera, Projector.OFF, 0.1, depth=False).left
    return PlaneCapture(f"at {height_m} m", white, exposure_s, sensor.true_depth_m(base_T_camera), None, off, 0.1)


def knee_response() -> Response:
    level, knee = np.arange(256) / 255.0, 1.5
    level[0] = 0.5 / 255
    return Response(np.log(level * knee / (1.0 + knee - level)))


def test_the_simulated_projector_comes_back() -> None:
    captures = [simulated(each, "matte", 0.012) for each in (0.5, 0.8)]
    found = fit_projector(captures, rig_for(320, 256), knee_response(), 0.22 / np.pi)
    assert found.intensity.value == pytest.approx(180.0, rel=0.01)
    assert found.vignetting.value == pytest.approx(2.0, abs=0.05)
    assert found.fall_off_exponent.value == pytest.approx(2.0, abs=0.02)
    assert found.warnings == ()
    wrong = fit_projector(captures, rig_for(320, 256), LINEAR, 0.22 / np.pi)
    assert any("check the response" in each for each in wrong.warnings)


def test_a_simulated_sheet_of_metal_is_no_matte_plane() -> None:
    with pytest.raises(CalibrationError, match="it shines"):
        fit_projector([simulated(0.6, "plated", 0.001)], rig_for(320, 256), knee_response(), 0.5)
