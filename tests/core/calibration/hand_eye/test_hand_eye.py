"""The hand-eye calibration: exact data, independent solvers, honest errors, and every way a cell gets it wrong."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import pytest
from hand_eye_scene import (
    BASE_T_BOARD,
    BOARD,
    CAMERA,
    FLANGE_T_CAMERA,
    MIDDLE,
    USUAL,
    Noise,
    camera_T_board,
    error,
    exact_arm,
    scene,
    seen,
    small_motion,
)
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from PIL import Image
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from sidelong.calibration.hand_eye.board import BoardObservation, render_board
from sidelong.calibration.hand_eye.checks import HandEyeSettings
from sidelong.calibration.hand_eye.park_martin import Motions, board_scale, park_martin, relative_motions, spread
from sidelong.calibration.hand_eye.picture import draw_hand_eye
from sidelong.calibration.hand_eye.refine import refine
from sidelong.calibration.hand_eye.solution import hand_eye_from_images, solve_hand_eye
from sidelong.errors import CalibrationError, ImageError, PoseError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import invert, rotation_about, transform, transform_points

EXACT = Noise()


def boards_of(observations: list[BoardObservation]) -> np.ndarray:
    return np.stack([one.camera_T_board for one in observations])


def motions_of(observations: list[BoardObservation], arm: np.ndarray) -> Motions:
    return relative_motions(arm, boards_of(observations))


def random_pose(random: np.random.Generator, metres: float = 1.0) -> np.ndarray:
    return transform(Rotation.random(rng=random).as_matrix(), random.uniform(-metres, metres, 3))


# ---- exact data


@hypothesis_settings(max_examples=60)
@given(seed=st.integers(0, 2**32 - 1), poses=st.integers(3, 8))
def test_any_motions_give_back_any_mounting_in_closed_form(seed: int, poses: int) -> None:
    """Rotations up to half a turn included, where logarithms are ambiguous."""
    random = np.random.default_rng(seed)
    mounting, base_T_board = random_pose(random, 0.3), random_pose(random)
    arm = np.stack([random_pose(random) for _ in range(poses)])
    motions = relative_motions(arm, invert(mounting) @ invert(arm) @ base_T_board)
    if spread(motions).least < 0.1:
        return
    np.testing.assert_allclose(park_martin(motions), mounting, atol=1e-9)
    assert board_scale(motions) == pytest.approx(1.0, abs=1e-9)


def test_half_turns_do_not_spoil_the_rotation() -> None:
    """Two poses half a turn apart, as around a bin: with noise the logarithm's sign is a toss."""
    for seed in range(10):
        random = np.random.default_rng(seed)
        boards = np.stack([camera_T_board(random) for _ in range(4)])
        boards[2:] = boards[:2] @ transform(rotation_about((0, 0, 1), np.pi), (0.24, 0.18, 0.0))
        arm = np.stack([pose @ small_motion(random, 5e-4, 2e-4) for pose in exact_arm(boards)])
        metres, radians = error(park_martin(relative_motions(arm, boards)))
        assert metres < 4e-3
        assert radians < 4e-3


def test_images_of_other_poses_give_no_reflection() -> None:
    """The search for mix-ups solves wrong pairings by the dozen; a mirror image fits half of them better."""
    for seed in range(20):
        random = np.random.default_rng(seed)
        arm, boards = (np.stack([random_pose(random) for _ in range(4)]) for _ in range(2))
        assert np.linalg.det(park_martin(relative_motions(arm, boards))[:3, :3]) == pytest.approx(1.0)


def test_exact_data_are_recovered_exactly() -> None:
    result = solve_hand_eye(*scene(6, noise=EXACT), CAMERA)
    np.testing.assert_allclose(result.closed_form, FLANGE_T_CAMERA, atol=1e-9)
    np.testing.assert_allclose(result.flange_T_camera, FLANGE_T_CAMERA, atol=1e-9)
    np.testing.assert_allclose(result.base_T_board, BASE_T_BOARD, atol=1e-9)
    assert result.rms_px < 1e-6
    assert result.residual_m.max() < 1e-8
    assert result.residual_rad.max() < 1e-8
    assert result.converged
    assert (result.poses, result.pairs) == (6, 15)
    assert result.used.all()
    assert result.warnings == ()
    assert result.names == tuple(f"image_{k}" for k in range(6))


