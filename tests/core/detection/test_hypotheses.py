"""Verified poses become objects: what is right is probable, what is flipped is kept, what is nothing is said to be."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from detection_scene import CAMERA, bracket, photograph, true_poses

from sidelong.detection.detector import TemplateDetector
from sidelong.detection.emptiness import is_empty
from sidelong.detection.half_turns import half_turns
from sidelong.detection.objects import ObjectBuilder, occupied, shared
from sidelong.detection.plausibility import log_odds, probability
from sidelong.detection.proposals import Starts, poses_on_rays
from sidelong.detection.report import NothingFound
from sidelong.detection.settings import DetectionSettings
from sidelong.detection.verification import Evidence, Verified, Verifier
from sidelong.geometry.raycast import RayScene
from sidelong.geometry.transforms import rotation_about, rotation_angle, transform
from sidelong.types import FloatArray

SETTINGS = DetectionSettings(view_step_deg=30, roll_step_deg=20, distance_m=(0.65, 0.75), span_px=48)
PART = bracket()
ANYWHERE_M = (0.3, 1.5)


def starts_at(poses: list[FloatArray]) -> Starts:
    return Starts(np.stack(poses), np.tile(ANYWHERE_M, (len(poses), 1)))


def measured_m() -> FloatArray:
    seen = RayScene([(PART, pose) for pose in true_poses()]).render(CAMERA, np.eye(4)).depth_m
    return np.where(np.isfinite(seen), seen, 0.76)


def verified(starts: Starts, depth_m: FloatArray | None) -> Verified:
    evidence = Evidence(photograph(PART, true_poses(), CAMERA), depth_m)
    return Verifier(PART, CAMERA, SETTINGS).verify(starts, evidence)


@pytest.mark.parametrize("depth_m", [None, measured_m()], ids=["image alone", "with depth"])
def test_the_right_pose_is_more_probable_than_any_half_turn_and_than_bare_ground(depth_m: FloatArray | None):
    truth = true_poses()[0]
    nothing = transform(truth[:3, :3], (0.0, 0.1, 0.7))
    found = verified(starts_at([truth, *(truth @ half_turns(PART)), nothing]), depth_m)
    assert found.log_odds[0] == max(found.log_odds)
    assert probability(found.log_odds[0]) > 0.2
    assert probability(found.log_odds[-1]) < 0.05


def test_depth_brings_tilts_back_that_contours_hardly_see():
    truth = true_poses()[0]
    tilted = [transform(rotation_about(axis, np.radians(6)) @ truth[:3, :3], truth[:3, 3]) for axis in np.eye(3)[:2]]
    turns = [
        [
            np.degrees(rotation_angle(pose[:3, :3].T @ truth[:3, :3]))
            for pose in verified(starts_at(tilted), depth).poses
        ]
        for depth in (None, measured_m())
    ]
    assert max(turns[1]) < 1.5
    assert max(turns[1]) < max(turns[0])


def test_missing_and_senseless_starts_give_numbers():
    truth = true_poses()[0]
    senseless = [transform(truth[:3, :3], place) for place in ((0, 0, -0.7), (3.0, 0, 0.7), (0, 0, 0.02), (0, 0, 40.0))]
    for depth_m in (None, measured_m(), np.full_like(measured_m(), np.nan)):
        found = verified(starts_at([truth, *senseless]), depth_m)
        assert np.isfinite(found.poses).all()
        assert np.isfinite(found.log_odds).all()
    assert len(verified(Starts.joined([]), None).poses) == 0


def test_log_odds_and_probability_are_inverse():
    odds = np.array([-800.0, -2.0, 0.0, np.log(3.0), 800.0])
    np.testing.assert_allclose(probability(odds), [0.0, 1 / (1 + np.exp(2.0)), 0.5, 0.75, 1.0], atol=1e-15)
    one, zero = np.ones(1), np.zeros(1)
    features = {"silhouette": one, "crease": one, "around": one, "inside": one, "facing": zero}
    depth = {"fits": one, "behind": zero, "before": zero, "flush": zero}
    looked_through = {**depth, "fits": zero, "behind": one}
    assert log_odds({**features, **depth})[0] > log_odds({**features, **looked_through})[0]


def made_up(poses: list[FloatArray], log_odds: list[float]) -> Verified:
    surface = np.stack(np.meshgrid(np.arange(30.0), np.arange(30.0)), axis=-1).reshape(-1, 2)
    silhouettes = tuple(
        np.column_stack([surface - 15 + CAMERA.project(pose[:3, :3] @ PART.centre_m + pose[:3, 3]), np.full(900, 0.7)])
        for pose in poses
    )
    return Verified(np.stack(poses), np.array(log_odds), np.zeros(len(poses)), silhouettes)


def test_neighbours_are_objects_of_their_own_and_alternatives_belong_to_the_nearest():
    left, right = (transform(np.eye(3), (x, 0.0, 0.7)) for x in (-0.03, 0.03))
    flipped = right @ transform(rotation_about((0, 0, 1), np.pi), np.zeros(3))
    again = transform(rotation_about((0, 0, 1), np.radians(5)), right[:3, 3])
    found = made_up([left, right, flipped, again], [2.0, 1.0, 0.8, 0.9])
    objects = ObjectBuilder(PART, CAMERA, SETTINGS).build(found)
    assert [len(each.hypotheses) for each in objects] == [1, 2]
    best, other = objects[1].hypotheses
    np.testing.assert_array_equal(best.camera_T_object, right)
    assert best.probability / other.probability == pytest.approx(np.exp(0.2 / SETTINGS.temperature))
    assert best.score == pytest.approx(100 / (1 + np.exp(-1.0)))


def test_parts_across_each_other_are_two_where_depth_tells_and_a_surface_taken_twice_is_one():
    (u, v), across = np.meshgrid(np.arange(60.0), np.arange(20.0)), 0.65
    lying = np.column_stack([u.ravel(), v.ravel() + 20, np.full(u.size, 0.70)])
    upright = np.column_stack([v.ravel() + 20, u.ravel(), np.full(u.size, across)])
    cells = [occupied(surface, 5.0) for surface in (lying, upright)]
    assert [len(each) for each in cells] == [48, 48]
    assert shared(*cells, like_m=0.01) == 0.0
    assert shared(*cells, like_m=0.06) == pytest.approx(16 / 48)
    assert shared(cells[0], cells[0], like_m=0.01) == 1.0
    pose = transform(np.eye(3), (0.0, 0.0, 0.7))
    aside = transform(np.eye(3), (0.03, 0.0, 0.7))
    counts = []
    for depth_m, fits in ((0.70, 0.5), (0.66, 0.5), (0.66, 0.0)):
        other = np.column_stack([lying[:, :2], np.full(len(lying), depth_m)])
        found = Verified(np.stack([pose, aside]), np.array([2.0, 1.0]), np.array([0.5, fits]), (lying, other))
        counts.append(len(ObjectBuilder(PART, CAMERA, SETTINGS).seeds(found)))
    assert counts == [1, 2, 1]  # what was measured on neither or one of them does not tell the two apart


def test_improbable_hypotheses_are_dropped_and_the_rest_sums_to_one():
    pose = true_poses()[0]
    centre = transform(np.eye(3), PART.centre_m)
    turned = [pose @ centre @ transform(rotation_about((0, 0, 1), a), -rotation_about((0, 0, 1), a) @ PART.centre_m)
              for a in (0.0, 1.0, 2.0)]  # fmt: skip
    (found,) = ObjectBuilder(PART, CAMERA, SETTINGS).build(made_up(turned, [3.0, 2.9, -20.0]))
    assert len(found.hypotheses) == 2
    assert sum(each.probability for each in found.hypotheses) == pytest.approx(1.0)


def test_the_visible_fraction_is_what_the_part_in_front_leaves():
    behind = transform(np.eye(3), (0.0, 0.0, 0.72))
    before = transform(np.eye(3), (0.03, 0.0, 0.66))
    verifier = Verifier(PART, CAMERA, SETTINGS)
    looks = [verifier._appearance.look(pose[None]) for pose in (behind, before)]
    surfaces = tuple(np.column_stack([look.uv[0], look.depth_m[0]])[look.covered[0]] for look in looks)
    found = Verified(np.stack([behind, before]), np.array([2.0, 1.0]), np.zeros(2), surfaces)
    shares = ObjectBuilder(PART, CAMERA, SETTINGS).visible_fractions(found)
    both = RayScene([(PART, behind), (PART, before)]).render(CAMERA, np.eye(4)).instance
    alone = RayScene([(PART, behind)]).render(CAMERA, np.eye(4)).instance
    assert shares[1] == 1.0
    assert shares[0] == pytest.approx((both == 0).sum() / (alone == 0).sum(), abs=0.05)


def test_half_turns_leave_out_those_of_the_symmetry():
    turns = half_turns(PART)
    assert 1 <= len(turns) <= 3
    for turn in turns:
        assert rotation_angle(turn[:3, :3]) == pytest.approx(np.pi)
        np.testing.assert_allclose(turn[:3, :3] @ PART.centre_m + turn[:3, 3], PART.centre_m, atol=1e-12)


def test_poses_on_rays_project_to_their_pixels_and_turn_with_the_ray():
    uv = np.array([[40.0, 200.0], [CAMERA.cx, CAMERA.cy], [300.0, 10.0]])
    centre_m, rotation = np.array([0.01, -0.02, 0.005]), rotation_about((1, 2, 3), 0.4)
    poses = poses_on_rays(uv, CAMERA, np.stack([rotation] * 3), np.full(3, 0.7), centre_m)
    np.testing.assert_allclose(CAMERA.project(poses[:, :3, :3] @ centre_m + poses[:, :3, 3]), uv, atol=1e-9)
    np.testing.assert_allclose(poses[1, :3, :3], rotation, atol=1e-12)
    rays = CAMERA.rays(uv[:, 0], uv[:, 1])
    for pose, ray in zip(poses, rays, strict=True):
        # seen along its ray, the part looks as the template did along the axis
        np.testing.assert_allclose(pose[:3, :3].T @ (ray / np.linalg.norm(ray)), rotation.T @ (0, 0, 1), atol=1e-12)


def _bin_m(with_part: bool) -> FloatArray:
    """Depth of a floor, walls seen from above, and perhaps a part on the floor."""
    u, v = np.meshgrid(np.arange(CAMERA.width), np.arange(CAMERA.height))
    depth_m = np.where((np.abs(u - 160) < 110) & (np.abs(v - 128) < 90), 0.75, 0.80)
    rim = (np.abs(u - 160) < 115) & (np.abs(v - 128) < 95) & (depth_m == 0.80)
    depth_m = np.where(rim, 0.70, depth_m) + np.random.default_rng(0).normal(0, 2e-4, depth_m.shape)
    part_m = RayScene([(PART, true_poses()[0])]).render(CAMERA, np.eye(4)).depth_m
    return np.where(np.isfinite(part_m), part_m, depth_m) if with_part else depth_m


def test_depth_tells_an_empty_bin_from_one_that_is_not():
    image = photograph(PART, true_poses(), CAMERA)
    assert is_empty(image, _bin_m(with_part=False), CAMERA, PART.diameter_m, 0.7)
    assert not is_empty(image, _bin_m(with_part=True), CAMERA, PART.diameter_m, 0.7)


def test_without_depth_only_an_image_without_edges_is_empty():
    noise = np.random.default_rng(1).poisson(40, (CAMERA.height, CAMERA.width)).astype(np.uint8)
    for depth_m in (None, np.full(noise.shape, np.nan)):
        assert is_empty(noise, depth_m, CAMERA, PART.diameter_m, 0.7)
        assert not is_empty(photograph(PART, true_poses(), CAMERA), depth_m, CAMERA, PART.diameter_m, 0.7)


@pytest.fixture(scope="module")
def detector(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TemplateDetector]:
    with TemplateDetector(PART, CAMERA, SETTINGS, tmp_path_factory.mktemp("templates")) as made:
        yield made


def test_the_report_says_why_there_is_nothing(detector: TemplateDetector):
    blank = np.full((CAMERA.height, CAMERA.width), 20, dtype=np.uint8)
    assert detector.detect(blank) == ()
    assert detector.last_report is not None
    assert detector.last_report.nothing_found is NothingFound.EMPTY_SCENE
    step = blank.copy()
    step[:, 160:] = 200
    assert detector.detect(step) == ()
    assert detector.last_report.nothing_found in (NothingFound.NO_MATCH, NothingFound.NONE_VERIFIED)
    assert len(detector.detect(photograph(PART, true_poses(), CAMERA))) == 2
    assert detector.last_report.nothing_found is None
