"""Equations (12) and (13) and what reaches a point, on scenes small enough to compute by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from sidelong.geometry.camera_model import LightProjector, PinholeCamera, StereoRig
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.transforms import invert, look_at, rotation_about, transform
from sidelong.physics.reflectance import Phong
from sidelong.physics.response import Response
from sidelong.physics.sensing import SensingCurve, SensingSettings
from sidelong.planning.gain import LightModel, Planner
from sidelong.planning.light import LightSettings, MaterialSettings
from sidelong.planning.prior import Belief, believe
from sidelong.types import DetectedObject, Hypothesis, View

CAMERA = PinholeCamera(160, 128, 150.0, 150.0, 79.5, 63.5)
MATTE = Phong(k_d=0.5, k_s=0.0, n=1.0)


def rig(baseline_m: float = 0.1) -> StereoRig:
    left_T_projector = transform(np.eye(3), (baseline_m / 2, 0.0, 0.0))
    return StereoRig(CAMERA, CAMERA, baseline_m, LightProjector(left_T_projector, 0.6, 0.6))


def box(size_m: tuple[float, float, float]) -> Part:
    mesh = trimesh.creation.box(size_m)
    return part_from_arrays("box", np.asarray(mesh.vertices), np.asarray(mesh.faces))


def light(material: Phong = MATTE, intensity: float = 50.0, **changes: object) -> LightModel:
    model = LightModel((material,), intensity, True, "all", 0.012, Response.gamma(), SensingSettings(z_min=1.0))
    return replace(model, **changes)


PLATE = box((0.08, 0.08, 0.01))
TOP = View("top", look_at((0.0, 0.0, 0.7), (0.0, 0.0, 0.0)))
EVERYWHERE = np.ones((CAMERA.height, CAMERA.width), dtype=np.bool_)


def detected(*base_T_objects: np.ndarray, probabilities: tuple[float, ...] | None = None) -> tuple[DetectedObject, ...]:
    camera_T_base = invert(TOP.base_T_camera)
    if probabilities is not None:  # one object, several hypotheses
        pairs = zip(base_T_objects, probabilities, strict=True)
        return (DetectedObject(tuple(Hypothesis(camera_T_base @ pose, 90.0, p) for pose, p in pairs)),)
    return tuple(DetectedObject((Hypothesis(camera_T_base @ pose, 90.0, 1.0),)) for pose in base_T_objects)


def belief_of(*poses: np.ndarray, part: Part = PLATE, probabilities: tuple[float, ...] | None = None) -> Belief:
    return believe(detected(*poses, probabilities=probabilities), part, CAMERA, TOP.base_T_camera, EVERYWHERE)


def at(x: float, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    return transform(np.eye(3), (x, y, z))


def test_prior_holds_depth_and_normal_of_the_model_at_the_missing_pixels() -> None:
    missing = EVERYWHERE.copy()
    missing[:, :80] = False
    belief = believe(detected(at(0.0)), PLATE, CAMERA, TOP.base_T_camera, missing)
    (prior,) = belief.priors
    assert (prior.pixels[:, 1] >= 80).all()
    np.testing.assert_allclose(prior.points_base[:, 2], 0.005, atol=1e-6)  # the upper face
    np.testing.assert_allclose(prior.normals_base, np.broadcast_to([0, 0, 1.0], prior.normals_base.shape), atol=1e-6)
    assert belief.target.sum() == len(prior.pixels)
    # the plate's half width covers 150 px * 0.04 / 0.695 = 8.63 px: columns 80 to 88, rows 55 to 72
    assert len(prior.pixels) == 9 * 18


def test_stride_keeps_the_sum_and_not_the_pixels() -> None:
    fine = believe(detected(at(0.0)), PLATE, CAMERA, TOP.base_T_camera, EVERYWHERE, stride_px=1).priors[0]
    coarse = believe(detected(at(0.0)), PLATE, CAMERA, TOP.base_T_camera, EVERYWHERE, stride_px=3).priors[0]
    assert coarse.weight == 9.0
    assert coarse.weight * len(coarse.pixels) == pytest.approx(fine.weight * len(fine.pixels), rel=0.15)


def test_an_object_behind_another_is_not_expected_to_show() -> None:
    belief = believe(detected(at(0, 0, 0), at(0, 0, 0.1)), PLATE, CAMERA, TOP.base_T_camera, EVERYWHERE)
    assert [len(prior.pixels) > 0 for prior in belief.priors] == [False, True]


def test_gain_of_a_matte_plate_is_the_closed_form_sum() -> None:
    planner = Planner(belief_of(at(0.0)), PLATE, rig(), light())
    score = planner.score(TOP, EVERYWHERE)
    (prior,) = belief_of(at(0.0)).priors
    projector = (TOP.base_T_camera @ rig().projector.left_T_projector)[:3, 3]
    to_light = projector - prior.points_base
    distance = np.linalg.norm(to_light, axis=1)
    radiance = 0.5 * 50.0 / distance**2 * (to_light[:, 2] / distance)
    expected = np.exp((255.0 * radiance * 0.012 - 255.0) / 100.0).sum()  # Lambert: left and right see the same
    # the response is a table: between two levels it is interpolated, 0.001 grey levels here
    assert score.gain_px == pytest.approx(expected, rel=1e-4)
    assert score.dropped is None


def test_gain_is_the_mean_over_hypotheses_weighted_by_their_probability() -> None:
    poses = at(0.0), transform(rotation_about((1, 0, 0), 0.3), (0, 0, 0))
    alone = [Planner(belief_of(pose), PLATE, rig(), light()).score(TOP, EVERYWHERE).gain_px for pose in poses]
    both = Planner(belief_of(*poses, probabilities=(0.7, 0.3)), PLATE, rig(), light()).score(TOP, EVERYWHERE)
    assert both.gain_px == pytest.approx(0.7 * alone[0] + 0.3 * alone[1], rel=1e-9)


def test_gain_counts_only_what_is_still_missing() -> None:
    planner = Planner(belief_of(at(0.0)), PLATE, rig(), light())
    rest = EVERYWHERE.copy()
    rest[:, :80] = False
    left, right = planner.score(TOP, EVERYWHERE & ~rest), planner.score(TOP, rest)
    assert left.gain_px + right.gain_px == pytest.approx(planner.score(TOP, EVERYWHERE).gain_px)
    assert planner.score(TOP, np.zeros_like(EVERYWHERE)).gain_px == 0.0


def test_rigid_motion_of_everything_changes_nothing() -> None:
    motion = transform(rotation_about((1, 2, 3), 0.7), (0.3, -0.2, 0.5))
    view = View("side", look_at((0.2, 0.1, 0.6), (0, 0, 0)))
    mirror = light(Phong(0.05, 0.7, 20.0))
    here = Planner(belief_of(at(0.0), at(0.1)), PLATE, rig(), mirror).score(view, EVERYWHERE)
    moved_belief = believe(detected(at(0.0), at(0.1)), PLATE, CAMERA, motion @ TOP.base_T_camera, EVERYWHERE)
    moved = Planner(moved_belief, PLATE, rig(), mirror).score(View("side", motion @ view.base_T_camera), EVERYWHERE)
    # rays are traced in float32: a pixel on an edge may fall either way
    assert moved.gain_px == pytest.approx(here.gain_px, rel=1e-2)


def test_a_wall_between_projector_and_plate_casts_a_shadow_the_cameras_do_not_share() -> None:
    """A small plate stands where only the ray to the projector passes."""
    projector = np.array([0.05, 0.0, 0.7])
    middle = at(*(0.5 * projector))
    small = box((0.012, 0.012, 0.012))
    belief = believe(detected(at(0.0), middle), small, CAMERA, TOP.base_T_camera, EVERYWHERE)
    lower = Belief(belief.priors[:1], belief.target, belief.surface_m, belief.base_T_objects)
    shadowed = Planner(lower, small, rig(), light()).score(TOP, EVERYWHERE)
    assert shadowed.gain_px == pytest.approx(0.0, abs=1.5)
    assert shadowed.lost_px["shadow"] > 3
    assert shadowed.lost_px["hidden"] == 0.0
    ignored = Planner(lower, small, rig(), light(shadows="self")).score(TOP, EVERYWHERE)
    assert ignored.lost_px["shadow"] == 0.0


def test_a_face_turned_away_is_hidden_or_in_its_own_shadow() -> None:
    below = View("below", look_at((0.0, 0.0, -0.7), (0.0, 0.0, 0.0)))
    score = Planner(belief_of(at(0.0)), PLATE, rig(), light()).score(below, EVERYWHERE)
    assert score.gain_px == 0.0
    assert score.lost_px["hidden"] + score.lost_px["shadow"] == pytest.approx(18 * 18)


def test_a_point_outside_one_image_or_the_cone_is_outside() -> None:
    aside = View("aside", look_at((0.0, 0.0, 0.7), (0.6, 0.0, 0.0)))
    score = Planner(belief_of(at(0.0)), PLATE, rig(), light()).score(aside, EVERYWHERE)
    assert score.lost_px["outside"] == pytest.approx(18 * 18)


@pytest.mark.parametrize(("intensity", "reason"), [(1e6, "saturated"), (1e-3, "dark")])
def test_too_much_or_too_little_light_is_named(intensity: float, reason: str) -> None:
    score = Planner(belief_of(at(0.0)), PLATE, rig(), light(intensity=intensity)).score(TOP, EVERYWHERE)
    assert score.gain_px == 0.0
    assert score.lost_px[reason] == pytest.approx(18 * 18)


def test_structured_light_needs_the_left_camera_only() -> None:
    far_right = rig(baseline_m=0.9)  # the right camera does not see the plate
    sensing = SensingSettings(z_min=1.0, stereo=False)
    one = Planner(belief_of(at(0.0)), PLATE, far_right, light(sensing=sensing)).score(TOP, EVERYWHERE)
    two = Planner(belief_of(at(0.0)), PLATE, far_right, light()).score(TOP, EVERYWHERE)
    assert one.gain_px > 0
    assert two.gain_px == 0.0


def test_nothing_detected_gives_no_gain() -> None:
    belief = believe((), PLATE, CAMERA, TOP.base_T_camera, EVERYWHERE)
    assert not belief.target.any()
    assert Planner(belief, PLATE, rig(), light()).score(TOP, EVERYWHERE).gain_px == 0.0


def test_a_camera_inside_a_part_sees_nothing_of_it() -> None:
    room = box((4.0, 4.0, 4.0))
    belief = believe(detected(at(0.0)), room, CAMERA, TOP.base_T_camera, EVERYWHERE)
    assert len(belief.priors[0].pixels) == 0


SIDE = View("side", look_at((0.3, 0.1, 0.6), (0.0, 0.0, 0.0)))
GRAZING = View("grazing", look_at((0.7, 0.0, 0.02), (0.0, 0.0, 0.0)))
CURVE = SensingSettings(curve=SensingCurve(log_exposure=(-3.0, -0.5, 0.0, 1.0), probability=(0.0, 0.7, 0.9, 0.3)))
MIRROR = Phong(0.05, 0.7, 20.0)


@pytest.mark.parametrize("view", [TOP, SIDE, GRAZING])
@pytest.mark.parametrize("sensing", [SensingSettings(z_min=60.0), CURVE])
def test_gain_and_losses_add_up_to_what_is_missing(view: View, sensing: SensingSettings) -> None:
    belief = belief_of(at(0.0), at(0.05, 0.03, 0.06))
    score = Planner(belief, PLATE, rig(), light(MIRROR, sensing=sensing)).score(view, EVERYWHERE)
    total = sum(prior.probability * prior.weight * len(prior.pixels) for prior in belief.priors)
    assert score.gain_px + sum(score.lost_px.values()) == pytest.approx(total)
    assert min(score.lost_px.values()) >= 0


def exposure_from_above(pixels: np.ndarray, intensity: float, power: float = 0.0) -> np.ndarray:
    """Lambert's law for the plate below the projector that looks straight down."""
    (prior,) = belief_of(at(0.0)).priors
    assert (prior.pixels == pixels).all()
    projector = (TOP.base_T_camera @ rig().projector.left_T_projector)[:3, 3]
    to_light = projector - prior.points_base
    distance = np.linalg.norm(to_light, axis=1)
    cosine = to_light[:, 2] / distance
    return 0.5 * intensity * cosine**power / distance**2 * cosine * 0.012