@hypothesis_settings(max_examples=15)
@given(seed=st.integers(0, 2**32 - 1))
def test_the_choice_of_base_and_board_frames_does_not_matter(seed: int) -> None:
    observations, arm = scene(5)
    moved = random_pose(np.random.default_rng(seed))
    first, second = solve_hand_eye(observations, arm, CAMERA), solve_hand_eye(observations, moved @ arm, CAMERA)
    np.testing.assert_allclose(second.flange_T_camera, first.flange_T_camera, atol=1e-5)
    np.testing.assert_allclose(second.base_T_board, moved @ first.base_T_board, atol=1e-5)
    np.testing.assert_allclose(second.covariance, first.covariance, rtol=0.01, atol=1e-10)
    boards = boards_of(observations)
    np.testing.assert_allclose(
        park_martin(relative_motions(arm, boards @ moved)), park_martin(relative_motions(arm, boards)), atol=1e-9
    )


def test_a_turn_of_the_flange_frame_turns_the_answer_and_its_covariance() -> None:
    observations, arm = scene(6)
    turned = transform(rotation_about((0.3, 1.0, -0.4), 0.8), (0.0, 0.0, 0.0))
    first, second = solve_hand_eye(observations, arm, CAMERA), solve_hand_eye(observations, arm @ turned, CAMERA)
    np.testing.assert_allclose(second.flange_T_camera, invert(turned) @ first.flange_T_camera, atol=1e-5)
    rotation = turned[:3, :3].T
    expected = rotation @ first.covariance[3:, 3:] @ rotation.T
    np.testing.assert_allclose(second.covariance[3:, 3:], expected, rtol=0.02, atol=1e-9)


# ---- independent solvers


def pose_of(parameters: np.ndarray) -> np.ndarray:
    return transform(Rotation.from_rotvec(parameters[:3]).as_matrix(), parameters[3:6])


def parameters_of(pose: np.ndarray) -> np.ndarray:
    return np.concatenate([Rotation.from_matrix(pose[:3, :3]).as_rotvec(), pose[:3, 3]])


def test_the_closed_form_is_the_least_squares_of_park_and_martins_equations() -> None:
    """Noise as large as 0.05 rad: the equations hold only in the mean, and the minimum is a matter of method."""
    observations, arm = scene(6, seed=3, noise=Noise(5e-2, 5e-3, 0.1))
    motions = motions_of(observations, arm)
    alpha, beta = (Rotation.from_matrix(m[:, :3, :3]).as_rotvec() for m in (motions.flange, motions.camera))

    def rotation_rest(rotvec: np.ndarray) -> np.ndarray:
        return (alpha - Rotation.from_rotvec(rotvec).apply(beta)).ravel()

    rotation = Rotation.from_rotvec(least_squares(rotation_rest, (0, 0, 1.5), xtol=1e-15, ftol=1e-15, gtol=1e-15).x)

    def translation_rest(t: np.ndarray) -> np.ndarray:
        left = motions.flange[:, :3, :3] @ t + motions.flange[:, :3, 3]
        return (left - rotation.apply(motions.camera[:, :3, 3]) - t).ravel()

    found = park_martin(motions)
    np.testing.assert_allclose(found[:3, :3], rotation.as_matrix(), atol=1e-6)
    np.testing.assert_allclose(found[:3, 3], least_squares(translation_rest, np.zeros(3)).x, atol=1e-6)


