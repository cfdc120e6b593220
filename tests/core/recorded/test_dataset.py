"""A recorded scene is read right: units, frames and numbering against independent sources; and damaged files by name.

The scene was rendered by a program that knows nothing of sidelong, so where its true depth, its images and its CAD
model agree through our poses and intrinsics, frames and units are right together.
"""

from __future__ import annotations

import json
import shutil
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from sidelong.errors import DatasetError, ImageError, InputError, MeshError, PoseError, UnknownNameError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.raycast import RayScene
from sidelong.recorded.dataset import Dataset, Scene
from sidelong.types import FloatArray, Projector

ROBI = Path(__file__).parents[2] / "data" / "robi"
OBJECT = "Tube_fitting"
FOLDER = f"{OBJECT}/Scene_1"
NAMES = ("view_0", "view_4", "view_8", "view_10", "view_12", "view_16")


def scene_of(root: Path) -> Scene:
    return Dataset(root).scene(OBJECT, 1)


@pytest.fixture(scope="module")
def dataset() -> Dataset:
    return Dataset(ROBI)


@pytest.fixture(scope="module")
def scene(dataset: Dataset) -> Scene:
    return dataset.scene(OBJECT, 1)


@pytest.fixture(scope="module")
def rendered(dataset: Dataset, scene: Scene) -> RayScene:
    part = dataset.part(OBJECT)
    return RayScene([(part, pose) for pose in scene.base_T_objects])


@pytest.fixture
def copy(tmp_path: Path) -> Iterator[Path]:
    """A copy to damage: all poses, pictures of the first view, of true depth all."""
    ignored = shutil.ignore_patterns("LEFT_view_[1-9]*.bmp", "RIGHT*", "StereoPattern")

    def ignore(folder: str, names: list[str]) -> set[str]:
        measured = {name for name in names if name.endswith(".png") and name != "DEPTH_view_0.png"}
        return set(ignored(folder, names)) | (measured if folder.endswith("Ensenso/Depth") else set())

    root = tmp_path / "robi"
    shutil.copytree(ROBI, root, ignore=ignore, copy_function=shutil.copyfile)
    yield root
    shutil.rmtree(root, ignore_errors=True)


# --- what the files say ---


def test_objects_scenes_and_views_are_listed(dataset: Dataset, scene: Scene) -> None:
    assert dataset.objects == (OBJECT,)
    assert dataset.scenes(OBJECT) == (1,)
    assert scene.names == NAMES
    assert [view.name for view in scene.views()] == list(NAMES)
    assert scene.folder == ROBI / FOLDER


def test_the_rig_is_that_of_the_yml_files_in_metres(dataset: Dataset) -> None:
    rig = dataset.rig
    assert rig.left == PinholeCamera(640, 512, 541.548523, 541.548523, 189.413437, 254.4685975)
    assert rig.right == PinholeCamera(640, 512, 541.548523, 541.548523, 367.7483215, 254.4685975)
    assert rig.baseline_m == pytest.approx(0.1011839, abs=1e-12)
    np.testing.assert_allclose(rig.left_T_right[:3, 3], (0.1011839, 0.0, 0.0), atol=1e-12)
    assert dataset.depth_unit_m == pytest.approx(0.03125e-3, rel=1e-12)


def test_the_projector_is_that_of_the_rig_file(dataset: Dataset) -> None:
    """Midway, turned inwards by the angle whose tangent is 77 mm over 997 mm, 62 degrees wide, as high as 5:4 gives."""
    projector = dataset.rig.projector
    np.testing.assert_allclose(projector.left_T_projector[:3, 3], (0.05059195, 0.0, 0.0), atol=1e-9)
    np.testing.assert_allclose(projector.left_T_projector[:3, 2], (0.0767727435, 0.0, 0.9970486176), atol=1e-9)
    assert projector.half_width_rad == pytest.approx(np.deg2rad(31.0))
    assert np.tan(projector.half_height_rad) == pytest.approx(np.tan(np.deg2rad(31.0)) * 4 / 5)


def test_exposures_are_seconds(dataset: Dataset, scene: Scene) -> None:
    assert dataset.exposure_s(Projector.OFF) == pytest.approx(0.2)
    assert dataset.exposure_s(Projector.DOTS) == dataset.exposure_s(Projector.WHITE) == pytest.approx(0.012)
    assert scene.exposure_s("view_0", Projector.OFF) == pytest.approx(0.2)
    assert scene.exposure_s("view_16", Projector.DOTS) == pytest.approx(0.012)


