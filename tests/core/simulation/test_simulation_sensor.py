"""The simulated camera measures matte surfaces, loses shiny ones as real cameras do, and repeats itself."""

import dataclasses

import numpy as np
import pytest

from sidelong.errors import UnknownNameError
from sidelong.geometry.mesh import part_from_arrays
from sidelong.geometry.transforms import look_at, rotation_about, transform
from sidelong.simulation.bin import Bin, fill_bin
from sidelong.simulation.exposure import ExposureSettings
from sidelong.simulation.lighting import Illumination, LightSettings, World
from sidelong.simulation.lofting import loft, rectangle_ring
from sidelong.simulation.parts import simulated_part
from sidelong.simulation.pattern import DotPatterns, PatternSettings
from sidelong.simulation.rig import rig_for
from sidelong.simulation.sensor import ActiveStereoSensor, SensorSettings
from sidelong.types import Projector

RIG = rig_for(320, 256)
EXPOSURE_S = 0.012
ABOVE = look_at((0.0, 0.0, 0.7), (0.0, 0.0, 0.0))
DARK_ROOM = LightSettings(dome=0.0, lamps=())


def plate(material, size_m=1.2, top_m=0.0):
    rings = [rectangle_ring(size_m, size_m, z) for z in (top_m - 0.01, top_m)]
    return part_from_arrays(f"{material} plate", *loft(rings), materials=(material,))


def sensor(*parts, rig=RIG, **settings):
    scene = [part if isinstance(part, tuple) else (part, np.eye(4)) for part in parts]
    return ActiveStereoSensor(rig, scene, SensorSettings(**settings))


def measured(sensor_, pose=ABOVE, exposure_s=EXPOSURE_S):
    return sensor_.capture(pose, Projector.DOTS, exposure_s, depth=True).depth_m


@pytest.fixture(scope="module")
def bin_of_fittings():
    part, bin_ = simulated_part("tube_fitting"), Bin()
    poses = fill_bin(part, 10, 1, np.eye(4), bin_)
    return sensor(bin_.part(), *((part, pose) for pose in poses), rig=rig_for(640, 512)), part, poses


@pytest.mark.parametrize("height_m", [0.6, 0.75, 0.9])
def test_a_matte_plate_is_measured_to_half_a_millimetre(height_m):
    camera = sensor(plate("matte"), rig=rig_for(640, 512))
    pose = look_at((0.1, 0.05, height_m), (0.0, 0.0, 0.0))
    depth_m, truth_m = measured(camera, pose), camera.true_depth_m(pose)
    assert np.isfinite(depth_m[20:-20, 20:400]).mean() > 0.95
    assert np.nanmedian(np.abs(depth_m - truth_m)) < 0.5e-3


def test_shiny_parts_lose_about_half_of_their_depth_and_more_where_they_are_clipped_or_dark(bin_of_fittings):
    camera, part, poses = bin_of_fittings
    lost, clipped, dark, between = [], [], [], []
    for eye in ((0.0, 0.0, 0.7), (0.3, 0.1, 0.6), (-0.2, 0.25, 0.65), (0.1, -0.3, 0.75)):
        pose = look_at(eye, (0.0, 0.0, 0.01))
        depth_m, truth_m = measured(camera, pose), camera.true_depth_m(pose)
        on_parts = np.abs(World([(part, each) for each in poses]).rays.render(camera.rig.left, pose).depth_m - truth_m)
        on_parts = on_parts < 1e-6
        white = camera.capture(pose, Projector.WHITE, EXPOSURE_S, depth=False).left
        missing = np.isnan(depth_m)
        lost.append(missing[on_parts].mean())
        clipped.extend(missing[on_parts & (white == 255)])
        dark.extend(missing[on_parts & (white < 24)])
        between.extend(missing[on_parts & (white >= 40) & (white < 64)])
    assert 0.3 < np.mean(lost) < 0.7
    assert np.mean(clipped) > np.mean(between) + 0.1
    assert np.mean(dark) > np.mean(between) + 0.2


