"""BOP's files, read back with json, csv, Pillow and trimesh alone, as its toolkit reads them."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from sidelong.evaluation.bop import ImageId, export_scene, symmetry_info, write_model, write_results
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.symmetry import Symmetry
from sidelong.geometry.transforms import rotation_about, transform
from sidelong.recorded.dataset import Dataset
from sidelong.types import DetectedObject, Hypothesis

ROBI = Path(__file__).parents[2] / "data" / "robi"
OBJECT = "Tube_fitting"


def parsed(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_results_are_millimetres_row_by_row(tmp_path: Path) -> None:
    rotation = rotation_about((1, 2, 3), 0.7)
    sure = Hypothesis(transform(rotation, (0.01, -0.02, 0.7)), 91.5, 0.8)
    other = Hypothesis(transform(np.eye(3), (0.1, 0.0, 0.8)), 85.0, 0.2)
    path = tmp_path / "results" / "sidelong_robi-test.csv"
    write_results(
        path,
        [
            (ImageId(1, 0), [DetectedObject((sure, other))], 0.25),
            (ImageId(1, 3, object=2), [DetectedObject((other,)), DetectedObject((sure,))], 0.5),
            (ImageId(1, 4), [], 0.1),
        ],
    )
    rows = parsed(path)
    assert path.read_text().splitlines()[0] == "scene_id,im_id,obj_id,score,R,t,time"
    assert [(row["scene_id"], row["im_id"], row["obj_id"]) for row in rows] == [
        ("1", "0", "1"), ("1", "3", "2"), ("1", "3", "2"),
    ]  # fmt: skip
    assert float(rows[0]["score"]) == 91.5
    assert float(rows[0]["time"]) == 0.25
    np.testing.assert_array_equal(np.array(rows[0]["R"].split(), dtype=float).reshape(3, 3), rotation)
    np.testing.assert_allclose(np.array(rows[0]["t"].split(), dtype=float), [10.0, -20.0, 700.0], rtol=1e-15)


@pytest.fixture(scope="module")
def exported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bop")
    export_scene(Dataset(ROBI).scene(OBJECT, 1), folder)
    return folder


def read(path: Path) -> dict[str, list[dict[str, list[float]]]]:
    return json.loads(path.read_text())


def test_every_image_has_its_files_and_entries(exported: Path) -> None:
    test = exported / "test" / "000001"
    names = [f"{image:06d}.png" for image in range(len(Dataset(ROBI).scene(OBJECT, 1).names))]
    for kind in ("gray", "depth"):
        assert sorted(path.name for path in (test / kind).iterdir()) == names
    for name in ("scene_camera", "scene_gt", "scene_gt_info"):
        assert list(read(test / f"{name}.json")) == [str(image) for image in range(len(names))]
    targets = json.loads((exported / "test_targets_bop19.json").read_text())
    assert targets[0] == {"im_id": 0, "inst_count": 10, "obj_id": 1, "scene_id": 1}
    assert len(targets) == len(names)


def test_images_are_those_of_the_scene(exported: Path) -> None:
    original = np.asarray(Image.open(ROBI / OBJECT / "Scene_1/Ensenso/Stereo/LEFT_view_0.bmp").convert("L"))
    np.testing.assert_array_equal(np.asarray(Image.open(exported / "test/000001/gray/000000.png")), original)
    depth = Image.open(exported / "test/000001/depth/000000.png")
    assert depth.mode.startswith("I;16")
    counts = np.asarray(Image.open(ROBI / OBJECT / "Scene_1/Ensenso/Depth/DEPTH_view_0.png"))
    np.testing.assert_array_equal(np.asarray(depth), counts)  # the same unit, 1/32 mm


def test_model_camera_pose_and_depth_fit_together(exported: Path) -> None:
    """Model points at the true pose, in BOP's numbers alone, have the depth that was measured where they are seen."""
    test = exported / "test" / "000001"
    model = trimesh.load_mesh(exported / "models" / "obj_000001.ply", process=False)
    camera = json.loads((test / "scene_camera.json").read_text())["0"]
    truths = json.loads((test / "scene_gt.json").read_text())["0"]
    depth_mm = np.asarray(Image.open(test / "depth" / "000000.png")) * camera["depth_scale"]
    intrinsics = np.array(camera["cam_K"]).reshape(3, 3)
    nearest_mm = np.full(depth_mm.shape, np.inf)
    for truth in truths:
        rotation, translation = np.array(truth["cam_R_m2c"]).reshape(3, 3), np.array(truth["cam_t_m2c"])
        points = model.sample(20_000, seed=0) @ rotation.T + translation
        uvw = points @ intrinsics.T
        u, v = np.rint(uvw[:, :2] / uvw[:, 2:]).astype(int).T
        inside = (u >= 0) & (u < depth_mm.shape[1]) & (v >= 0) & (v < depth_mm.shape[0])
        np.minimum.at(nearest_mm, (v[inside], u[inside]), points[inside, 2])
    both = np.isfinite(nearest_mm) & (depth_mm > 0)
    apart_mm = np.abs(nearest_mm - depth_mm)[both]
    assert both.sum() > 1000
    assert np.median(apart_mm) < 0.8  # a pixel is 1.1 mm wide, and the nearest of its points is taken
    assert (apart_mm < 2).mean() > 0.75