@pytest.mark.parametrize("intensity", [20.0, 200.0])
def test_a_prediction_holds_the_exposure_of_each_pixel_and_the_curves_probability(intensity: float) -> None:
    prediction = Planner(belief_of(at(0.0)), PLATE, rig(), light(intensity=intensity, sensing=CURVE)).predict(TOP)
    expected = exposure_from_above(prediction.pixels, intensity)
    np.testing.assert_allclose(prediction.exposure, np.stack([expected, expected], axis=1), rtol=1e-9)
    assert prediction.reached.all()
    assert CURVE.curve is not None
    at_x = CURVE.curve.at(expected)
    np.testing.assert_allclose(prediction.probability, np.where(at_x >= 0.54, at_x, 0.0), rtol=1e-9)
    assert (prediction.seen_at == prediction.pixels).all()
    np.testing.assert_allclose(prediction.depth_m, 0.695, atol=1e-6)


@pytest.mark.parametrize("view", [TOP, SIDE, GRAZING])
@pytest.mark.parametrize("sensing", [SensingSettings(z_min=30.0), CURVE])
def test_predictions_sum_up_to_the_gain(view: View, sensing: SensingSettings) -> None:
    poses = at(0.0), at(0.02, 0.01, 0.05)
    planner = Planner(belief_of(*poses, probabilities=(0.7, 0.3)), PLATE, rig(), light(MIRROR, sensing=sensing))
    prediction = planner.predict(view)
    score = planner.score(view, EVERYWHERE)
    assert prediction.weight @ prediction.probability == pytest.approx(score.gain_px)
    unreached = score.lost_px["outside"] + score.lost_px["hidden"] + score.lost_px["shadow"]
    # a dark point is counted as dark without asking what hides it
    assert unreached <= prediction.weight[~prediction.reached].sum() + 1e-9