def test_the_same_pose_and_request_give_the_same_capture(bin_of_fittings):
    camera, _, _ = bin_of_fittings
    pose = look_at((0.2, 0.0, 0.7), (0.0, 0.0, 0.0))
    first, second = (camera.capture(pose, Projector.DOTS, EXPOSURE_S, depth=True) for _ in range(2))
    assert np.array_equal(first.left, second.left)
    assert np.array_equal(first.right, second.right)
    assert np.array_equal(first.depth_m, second.depth_m, equal_nan=True)
    without_depth = camera.capture(pose, Projector.DOTS, EXPOSURE_S, depth=False)
    assert np.array_equal(first.left, without_depth.left)


def test_noise_differs_between_seeds_poses_and_sides():
    camera, other = (sensor(plate("matte"), noise_seed=seed) for seed in (0, 1))
    turned = ABOVE @ transform(rotation_about((0, 0, 1), np.pi), (0.0, 0.0, 0.0))
    here, there = (camera.capture(pose, Projector.OFF, 0.2, depth=False) for pose in (ABOVE, turned))
    assert not np.array_equal(here.left, there.left)
    assert not np.array_equal(here.left, here.right)
    assert not np.array_equal(here.left, other.capture(ABOVE, Projector.OFF, 0.2, depth=False).left)


def test_a_black_surface_gives_no_depth_where_a_matte_one_does():
    # from aside: straight above, even black plastic has a faint highlight to match
    aside = look_at((0.5, 0.0, 0.5), (0.0, 0.0, 0.0))
    black, matte = (
        measured(sensor(plate(material), light=DARK_ROOM), aside) for material in ("black_plastic", "matte")
    )
    assert np.isfinite(black).mean() < 0.02
    assert np.isfinite(matte).mean() > 0.4


@pytest.mark.parametrize("exposure_s", [1e-5, 2.0])
def test_too_short_and_too_long_exposures_lose_all_depth(exposure_s):
    camera = sensor(plate("matte"))
    assert np.isfinite(measured(camera)).mean() > 0.6
    assert np.isfinite(measured(camera, exposure_s=exposure_s)).mean() < 0.01


def test_brightness_rises_with_exposure_up_to_saturation():
    camera = sensor(plate("matte"))
    levels = [camera.capture(ABOVE, Projector.WHITE, t, False).left[100:150, 80:140].mean() for t in (1e-3, 1e-2, 1, 3)]
    assert levels == sorted(levels)
    assert levels[0] < 30
    assert levels[-1] == 255


def test_light_of_a_matte_plate_is_lambert_times_inverse_square():
    light = LightSettings(dome=0.0, lamps=(), projector_vignetting=0.0)
    world = World([(plate("matte"), np.eye(4))])
    for height_m in (0.5, 1.0):
        pose = look_at((0.0, 0.0, height_m), (0.0, 0.0, 0.0))
        source = pose @ RIG.projector.left_T_projector
        maps = Illumination(light, RIG.projector, source, world).maps(RIG.left, pose, projector_on=True)
        offset = source[:3, 3] - maps.points_base
        distance = np.linalg.norm(offset, axis=-1)
        expected = 0.22 / np.pi * light.projector_intensity * height_m / distance**3
        assert maps.direct[60:200, 40:160] == pytest.approx(expected[60:200, 40:160], rel=1e-4)
        assert (maps.bounced == 0).all()


