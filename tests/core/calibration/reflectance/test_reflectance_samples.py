"""Samples from a capture: closed forms, what is dropped and why, a moved camera, the simulated cell."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sidelong.calibration.reflectance.fit import fit_reflectance
from sidelong.calibration.reflectance.registration import check_registration
from sidelong.calibration.reflectance.samples import (
    Exposed,
    ProjectorLight,
    SampleSettings,
    SprayedScene,
    reflectance_samples,
)
from sidelong.errors import CalibrationError
from sidelong.geometry.camera_model import LightProjector, PinholeCamera, StereoRig
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.transforms import look_at, transform
from sidelong.physics.reflectance import Phong, fall_off, radiance, vignetting
from sidelong.physics.response import Response
from sidelong.simulation.lighting import LightSettings
from sidelong.simulation.rig import rig_for
from sidelong.simulation.sensor import ActiveStereoSensor, SensorSettings
from sidelong.types import Projector

CAMERA = PinholeCamera(320, 256, 400.0, 400.0, 159.5, 127.5)
PROJECTOR = LightProjector(transform(np.eye(3), (0.05, 0.0, 0.0)), 0.6, 0.5)
RIG = StereoRig(CAMERA, CAMERA, 0.1, PROJECTOR)
LIGHT = ProjectorLight(intensity=30.0, fall_off=True, vignetting=1.5)
LINEAR = Response.gamma(1.0)
EXPOSURE_S = 0.01
TRUTH = Phong(0.2, 0.6, 15.0)
SPHERE_M, RADIUS_M = np.array([0.0, 0.0, 0.6]), 0.12


def sphere() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Depth, normals and mask of a ball before a wall at 0.9 m, by the quadratic formula."""
    rays = CAMERA.pixel_rays()
    a, b = np.square(rays).sum(axis=-1), rays @ SPHERE_M
    root = b**2 - a * (SPHERE_M @ SPHERE_M - RADIUS_M**2)
    ball = root > 0
    depth = np.where(ball, (b - np.sqrt(np.maximum(root, 0.0))) / a, 0.9)
    points = rays * depth[..., None]
    normals = np.where(ball[..., None], (points - SPHERE_M) / RADIUS_M, (0.0, 0.0, -1.0))
    return depth, normals, ball


def shading(points: np.ndarray, normals: np.ndarray, eye_m: np.ndarray, material: Phong) -> np.ndarray:
    to_light = PROJECTOR.left_T_projector[:3, 3] - points
    distance = np.linalg.norm(to_light, axis=-1)
    axial = -to_light[..., 2] / distance
    light = fall_off(LIGHT.intensity, distance) * vignetting(axial, LIGHT.vignetting)
    to_camera = eye_m - points
    to_camera = to_camera / np.linalg.norm(to_camera, axis=-1, keepdims=True)
    return radiance(light, (to_light / distance[..., None], to_camera), normals, material)


def grey(value: np.ndarray, exposure_s: float = EXPOSURE_S) -> np.ndarray:
    return np.rint(LINEAR.intensity(value, exposure_s)).astype(np.uint8)


@cache
def ball_scene() -> tuple[SprayedScene, Exposed]:
    depth, normals, ball = sphere()
    points = CAMERA.pixel_rays() * depth[..., None]
    left = grey(shading(points, normals, np.zeros(3), TRUTH))
    # what the right camera sees of the ball
    rays = CAMERA.pixel_rays()
    centre = SPHERE_M - (RIG.baseline_m, 0.0, 0.0)
    a, b = np.square(rays).sum(axis=-1), rays @ centre
    root = b**2 - a * (centre @ centre - RADIUS_M**2)
    seen = (rays * ((b - np.sqrt(np.maximum(root, 0.0))) / a)[..., None]) + (RIG.baseline_m, 0.0, 0.0)
    value = shading(seen, (seen - SPHERE_M) / RADIUS_M, np.array([RIG.baseline_m, 0.0, 0.0]), TRUTH)
    right = np.where(root > 0, grey(np.where(root > 0, value, 0.0)), 0).astype(np.uint8)
    sigma = np.full(depth.shape, 1e-4)
    return SprayedScene(depth, normals, sigma, np.where(ball, 3, -1)), Exposed(left, right, EXPOSURE_S)


