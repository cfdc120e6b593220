"""Refinement of hypotheses: which pose wins, by how much, and what views without depth may not change."""

from __future__ import annotations

import gc
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from depth_scene import CAMERA, average_distance_m, displaced, disturbed, error_twist, measured
from detection_scene import bracket

from sidelong.detection.appearance import Look
from sidelong.detection.depth_likelihood import log_likelihood_ratio
from sidelong.detection.refinement import DepthView, Refiner
from sidelong.detection.refinement_settings import RefinementSettings
from sidelong.errors import ImageError, PoseError
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.transforms import invert, look_at, rotation_about, transform
from sidelong.types import DetectedObject, FloatArray, Hypothesis

POSE = transform(rotation_about((0.3, 1.0, 0.2), 0.9) @ rotation_about((1, 0, 0), 2.4), (0.01, -0.005, 0.45))
UNKNOWN = np.full((CAMERA.height, CAMERA.width), np.nan)


@pytest.fixture(scope="module")
def part() -> Part:
    return bracket()


def seen_from(name: str, part: Part, camera: FloatArray, seed: int = 0, outliers: float = 0.0) -> DepthView:
    depth_m = measured(part, [POSE], np.random.default_rng(seed), camera, outliers=outliers)
    return DepthView(name, depth_m, camera)


def beside(angle_rad: float) -> FloatArray:
    """A camera at the same distance from the part, turned about the vertical of the image."""
    eye = POSE[:3, 3] + 0.45 * np.array([np.sin(angle_rad), 0.0, -np.cos(angle_rad)])
    return look_at(eye, POSE[:3, 3])


def refiner(part: Part, *views: DepthView, **settings: float) -> Refiner:
    made = Refiner(part, CAMERA, RefinementSettings(**settings))
    for view in views:
        made.add(view)
    return made


def detected(*poses: FloatArray, probabilities: tuple[float, ...] | None = None) -> DetectedObject:
    shares = probabilities or (1 / len(poses),) * len(poses)
    return DetectedObject(tuple(Hypothesis(pose, 70.0, share) for pose, share in zip(poses, shares, strict=True)))


def decoys(part: Part) -> list[FloatArray]:
    """The part turned end for end, on its side and upside down."""
    return [displaced(POSE, part, POSE[:3, :3] @ (np.pi * axis), np.zeros(3)) for axis in np.eye(3)]


class TestPoses:
    def test_the_right_hypothesis_wins_and_is_exact(self, part: Part) -> None:
        rng = np.random.default_rng(0)
        start = disturbed(POSE, part, 8.0, 4e-3, rng)
        view = seen_from("reference", part, np.eye(4), outliers=0.33)
        (found,) = refiner(part, view).refine((detected(*decoys(part), start),))
        best = found.hypotheses[0]
        assert average_distance_m(POSE, best.camera_T_object, part) < 0.02e-3
        assert best.probability > 0.9
        assert found.supporting_views == ("reference",)
        assert best.covariance is not None
        assert np.linalg.eigvalsh(best.covariance).min() > 0

    def test_more_views_leave_less_uncertainty(self, part: Part) -> None:
        views = [seen_from(f"{k}", part, camera, k) for k, camera in enumerate([np.eye(4), beside(0.8), beside(-0.8)])]
        made, objects, volumes = refiner(part), (detected(POSE),), []
        for view in views:
            made.add(view)
            objects = made.refine(objects)
            covariance = objects[0].hypotheses[0].covariance
            assert covariance is not None
            volumes.append(np.linalg.slogdet(covariance)[1])
        assert volumes[0] > volumes[1] > volumes[2]
        assert objects[0].supporting_views == ("0", "1", "2")

    def test_a_later_view_is_used_in_the_frame_of_the_reference(self, part: Part) -> None:
        start = disturbed(POSE, part, 4.0, 2e-3, np.random.default_rng(1))
        nothing = DepthView("reference", UNKNOWN, np.eye(4))
        (found,) = refiner(part, nothing, seen_from("side", part, beside(0.5))).refine((detected(start),))
        assert average_distance_m(POSE, found.hypotheses[0].camera_T_object, part) < 0.1e-3
        assert found.supporting_views == ("side",)

    def test_a_later_view_decides_between_hypotheses(self, part: Part) -> None:
        """The decoy is right, were the view taken from where the reference was."""
        camera = beside(0.5)
        made = refiner(part, DepthView("reference", UNKNOWN, np.eye(4)), seen_from("side", part, camera), tempering=0.2)
        (found,) = made.refine((detected(invert(camera) @ POSE, POSE, probabilities=(0.9, 0.1)),))
        assert average_distance_m(POSE, found.hypotheses[0].camera_T_object, part) < 0.1e-3

    def test_hypotheses_that_become_one_pose_add_their_probabilities(self, part: Part) -> None:
        rng = np.random.default_rng(2)
        near = [disturbed(POSE, part, 5.0, 2e-3, rng) for _ in range(2)]
        one = detected(*near, decoys(part)[0], probabilities=(0.2, 0.3, 0.5))
        made = refiner(part, seen_from("reference", part, np.eye(4)), tempering=1e-9)
        (found,) = made.refine((one,))
        assert [each.probability for each in found.hypotheses] == pytest.approx([0.5, 0.5], abs=1e-6)

    def test_poses_that_a_symmetry_joins_are_one(self) -> None:
        nut = trimesh.creation.cylinder(radius=15e-3, height=20e-3, sections=6)
        part = part_from_arrays("prism", np.asarray(nut.vertices), np.asarray(nut.faces, dtype=np.intp))
        pose = transform(rotation_about((1, 0.2, 0), 2.5), POSE[:3, 3])
        turned = [pose @ transform(rotation_about((0, 0, 1), k * np.pi / 3), np.zeros(3)) for k in range(3)]
        view = DepthView("reference", measured(part, [pose], np.random.default_rng(3)), np.eye(4))
        (found,) = refiner(part, view).refine((detected(*turned),))
        assert len(found.hypotheses) == 1
        assert found.hypotheses[0].probability == pytest.approx(1.0)


