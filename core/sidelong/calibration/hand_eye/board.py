"""The calibration board: a ChArUco pattern, its corners in an image, its pose, and pictures of it."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, model_validator

from sidelong.errors import CalibrationError, ImageError, PoseError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import rotation_angle, transform, transform_points
from sidelong.types import FloatArray, GrayImage, IntArray

DictionaryName = Literal[
    "DICT_4X4_50", "DICT_4X4_100", "DICT_4X4_250", "DICT_5X5_50", "DICT_5X5_100", "DICT_5X5_250",
    "DICT_6X6_50", "DICT_6X6_100", "DICT_6X6_250", "DICT_APRILTAG_16h5", "DICT_APRILTAG_25h9", "DICT_APRILTAG_36h11",
]  # fmt: skip
MARKERS: dict[DictionaryName, int] = {
    "DICT_4X4_50": 50, "DICT_4X4_100": 100, "DICT_4X4_250": 250, "DICT_5X5_50": 50, "DICT_5X5_100": 100,
    "DICT_5X5_250": 250, "DICT_6X6_50": 50, "DICT_6X6_100": 100, "DICT_6X6_250": 250, "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_25h9": 35, "DICT_APRILTAG_36h11": 587,
}  # fmt: skip
"""How many markers each dictionary has: known here, so that settings are checked without OpenCV."""
FEWEST_CORNERS = 8
MAX_RMS_PX = 1.0
"""Reprojection error above which the corners are not those of a flat board seen by this camera; 0.05 px is usual."""
LINE_RATIO = 0.05
"""Narrow over wide extent of the corners on the board below which they lie on a line."""
SAME_POSE_RAD = 1e-3
SUPERSAMPLING = 4


class BoardSettings(BaseModel):
    """A ChArUco board. The default is 220 x 160 mm and fits on A4 paper.

    The frame ``board`` has its origin at the outer corner of the first square, x along ``squares_x``, y along
    ``squares_y``, z away from the viewer.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    squares_x: Annotated[int, Field(ge=3, le=40, description="squares along x, the printed width")] = 11
    squares_y: Annotated[int, Field(ge=3, le=40, description="squares along y, the printed height")] = 8
    square_m: Annotated[FiniteFloat, Field(ge=1e-3, le=1, description="side of a square, measured on the print")] = 0.02
    marker_m: Annotated[FiniteFloat, Field(ge=1e-3, le=1, description="side of a marker, its black rim included")] = (
        0.015
    )
    dictionary: DictionaryName = Field(default="DICT_4X4_50", description="ArUco dictionary of the markers")
    legacy_pattern: bool = Field(
        default=False, description="board of OpenCV before 4.6: with an even squares_y it starts with a white square"
    )

    @model_validator(mode="after")
    def _can_be_told_apart(self) -> BoardSettings:
        if not 0.3 * self.square_m <= self.marker_m <= 0.9 * self.square_m:
            raise ValueError(
                f"marker_m: {self.marker_m:g} m, limits 0.3 to 0.9 of square_m, which is {self.square_m:g} m"
            )
        markers, known = self.squares_x * self.squares_y // 2, MARKERS[self.dictionary]
        if markers > known:
            raise ValueError(f"dictionary: the board needs {markers} markers, {self.dictionary} has {known}")
        return self

    @property
    def corners_board(self) -> FloatArray:
        """Inner corners (M, 3) in metres by id: row by row, x first."""
        y, x = np.mgrid[1 : self.squares_y, 1 : self.squares_x]
        return self.square_m * np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1).astype(np.float64)


@dataclass(frozen=True, eq=False)
class BoardObservation:
    """The board in one image.

    Attributes
    ----------
    name
        Of the image.
    corners_px, corners_board
        (N, 2) found corners in pixels and (N, 3) the same corners on the board in metres.
    camera_T_board
        (4, 4) pose of least reprojection error.
    rms_px
        Its reprojection error: root of the mean squared distance.
    ambiguity
        Reprojection error of this pose over that of the mirrored one, 0..1. Near 1 the image does not tell which way
        the board is tilted; 0 where there is no second pose.
    """

    name: str
    corners_px: FloatArray
    corners_board: FloatArray
    camera_T_board: FloatArray
    rms_px: float
    ambiguity: float