def sampled(white: Exposed, scene: SprayedScene, **how: object) -> dict:
    return dict(reflectance_samples(white, scene, RIG, LINEAR, LIGHT, **how).materials)


def test_samples_follow_the_closed_form_for_both_eyes() -> None:
    scene, white = ball_scene()
    found = sampled(white, scene)
    assert list(found) == [3]
    each = found[3]
    measured = ~(each.samples.saturated | each.samples.dark)
    for right, eye in ((False, 0.0), (True, RIG.baseline_m)):
        chosen = (each.right == right) & measured & np.isfinite(each.samples.radiance)
        assert chosen.sum() > 2000
        rows, columns = each.pixels[chosen].T
        points = CAMERA.pixel_rays()[rows, columns] * scene.depth_m[rows, columns, None]
        exact = shading(points, scene.normals_camera[rows, columns], np.array([eye, 0.0, 0.0]), TRUTH)
        # half a grey level; the right image is read between its pixels, on a steep highlight
        assert np.median(np.abs(each.samples.radiance[chosen] - exact)) < 0.6 / 255 / EXPOSURE_S
        assert np.percentile(np.abs(each.samples.radiance[chosen] - exact), 99) < 2.5 / 255 / EXPOSURE_S
        to_light = PROJECTOR.left_T_projector[:3, 3] - points
        distance = np.linalg.norm(to_light, axis=1)
        assert each.samples.to_light[chosen] == pytest.approx(to_light / distance[:, None])
        light = LIGHT.intensity / distance**2 * (-to_light[:, 2] / distance) ** LIGHT.vignetting
        assert each.samples.light[chosen] == pytest.approx(light)
        assert each.samples.sigma[chosen] == pytest.approx(1.5 / 255 / EXPOSURE_S)
    assert each.samples.normal_sigma_rad == pytest.approx(1e-4 / np.sqrt(2.0))


def test_the_fit_of_the_ball_gives_back_its_reflectance() -> None:
    scene, white = ball_scene()
    fit = fit_reflectance(sampled(white, scene)[3].samples, sensor=(LINEAR, EXPOSURE_S))
    assert (fit.phong.k_d, fit.phong.k_s, fit.phong.n) == pytest.approx((0.2, 0.6, 15.0), rel=0.01)
    assert fit.residual_rms_grey is not None
    assert fit.residual_rms_grey < 1.0


def test_light_without_fall_off_or_vignetting_is_the_papers_constant() -> None:
    points = np.array([[0.0, 0.0, 0.5], [0.3, 0.1, 1.0], [0.0, 0.0, 0.0]])
    assert ProjectorLight(7.0, fall_off=False).incident(points)[:2] == pytest.approx([7.0, 7.0])
    assert ProjectorLight(7.0, fall_off=True).incident(points)[:2] == pytest.approx([28.0, 7.0 / 1.1])
    assert ProjectorLight(7.0, False, 2.0).incident(points)[1] == pytest.approx(7.0 / 1.1)
    assert ProjectorLight(7.0, True, 2.0).incident(points)[2] == 0.0
    for bad in ({"intensity": 0.0}, {"intensity": np.nan}, {"intensity": 1.0, "vignetting": -1.0}):
        with pytest.raises(CalibrationError, match="needs a"):
            ProjectorLight(**bad)


