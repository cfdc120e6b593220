"""The board's corners and pose against rendered images whose pose is known, and what is refused."""

from __future__ import annotations

import io

import cv2
import numpy as np
import pytest
from hand_eye_scene import BOARD, MIDDLE, camera_T_board
from PIL import Image
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from sidelong.calibration.hand_eye.board import (
    MARKERS,
    BoardObservation,
    BoardSettings,
    board_image,
    board_png,
    detect_board,
    observe,
    render_board,
)
from sidelong.errors import CalibrationError, ImageError, PoseError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import rotation_angle, transform, transform_points

SMALL = PinholeCamera(640, 512, 700.0, 705.0, 322.0, 254.0)
LARGE = PinholeCamera(1280, 1024, 1400.0, 1410.0, 644.0, 508.0)


def tilted(rotvec: tuple[float, float, float], distance_m: float = 0.6) -> np.ndarray:
    rotation = Rotation.from_rotvec(rotvec).as_matrix()
    return transform(rotation, np.array([0.0, 0.0, distance_m]) - rotation @ MIDDLE)


@pytest.mark.parametrize(
    ("camera", "corner_px", "metres", "radians"), [(SMALL, 0.15, 6e-4, 4e-3), (LARGE, 0.08, 2e-4, 1e-3)]
)
def test_rendered_boards_are_found_where_they_are(
    camera: PinholeCamera, corner_px: float, metres: float, radians: float
) -> None:
    random = np.random.default_rng(1)
    missed = []
    for k in range(6):
        pose = camera_T_board(random)
        found = detect_board(render_board(BOARD, camera, pose, noise_grey=2.0, seed=k), f"image_{k}", camera, BOARD)
        missed.append(found.corners_px - camera.project(transform_points(pose, found.corners_board)))
        assert len(found.corners_px) > 20
        assert np.linalg.norm((found.camera_T_board - pose)[:3, 3]) < metres
        assert rotation_angle(found.camera_T_board[:3, :3].T @ pose[:3, :3]) < radians
        assert found.rms_px < corner_px
    every = np.concatenate(missed)
    assert np.sqrt((every**2).sum(axis=1).mean()) < corner_px
    # half a pixel of a wrong convention anywhere in drawing or detection would show here
    np.testing.assert_allclose(every.mean(axis=0), 0.0, atol=0.02)


def test_exact_corners_give_the_exact_pose() -> None:
    random = np.random.default_rng(2)
    for _ in range(10):
        pose = camera_T_board(random, 0.4)
        found = observe(LARGE.project(transform_points(pose, BOARD.corners_board)), BOARD.corners_board, "exact", LARGE)
        np.testing.assert_allclose(found.camera_T_board, pose, atol=1e-8)
        assert found.rms_px < 1e-8


def noisy(distance_m: float, seed: int) -> BoardObservation:
    exact = SMALL.project(transform_points(tilted((0.35, 0.0, 0.0), distance_m), BOARD.corners_board))
    noise = 0.3 * np.random.default_rng(seed).normal(size=exact.shape)
    return observe(exact + noise, BOARD.corners_board, "far", SMALL)


def test_a_distant_board_is_ambiguous_and_a_near_one_is_not() -> None:
    near = [noisy(0.6, seed).ambiguity for seed in range(10)]
    far = [noisy(6.0, seed).ambiguity for seed in range(10)]
    assert max(near) < 0.3
    assert 0.8 < np.median(far) <= 1.0


def test_the_better_of_the_two_poses_is_taken() -> None:
    for seed in range(10):
        found = noisy(1.5, seed)
        assert rotation_angle(found.camera_T_board[:3, :3].T @ tilted((0.35, 0.0, 0.0))[:3, :3]) < 0.15


def test_a_board_cut_off_by_the_image_is_still_found() -> None:
    pose = tilted((0.2, 0.1, 0.3)) + np.array([[0, 0, 0, 0.2], [0] * 4, [0] * 4, [0] * 4])
    found = detect_board(render_board(BOARD, LARGE, pose), "cut", LARGE, BOARD)
    assert 8 <= len(found.corners_px) < len(BOARD.corners_board)
    np.testing.assert_allclose(found.camera_T_board, pose, atol=3e-3)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((512, 640), dtype=np.uint16), r"deep.png: the image is uint16, needs 8-bit grey \(uint8\)"),
        (
            np.zeros((512, 640, 3), dtype=np.uint8),
            r"deep.png: the image has shape \(512, 640, 3\), needs one grey channel",
        ),
        (np.zeros((640, 512), dtype=np.uint8), r"deep.png: the image is 512x640 px, the camera's is 640x512"),
    ],
)
def test_images_of_the_wrong_kind_are_refused(image: np.ndarray, message: str) -> None:
    with pytest.raises(ImageError, match=message):
        detect_board(image, "deep.png", SMALL, BOARD)


def test_no_board_is_refused() -> None:
    with pytest.raises(CalibrationError, match=r"empty\.png: no board, no marker of DICT_4X4_50 was found"):
        detect_board(np.full((512, 640), 110, dtype=np.uint8), "empty.png", SMALL, BOARD)