def test_the_world_is_one_for_all_images(exported: Path) -> None:
    """World coordinates of an object, from its pose and that of the camera, are the same in every image."""
    test = exported / "test" / "000001"
    cameras, truths = (json.loads((test / name).read_text()) for name in ("scene_camera.json", "scene_gt.json"))
    places = [
        np.array(camera["cam_R_w2c"]).reshape(3, 3).T
        @ (np.array(truths[image][3]["cam_t_m2c"]) - np.array(camera["cam_t_w2c"]))
        for image, camera in cameras.items()
    ]
    np.testing.assert_allclose(places, np.broadcast_to(places[0], (len(places), 3)), atol=1e-6)
    recorded = list(json.loads((ROBI / OBJECT / "Scene_1/GT_world2obj.json").read_text()).values())[3]
    np.testing.assert_allclose(places[0], np.reshape(recorded, (4, 4))[:3, 3], atol=1e-3)


def test_visible_shares_are_pixels_over_pixels(exported: Path) -> None:
    infos = read(exported / "test/000001/scene_gt_info.json")["0"]
    fractions = [info["visib_fract"] for info in infos]
    assert len(infos) == 10
    assert 0.0 <= min(fractions) < 1.0
    assert max(fractions) == 1.0
    for info in infos:
        assert info["visib_fract"] == pytest.approx(info["px_count_visib"] / info["px_count_all"])
        assert 0 < info["px_count_valid"] <= info["px_count_all"]
        left, top, width, height = info["bbox_visib"]
        outer_left, outer_top, outer_width, outer_height = info["bbox_obj"]
        assert outer_left <= left
        assert outer_top <= top
        assert left + width <= outer_left + outer_width
        assert top + height <= outer_top + outer_height


def test_the_model_is_in_millimetres_with_its_symmetry(exported: Path) -> None:
    info = json.loads((exported / "models/models_info.json").read_text())["1"]
    part = Dataset(ROBI).part(OBJECT)
    model = trimesh.load_mesh(exported / "models/obj_000001.ply", process=False)
    points = np.asarray(model.vertices)
    assert info["diameter"] == pytest.approx(part.diameter_m * 1e3)
    assert [info["min_x"], info["min_y"], info["min_z"]] == pytest.approx(points.min(axis=0), abs=1e-4)
    assert [info["size_x"], info["size_y"], info["size_z"]] == pytest.approx(np.ptp(points, axis=0), abs=1e-4)
    np.testing.assert_allclose(np.asarray(model.face_normals), part.triangle_normals, atol=1e-3)
    assert "symmetries_continuous" not in info
    assert len(info["symmetries_discrete"]) == 5
    for numbers in info["symmetries_discrete"]:
        turn = np.reshape(numbers, (4, 4))
        moved = points @ turn[:3, :3].T + turn[:3, 3]
        apart_mm = np.linalg.norm(moved[::50, None] - points, axis=2).min(axis=1)
        assert apart_mm.max() < 0.5  # a vertex comes to lie beside another


def test_a_continuous_axis_has_its_offset_and_a_flip_goes_with_it() -> None:
    centre_m, axis = np.array([0.01, 0.02, 0.03]), np.array([0.0, 0.0, 1.0])
    flip = np.diag([1.0, -1.0, -1.0])
    info = symmetry_info(Symmetry(centre_m, np.stack([np.eye(3), flip]), axis=axis))
    (continuous,) = info["symmetries_continuous"]
    assert continuous["axis"] == [0.0, 0.0, 1.0]
    assert continuous["offset"] == pytest.approx([10.0, 20.0, 30.0])
    (discrete,) = info["symmetries_discrete"]
    np.testing.assert_allclose(np.reshape(discrete, (4, 4)) @ [10, 20, 31, 1], [10, 20, 29, 1])
    json.dumps(info)
    assert symmetry_info(Symmetry(centre_m, np.eye(3)[None])) == {}
    assert len(symmetry_info(Symmetry(centre_m, np.eye(3)[None], ball=True))["symmetries_continuous"]) == 3


def test_models_gather_in_one_folder(tmp_path: Path) -> None:
    part = brick()
    write_model(tmp_path, part, 1)
    write_model(tmp_path, part, 7)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["models_info.json", "obj_000001.ply", "obj_000007.ply"]
    assert list(json.loads((tmp_path / "models_info.json").read_text())) == ["1", "7"]


def brick() -> Part:
    mesh = trimesh.creation.box((0.03, 0.04, 0.12))
    return part_from_arrays("brick", np.asarray(mesh.vertices), np.asarray(mesh.faces, dtype=np.intp))