def missed_px(parameters: np.ndarray, observations: list[BoardObservation], arm: np.ndarray) -> np.ndarray:
    predicted = invert(pose_of(parameters[:6])) @ invert(arm) @ pose_of(parameters[6:12])
    return np.concatenate(
        [
            (CAMERA.project(transform_points(pose, one.corners_board)) - one.corners_px).ravel()
            for one, pose in zip(observations, predicted, strict=True)
        ]
    )


def start_of(observations: list[BoardObservation], arm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    closed = park_martin(motions_of(observations, arm))
    return closed, arm[0] @ closed @ observations[0].camera_T_board


def test_image_noise_alone_is_the_least_squares_of_all_corners() -> None:
    observations, arm = scene(5, seed=2, noise=Noise(2e-4, 1e-4, 0.2))
    start = start_of(observations, arm)
    refined = refine(observations, arm, CAMERA, start, None, "image")
    brute = least_squares(
        missed_px, np.concatenate([parameters_of(pose) for pose in start]), args=(observations, arm), x_scale="jac",
        xtol=1e-14, ftol=1e-14, gtol=1e-14,
    )  # fmt: skip
    np.testing.assert_allclose(refined.flange_T_camera, pose_of(brute.x[:6]), atol=2e-6)
    np.testing.assert_allclose(refined.base_T_board, pose_of(brute.x[6:]), atol=2e-6)


def test_arm_noise_is_the_bundle_adjustment_with_a_correction_to_each_pose() -> None:
    observations, arm = scene(5, seed=2, noise=Noise(1e-3, 5e-4, 0.1))
    start = start_of(observations, arm)
    refined = refine(observations, arm, CAMERA, start)

    def rest(parameters: np.ndarray) -> np.ndarray:
        corrections = parameters[12:].reshape(-1, 6)
        corrected = np.stack([pose @ pose_of(by) for pose, by in zip(arm, corrections, strict=True)])
        return np.concatenate(
            [
                missed_px(parameters[:12], observations, corrected) / refined.corner_noise_px,
                corrections[:, :3].ravel() / refined.arm_noise_rad,
                corrections[:, 3:].ravel() / refined.arm_noise_m,
            ]
        )

    first = np.concatenate([*(parameters_of(pose) for pose in start), np.zeros(6 * len(arm))])
    brute = least_squares(rest, first, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    metres, radians = refined.covariance[3:, 3:].trace() ** 0.5, refined.covariance[:3, :3].trace() ** 0.5
    assert np.linalg.norm((refined.flange_T_camera - pose_of(brute.x[:6]))[:3, 3]) < 0.03 * metres
    turned = Rotation.from_matrix(refined.flange_T_camera[:3, :3].T @ pose_of(brute.x[:6])[:3, :3])
    assert turned.magnitude() < 0.03 * radians
    # the covariance of the mounting, from the bundle's own Jacobian
    bundle = np.linalg.inv(brute.jac.T @ brute.jac)[3:6, 3:6]
    np.testing.assert_allclose(np.diag(refined.covariance)[3:], np.diag(bundle), rtol=0.05)


# ---- statistics


def trials(count: int, poses: int = 12, noise: Noise = USUAL) -> list:
    return [solve_hand_eye(*scene(poses, seed=seed, noise=noise), CAMERA) for seed in range(count)]


def test_errors_are_as_stated_and_below_the_closed_forms() -> None:
    results = trials(60)
    turned = [Rotation.from_matrix(r.flange_T_camera[:3, :3] @ FLANGE_T_CAMERA[:3, :3].T).as_rotvec() for r in results]
    moved = [(r.flange_T_camera - FLANGE_T_CAMERA)[:3, 3] for r in results]
    by_rotation = np.array([t / r.standard_error_rad for t, r in zip(turned, results, strict=True)])
    by_translation = np.array([m / r.standard_error_m for m, r in zip(moved, results, strict=True)])
    assert 0.7 < np.sqrt((by_rotation**2).mean()) < 1.35
    assert 0.7 < np.sqrt((by_translation**2).mean()) < 1.35
    np.testing.assert_allclose(by_translation.mean(axis=0), 0.0, atol=0.45)
    refined = np.sqrt(np.mean([np.square(error(r.flange_T_camera)) for r in results], axis=0))
    closed = np.sqrt(np.mean([np.square(error(r.closed_form)) for r in results], axis=0))
    assert refined[0] < closed[0]
    assert refined[1] < 0.9 * closed[1]
    assert refined[0] < 5e-4
    # the noise is told apart: of the arm's turns, of its places, of the corners
    assert np.median([r.arm_noise_rad for r in results]) == pytest.approx(USUAL.arm_rad, rel=0.1)
    assert np.median([r.arm_noise_m for r in results]) == pytest.approx(USUAL.arm_m, rel=0.1)
    assert np.median([r.corner_noise_px for r in results]) == pytest.approx(USUAL.corner_px, rel=0.05)
    # scale and outliers: no false alarm worth the name
    assert sum(len(r.down_weighted) for r in results) <= 2
    assert sum(any("times as large" in w for w in r.warnings) for r in results) <= 1


def test_the_image_model_is_honest_where_the_arm_is_exact() -> None:
    results = trials(20, poses=8, noise=Noise(0.0, 0.0, 0.1))
    by_translation = [(r.flange_T_camera - FLANGE_T_CAMERA)[:3, 3] / r.standard_error_m for r in results]
    assert 0.7 < np.sqrt(np.square(by_translation).mean()) < 1.35


def test_the_limit_on_motion_does_not_depend_on_the_number_of_poses() -> None:
    few = [spread(motions_of(*scene(5, seed))).least for seed in range(10)]
    many = [spread(motions_of(*scene(25, seed))).least for seed in range(10)]
    # the singular value itself grows sixfold, with the square root of 10 and 300 pairs
    assert np.mean(many) == pytest.approx(np.mean(few), rel=0.4)


# ---- what a cell gets wrong


def refused(observations: list[BoardObservation], arm: np.ndarray, **settings: float) -> str:
    with pytest.raises(CalibrationError) as caught:
        solve_hand_eye(observations, list(arm), CAMERA, HandEyeSettings(**settings))
    return str(caught.value)


def test_fewer_than_three_poses_are_refused() -> None:
    observations, arm = scene(2)
    assert refused(observations, arm) == "hand-eye: 2 poses, needs 3"
    assert refused([], arm[:0]) == "hand-eye: 0 poses, needs 3"


def test_repeated_poses_do_not_count() -> None:
    observations, arm = scene(3)
    observations[2] = replace(observations[0], name="again")
    message = refused(observations, arm[[0, 1, 0]])
    assert message == "hand-eye: 2 different arm poses, needs 3; again repeats image_0"


def test_a_repeated_pose_is_named() -> None:
    observations, arm = scene(5)
    result = solve_hand_eye([*observations, replace(observations[1], name="again")], arm[[0, 1, 2, 3, 4, 1]], CAMERA)
    assert "again repeats the arm pose of image_1 and adds next to nothing" in result.warnings


def test_lists_of_different_lengths_and_double_names_are_refused() -> None:
    observations, arm = scene(4)
    assert refused(observations, arm[:3]) == "hand-eye: 4 images and 3 arm poses, need one of each"
    observations[2] = replace(observations[2], name="image_0")
    assert refused(observations, arm) == "hand-eye: the name image_0 is given to 2 images"


def test_poses_that_are_no_rigid_motions_are_refused() -> None:
    observations, arm = scene(4)
    arm[1, :3, :3] *= 1.01
    with pytest.raises(PoseError, match="base_T_flange of image_1: the rotation is not orthonormal"):
        solve_hand_eye(observations, list(arm), CAMERA)
    arm[1] = np.nan
    with pytest.raises(PoseError, match="base_T_flange of image_1: the pose has 16 of 16 entries not finite"):
        solve_hand_eye(observations, list(arm), CAMERA)


def axis_scene(turns: np.ndarray) -> tuple[list[BoardObservation], np.ndarray]:
    """Return views of a camera that only turns like this (N, 3), noise included."""
    random = np.random.default_rng(0)
    boards = np.stack(
        [
            transform(rotation, np.append(random.normal(size=2) * 0.02, 0.6) - rotation @ MIDDLE)
            for rotation in Rotation.from_rotvec(turns).as_matrix()
        ]
    )
    arm = np.stack([pose @ small_motion(random, 5e-4, 2e-4) for pose in exact_arm(boards)])
    return seen(boards), arm


def test_translations_alone_are_refused() -> None:
    message = refused(*axis_scene(np.zeros((8, 3))))
    assert "the 8 arm poses hardly turn, 0.0" in message
    assert "need 1.15 deg about two axes: translations do not fix where the camera sits" in message


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.3, -0.5, 0.8)])
def test_turns_about_one_axis_are_refused(axis: tuple[float, float, float]) -> None:
    message = refused(*axis_scene(np.linspace(-0.5, 0.5, 8)[:, None] * np.array(axis)))
    assert "the 8 arm poses turn about one axis only" in message
    assert "tilt the flange about a second one" in message