class TestProbabilities:
    def test_looking_twice_at_the_same_depth_counts_it_once(self, part: Part) -> None:
        made = refiner(part, seen_from("reference", part, np.eye(4)), tempering=0.01)
        once = made.refine((detected(POSE, decoys(part)[1]),))
        again = made.refine(made.refine(once))
        odds = [
            objects[0].hypotheses[-1].probability / objects[0].hypotheses[0].probability for objects in (once, again)
        ]
        assert len(once[0].hypotheses) == 2
        # the wrong pose still creeps a little; counted three times its odds would be cubed
        assert abs(np.log(odds[1]) - np.log(odds[0])) < 0.2 * abs(np.log(odds[0]))

    def test_memory_of_hypotheses_that_are_gone_is_freed(self, part: Part) -> None:
        made = refiner(part, seen_from("reference", part, np.eye(4)))
        objects = (detected(POSE),)
        for _ in range(5):
            objects = made.refine(objects)
        gc.collect()
        assert len(made._log_prior) == 1

    def test_unmeasured_depth_leaves_everything_as_it_is(self, part: Part) -> None:
        before = detected(POSE, *decoys(part), probabilities=(0.1, 0.2, 0.3, 0.4))
        (after,) = refiner(part, DepthView("reference", UNKNOWN, np.eye(4))).refine((before,))
        assert [each.probability for each in after.hypotheses] == pytest.approx([0.4, 0.3, 0.2, 0.1])
        for old, new in zip(reversed(before.hypotheses), after.hypotheses, strict=True):
            assert new.camera_T_object == pytest.approx(old.camera_T_object, abs=1e-12)
            assert new.covariance is None
        assert after.supporting_views == ()

    def test_no_views_no_objects_no_hypotheses(self, part: Part) -> None:
        objects = (detected(POSE),)
        assert refiner(part).refine(objects) is objects
        assert refiner(part, seen_from("reference", part, np.eye(4))).refine(()) == ()
        assert refiner(part, seen_from("reference", part, np.eye(4))).refine((DetectedObject(()),))[0].hypotheses == ()

    @pytest.mark.parametrize("seed", range(3))
    def test_they_are_ordered_and_sum_to_one(self, part: Part, seed: int) -> None:
        rng = np.random.default_rng(seed)
        poses = [disturbed(POSE, part, rng.uniform(0, 180), 5e-3, rng) for _ in range(10)]
        (found,) = refiner(part, seen_from("reference", part, np.eye(4), seed)).refine((detected(*poses),))
        shares = [each.probability for each in found.hypotheses]
        assert sum(shares) == pytest.approx(1.0)
        assert shares == sorted(shares, reverse=True)
        assert min(shares) >= 1e-3