def test_the_room_is_subtracted() -> None:
    scene, _ = ball_scene()
    room = 20.0
    points = CAMERA.pixel_rays() * scene.depth_m[..., None]
    both = shading(points, scene.normals_camera, np.zeros(3), TRUTH) + room
    lit = Exposed(grey(both), None, EXPOSURE_S)
    off = Exposed(grey(np.full(both.shape, room), 0.04), None, 0.04)
    assert fit_reflectance(sampled(lit, scene)[3].samples).phong.k_d > 0.25
    fit = fit_reflectance(sampled(lit, scene, off=off)[3].samples)
    assert (fit.phong.k_d, fit.phong.k_s) == pytest.approx((0.2, 0.6), rel=0.02)
    blinded = Exposed(np.full(both.shape, 255, dtype=np.uint8), None, 0.04)
    assert np.isnan(sampled(lit, scene, off=blinded)[3].samples.radiance).all()


def test_saturated_and_dark_pixels_are_bounds() -> None:
    scene, white = ball_scene()
    left = white.left.copy()
    left[120:130, 150:160] = 255
    left[90:95, 140:150] = 1
    each = sampled(replace(white, left=left, right=None), scene)[3]
    rows, columns = each.pixels.T
    saturated = left[rows, columns] >= 254
    assert (each.samples.saturated == saturated).all()
    assert saturated.any()
    assert each.samples.radiance[saturated] == pytest.approx(254 / 255 / EXPOSURE_S)
    assert (each.samples.dark == (left[rows, columns] <= 3)).all()
    assert each.samples.radiance[each.samples.dark] == pytest.approx(3 / 255 / EXPOSURE_S)


def test_edges_holes_and_missing_normals_are_dropped_and_counted() -> None:
    scene, white = ball_scene()
    depth, normals = scene.depth_m.copy(), scene.normals_camera.copy()
    depth[100, 160] = np.nan
    normals[140:150, 150:160] = np.nan
    each = sampled(replace(white, right=None), replace(scene, depth_m=depth, normals_camera=normals))[3]
    assert each.dropped["no depth"] == 1
    assert each.dropped["no normal"] == 100
    assert each.dropped["edge"] > 48
    kept = np.zeros(depth.shape, dtype=bool)
    kept[each.pixels[:, 0], each.pixels[:, 1]] = True
    ball = scene.labels >= 0
    border = [ball & ~np.roll(ball, step, axis) for step in (-1, 1) for axis in (0, 1)]
    assert not (kept & np.any(border, axis=0)).any()
    assert not kept[97:104, 157:164].any()
    assert len(each.pixels) + sum(each.dropped.values()) == ball.sum()
    every = sampled(replace(white, right=None), scene, settings=SampleSettings(edge_px=0))[3]
    assert len(every.pixels) > len(sampled(replace(white, right=None), scene)[3].pixels)


def test_shadows_and_what_the_right_camera_misses_are_dropped() -> None:
    """The ball hides a strip of the wall from the projector, and a wider one from the right camera."""
    scene, white = ball_scene()
    wall = replace(scene, labels=np.where(scene.labels >= 0, -1, 0))
    points = CAMERA.pixel_rays() * scene.depth_m[..., None]
    flat = Exposed(np.full(white.left.shape, 90, dtype=np.uint8), np.full(white.left.shape, 90, dtype=np.uint8), 0.01)
    each = sampled(flat, wall)[0]

    def hidden(pixels: np.ndarray, eye: np.ndarray, radius: float) -> np.ndarray:
        target = points[pixels[:, 0], pixels[:, 1]]
        towards = target - eye
        along = np.clip(((SPHERE_M - eye) * towards).sum(axis=1) / np.square(towards).sum(axis=1), 0.0, 1.0)
        return np.linalg.norm(eye + along[:, None] * towards - SPHERE_M, axis=1) < radius

    source, right_eye = PROJECTOR.left_T_projector[:3, 3], np.array([RIG.baseline_m, 0.0, 0.0])
    left = each.pixels[~each.right]
    assert each.dropped["shadow"] > 200
    # the depth buffer holds what the left camera saw: the ball's side that only the projector sees is not in it
    assert hidden(left, source, 0.95 * RADIUS_M).sum() == 0
    assert hidden(each.pixels[each.right], right_eye, 0.9 * RADIUS_M).sum() == 0
    assert len(left) > each.right.sum() > 0.5 * len(left)
    # nothing is dropped for a shadow that is far from one
    shadowed = np.argwhere(wall.labels == 0)
    assert each.dropped["shadow"] < 1.3 * hidden(shadowed, source, RADIUS_M + 0.004).sum()