@pytest.mark.parametrize("poses", [4, 12])
def test_small_turns_are_poor_and_smaller_ones_are_refused(poses: int) -> None:
    """Whatever the number of poses: the measure is per pair."""
    random = np.random.default_rng(1)
    turns = random.normal(size=(poses, 3))
    result = solve_hand_eye(*axis_scene(0.06 * turns), CAMERA)
    assert "poor motion" in result.warnings[0]
    assert "rotate more, about two different axes" in result.warnings[0]
    assert 0.02 < result.spread.least < 0.2
    assert result.spread.condition == pytest.approx(result.spread.largest / result.spread.least)
    assert "hardly turn" in refused(*axis_scene(0.005 * turns))


def test_wide_turns_are_not_called_poor() -> None:
    assert solve_hand_eye(*scene(12), CAMERA).warnings == ()


@pytest.mark.parametrize("poses", [4, 12])
def test_inverted_poses_are_told(poses: int) -> None:
    observations, arm = scene(poses, tilt_rad=0.4)
    message = refused(observations, invert(arm))
    assert "disagree" in message
    assert "with inverted poses it would be 0." in message
    assert "the poses seem to be flange_T_base" in message


def test_another_order_is_told() -> None:
    observations, arm = scene(12)
    message = refused(observations, np.roll(arm, 1, axis=0))
    assert "in another order it would be 0." in message
    assert "image_0 with image_1's, image_1 with image_2's" in message
    assert "and 6 more" in message