def test_poses_are_metres_in_the_base_frame(scene: Scene) -> None:
    np.testing.assert_allclose(
        scene.view("view_16").base_T_camera,
        [
            [0.7693295106690378, 0.1662210907264981, -0.6168489709900082, 0.37661925281284806],
            [-0.17351556054838754, -0.8748945892259938, -0.45216347485246755, 0.3452710538289569],
            [-0.614836933065441, 0.454895599825688, -0.6442402804838501, 0.5273989906227603],
            [0, 0, 0, 1],
        ],
        atol=1e-6,
    )
    assert len(scene.base_T_objects) == 10
    np.testing.assert_allclose(scene.base_T_objects[9][:3, 3], (-0.0213765770, -0.0625266267, 0.0109978056), atol=1e-9)


def test_depth_is_the_count_of_the_picture_times_the_unit_and_missing_is_nan(scene: Scene) -> None:
    depth_m = scene.depth_m("view_0")
    counts = cv2.imread(str(ROBI / FOLDER / "Ensenso/Depth/DEPTH_view_0.png"), cv2.IMREAD_UNCHANGED)
    assert depth_m.shape == (512, 640)
    assert depth_m.dtype == np.float64
    assert counts[256, 320] == 20891
    assert depth_m[256, 320] == pytest.approx(0.65284375, abs=1e-12)
    assert np.isnan(depth_m[0, 0])
    np.testing.assert_array_equal(np.isnan(depth_m), counts == 0)
    np.testing.assert_allclose(np.nan_to_num(depth_m), counts * 0.03125e-3, rtol=1e-12)


def test_images_are_grey_bytes_and_none_where_none_was_recorded(scene: Scene) -> None:
    left = scene.image("view_12", Projector.OFF)
    expected = cv2.imread(str(ROBI / FOLDER / "Ensenso/Stereo/LEFT_view_12.bmp"), cv2.IMREAD_GRAYSCALE)
    assert left is not None
    assert left.dtype == np.uint8
    np.testing.assert_array_equal(left, expected)
    assert scene.image("view_12", Projector.OFF, "RIGHT") is None
    assert scene.image("view_12", Projector.DOTS) is None
    assert scene.image("view_0", Projector.WHITE) is None


def test_the_cad_model_is_a_part_of_some_centimetres(dataset: Dataset) -> None:
    part = dataset.part(OBJECT)
    assert (part.name, part.materials, len(part.triangles)) == (OBJECT, ("stainless",), 7344)
    assert part.diameter_m == pytest.approx(56.08e-3, abs=0.01e-3)


def test_the_white_capture_comes_with_its_exposure_and_the_poses_of_its_own_bin(dataset: Dataset, scene: Scene) -> None:
    white = dataset.white_capture(OBJECT)
    assert white is not None
    assert (white.frame.projector, white.frame.exposure_s) == (Projector.WHITE, pytest.approx(0.012))
    np.testing.assert_allclose(white.frame.view.base_T_camera[:3, 3], (0.025, -0.04, 0.7), atol=1e-9)
    assert len(white.base_T_objects) == 10
    assert not np.allclose(white.base_T_objects[0], scene.base_T_objects[0], atol=1e-2)


# --- frames and units together, against what was rendered elsewhere ---


@pytest.mark.parametrize("name", NAMES)
def test_the_cad_model_at_the_true_poses_is_where_the_true_depth_says(
    dataset: Dataset, scene: Scene, rendered: RayScene, name: str
) -> None:
    """Half a pixel beside, twenty times the error: a wrong pixel centre or axis would not pass."""
    truth_m = scene.true_depth_m(name)
    assert truth_m is not None
    left, pose = dataset.rig.left, scene.view(name).base_T_camera

    def error_m(camera: PinholeCamera) -> FloatArray:
        error_m = np.abs(rendered.render(camera, pose).depth_m - truth_m)
        return error_m[np.isfinite(error_m)]

    right = error_m(left)
    assert right.size > 4000
    assert np.median(right) < 0.03e-3
    assert (right < 0.5e-3).mean() > 0.95
    for beside in (replace(left, cx=left.cx + 0.5), replace(left, cy=left.cy + 0.5)):
        assert np.median(error_m(beside)) > 0.1e-3