@pytest.mark.parametrize("shift", [(3, 0), (-3, 0), (0, 3), (5, -4), (11, 2)])
def test_a_camera_that_moved_between_the_scans_is_noticed(shift: tuple[int, int]) -> None:
    scene, white = ball_scene()
    moved = np.roll(white.left, shift[::-1], axis=(0, 1))
    with pytest.raises(CalibrationError, match=rf"moved by .* px \(best fit: u {shift[0]} px, v {shift[1]} px"):
        sampled(replace(white, left=moved), scene)


def test_parts_that_turned_between_the_scans_are_noticed() -> None:
    import cv2

    rng = np.random.default_rng(1)
    pixels = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width].astype(np.float64)
    bumps = sum(np.sin(pixels[0] / a + b) * np.sin(pixels[1] / c + d) for a, b, c, d in rng.uniform(4.0, 9.0, (6, 4)))
    cos_alpha = np.clip(0.85 + 0.05 * np.asarray(bumps), 0.0, 1.0)
    image = np.rint(255 * (0.05 + 0.9 * cos_alpha**20)).astype(np.uint8)
    labels = np.zeros(image.shape, dtype=np.intp)
    cosines = (np.ones(image.shape), cos_alpha)
    assert check_registration(image, cosines, labels, 2.0) is not None
    middle = ((CAMERA.width - 1) / 2, (CAMERA.height - 1) / 2)
    turned = cv2.warpAffine(
        image, cv2.getRotationMatrix2D(middle, 2.0, 1.0), image.shape[::-1], borderMode=cv2.BORDER_REFLECT
    )
    with pytest.raises(CalibrationError, match=r"best fit: u 0 px, v 0 px, turn -?[12]\.\d+ deg"):
        check_registration(turned, cosines, labels, 2.0)


def test_an_image_of_something_else_is_noticed() -> None:
    scene, white = ball_scene()
    noise = np.random.default_rng(0).integers(10, 200, white.left.shape).astype(np.uint8)
    with pytest.raises(CalibrationError, match="image and depth show different things"):
        sampled(replace(white, left=noise), scene)


def test_registration_says_when_it_could_not_tell() -> None:
    scene, white = ball_scene()
    good = reflectance_samples(white, scene, RIG, LINEAR, LIGHT)
    assert good.registration is not None
    assert (good.registration.shift_px, good.registration.moved_px) == ((0, 0), 0.0)
    assert good.registration.conclusive
    assert not any("could not be compared" in each for each in good.warnings)
    plain = replace(white, left=np.full(white.left.shape, 90, dtype=np.uint8))
    blank = reflectance_samples(plain, scene, RIG, LINEAR, LIGHT)
    assert blank.registration is None
    assert any("could not be compared" in each for each in blank.warnings)


def test_materials_are_kept_apart() -> None:
    scene, white = ball_scene()
    columns = np.arange(CAMERA.width)[None, :]
    labels = np.where(scene.labels < 0, -1, np.where(columns < 160, 0, 7))
    found = sampled(white, replace(scene, labels=labels))
    assert sorted(found) == [0, 7]
    for label, each in found.items():
        assert (labels[each.pixels[:, 0], each.pixels[:, 1]] == label).all()
    # the seam between them is an edge of both
    assert min(np.abs(each.pixels[:, 1] - 159.5).min() for each in found.values()) > 3