def test_what_was_measured_is_depth_of_the_predicted_surface_and_of_nothing_else() -> None:
    prediction = Planner(belief_of(at(0.0)), PLATE, rig(), light()).predict(TOP)
    depth_m = np.full((CAMERA.height, CAMERA.width), np.nan)
    depth_m[:, 71:74] = 0.695 + 0.0029
    depth_m[:, 74:77] = 0.695 + 0.0031
    depth_m[:, 77:80] = 0.695 - 0.0029
    columns = prediction.pixels[:, 1]
    expected = ((columns >= 71) & (columns < 74)) | ((columns >= 77) & (columns < 80))
    assert (prediction.measured(depth_m) == expected).all()
    assert (prediction.measured(depth_m, tolerance_m=0.0032) == (columns < 80)).all()


def test_points_outside_the_image_are_not_measured_wherever_depth_is() -> None:
    aside = View("aside", look_at((0.0, 0.0, 0.7), (0.6, 0.0, 0.0)))
    prediction = Planner(belief_of(at(0.0)), PLATE, rig(), light()).predict(aside)
    assert not prediction.reached.any()
    assert (prediction.seen_at == -1).all()
    assert not prediction.measured(np.full((CAMERA.height, CAMERA.width), prediction.depth_m[0])).any()


def test_a_forecast_is_what_was_promised_beside_what_was_completed() -> None:
    planner = Planner(belief_of(at(0.0)), PLATE, rig(), light())
    missing, still_missing = EVERYWHERE.copy(), EVERYWHERE.copy()
    missing[:, :75] = False
    still_missing[:, :85] = False
    forecast = planner.forecast(TOP, missing, still_missing)
    assert forecast.weight @ forecast.probability == pytest.approx(planner.score(TOP, missing).gain_px)
    assert len(forecast.measured) == 14 * 18  # columns 75 to 88
    assert forecast.measured.sum() == 10 * 18