@pytest.mark.parametrize("name", NAMES)
def test_measured_depth_is_the_true_depth_but_for_noise(scene: Scene, name: str) -> None:
    measured_m, truth_m = scene.depth_m(name), scene.true_depth_m(name)
    assert truth_m is not None
    both = np.isfinite(measured_m) & np.isfinite(truth_m)
    assert both.mean() > 0.1
    assert np.median(np.abs(measured_m - truth_m)[both]) < 0.5e-3
    # the truth knows more than was measured, else there were nothing to complete
    assert np.isfinite(truth_m).sum() > 1.5 * np.isfinite(measured_m).sum()


@pytest.mark.parametrize("projector", [Projector.OFF, Projector.DOTS])
def test_the_right_image_repeats_the_left_at_the_disparity_of_the_true_depth(
    dataset: Dataset, scene: Scene, projector: Projector
) -> None:
    left, right = scene.image("view_0", projector), scene.image("view_0", projector, "RIGHT")
    truth_m = scene.true_depth_m("view_0")
    assert left is not None
    assert right is not None
    assert truth_m is not None
    rows, columns = np.mgrid[:512, :640].astype(np.float32)

    def alike(baseline_m: float, beside_px: float) -> float:
        u = columns - replace(dataset.rig, baseline_m=baseline_m).disparity_px(truth_m) + beside_px
        seen = np.isfinite(u) & (u >= 0) & (u <= 639)
        moved = cv2.remap(right, np.where(seen, u, 0).astype(np.float32), rows, cv2.INTER_LINEAR)
        return float(np.corrcoef(left[seen], moved[seen])[0, 1])

    here = alike(dataset.rig.baseline_m, 0.0)
    assert here > 0.95
    assert max(alike(dataset.rig.baseline_m, beside_px) for beside_px in (-1.0, 1.0)) < here - 0.03
    assert alike(1.01 * dataset.rig.baseline_m, 0.0) < here - 0.03


# --- how the published data sets differ ---


def test_true_depth_counted_anew_is_found_by_its_pose(copy: Path, scene: Scene) -> None:
    truth = copy / FOLDER / "GT_Depth"
    kept = ("view_8", "view_4", "view_16")
    files = {name: [(truth / f"DEPTH_{name}{suffix}").read_bytes() for suffix in (".png", ".json")] for name in kept}
    shutil.rmtree(truth)
    truth.mkdir()
    for index, name in enumerate(kept):
        for suffix, content in zip((".png", ".json"), files[name], strict=True):
            (truth / f"DEPTH_view_{index}{suffix}").write_bytes(content)
    found = scene_of(copy)
    for name in kept:
        np.testing.assert_array_equal(found.true_depth_m(name), scene.true_depth_m(name))
    assert [found.true_depth_m(name) for name in ("view_0", "view_10", "view_12")] == [None] * 3


def test_true_depth_without_poses_is_found_by_its_name(copy: Path, scene: Scene) -> None:
    for path in (copy / FOLDER / "GT_Depth").glob("*.json"):
        path.unlink()
    (copy / FOLDER / "GT_Depth/DEPTH_view_4.png").unlink()
    np.testing.assert_array_equal(scene_of(copy).true_depth_m("view_8"), scene.true_depth_m("view_8"))
    assert scene_of(copy).true_depth_m("view_4") is None


def test_true_depth_from_a_place_nobody_looked_from_belongs_to_no_view(copy: Path) -> None:
    edit_json("GT_Depth/DEPTH_view_8.json", lambda about: about["cam_pose"].__setitem__(3, 400.0))(copy)
    assert scene_of(copy).true_depth_m("view_8") is None
    assert scene_of(copy).true_depth_m("view_10") is not None


def test_a_scene_without_true_depth_has_none(copy: Path) -> None:
    shutil.rmtree(copy / FOLDER / "GT_Depth")
    assert [scene_of(copy).true_depth_m(name) for name in NAMES] == [None] * 6


def test_the_folder_of_true_depth_may_have_a_longer_name(copy: Path, scene: Scene) -> None:
    (copy / FOLDER / "GT_Depth").rename(copy / FOLDER / "GT_Depth_Raw")
    np.testing.assert_array_equal(scene_of(copy).true_depth_m("view_12"), scene.true_depth_m("view_12"))