def test_neighbours_and_both_eyes_share_a_group() -> None:
    scene, white = ball_scene()
    each = sampled(white, scene)[3]
    tile = (each.pixels // 8) @ (40, 1)
    _, group = np.unique(each.samples.group, return_inverse=True)
    assert (group == np.unique(tile, return_inverse=True)[1]).all()


def test_captures_that_cannot_be_are_refused() -> None:
    scene, white = ball_scene()
    cases = [
        (replace(white, left=white.left[:-1]), scene, "white left: is 320x255 px, the camera has 320x256 px"),
        (replace(white, right=white.left[:, :-1]), scene, "white right: is 319x256 px"),
        (replace(white, exposure_s=0.0), scene, "white: its exposure is 0.0 s"),
        (white, replace(scene, labels=scene.labels[1:]), "labels: is 320x255 px"),
        (white, replace(scene, depth_m=scene.depth_m * np.nan), "0 pixels have both a material and depth"),
        (white, replace(scene, labels=np.full_like(scene.labels, -1)), "0 pixels have both"),
    ]
    for capture, sprayed, why in cases:
        with pytest.raises(CalibrationError, match=why):
            sampled(capture, sprayed)


def test_a_material_that_is_all_edge_has_no_entry() -> None:
    scene, white = ball_scene()
    labels = scene.labels.copy()
    labels[125:128, 158:161] = 9
    assert 9 not in sampled(white, replace(scene, labels=labels))


# the simulated cell: microfacets, blur, noise, 8 bits; nothing there knows Phong

KNEE = 1.5


def knee_response() -> Response:
    level = np.arange(256) / 255.0
    level[0] = 0.5 / 255
    return Response(np.log(level * KNEE / (1.0 + KNEE - level)))


def ball_part(material: str) -> Part:
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    return part_from_arrays("ball", np.array(mesh.vertices), np.array(mesh.faces), materials=(material,))


@pytest.mark.parametrize(
    ("material", "exposure_s", "width_px"),
    [("matte", 0.008, 320), ("stainless", 0.0005, 640), ("black_plastic", 0.02, 320)],
)
def test_the_simulated_camera_gives_consistent_reflectances(material: str, exposure_s: float, width_px: int) -> None:
    rig, base_T_camera = rig_for(width_px, width_px * 4 // 5), look_at((0.05, -0.02, 0.55), (0.03, 0.0, 0.03))
    settings = SensorSettings(light=LightSettings(projector_vignetting=2.0))
    sensor = ActiveStereoSensor(rig, [(ball_part(material), transform(np.eye(3), (0.0, 0.0, 0.05)))], settings)
    shot = sensor.capture(base_T_camera, Projector.WHITE, exposure_s, depth=False)
    dark = sensor.capture(base_T_camera, Projector.OFF, 0.1, depth=False)
    depth = sensor.true_depth_m(base_T_camera)
    points = rig.left.pixel_rays() * depth[..., None]
    centre = np.linalg.inv(base_T_camera) @ (0.0, 0.0, 0.05, 1.0)
    normals = (points - centre[:3]) / np.linalg.norm(points - centre[:3], axis=-1, keepdims=True)
    scene = SprayedScene(depth, normals, np.full(depth.shape, 2e-3), np.where(np.isfinite(depth), 0, -1))
    response, light = knee_response(), ProjectorLight(210.0, True, 2.0)
    found = reflectance_samples(
        Exposed(shot.left, shot.right, exposure_s), scene, rig, response, light, Exposed(dark.left, dark.right, 0.1)
    )
    fit = fit_reflectance(found.materials[0].samples, sensor=(response, exposure_s))
    if material == "matte":  # a Lambert surface of albedo 0.22 returns 0.22 / pi
        assert fit.phong.k_d == pytest.approx(0.22 / np.pi, rel=0.01)
        assert not fit.parameters["n"].identified
        assert fit.relative_misfit < 0.02
    elif material == "stainless":  # f0 / (4 pi alpha^2) at the mirror direction, which a Phong lobe rounds off
        assert 0.3 * 1.87 < fit.phong.k_s < 1.87
        assert 7.0 < fit.phong.n < 2.0 / 0.16**2
        assert fit.phong.k_d < 0.04
        assert fit.relative_misfit > 0.1
    else:
        assert fit.phong.k_d + fit.phong.k_s < 0.03
        assert not fit.absorbing