def test_millimetres_are_told() -> None:
    observations, arm = scene(12)
    arm[:, :3, 3] *= 1e3
    assert "with positions in millimetres it would be 0." in refused(observations, arm)


def resized(observations: list[BoardObservation], factor: float) -> list[BoardObservation]:
    """Return what would be seen, were the board stated this much larger than it is."""
    scaled = [observation.corners_board * factor for observation in observations]
    boards = boards_of(observations)
    boards[:, :3, 3] *= factor
    return [
        replace(one, corners_board=corners, camera_T_board=pose)
        for one, corners, pose in zip(observations, scaled, boards, strict=True)
    ]


def test_a_board_of_another_size_is_told() -> None:
    observations, arm = scene(12)
    message = refused(resized(observations, 1.5), arm)
    assert "with a board 0.66" in message
    assert "times as large it would be 0." in message


def test_a_print_two_per_cent_off_is_a_warning_with_its_size() -> None:
    """Its residual is small: the error hides in the distance of the camera from the flange."""
    observations, arm = scene(20, seed=4)
    result = solve_hand_eye(resized(observations, 1.02), arm, CAMERA)
    assert result.board_scale == pytest.approx(1 / 1.02, abs=4 * result.board_scale_error)
    assert any("a board 0.98" in warning and "measure square_m" in warning for warning in result.warnings)
    true = solve_hand_eye(observations, arm, CAMERA)
    assert true.board_scale == pytest.approx(1.0, abs=4 * true.board_scale_error)
    assert error(result.flange_T_camera)[0] > 3 * error(true.flange_T_camera)[0]