def test_without_a_rig_file_the_projector_is_midway_and_looks_ahead(copy: Path) -> None:
    (copy / "cam/rig.json").unlink()
    found = Dataset(copy)
    np.testing.assert_allclose(found.rig.projector.left_T_projector[:3, 3], (0.1011839 / 2, 0.0, 0.0))
    np.testing.assert_array_equal(found.rig.projector.left_T_projector[:3, :3], np.eye(3))
    assert found.rig.projector.half_width_rad == pytest.approx(np.deg2rad(31.0))
    assert [found.exposure_s(projector) for projector in Projector] == [None] * 3
    assert scene_of(copy).exposure_s("view_4", Projector.DOTS) is None
    # beside an image it is still told
    assert scene_of(copy).exposure_s("view_4", Projector.OFF) == pytest.approx(0.2)


def test_the_first_line_opencv_writes_is_accepted(copy: Path) -> None:
    for path in (copy / "cam").glob("*.yml"):
        path.write_text(f"%YAML:1.0\n---\n{path.read_text()}")
    assert Dataset(copy).rig.left == Dataset(ROBI).rig.left
    assert Dataset(copy).depth_unit_m == Dataset(ROBI).depth_unit_m


def test_the_baseline_may_stand_beside_the_left_intrinsics(copy: Path) -> None:
    edit_text("cam/Ensenso_DEPTH.yml", "baseline: 101.1839", "")(copy)
    left = copy / "cam/Ensenso_LEFT.yml"
    left.write_text(f"{left.read_text()}baseline: 98.5\n")
    assert Dataset(copy).rig.baseline_m == pytest.approx(0.0985)


def test_a_view_listed_twice_is_one_view(copy: Path) -> None:
    (copy / FOLDER / "Ensenso/list.txt").write_text("view_4\nview_0\n\nview_4\n")
    assert scene_of(copy).names == ("view_4", "view_0")


def test_without_a_white_image_there_is_no_white_capture(copy: Path) -> None:
    (copy / OBJECT / "Calibration/Phong/LEFT_white.bmp").unlink()
    assert Dataset(copy).white_capture(OBJECT) is None


# --- damage ---

Damage = Callable[[Path], object]
Use = Callable[[Path], object]


def placed(file: str) -> str:
    """Files of the scene are named without its folder, all others from the root."""
    return file if file.split("/")[0] in ("cam", "models", OBJECT) else f"{FOLDER}/{file}"


def nothing(root: Path) -> None:
    """The data set stays as it is: what is asked of it is wrong."""


def removed(file: str) -> Damage:
    return lambda root: (root / placed(file)).unlink()


def written(file: str, content: str | bytes) -> Damage:
    data = content.encode() if isinstance(content, str) else content
    return lambda root: (root / placed(file)).write_bytes(data)


def edit_text(file: str, old: str, new: str) -> Damage:
    def damage(root: Path) -> None:
        content = (root / placed(file)).read_text()
        assert old in content
        (root / placed(file)).write_text(content.replace(old, new))

    return damage


def edit_json(file: str, change: Callable[[dict[str, Any]], object]) -> Damage:
    def damage(root: Path) -> None:
        about = json.loads((root / placed(file)).read_text())
        change(about)
        (root / placed(file)).write_text(json.dumps(about))

    return damage


def edit_pose(change: Callable[[list[Any]], Any], file: str = "Ensenso/Depth/DEPTH_view_0.json") -> Damage:
    return edit_json(file, lambda about: about.update(cam_pose=change(about["cam_pose"])))


def cut(file: str, size: int) -> Damage:
    return lambda root: (root / placed(file)).write_bytes((root / placed(file)).read_bytes()[:size])


def flipped(file: str, at: int) -> Damage:
    def damage(root: Path) -> None:
        content = bytearray((root / placed(file)).read_bytes())
        content[at] ^= 0x10
        (root / placed(file)).write_bytes(content)

    return damage


def pictured(file: str, mode: str, size: tuple[int, int]) -> Damage:
    return lambda root: Image.new(mode, size).save(root / placed(file))


def huge_bmp(root: Path) -> None:
    """Width and height in the header say 100,000 each: nothing may try to hold that."""
    path = root / placed(LEFT)
    content = bytearray(path.read_bytes())
    struct.pack_into("<ii", content, 18, 100_000, 100_000)
    path.write_bytes(content)


