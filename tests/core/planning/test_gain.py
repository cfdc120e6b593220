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
from sidelong.physics.sensing import SensingSettings
from sidelong.planning.gain import LightModel, Planner
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