def test_nonsense_has_no_explanation() -> None:
    observations, _ = scene(8)
    random = np.random.default_rng(3)
    message = refused(observations, np.stack([random_pose(random) for _ in range(8)]))
    assert message.endswith("inverted poses, another order, other units or another board do not explain it")


@pytest.mark.parametrize(
    ("poses", "bump"),
    [(12, (0.03, 0.02)), (12, (0.0, 3e-3)), (12, (1.5, 0.5)), (7, (0.03, 0.02))],
)
def test_a_bumped_pose_is_named_and_does_not_count(poses: int, bump: tuple[float, float]) -> None:
    observations, arm = scene(poses, seed=6)
    arm[2] = arm[2] @ transform(rotation_about((1, 1, 0), bump[0]), (0.0, bump[1], 0.0))
    result = solve_hand_eye(observations, arm, CAMERA)
    assert result.down_weighted == ("image_2",)
    assert (result.poses, len(result.names)) == (poses - 1, poses)
    assert any(w.startswith("image_2 disagrees with the other poses by") for w in result.warnings)
    assert int(np.argmax(result.residual_m)) == 2
    without = solve_hand_eye([*observations[:2], *observations[3:]], np.delete(arm, 2, axis=0), CAMERA)
    np.testing.assert_allclose(result.flange_T_camera, without.flange_T_camera, atol=1e-6)
    assert result.rms_px == pytest.approx(without.rms_px, rel=1e-3)


def test_a_pose_that_puts_the_board_behind_the_camera_is_named() -> None:
    observations, arm = scene(8)
    arm[3] = arm[3] @ invert(FLANGE_T_CAMERA @ transform(rotation_about((1, 0, 0), np.pi), (0.0, 0.0, 0.0)))
    result = solve_hand_eye(observations, arm, CAMERA)
    assert result.down_weighted == ("image_3",)
    assert error(result.flange_T_camera)[0] < 1.5e-3


def test_two_swapped_images_are_named_with_their_order() -> None:
    observations, arm = scene(12)
    result = solve_hand_eye(observations, arm[[0, 1, 5, 3, 4, 2, 6, 7, 8, 9, 10, 11]], CAMERA)
    assert result.down_weighted == ("image_2", "image_5")
    assert any("image_2 with image_5's, image_5 with image_2's" in warning for warning in result.warnings)


def test_a_wrong_one_among_few_is_named_and_refused() -> None:
    observations, arm = scene(5)
    arm[2] = arm[2] @ transform(rotation_about((1, 1, 0), 0.05), (0.0, 0.03, 0.0))
    message = refused(observations, arm)
    assert "1 of 5 poses disagree with the others (image_2 " in message
    assert "limit 0 % below 6 poses; was the arm" in message


def test_too_many_wrong_poses_are_refused() -> None:
    observations, arm = scene(10)
    for k in (1, 4, 6):
        arm[k] = arm[k] @ small_motion(np.random.default_rng(k), 0.03, 0.02)
    message = refused(observations, arm)
    assert "3 of 10 poses disagree with the others (image_1 " in message
    assert "limit 25 %; was the arm at rest at each image" in message
    assert solve_hand_eye(observations, arm, CAMERA, HandEyeSettings(max_outlier_share=0.3)).poses == 7


def test_few_poses_are_warned_about() -> None:
    warnings = solve_hand_eye(*scene(3), CAMERA).warnings
    assert any(warning.startswith("3 poses: below 6 a wrong pose is not told from the others") for warning in warnings)


def test_an_ambiguous_tilt_is_named() -> None:
    observations, arm = scene(6)
    observations[4] = replace(observations[4], ambiguity=0.93)
    assert (
        "image_4: the board's tilt is ambiguous (ratio 0.93, limit 0.8)"
        in solve_hand_eye(observations, arm, CAMERA).warnings
    )