def detect_board(image: GrayImage, name: str, camera: PinholeCamera, board: BoardSettings) -> BoardObservation:
    """Find the board in a rectified image and its pose.

    The detector refines corners to about 0.04 px rms on sharp images; refining again with a window of a quarter square
    was measured to be worse (0.1-0.2 px), as neighbouring markers get into the window.

    Raises
    ------
    ImageError
        The image is not (camera.height, camera.width) of 8-bit grey.
    CalibrationError
        It shows no marker of the dictionary, fewer than ``FEWEST_CORNERS`` corners of the board, corners on one line
        only, or corners that no flat board projects to.
    """
    import cv2

    _validate_image(image, name, camera)
    found: Any = cv2.aruco.CharucoDetector(_charuco(board)).detectBoard(np.ascontiguousarray(image))
    corners, ids, _, marker_ids = found
    if marker_ids is None or len(marker_ids) == 0:
        raise CalibrationError(f"{name}: no board, no marker of {board.dictionary} was found")
    corner_ids: IntArray = np.zeros(0, dtype=np.intp) if ids is None else np.asarray(ids, dtype=np.intp).ravel()
    if len(corner_ids) < FEWEST_CORNERS:
        raise CalibrationError(
            f"{name}: {len(corner_ids)} corners of the board and {len(marker_ids)} markers were found, needs "
            f"{FEWEST_CORNERS} corners: is the board in view, and are squares_x, squares_y and legacy_pattern right?"
        )
    corners_px = np.asarray(corners, dtype=np.float64).reshape(-1, 2)
    return observe(corners_px, board.corners_board[corner_ids], name, camera)


def observe(corners_px: FloatArray, corners_board: FloatArray, name: str, camera: PinholeCamera) -> BoardObservation:
    """Return the observation of a board whose corners were found: the better of the two poses of a plane.

    Both closed-form poses (IPPE: Collins and Bartoli, Infinitesimal Plane-Based Pose Estimation, IJCV 2014) are refined
    on the reprojection error (Levenberg-Marquardt).

    Parameters
    ----------
    corners_px, corners_board
        (N, 2) pixels and (N, 3) metres, z = 0.

    Raises
    ------
    CalibrationError
        Fewer than ``FEWEST_CORNERS`` corners, corners not finite or on one line, or an error above ``MAX_RMS_PX``.
    """
    _validate_corners(corners_px, corners_board, name)
    poses = _plane_poses(corners_px, corners_board, camera)
    rms = [_rms_px(corners_px, corners_board, pose, camera) for pose in poses]
    first, second = np.argsort(rms)[:2] if len(poses) > 1 else (0, 0)
    if not rms[first] <= MAX_RMS_PX:  # NaN where the board comes out behind the camera
        raise CalibrationError(
            f"{name}: a flat board misses its corners by {rms[first]:.3g} px rms, limit {MAX_RMS_PX:g} px: is the "
            "image rectified, is it this camera's, is the board flat?"
        )
    apart = rotation_angle(poses[first][:3, :3].T @ poses[second][:3, :3])
    # exact corners have no error at all, and still only one pose
    ambiguity = float(rms[first] / rms[second]) if apart > SAME_POSE_RAD and rms[second] > 0 else 0.0
    return BoardObservation(name, corners_px, corners_board, poses[first], float(rms[first]), ambiguity)


def board_image(board: BoardSettings, square_px: int, margin_px: int = 0) -> GrayImage:
    """Draw the board, ``square_px`` to a square, with a white margin all around; (H, W)."""
    size = (board.squares_x * square_px, board.squares_y * square_px)
    drawn = np.asarray(_charuco(board).generateImage(size), dtype=np.uint8)
    return np.pad(drawn, margin_px, constant_values=255)