class TestLikelihood:
    """One pose that covers ten pixels of one row at a depth of 0.5 m; the uniform distributions span 50 mm."""

    look = Look(
        uv=np.stack([np.arange(10.0), np.zeros(10)], axis=-1)[None],
        covered=np.ones((1, 10), dtype=np.bool_),
        normals=np.tile([0.0, 0.0, -1.0], (1, 10, 1)),
        depth_m=np.full((1, 10), 0.5),
    )
    settings = RefinementSettings()

    def ratio(self, depth_m: float) -> float:
        return float(log_likelihood_ratio(self.look, np.full((1, 10), depth_m), 0.05, self.settings)[0])

    def test_nothing_measured_says_nothing(self) -> None:
        assert self.ratio(np.nan) == 0.0

    def test_an_occluder_says_little_and_free_space_much(self) -> None:
        assert self.ratio(0.4) == pytest.approx(10 * np.log(self.settings.occluder_odds))
        assert self.ratio(0.6) == pytest.approx(10 * np.log(self.settings.behind_odds))
        assert abs(self.ratio(0.4)) < 0.1 * self.ratio(0.5) < -self.ratio(0.6)

    def test_agreement_is_a_gaussian_on_a_floor(self) -> None:
        s = self.settings
        peak = s.agreement_odds * 0.05 / (s.agreement_m * np.sqrt(2 * np.pi))
        one_off = 0.5 + s.agreement_m
        assert self.ratio(one_off) == pytest.approx(10 * np.log(peak * np.exp(-0.5) + s.behind_odds), rel=1e-6)

    def test_pixels_outside_the_image_say_nothing(self) -> None:
        outside = replace(self.look, uv=self.look.uv + 1e4)
        assert log_likelihood_ratio(outside, np.full((1, 10), 0.6), 0.05, self.settings)[0] == 0.0


class TestHardCases:
    def test_poses_behind_the_camera_and_far_away_stay(self, part: Part) -> None:
        away = [displaced(POSE, part, np.zeros(3), np.array([0.0, 0.0, z])) for z in (-1.0, -0.45, 50.0)]
        view = seen_from("reference", part, np.eye(4))
        (found,) = refiner(part, view, seen_from("side", part, beside(2.0))).refine((detected(*away, POSE),))
        for each in found.hypotheses:
            assert np.isfinite(each.camera_T_object).all()
            rotation = each.camera_T_object[:3, :3]
            assert np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-12
        best = found.hypotheses[0].camera_T_object
        assert average_distance_m(POSE, best, part) < 0.1e-3

    def test_points_are_bounded_however_many_views(self, part: Part) -> None:
        view = seen_from("0", part, np.eye(4))
        made = refiner(part, *(replace(view, name=f"{k}") for k in range(100)))
        cloud = made._cloud_around(POSE[None])
        assert len(cloud.points) <= made._settings.object_points
        assert len(np.unique(cloud.view)) == 100

    def test_impossible_depth_is_not_measured(self, part: Part) -> None:
        view = seen_from("reference", part, np.eye(4))
        spoiled = view.depth_m.copy()
        spoiled[::7] = np.inf
        spoiled[1::7] = -0.3
        spoiled[2::7] = 0.0
        start = disturbed(POSE, part, 3.0, 1e-3, np.random.default_rng(4))
        (found,) = refiner(part, replace(view, depth_m=spoiled)).refine((detected(start),))
        assert average_distance_m(POSE, found.hypotheses[0].camera_T_object, part) < 0.1e-3

    def test_a_neighbour_that_touches_does_not_draw_the_part(self, part: Part) -> None:
        neighbour = displaced(POSE, part, np.array([0.4, 0.2, 1.0]), np.array([0.05, 0.01, 0.01]))
        depth_m = measured(part, [POSE, neighbour], np.random.default_rng(5))
        start = disturbed(POSE, part, 4.0, 2e-3, np.random.default_rng(6))
        (found,) = refiner(part, DepthView("reference", depth_m, np.eye(4))).refine((detected(start),))
        assert average_distance_m(POSE, found.hypotheses[0].camera_T_object, part) < 0.1e-3

    def test_what_cannot_be_used_is_refused(self, part: Part) -> None:
        made = refiner(part)
        with pytest.raises(ImageError, match=r"side.*\(3, 4\).*\(256, 320\)"):
            made.add(DepthView("side", np.zeros((3, 4)), np.eye(4)))
        with pytest.raises(PoseError, match="side"):
            made.add(DepthView("side", UNKNOWN, 2 * np.eye(4)))
        made.add(DepthView("side", UNKNOWN, np.eye(4)))
        with pytest.raises(PoseError, match="not finite"):
            made.refine((detected(np.full((4, 4), np.nan)),))


def test_views_in_another_frame_give_the_same_pose(part: Part) -> None:
    """Take the side view for the reference: the pose found is the same one, in its frame."""
    start = disturbed(POSE, part, 4.0, 2e-3, np.random.default_rng(7))
    first, side = seen_from("first", part, np.eye(4)), seen_from("side", part, beside(0.7), 1)
    (here,) = refiner(part, first, side).refine((detected(start),))
    side_T_first = invert(side.reference_T_camera)
    moved = [replace(view, reference_T_camera=side_T_first @ view.reference_T_camera) for view in (first, side)]
    (there,) = refiner(part, *moved).refine((detected(side_T_first @ start),))
    expected = side_T_first @ here.hypotheses[0].camera_T_object
    # points are drawn anew, so only the data's noise is common
    assert np.abs(error_twist(expected, there.hypotheses[0].camera_T_object, part)).max() < 1e-3