def test_a_mirrored_tilt_does_not_matter_to_the_refinement() -> None:
    """It works on corners: the pose a plane's ambiguity gave away only starts it."""
    observations, arm = scene(8)
    mirrored = observations[4].camera_T_board @ transform(rotation_about((1, 0, 0), 0.5), (0.0, 0.0, 0.0))
    result = solve_hand_eye(
        [replace(one, camera_T_board=mirrored) if k == 4 else one for k, one in enumerate(observations)], arm, CAMERA
    )
    np.testing.assert_allclose(
        result.flange_T_camera, solve_hand_eye(observations, arm, CAMERA).flange_T_camera, atol=2e-4
    )
    assert result.used.all()


# ---- from images


@pytest.mark.parametrize(
    ("camera", "metres", "radians"),
    [
        (PinholeCamera(640, 512, 700.0, 702.0, 322.0, 254.0), 1.2e-3, 2.5e-3),
        (PinholeCamera(1280, 1024, 1400.0, 1405.0, 645.0, 508.0), 8e-4, 1.5e-3),
    ],
)
def test_from_rendered_images_to_the_mounting(camera: PinholeCamera, metres: float, radians: float) -> None:
    random = np.random.default_rng(8)
    boards = np.stack([camera_T_board(random, 0.2) for _ in range(9)])
    arm = [pose @ small_motion(random, 1e-4, 5e-5) for pose in exact_arm(boards)]
    images = [render_board(BOARD, camera, pose, noise_grey=2.0, seed=k) for k, pose in enumerate(boards)]
    images[4] = np.full_like(images[4], 90)
    names = [f"view_{k}.png" for k in range(9)]
    told: list[tuple[int, int]] = []
    result = hand_eye_from_images(images, names, arm, camera, BOARD, lambda done, of: told.append((done, of)))
    moved, turned = error(result.flange_T_camera)
    assert moved < metres
    assert turned < radians
    assert moved < 4 * np.linalg.norm(result.standard_error_m)
    assert result.unused == (("view_4.png", "view_4.png: no board, no marker of DICT_4X4_50 was found"),)
    assert result.names == (*names[:4], *names[5:])
    assert told == [(k, 9) for k in range(1, 10)]
    assert result.rms_px < 0.5


def test_too_few_images_with_a_board_are_refused_with_their_reasons() -> None:
    camera = PinholeCamera(640, 512, 700.0, 702.0, 322.0, 254.0)
    random = np.random.default_rng(8)
    boards = np.stack([camera_T_board(random, 0.2) for _ in range(4)])
    images = [render_board(BOARD, camera, pose) for pose in boards]
    images[1:3] = [np.full_like(images[0], 90)] * 2
    with pytest.raises(CalibrationError, match=r"2 of 4 images show the board, needs 3; b: no board.*; c: no board"):
        hand_eye_from_images(images, list("abcd"), list(exact_arm(boards)), camera, BOARD)
    with pytest.raises(CalibrationError, match="4 images, 3 names and 4 arm poses, need one of each"):
        hand_eye_from_images(images, list("abc"), list(exact_arm(boards)), camera, BOARD)
    images[2] = images[2].astype(np.uint16)  # type: ignore[assignment]
    with pytest.raises(ImageError, match="c: the image is uint16"):
        hand_eye_from_images(images, list("abcd"), list(exact_arm(boards)), camera, BOARD)


# ---- the picture


def test_the_picture_is_one() -> None:
    observations, arm = scene(7)
    arm[2] = arm[2] @ transform(rotation_about((1, 1, 0), 0.03), (0.0, 0.02, 0.0))
    picture = Image.open(io.BytesIO(draw_hand_eye(solve_hand_eye(observations, arm, CAMERA))))
    assert picture.format == "PNG"
    assert picture.size[0] > 1000
    # arrows and bars leave colour on the paper
    assert len(np.unique(np.asarray(picture.convert("RGB")).reshape(-1, 3), axis=0)) > 100
