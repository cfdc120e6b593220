"""Captures for calibrations: read as they were recorded, or refused with the file and what is wrong with it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from sidelong.errors import CalibrationError, DatasetError, ImageError, PoseError
from sidelong.recorded.captures import CalibrationCaptures
from sidelong.recorded.dataset import Dataset

ROBI = Path(__file__).parents[2] / "data" / "robi"
OBJECT = "Tube_fitting"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """The intrinsics and captures of the recorded scene, to be damaged."""
    shutil.copytree(ROBI / "cam", tmp_path / "cam")
    shutil.copytree(ROBI / OBJECT / "Calibration", tmp_path / OBJECT / "Calibration")
    return tmp_path


def captures(root: Path) -> CalibrationCaptures:
    return CalibrationCaptures(Dataset(root), OBJECT)


def response(root: Path) -> Path:
    return root / OBJECT / "Calibration" / "Response"


def phong(root: Path) -> Path:
    return root / OBJECT / "Calibration" / "Phong"


def change(path: Path, **changes: object) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


# --- bracket ---


def test_a_bracket_has_an_exposure_for_each_image_in_seconds() -> None:
    bracket = captures(ROBI).bracket()
    assert len(bracket.names) == len(bracket.images) == len(bracket.exposures_s) == 9
    assert dict(zip(bracket.names, bracket.exposures_s, strict=True))["LEFT_0.25ms.bmp"] == pytest.approx(0.25e-3)
    assert {image.shape for image in bracket.images} == {(256, 320)}
    assert {file.name for file in bracket.files} == {"times.json", *bracket.names}


@pytest.mark.parametrize(("unit", "seconds"), [("s", 1.0), ("ms", 1e-3), ("us", 1e-6)])
def test_exposures_are_read_in_the_unit_the_file_names(root: Path, unit: str, seconds: float) -> None:
    change(response(root) / "times.json", unit=unit)
    assert max(captures(root).bracket().exposures_s) == pytest.approx(64 * seconds)


def test_of_both_cameras_the_left_one_is_taken(root: Path) -> None:
    folder = response(root)
    shutil.copy(folder / "LEFT_1ms.bmp", folder / "RIGHT_1ms.bmp")
    times = json.loads((folder / "times.json").read_text())["times"]
    change(folder / "times.json", times=times | {"RIGHT_1ms.bmp": 1})
    assert all(name.startswith("LEFT") for name in captures(root).bracket().names)


def test_captures_of_the_device_stand_in_for_those_of_the_object(root: Path) -> None:
    (root / "Calibration").mkdir()
    response(root).rename(root / "Calibration" / "Response")
    assert len(captures(root).bracket().names) == 9
    assert len(CalibrationCaptures(Dataset(root)).bracket().names) == 9


def test_where_nothing_was_captured_all_places_are_named(root: Path) -> None:
    shutil.rmtree(response(root))
    with pytest.raises(DatasetError, match=r"Tube_fitting/Calibration/Response and .*/Calibration/Response: no such"):
        captures(root).bracket()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"unit": "min"}, r"times\.json: unit is 'min', known are s, ms, us"),
        ({"times": [1, 2]}, r"times\.json: holds list"),
        ({"times": {"LEFT_1ms.bmp": "soon"}}, r"LEFT_1ms\.bmp is 'soon', needs a finite number"),
        ({"times": {"LEFT_1ms.bmp": float("nan")}}, r"LEFT_1ms\.bmp is nan"),
        ({"times": {"../../cam/rig.json": 1}}, r"'\.\./\.\./cam/rig\.json' is no name of a file in its folder"),
        ({"times": {"LEFT_3ms.bmp": 3}}, r"LEFT_3ms\.bmp: the image is missing"),
    ],
)
def test_times_that_cannot_be_used_are_named(root: Path, changes: dict[str, object], message: str) -> None:
    change(response(root) / "times.json", **changes)
    with pytest.raises((DatasetError, ImageError), match=message):
        captures(root).bracket()


def test_images_of_more_than_8_bits_or_with_colours_are_refused(root: Path) -> None:
    path = response(root) / "LEFT_1ms.bmp"
    gray = np.asarray(Image.open(path))
    Image.fromarray(gray.astype(np.uint16) * 256).save(path, format="PNG")
    with pytest.raises(ImageError, match=r"LEFT_1ms\.bmp: its pixels are of kind 'I;16', needs 8-bit grey ones"):
        captures(root).bracket()
    coloured = np.stack([gray, gray, gray], axis=2)
    coloured[:3, :2, 0] ^= 1
    Image.fromarray(coloured).save(path)
    with pytest.raises(ImageError, match=r"LEFT_1ms\.bmp: 6 of its pixels have a colour"):
        captures(root).bracket()


def test_a_grey_image_may_be_stored_with_three_channels(root: Path) -> None:
    path = response(root) / "LEFT_1ms.bmp"
    gray = np.array(Image.open(path))
    Image.fromarray(np.stack([gray] * 3, axis=2)).save(path)
    bracket = captures(root).bracket()
    np.testing.assert_array_equal(bracket.images[bracket.names.index("LEFT_1ms.bmp")], gray)


# --- white images and sprayed depth ---


def test_a_sprayed_capture_has_both_images_the_depth_and_what_is_marked() -> None:
    capture = captures(ROBI).sprayed()
    assert (len(capture.left), len(capture.right), len(capture.base_T_objects)) == (1, 1, 10)
    assert capture.exposure_s == pytest.approx(0.012)
    assert capture.left[0].shape == capture.depth_m.shape == (512, 640)
    assert capture.mask is not None
    assert np.isfinite(capture.depth_m[capture.mask]).mean() > 0.9
    assert 0.4 < np.nanmedian(capture.depth_m) < 1.0


def test_without_right_image_mask_and_poses_there_is_the_left_one(root: Path) -> None:
    for name in ("RIGHT_white.bmp", "RIGHT_white.json", "mask_parts.png", "GT_world2obj.json"):
        (phong(root) / name).unlink()
    capture = captures(root).sprayed()
    assert (capture.right, capture.mask, capture.base_T_objects) == ((), None, ())


def test_shifted_patterns_stand_in_for_a_white_one_in_the_order_of_their_numbers(root: Path) -> None:
    folder = phong(root)
    white = np.array(Image.open(folder / "LEFT_white.bmp"))
    for index in range(11):
        Image.fromarray(np.full_like(white, index)).save(folder / f"LEFT_pattern_{index}.bmp")
    (folder / "LEFT_white.bmp").unlink()
    (folder / "LEFT_white.json").rename(folder / "LEFT_pattern_0.json")
    capture = captures(root).sprayed()
    assert [int(image[0, 0]) for image in capture.left] == list(range(11))


def test_a_camera_that_moved_between_the_scans_is_told(root: Path) -> None:
    about = phong(root) / "DEPTH_sprayed.json"
    pose = json.loads(about.read_text())["cam_pose"]
    pose[3] += 4.0
    change(about, cam_pose=pose)
    with pytest.raises(
        CalibrationError, match=r"the camera moved 4 mm and .* limits 1 mm and 0\.11 degrees: take both"
    ):
        captures(root).sprayed()


@pytest.mark.parametrize("missing", ["LEFT_white.bmp", "DEPTH_sprayed.png"])
def test_a_missing_picture_is_named(root: Path, missing: str) -> None:
    (phong(root) / missing).unlink()
    with pytest.raises(ImageError, match=missing.replace(".", r"\.")):
        captures(root).sprayed()


def test_an_exposure_that_is_missing_is_named(root: Path) -> None:
    about = phong(root) / "LEFT_white.json"
    content = json.loads(about.read_text())
    del content["exposure_ms"]
    about.write_text(json.dumps(content))
    with pytest.raises(DatasetError, match=r"LEFT_white\.json: exposure_ms is None"):
        captures(root).sprayed()


# --- plane ---


def test_planes_are_read_with_their_own_exposures(root: Path) -> None:
    folder = root / "Calibration" / "Plane"
    folder.mkdir(parents=True)
    for index in range(2):
        shutil.copy(phong(root) / "LEFT_white.bmp", folder / f"LEFT_white_{index}.bmp")
        shutil.copy(phong(root) / "DEPTH_sprayed.png", folder / f"DEPTH_{index}.png")
        (folder / f"LEFT_white_{index}.json").write_text(json.dumps({"exposure_ms": 4.0 + index}))
    planes, files = captures(root).planes()
    assert [(plane.name, plane.exposure_s) for plane in planes] == [("0", 0.004), ("1", 0.005)]
    assert len(files) == 6


def test_a_folder_without_planes_is_told(root: Path) -> None:
    (root / "Calibration" / "Plane").mkdir(parents=True)
    with pytest.raises(DatasetError, match=r"Plane: has no LEFT_white_<i>\.bmp"):
        captures(root).planes()


# --- board ---


def board(root: Path, **poses: object) -> Path:
    folder = root / "Calibration" / "HandEye"
    folder.mkdir(parents=True)
    (folder / "board.json").write_text(json.dumps({"squares_x": 7}))
    for name in poses:
        shutil.copy(phong(root) / "LEFT_white.bmp", folder / f"{name}.bmp")
    content = {"unit": "mm", "poses": {f"{name}.bmp": pose for name, pose in poses.items()}}
    (folder / "poses.json").write_text(json.dumps(content))
    return folder


def test_each_image_of_a_board_has_its_pose_in_metres(root: Path) -> None:
    pose = np.eye(4)
    pose[:3, 3] = (100.0, -20.0, 300.0)
    board(root, a=np.eye(4).tolist(), b=pose.ravel().tolist())
    read = captures(root).board()
    assert read.names == ("a.bmp", "b.bmp")
    assert read.board == {"squares_x": 7}
    np.testing.assert_allclose(read.base_T_flanges[1][:3, 3], (0.1, -0.02, 0.3))
    change(root / "Calibration" / "HandEye" / "poses.json", unit="m")
    np.testing.assert_allclose(captures(root).board().base_T_flanges[1][:3, 3], (100.0, -20.0, 300.0))


def test_a_pose_that_is_none_is_named_with_its_image(root: Path) -> None:
    board(root, a=(2 * np.eye(4)).tolist())
    with pytest.raises(PoseError, match=r"poses\.json: a\.bmp: the"):
        captures(root).board()


def test_other_exposures_of_the_white_image_come_in_their_order(root: Path) -> None:
    for index, exposure_ms in ((2, 0.75), (10, 0.2), (1, 3.0)):
        shutil.copy(phong(root) / "LEFT_white.bmp", phong(root) / f"LEFT_white_{index}.bmp")
        (phong(root) / f"LEFT_white_{index}.json").write_text(json.dumps({"exposure_ms": exposure_ms}))
    others = captures(root).sprayed().others
    assert [other.exposure_s for other in others] == pytest.approx([3e-3, 0.75e-3, 0.2e-3])
    assert captures(ROBI).sprayed().others == ()


def test_the_room_is_read_where_it_was_taken(root: Path) -> None:
    assert captures(root).sprayed().room is None
    shutil.copy(phong(root) / "LEFT_white.bmp", phong(root) / "LEFT_off.bmp")
    (phong(root) / "LEFT_off.json").write_text(json.dumps({"exposure_ms": 200}))
    room = captures(root).sprayed().room
    assert room is not None
    assert (room.exposure_s, room.right) == (pytest.approx(0.2), None)