def reshaped(change: Callable[[np.ndarray], np.ndarray], *, materials: bool = True) -> Damage:
    """Change the triangles (F, 3, 3) of the STL file, in mm."""

    def damage(root: Path) -> None:
        path = root / STL
        content = path.read_bytes()
        record = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
        triangles = np.frombuffer(content, record, offset=84).copy()
        corners = change(triangles["corners"])
        triangles = triangles[: len(corners)]
        triangles["corners"] = corners
        path.write_bytes(content[:80] + struct.pack("<I", len(triangles)) + triangles.tobytes())
        if not materials:
            path.with_suffix(".json").unlink()

    return damage


def ranges(*face_ranges: tuple[int, int, str]) -> Damage:
    return written(f"models/{OBJECT}.json", json.dumps({"unit": "mm", "face_ranges": face_ranges}))


LIST, POSE, DEPTH = "Ensenso/list.txt", "Ensenso/Depth/DEPTH_view_0.json", "Ensenso/Depth/DEPTH_view_0.png"
LEFT, LEFT_ABOUT = "Ensenso/Stereo/LEFT_view_0.bmp", "Ensenso/Stereo/LEFT_view_0.json"
OBJECTS, TRUTH, TRUTH_POSE = "GT_world2obj.json", "GT_Depth/DEPTH_view_8.png", "GT_Depth/DEPTH_view_8.json"
DEPTH_YML, LEFT_YML, RIG = "cam/Ensenso_DEPTH.yml", "cam/Ensenso_LEFT.yml", "cam/rig.json"
STL, WHITE = f"models/{OBJECT}.stl", f"{OBJECT}/Calibration/Phong/LEFT_white"
FX = "fx: 541.548523"


def rig(root: Path) -> object:
    return Dataset(root).rig


def part(root: Path) -> object:
    return Dataset(root).part(OBJECT)


def names(root: Path) -> object:
    return scene_of(root).names


def views(root: Path) -> object:
    return scene_of(root).views()


def depth(root: Path) -> object:
    return scene_of(root).depth_m("view_0")


def left_image(root: Path) -> object:
    return scene_of(root).image("view_0", Projector.OFF)


def exposure(root: Path) -> object:
    return scene_of(root).exposure_s("view_0", Projector.OFF)


def pattern_exposure(root: Path) -> object:
    return Dataset(root).exposure_s(Projector.DOTS)


def objects(root: Path) -> object:
    return scene_of(root).base_T_objects


def truth(root: Path) -> object:
    return scene_of(root).true_depth_m("view_8")


def white(root: Path) -> object:
    return Dataset(root).white_capture(OBJECT)


TRUNCATED = r"DEPTH_view_0\.png: the image is truncated or damaged"
NOT_16 = r"DEPTH_view_0\.json: a pose needs 16 numbers"