def board_png(board: BoardSettings, dots_per_inch: int = 600) -> bytes:
    """Return the board to print, with a white margin of half a square, as a PNG that states its true scale.

    Print without fitting to the page, then measure ``square_m`` across many squares of the print.
    """
    from PIL import Image

    dots_per_m = dots_per_inch / 0.0254
    square_px = max(round(board.square_m * dots_per_m), 16)
    true_dpi = square_px / board.square_m * 0.0254  # whole dots to a square: all corners fall between dots
    picture = io.BytesIO()
    image = Image.fromarray(board_image(board, square_px, square_px // 2))
    image.save(picture, format="png", dpi=(true_dpi, true_dpi), optimize=True)
    return picture.getvalue()


def render_board(
    board: BoardSettings,
    camera: PinholeCamera,
    camera_T_board: FloatArray,
    *,
    blur_px: float = 0.7,
    noise_grey: float = 0.0,
    seed: int = 0,
) -> GrayImage:
    """Draw what the camera sees of a board with a white margin on grey ground; (H, W).

    Parameters
    ----------
    blur_px, noise_grey
        Standard deviations of the lens's blur and of the grey levels; the print spans grey levels 25 to 225.

    Raises
    ------
    PoseError
        A part of the board is not in front of the camera.
    """
    import cv2

    outline = board.square_m * np.array(
        [[x, y, 0.0] for x in (-1, board.squares_x + 1) for y in (-1, board.squares_y + 1)]
    )
    depth_m = transform_points(camera_T_board, outline)[:, 2]
    if not depth_m.min() > 0:
        raise PoseError(f"camera_T_board: a corner of the board lies at depth {depth_m.min():.3g} m, needs above 0")
    fine = camera.scaled(SUPERSAMPLING)
    square_px = int(np.clip(round(fine.fx * board.square_m / float(np.median(depth_m))), 12, 240))
    texture = board_image(board, square_px, square_px).astype(np.float32) * np.float32(200 / 255) + np.float32(25)
    # texture pixel -> board: pixel centres are whole numbers on both sides, and the margin is one square
    per_px = board.square_m / square_px
    offset = 0.5 * per_px - board.square_m
    board_H_texture = np.array([[per_px, 0, offset], [0, per_px, offset], [0, 0, 1]])
    homography = _matrix(fine) @ camera_T_board[:3, [0, 1, 3]] @ board_H_texture
    seen = cv2.warpPerspective(texture, homography, (fine.width, fine.height), borderValue=(110.0,))
    seen = cv2.resize(seen, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
    grey = np.asarray(cv2.GaussianBlur(seen, (0, 0), blur_px) if blur_px > 0 else seen, dtype=np.float64)
    grey = grey + noise_grey * np.random.default_rng(seed).standard_normal(grey.shape)
    return np.clip(np.round(grey), 0, 255).astype(np.uint8)


def _validate_image(image: NDArray[Any], name: str, camera: PinholeCamera) -> None:
    if image.dtype != np.uint8:
        raise ImageError(f"{name}: the image is {image.dtype}, needs 8-bit grey (uint8)")
    if image.ndim != 2:
        raise ImageError(f"{name}: the image has shape {image.shape}, needs one grey channel (H, W)")
    if image.shape != (camera.height, camera.width):
        raise ImageError(
            f"{name}: the image is {image.shape[1]}x{image.shape[0]} px, the camera's is {camera.width}x{camera.height}"
        )


def _validate_corners(corners_px: FloatArray, corners_board: FloatArray, name: str) -> None:
    count = len(corners_px)
    if corners_px.shape != (count, 2) or corners_board.shape != (count, 3):
        raise CalibrationError(
            f"{name}: corners have shapes {corners_px.shape} and {corners_board.shape}, need (N, 2) and (N, 3)"
        )
    if count < FEWEST_CORNERS:
        raise CalibrationError(f"{name}: {count} corners, needs {FEWEST_CORNERS}")
    if not (np.isfinite(corners_px).all() and np.isfinite(corners_board).all()):
        raise CalibrationError(f"{name}: a corner is not finite")
    wide, narrow = np.linalg.svd(corners_board[:, :2] - corners_board[:, :2].mean(axis=0), compute_uv=False)
    if narrow < LINE_RATIO * wide:
        raise CalibrationError(
            f"{name}: all {count} corners lie on one line (narrow over wide extent {narrow / max(wide, 1e-30):.3g}, "
            f"limit {LINE_RATIO:g}), the pose is not identifiable"
        )


def _plane_poses(corners_px: FloatArray, corners_board: FloatArray, camera: PinholeCamera) -> list[FloatArray]:
    """Return camera_T_board (4, 4) of both poses of a plane, each refined."""
    import cv2

    K, undistorted = _matrix(camera), np.zeros(4)
    # IPPE wants the plane's points around the origin
    centre = corners_board.mean(axis=0)
    points, pixels = corners_board - centre, np.ascontiguousarray(corners_px)
    solved: Any = cv2.solvePnPGeneric(points, pixels, K, undistorted, flags=cv2.SOLVEPNP_IPPE)
    poses: list[FloatArray] = []
    for start_rotation, start_translation in zip(solved[1], solved[2], strict=True):
        rvec, tvec = cv2.solvePnPRefineLM(
            points, pixels, K, undistorted, start_rotation, start_translation,
            criteria=(cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-12),
        )  # fmt: skip
        rotation = np.asarray(cv2.Rodrigues(rvec)[0], dtype=np.float64)
        poses.append(transform(rotation, np.asarray(tvec, dtype=np.float64).ravel() - rotation @ centre))
    return poses


def _rms_px(px: FloatArray, points: FloatArray, camera_T_board: FloatArray, camera: PinholeCamera) -> float:
    missed = camera.project(transform_points(camera_T_board, points)) - px
    return float(np.sqrt((missed**2).sum(axis=1).mean()))


def _matrix(camera: PinholeCamera) -> FloatArray:
    return np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])


def _charuco(board: BoardSettings) -> Any:
    import cv2

    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
    charuco = cv2.aruco.CharucoBoard((board.squares_x, board.squares_y), board.square_m, board.marker_m, dictionary)
    charuco.setLegacyPattern(board.legacy_pattern)
    return charuco