def test_a_part_shadows_the_projector_and_outside_its_cone_it_is_dark():
    block = plate("matte", size_m=0.06, top_m=0.15)
    camera = sensor(plate("matte"), block, light=DARK_ROOM)
    image = camera.capture(ABOVE, Projector.WHITE, EXPOSURE_S, depth=False).left
    # seen from the left camera the projector stands to the right: the shadow lies to the left of the block
    block_edge = round(RIG.left.cx - 0.03 / 0.55 * RIG.left.fx)
    row = round(RIG.left.cy)
    assert image[row, block_edge - 4] <= 3
    assert image[row, block_edge - 25] > 40
    # the cone ends left of the image's right edge
    assert image[row, 317:].max() <= 3
    assert image[row, 290] > 20


def test_projector_off_shows_the_parts_against_the_bin(bin_of_fittings):
    camera, _, _ = bin_of_fittings
    image = camera.capture(ABOVE, Projector.OFF, 0.2, depth=False).left
    height_m = 0.7 - camera.true_depth_m(ABOVE)
    on_parts, on_floor = (height_m > 0.015) & (height_m < 0.025), np.abs(height_m) < 1e-4
    assert np.median(image[on_parts]) > np.median(image[on_floor]) + 10
    assert (image == 255).mean() < 0.01


def test_a_mirror_shows_the_light_of_the_surface_it_faces():
    # a steel wall beside a lit floor: seen from aside it mirrors the floor, which the projector lights
    wall = plate("stainless", size_m=0.2)
    upright = transform(rotation_about((0, 1, 0), np.pi / 2), (-0.1, 0.0, 0.1))
    world = World([(plate("matte"), np.eye(4)), (wall, upright)])
    pose = look_at((0.35, 0.0, 0.6), (-0.1, 0.0, 0.08))
    source = pose @ RIG.projector.left_T_projector
    maps = Illumination(DARK_ROOM, RIG.projector, source, world).maps(RIG.left, pose, projector_on=True)
    on_wall = np.abs(maps.points_base[..., 0] + 0.1) < 1e-5
    on_wall &= (maps.points_base[..., 2] > 0.02) & (maps.points_base[..., 2] < 0.15)
    assert on_wall.sum() > 500
    floor = maps.direct[~on_wall & (np.abs(maps.points_base[..., 2]) < 1e-5)]
    # F0 is 0.6: the floor's image in the wall is about that much as bright as the floor
    assert 0.4 * np.median(floor) < np.median(maps.bounced[on_wall]) < 1.0 * np.median(floor)


def test_patterns_are_one_slide_shifted():
    patterns = DotPatterns(PatternSettings(shifts_px=(0, 7)), RIG.projector)
    v, u = np.mgrid[100:200, 300:400].astype(np.float64)
    here = np.stack([u, v], axis=-1)
    assert np.allclose(patterns.sample(0, here + np.array([7.0, 0.0])), patterns.sample(1, here))
    assert patterns.slide.mean() == pytest.approx(patterns.mean, abs=0.01)
    assert patterns.sample(0, np.full((2, 2, 2), np.nan)).tolist() == [[0.0, 0.0], [0.0, 0.0]]


def test_nothing_in_view_is_black_and_without_depth():
    camera = sensor(plate("matte", size_m=0.1))
    away = look_at((0.0, 0.0, 0.7), (0.0, 0.0, 2.0))
    shot = camera.capture(away, Projector.DOTS, EXPOSURE_S, depth=True)
    assert shot.left.max() <= 5
    assert np.isnan(shot.depth_m).all()
    assert np.isnan(camera.true_depth_m(away)).all()


def test_blur_settings_reach_the_image():
    sharp, soft = (sensor(plate("matte"), exposure=ExposureSettings(blur_px=s)) for s in (0.0, 2.0))
    spread = [
        each.capture(ABOVE, Projector.DOTS, EXPOSURE_S, False).left[80:170, 60:150].std() for each in (sharp, soft)
    ]
    assert spread[1] < 0.6 * spread[0]


def test_an_unknown_material_is_refused():
    glass = dataclasses.replace(plate("matte"), materials=("glass",))
    with pytest.raises(UnknownNameError, match="simulated material: 'glass' is unknown"):
        sensor(glass)