DAMAGES: dict[str, tuple[Damage, Use, type[InputError], str]] = {
    # names
    "no such folder": (shutil.rmtree, rig, UnknownNameError, r"robi: no such data set folder"),
    "unknown object": (
        nothing, lambda root: Dataset(root).scene("Gear", 1), UnknownNameError,
        "robi: object 'Gear' is unknown, known are Tube_fitting$",
    ),
    "no object at all": (
        lambda root: shutil.rmtree(root / OBJECT), lambda root: Dataset(root).scenes(OBJECT), UnknownNameError,
        "robi: object 'Tube_fitting' is unknown, known are none$",
    ),
    "unknown scene": (
        nothing, lambda root: Dataset(root).scene(OBJECT, 2), UnknownNameError,
        "Tube_fitting: scene 2 is unknown, known are 1$",
    ),
    "unknown view": (
        nothing, lambda root: scene_of(root).view("view_1"), UnknownNameError,
        "Scene_1: view 'view_1' is unknown, known are view_0, view_4, view_8, view_10, view_12, view_16$",
    ),
    # list of views
    "list missing": (removed(LIST), names, DatasetError, r"list\.txt: the list of views is missing"),
    "list empty": (written(LIST, ""), names, DatasetError, r"list\.txt: lists no view"),
    "list of blanks": (written(LIST, " \n\t\n"), names, DatasetError, r"list\.txt: lists no view"),
    "list with a path": (
        written(LIST, "view_0\n../../../secret\n"), names, DatasetError,
        r"list\.txt: '\.\./\.\./\.\./secret' is no name of a view",
    ),
    "list of bytes": (written(LIST, b"\xff\xfe\x00view"), names, DatasetError, r"list\.txt: .* is no name of a view"),
    # intrinsics
    "left yml missing": (removed(LEFT_YML), rig, DatasetError, r"Ensenso_LEFT\.yml: the file is missing"),
    "depth yml missing": (removed(DEPTH_YML), depth, DatasetError, r"Ensenso_DEPTH\.yml: the file is missing"),
    "no fx": (
        edit_text(LEFT_YML, FX, ""), rig, DatasetError, r"Ensenso_LEFT\.yml: fx is None, needs a finite number",
    ),
    "fx NaN": (
        edit_text(LEFT_YML, FX, "fx: .nan"), rig, DatasetError, r"Ensenso_LEFT\.yml: fx is nan, needs a finite",
    ),
    "fx text": (
        edit_text(LEFT_YML, FX, "fx: wide"), rig, DatasetError, r"Ensenso_LEFT\.yml: fx is 'wide', needs a finite",
    ),
    "fx true": (
        edit_text(LEFT_YML, FX, "fx: yes"), rig, DatasetError, r"Ensenso_LEFT\.yml: fx is True, needs a finite",
    ),
    "fx 0": (
        edit_text(LEFT_YML, FX, "fx: 0"), rig, DatasetError,
        r"Ensenso_LEFT\.yml: camera: focal lengths are 0\.0, 541\.\d+ px, need positive",
    ),
    "width 0": (
        edit_text(LEFT_YML, "width: 640", "width: 0"), rig, DatasetError,
        r"Ensenso_LEFT\.yml: width is 0, needs a number greater than 0",
    ),
    "sizes differ": (
        edit_text(LEFT_YML, "width: 640", "width: 320"), rig, DatasetError, r"cam: rig: left and right .* in size",
    ),
    "no baseline": (
        edit_text(DEPTH_YML, "baseline: 101.1839", ""), rig, DatasetError,
        r"Ensenso_DEPTH\.yml: baseline is None, needs a finite number",
    ),
    "negative baseline": (
        edit_text(DEPTH_YML, "baseline: ", "baseline: -"), rig, DatasetError,
        r"Ensenso_DEPTH\.yml: baseline is -101\.1839, needs a number greater than 0",
    ),
    "no depth unit": (
        edit_text(DEPTH_YML, "depth_unit: 0.03125", ""), depth, DatasetError,
        r"Ensenso_DEPTH\.yml: depth_unit is None, needs a finite number",
    ),
    "depth unit 0": (
        edit_text(DEPTH_YML, "depth_unit: 0.03125", "depth_unit: 0"), depth, DatasetError,
        r"Ensenso_DEPTH\.yml: depth_unit is 0, needs a number greater than 0",
    ),
    "yml is prose": (
        written(LEFT_YML, "see the other folder"), rig, DatasetError, r"Ensenso_LEFT\.yml: holds str, needs names",
    ),
    "yml empty": (written(LEFT_YML, ""), rig, DatasetError, r"Ensenso_LEFT\.yml: holds NoneType, needs names"),
    "yml broken": (
        written(LEFT_YML, "fx: [1, 2"), rig, DatasetError, r"Ensenso_LEFT\.yml: cannot be read as YAML",
    ),
    "yml of bytes": (
        written(LEFT_YML, b"\xff\xfe\x80"), rig, DatasetError, r"Ensenso_LEFT\.yml: cannot be read as YAML",
    ),
    "rig file is a list": (written(RIG, "[]"), rig, DatasetError, r"rig\.json: holds list, needs names with values"),
    "projector of 12 numbers": (
        edit_json(RIG, lambda about: about["projector_in_left"].pop()), rig, PoseError,
        r"rig\.json: a pose needs 16 numbers \(4x4, row-major\), got 15",
    ),
    "projector of 200 degrees": (
        edit_json(RIG, lambda about: about.update(projector_fov_x_deg=200)), rig, DatasetError,
        r"cam: projector: half_width_rad is 1\.7\d+ rad, limits 0 to pi/2",
    ),
    "exposures are no names": (
        edit_json(RIG, lambda about: about.update(exposure_ms=12)), pattern_exposure, DatasetError,
        r"rig\.json: holds int, needs names",
    ),
    "exposure 0": (
        edit_json(RIG, lambda about: about["exposure_ms"].update(pattern=0)), pattern_exposure, DatasetError,
        r"rig\.json: pattern is 0, needs a number greater than 0",
    ),
    "exposure of an image negative": (
        edit_json(LEFT_ABOUT, lambda about: about.update(exposure_ms=-3)), exposure, DatasetError,
        r"LEFT_view_0\.json: exposure_ms is -3, needs a number greater than 0",
    ),
    # pictures
    "depth missing": (removed(DEPTH), depth, ImageError, r"DEPTH_view_0\.png: the image is missing"),
    **{f"png cut to {size}": (cut(DEPTH, size), depth, ImageError, TRUNCATED) for size in (0, 8, 33, 60, 30_000)},
    # all pixels are there, but not the end of the file
    **{f"png cut by {-size}": (cut(DEPTH, size), depth, ImageError, TRUNCATED) for size in (-30, -14, -12, -6)},
    "png with a flipped bit": (flipped(DEPTH, 30_000), depth, ImageError, TRUNCATED),
    "text named png": (written(DEPTH, "version https://example"), depth, ImageError, TRUNCATED),
    **{
        f"bmp cut to {size}": (
            cut(LEFT, size), left_image, ImageError, r"LEFT_view_0\.bmp: the image is truncated or damaged",
        )
        for size in (0, 2, 14, 54, 1078, 200_000, -1)
    },
    "bmp of 10 gigapixels": (huge_bmp, left_image, ImageError, r"LEFT_view_0\.bmp: .*10000000000 pixels"),
    "depth of another size": (
        pictured(DEPTH, "I;16", (320, 256)), depth, ImageError,
        r"DEPTH_view_0\.png: the image is 320x256 px, cam/ says 640x512 px",
    ),
    "image of another size": (
        pictured(LEFT, "L", (512, 640)), left_image, ImageError,
        r"LEFT_view_0\.bmp: the image is 512x640 px, cam/ says 640x512 px",
    ),
    "depth of 8 bits": (
        pictured(DEPTH, "L", (640, 512)), depth, ImageError,
        r"DEPTH_view_0\.png: its pixels are of kind 'L', a depth map has 16-bit",
    ),
    "depth in colour": (
        pictured(DEPTH, "RGB", (640, 512)), depth, ImageError,
        r"DEPTH_view_0\.png: its pixels are of kind 'RGB', a depth map has 16-bit",
    ),
    "true depth cut": (cut(TRUTH, 20_000), truth, ImageError, r"GT_Depth/DEPTH_view_8\.png: the image is truncated"),
    "white image cut": (cut(f"{WHITE}.bmp", 900), white, ImageError, r"LEFT_white\.bmp: the image is truncated"),
    # poses
    "pose file missing": (removed(POSE), views, DatasetError, r"DEPTH_view_0\.json: the file is missing"),
    "pose missing": (edit_json(POSE, dict.clear), views, PoseError, rf"{NOT_16} \(4x4, row-major\), got 0"),
    "pose of 15 numbers": (edit_pose(lambda p: p[:15]), views, PoseError, rf"{NOT_16} \(4x4, row-major\), got 15"),
    "pose of words": (edit_pose(lambda p: "above the bin"), views, PoseError, f"{NOT_16}, got 'above the bin'"),
    "pose with a word": (edit_pose(lambda p: [*p[:15], "x"]), views, PoseError, f"{NOT_16}, got"),
    "pose with NaN": (
        edit_pose(lambda p: [*p[:3], np.nan, *p[4:]]), views, PoseError,
        r"DEPTH_view_0\.json: the pose has 1 of 16 entries not finite",
    ),
    "pose sheared": (
        edit_pose(lambda p: [p[0] * 1.01, *p[1:]]), views, PoseError,
        r"DEPTH_view_0\.json: the rotation is not orthonormal, \|R R\^T - I\| is 0\.0\d+, limit 0\.0001",
    ),
    "pose mirrored": (
        edit_pose(lambda p: [-x if i % 4 == 0 and i < 12 else x for i, x in enumerate(p)]), views, PoseError,
        r"DEPTH_view_0\.json: the rotation is a reflection, its determinant is -1",
    ),
    "pose by columns": (
        edit_pose(lambda p: np.reshape(p, (4, 4)).T.ravel().tolist()), views, PoseError,
        r"DEPTH_view_0\.json: the last row of the pose is \[54\.79.*, should be \[0, 0, 0, 1\]",
    ),
    "pose file is a list": (written(POSE, "[1, 2]"), views, DatasetError, r"DEPTH_view_0\.json: holds list, needs"),
    "pose file cut": (cut(POSE, 50), views, DatasetError, r"DEPTH_view_0\.json: cannot be read as JSON"),
    "pose of true depth": (
        edit_pose(lambda p: p[:4], TRUTH_POSE), truth, PoseError, r"GT_Depth/DEPTH_view_8\.json: a pose .* got 4",
    ),
    "true poses missing": (removed(OBJECTS), objects, DatasetError, r"GT_world2obj\.json: the file is missing"),
    "true poses are a list": (written(OBJECTS, "[]"), objects, DatasetError, r"GT_world2obj\.json: holds list, needs"),
    "one true pose is short": (
        edit_json(OBJECTS, lambda poses: poses["Object_3"].pop()), objects, PoseError,
        r"GT_world2obj\.json: Object_3: a pose needs 16 numbers \(4x4, row-major\), got 15",
    ),
    "white capture without pose": (
        edit_json(f"{WHITE}.json", lambda about: about.pop("cam_pose")), white, PoseError,
        r"LEFT_white\.json: a pose needs 16 numbers",
    ),
    "white capture without exposure": (
        edit_json(f"{WHITE}.json", lambda about: about.pop("exposure_ms")), white, DatasetError,
        r"LEFT_white\.json: exposure_ms is None, needs a finite number",
    ),
    # CAD model
    "mesh missing": (removed(STL), part, UnknownNameError, r"Tube_fitting\.stl: no such CAD file"),
    "mesh in metres": (
        reshaped(lambda corners: corners * 1e-3), part, MeshError,
        r"Tube_fitting\.stl: .* the largest extent is 0\.05\d+ mm, limits 0\.5 to 5000 mm; .* in metres",
    ),
    "mesh without a byte": (written(STL, b""), part, MeshError, r"Tube_fitting\.stl: "),
    "mesh without a triangle": (
        reshaped(lambda corners: corners[:0]), part, MeshError, r"Tube_fitting\.stl: .*(empty|cannot be read)",
    ),
    "mesh cut": (cut(STL, 200_000), part, MeshError, r"Tube_fitting\.stl: "),
    "mesh open": (
        reshaped(lambda corners: corners[: len(corners) * 4 // 5], materials=False), part, MeshError,
        r"Tube_fitting\.stl: .* not watertight, \d+ edges have a triangle on one side alone; .* limit 1 %",
    ),
    "mesh with NaN": (
        reshaped(lambda corners: np.where(corners == corners.max(), np.nan, corners)), part, MeshError,
        r"Tube_fitting\.stl: .* coordinates are not finite",
    ),
    "materials overlap": (
        ranges((0, 5000, "stainless"), (4000, 7344, "rubber")), part, MeshError,
        r"Tube_fitting\.json: face range 4000\.\.7344 overlaps another",
    ),
    "materials with a gap": (
        ranges((0, 5000, "stainless"), (5001, 7344, "rubber")), part, MeshError,
        r"Tube_fitting\.json: 1 of 7344 faces have no material",
    ),
    "materials beyond the mesh": (
        ranges((0, 7345, "stainless")), part, MeshError,
        r"Tube_fitting\.json: face range 0\.\.7345 lies outside 0\.\.7344",
    ),
}  # fmt: skip


@pytest.mark.parametrize(("damage", "use", "error", "message"), DAMAGES.values(), ids=DAMAGES)
def test_damage_is_refused_by_the_name_of_the_file(
    copy: Path, damage: Damage, use: Use, error: type[InputError], message: str
) -> None:
    damage(copy)
    with pytest.raises(InputError, match=message) as refused:
        use(copy)
    assert type(refused.value) is error
    assert str(refused.value).startswith(str(copy))


@pytest.mark.parametrize("use", dict.fromkeys(use for _, use, _, _ in DAMAGES.values() if use.__name__ != "<lambda>"))
def test_nothing_is_refused_of_the_copy_before_it_is_damaged(copy: Path, use: Use) -> None:
    assert use(copy) is not None


def test_the_range_of_distances_holds_what_was_measured() -> None:
    scene = Dataset(ROBI).scene("Tube_fitting", 1)
    near_m, far_m = scene.distance_range_m() or (0.0, 0.0)
    depths = np.concatenate([scene.depth_m(name).ravel() for name in scene.names])
    inside = (depths >= near_m) & (depths <= far_m)
    assert inside.sum() > 0.95 * np.isfinite(depths).sum()
    assert 0.5 < near_m < far_m < 1.0