def test_without_a_belief_there_is_nothing_to_predict() -> None:
    belief = believe((), PLATE, CAMERA, TOP.base_T_camera, EVERYWHERE)
    planner = Planner(belief, PLATE, rig(), light(sensing=CURVE))
    prediction, forecast = planner.predict(TOP), planner.forecast(TOP, EVERYWHERE, EVERYWHERE)
    assert prediction.exposure.shape == (0, 2)
    assert prediction.measured(np.ones((CAMERA.height, CAMERA.width))).shape == (0,)
    assert len(forecast.probability) == len(forecast.measured) == 0
    assert sum(planner.score(TOP, EVERYWHERE).lost_px.values()) == 0.0


@pytest.mark.parametrize("power", [0.5, 4.0])
def test_off_its_axis_the_projector_is_weaker_by_the_cosine_to_a_power(power: float) -> None:
    planner = Planner(belief_of(at(0.0)), PLATE, rig(), light(vignetting=power))
    pixels, radiance = planner.left_radiance(TOP)
    # the projector looks straight down: the angle off its axis is the angle of incidence
    np.testing.assert_allclose(radiance * 0.012, exposure_from_above(pixels, 50.0, power), rtol=1e-9)
    np.testing.assert_allclose(planner.predict(TOP).exposure[:, 0], radiance * 0.012, rtol=1e-9)


def test_vignetting_follows_the_projector_where_it_is_turned() -> None:
    turned = LightProjector(transform(rotation_about((0, 1, 0), 0.3), (0.05, 0.0, 0.0)), 0.6, 0.6)
    askew = StereoRig(CAMERA, CAMERA, 0.1, turned)
    plain, weaker = (
        Planner(belief_of(at(0.0)), PLATE, askew, light(vignetting=power)).left_radiance(TOP)[1] for power in (0.0, 2.0)
    )
    (prior,) = belief_of(at(0.0)).priors
    in_projector = (invert(TOP.base_T_camera @ turned.left_T_projector) @ np.insert(prior.points_base, 3, 1.0, 1).T).T
    cosine = in_projector[:, 2] / np.linalg.norm(in_projector[:, :3], axis=1)
    np.testing.assert_allclose(weaker / plain, cosine**2, rtol=1e-9)


def test_a_material_that_gives_no_depth_is_dark_whatever_its_numbers() -> None:
    absorbing = MaterialSettings(k_d=0.5, k_s=0.0, n=1.0, absorbing=True)
    (reflectance,) = LightSettings(materials={"felt": absorbing}).reflectances(("felt",))
    score = Planner(belief_of(at(0.0)), PLATE, rig(), light(reflectance)).score(TOP, EVERYWHERE)
    assert score.gain_px == 0.0
    assert score.lost_px["dark"] == pytest.approx(18 * 18)