def test_a_few_corners_are_refused() -> None:
    image = render_board(BOARD, SMALL, tilted((0.0, 0.0, 0.0)))
    image[:, 330:] = 110
    image[260:] = 110
    with pytest.raises(CalibrationError, match=r"part.png: \d corners of the board and \d+ markers .* needs 8 corners"):
        detect_board(image, "part.png", SMALL, BOARD)


def test_the_other_pattern_of_older_boards_is_told() -> None:
    image = render_board(BOARD.model_copy(update={"legacy_pattern": True}), LARGE, tilted((0.2, 0.0, 0.0)))
    with pytest.raises(CalibrationError, match=r"0 corners of the board and \d+ markers .* legacy_pattern right"):
        detect_board(image, "old.png", LARGE, BOARD)
    assert len(detect_board(image, "old", LARGE, BOARD.model_copy(update={"legacy_pattern": True})).corners_px) == 35


def test_corners_on_one_line_are_refused() -> None:
    line = BoardSettings(squares_x=12, squares_y=3).corners_board[:11]
    pose = tilted((0.2, 0.1, 0.0))
    with pytest.raises(CalibrationError, match="row: all 11 corners lie on one line"):
        observe(LARGE.project(transform_points(pose, line)), line, "row", LARGE)


def test_a_bent_board_is_refused() -> None:
    bent = BOARD.corners_board.copy()
    bent[:, 2] = 3.0 * (bent[:, 0] - 0.12) ** 2
    pixels = LARGE.project(transform_points(tilted((0.5, 0.0, 0.0)), bent))
    with pytest.raises(CalibrationError, match=r"bent: a flat board misses its corners by .* px rms, limit 1 px"):
        observe(pixels, BOARD.corners_board, "bent", LARGE)


@pytest.mark.parametrize(
    ("pixels", "points", "message"),
    [
        (np.zeros((7, 2)), BOARD.corners_board[:7], "7 corners, needs 8"),
        (np.zeros((9, 3)), BOARD.corners_board[:9], r"shapes \(9, 3\) and \(9, 3\)"),
        (np.full((9, 2), np.nan), BOARD.corners_board[:9], "a corner is not finite"),
    ],
)
def test_corners_that_cannot_be_used_are_refused(pixels: np.ndarray, points: np.ndarray, message: str) -> None:
    with pytest.raises(CalibrationError, match=f"x: .*{message}"):
        observe(pixels, points, "x", LARGE)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"squares_x": 20, "squares_y": 12}, "the board needs 120 markers, DICT_4X4_50 has 50"),
        ({"marker_m": 0.02}, "marker_m: 0.02 m, limits 0.3 to 0.9 of square_m, which is 0.02 m"),
        ({"square_m": 20.0}, "less than or equal to 1"),
        ({"dictionary": "DICT_9X9"}, "dictionary"),
    ],
)
def test_boards_that_cannot_be_are_refused(settings: dict[str, object], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        BoardSettings(**settings)


def test_the_dictionaries_are_as_large_as_stated() -> None:
    for name, markers in MARKERS.items():
        assert len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)).bytesList) == markers


@pytest.mark.parametrize("board", [BOARD, BoardSettings(), BOARD.model_copy(update={"legacy_pattern": True})])
def test_the_stated_corners_are_those_of_opencv(board: BoardSettings) -> None:
    charuco = cv2.aruco.CharucoBoard(
        (board.squares_x, board.squares_y), board.square_m, board.marker_m, cv2.aruco.getPredefinedDictionary(0)
    )
    np.testing.assert_allclose(board.corners_board, charuco.getChessboardCorners(), atol=1e-7)


def test_the_print_has_its_true_size_and_corners_between_dots() -> None:
    board = BoardSettings()
    printed = Image.open(io.BytesIO(board_png(board, 300)))
    pixels = np.asarray(printed)
    per_m = printed.info["dpi"][0] / 0.0254
    assert printed.info["dpi"] == pytest.approx((300, 300), rel=0.01)
    square_px = board.square_m * per_m
    assert square_px == pytest.approx(round(square_px), abs=1e-3)
    assert pixels.shape == (9 * round(square_px), 12 * round(square_px))
    assert pixels[0].min() == 255
    # the first inner corner: black and white change places across it, both ways
    at = round(1.5 * square_px)
    a, b, c, d = (int(pixels[at + v, at + u]) for v, u in ((-1, -1), (-1, 0), (0, -1), (0, 0)))
    assert a == d
    assert b == c
    assert abs(a - b) == 255


def test_a_drawn_board_has_its_margin() -> None:
    image = board_image(BOARD, 40, 15)
    assert image.shape == (6 * 40 + 30, 8 * 40 + 30)
    assert image[:15].min() == 255
    assert image[15, 15] == 0


def test_a_board_behind_the_camera_is_not_drawn() -> None:
    with pytest.raises(PoseError, match=r"camera_T_board: a corner of the board lies at depth -0.6 m, needs above 0"):
        render_board(BOARD, SMALL, transform(np.eye(3), (0.0, 0.0, -0.6)))
