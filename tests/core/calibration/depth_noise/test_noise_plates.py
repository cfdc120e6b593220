"""Noise from captures of a plate: known numbers are found within their intervals, and what is no plate is refused."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from noise_scene import FB, RIG, SIZE, TILTS, Plate, blurred, plane_px

from sidelong.calibration.depth_noise.plane import flat_surface
from sidelong.calibration.depth_noise.plates import noise_from_plates
from sidelong.errors import CalibrationError
from sidelong.geometry.mesh import part_from_arrays
from sidelong.geometry.transforms import rotation_about, transform
from sidelong.physics.depth_noise import DepthNoise
from sidelong.simulation.bin import Bin
from sidelong.simulation.heap import heap
from sidelong.simulation.lofting import loft, rectangle_ring
from sidelong.simulation.parts import simulated_part
from sidelong.simulation.rig import rig_for
from sidelong.simulation.sensor import ActiveStereoSensor, SensorSettings
from sidelong.types import FloatArray, Projector

LOUD = DepthNoise(
    disparity_px=0.1, slope_px=0.5, rim_px=0.6, rim_reach_px=2.0, outlier_share=4e-3, rim_outlier_share=0.06
)


@pytest.mark.parametrize("blur_px", [0.0, 1.2, 2.5])
@pytest.mark.parametrize(
    "noise",
    [
        LOUD,
        LOUD.model_copy(update={"disparity_px": 0.03, "slope_px": 0.3, "rim_px": 0.35, "rim_reach_px": 1.2}),
        LOUD.model_copy(update={"disparity_px": 0.25, "slope_px": 1.2, "rim_px": 0.9, "outlier_share": 0.02}),
    ],
    ids=["usual", "quiet", "loud"],
)
def test_known_numbers_are_found_within_their_intervals(noise: DepthNoise, blur_px: float) -> None:
    fit = noise_from_plates(Plate(noise, blur_px).captures(), RIG)
    for name, found in fit.parameters.items():
        truth = getattr(noise, name)
        # 95 % intervals of 54 numbers: the worst may be half as far again
        assert abs(found.value - truth) <= 1.5 * (found.high - found.value), name
        assert found.identified, name
        assert found.standard_error < 0.2 * truth, name
        assert getattr(fit.noise, name) == found.value
    assert fit.captures == len(TILTS)
    assert fit.noise.bend == DepthNoise().bend
    assert fit.warnings == ()


def test_the_order_of_captures_does_not_count() -> None:
    captures = {name: Plate(LOUD).capture(*TILTS[index], index) for index, name in enumerate("abc")}
    turned = dict(reversed(captures.items()))
    first, second = noise_from_plates(captures, RIG), noise_from_plates(turned, RIG)
    for name, found in first.parameters.items():
        assert second.parameters[name].value == pytest.approx(found.value, rel=1e-9), name


def test_one_tilt_does_not_tell_the_slope_and_says_so() -> None:
    fit = noise_from_plates({"DEPTH_0": Plate(LOUD).capture(*TILTS[0], 0)}, RIG)
    slope = fit.parameters["slope_px"]
    assert (slope.identified, slope.value, fit.noise.slope_px) == (False, DepthNoise().slope_px, DepthNoise().slope_px)
    assert slope.note == "default kept: gradients of disparity span 0 px per px, needs 0.1: tilt the plate more"
    assert fit.parameters["disparity_px"].value == pytest.approx(0.1, rel=0.05)
    assert any("number of captures: 1" in warning for warning in fit.warnings)


def test_a_plate_that_fills_the_image_does_not_tell_of_rims_and_says_so() -> None:
    plate = Plate(LOUD, dropout=0.0, behind=False, filling=True)
    fit = noise_from_plates({str(tilt): plate.capture(*tilt, 0) for tilt in (TILTS[0], TILTS[4])}, RIG)
    for name in ("rim_px", "rim_reach_px", "rim_outlier_share"):
        assert not fit.parameters[name].identified
        assert getattr(fit.noise, name) == getattr(DepthNoise(), name)
    assert "0 depths lie beside missing ones, needs 500" in fit.parameters["rim_px"].note
    assert fit.parameters["slope_px"].identified


def test_rims_cleaner_than_those_of_parts_do_not_make_fusion_bold() -> None:
    quiet = LOUD.model_copy(update={"rim_px": 0.1, "outlier_share": 1e-4, "rim_outlier_share": 1e-3})
    fit = noise_from_plates(Plate(quiet).captures(), RIG)
    for name in ("rim_px", "rim_reach_px", "outlier_share", "rim_outlier_share"):
        assert getattr(fit.noise, name) == getattr(DepthNoise(), name)
        assert fit.parameters[name].note.startswith("default kept")
    assert fit.parameters["rim_px"].low < 0.1 < fit.parameters["rim_px"].high


def test_a_plate_that_faces_the_camera_is_told_to_be_tilted() -> None:
    # as seen by the camera: faced, its disparity is the same everywhere
    fit = noise_from_plates({"faced": Plate(LOUD).capture(0.7, 0.0, 0.0, 3)}, RIG)
    assert any("over faced: errors that go with the fraction" in warning for warning in fit.warnings)


def test_of_two_flat_surfaces_close_to_each_other_only_one_is_taken() -> None:
    # the floor of a bin 3 mm above the table, 0.35 px of disparity at this size
    v, u = np.indices(SIZE)
    step_px = np.where((np.abs(u - 320) < 200) & (np.abs(v - 256) < 150), 0.35, 0.0)
    gap = (np.abs(np.abs(u - 320) - 200) < 6) & (np.abs(v - 256) < 156)
    gap |= (np.abs(np.abs(v - 256) - 150) < 6) & (np.abs(u - 320) < 206)
    truth_px = plane_px(0.7, 0.3, 0.5) + step_px
    depth_m = FB / np.where(gap, np.nan, truth_px + 0.05 * blurred(np.random.default_rng(0), 1.2))
    surface = flat_surface(depth_m, RIG, "two")
    steps = step_px[surface.pixels]
    assert max((steps == 0).mean(), (steps > 0).mean()) > 0.97
    assert surface.error_px[surface.pixels].std() == pytest.approx(0.05, rel=0.1)


# --- from the simulated plate to a simulated heap ---


def seen_from(sensor: ActiveStereoSensor, distance_m: float, tilt_rad: float) -> tuple[FloatArray, FloatArray]:
    """Return depth and truth (H, W) of what lies at the origin."""
    turn = np.diag([1.0, -1.0, -1.0]) @ rotation_about((1, 0.4, 0), tilt_rad)
    # the image's middle is right of the axis
    beside = turn @ np.array([0.24 * distance_m, 0.0, distance_m])
    pose = transform(turn, -beside)
    depth_m = sensor.capture(pose, Projector.DOTS, 0.012 * (distance_m / 0.7) ** 2, depth=True).depth_m
    assert depth_m is not None
    return depth_m, sensor.true_depth_m(pose)


def test_numbers_of_a_plate_are_honest_on_a_heap() -> None:
    rig = rig_for(640, 512)
    plate = part_from_arrays(
        "plate", *loft([rectangle_ring(0.24, 0.18, z) for z in (-0.01, 0.0)]), materials=("matte",)
    )
    sensor = ActiveStereoSensor(rig, [(plate, np.eye(4))], SensorSettings())
    views = ((0.6, 0.1), (0.7, 0.5), (0.75, 0.8), (0.6, -0.8))
    captures = {f"DEPTH_{index}": seen_from(sensor, *view)[0] for index, view in enumerate(views)}
    fit = noise_from_plates(captures, rig)
    assert fit.parameters["disparity_px"].identified
    assert fit.parameters["slope_px"].identified
    bin_, part = Bin(), simulated_part("tube_fitting")
    poses = heap(part, 12, 3, np.eye(4), bin_)
    scene = [(bin_.part(), np.eye(4)), *((part, pose) for pose in poses)]
    cell = ActiveStereoSensor(rig, scene, SensorSettings())
    for view in ((0.65, 0.1), (0.7, 0.4)):
        depth_m, truth_m = seen_from(cell, *view)
        ratio = (depth_m - truth_m) / fit.noise.sigma_m(depth_m, rig)
        ratio = ratio[np.isfinite(ratio)]
        assert 0.8 < ratio.std() < 1.25
        assert 0.92 < (np.abs(ratio) < 1.96).mean() < 0.98


# --- what is no plate ---


def flat(distance_m: float = 0.7) -> FloatArray:
    return Plate(LOUD).capture(distance_m, 0.3, 0.5, 0)


def sphere(radius_m: float) -> FloatArray:
    rays, centre = RIG.left.pixel_rays(), np.array([0.17, 0.0, 0.5 + radius_m])
    a, b = (rays**2).sum(axis=-1), rays @ centre
    under = b**2 - a * (centre @ centre - radius_m**2)
    depth_m = np.where(under > 0, (b - np.sqrt(np.maximum(under, 0.0))) / a, np.nan)
    return FB / (FB / depth_m + 0.05 * blurred(np.random.default_rng(0), 1.2))


def bowl(depth_px: float) -> FloatArray:
    """Return the depth of a plate that is pressed in."""
    v, u = np.indices(SIZE)
    dent_px = depth_px * (((u - 320) / 320) ** 2 + ((v - 256) / 256) ** 2)
    return FB / (plane_px(0.7, 0.3, 0.5) + dent_px + 0.05 * blurred(np.random.default_rng(0), 1.2))


def small(pixels: int) -> FloatArray:
    depth_m, shown = flat(), np.zeros(SIZE, dtype=np.bool_)
    shown[250 : 250 + pixels, 150 : 150 + pixels] = True
    return np.where(shown, depth_m, np.nan)


def patchy() -> FloatArray:
    """Return depth in squares of 4 px, each in a frame of missing ones."""
    v, u = np.indices(SIZE)
    depth_m = Plate(LOUD, dropout=0.0, filling=True).capture(0.7, 0.3, 0.5, 0)
    return np.where((u % 6 < 4) & (v % 6 < 4), depth_m, np.nan)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: np.full(SIZE, np.nan), r"it: 0 of 327680 px are measured, needs 2000"),
        (lambda: np.full(SIZE, -1.0), r"it: 0 of 327680 px are measured, needs 2000"),
        (lambda: np.full(SIZE, 0.7), r"it: the depth of its flat surface has no noise .*stored in steps"),
        (lambda: FB / plane_px(0.7, 0.3, 0.5), r"it: the depth of its flat surface has no noise"),
        (lambda: flat()[:256], r"it: the depth map is \(256, 640\), the camera has \(512, 640\) rows and columns"),
        (lambda: small(40), r"it: \d+ of 327680 px are measured, needs 2000"),
        (lambda: sphere(0.3), r"it: its flattest surface scatters by .* px of disparity about a plane, limit 1: show"),
        (lambda: bowl(1.0), r"it: its largest surface is bent by .*limit 50%: show a flat plate"),
        (lambda: np.random.default_rng(0).uniform(0.5, 1.0, SIZE), r"it: its flattest surface scatters by .*, limit 1"),
        (patchy, r"more than 2\.5 px from missing ones, needs 1000"),
    ],
    ids=["empty", "negative", "constant", "exact", "size", "small", "sphere", "bowl", "scatter", "patchy"],
)  # fmt: skip
def test_what_is_no_plate_is_refused_by_name(make: Callable[[], FloatArray], message: str) -> None:
    with pytest.raises(CalibrationError, match=message):
        noise_from_plates({"it": make()}, RIG)


def test_no_captures_and_copies_are_refused() -> None:
    with pytest.raises(CalibrationError, match="0 captures of a plate, needs at least 1"):
        noise_from_plates({}, RIG)
    depth_m = flat()
    with pytest.raises(CalibrationError, match="second: is the same as first to the last bit"):
        noise_from_plates({"first": depth_m, "second": depth_m.copy()}, RIG)
