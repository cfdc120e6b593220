"""From recorded captures to calibrations: what comes out is near the truth that was simulated, what cannot is refused.

Most recordings are of balls on a bench, 320x256: they have normals in all directions, and cost a second.
"""

from __future__ import annotations

import io
import json
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from recordings import (
    BALLS_VIEW,
    BASE_T_BOARD,
    FLANGE_T_CAMERA,
    SERIAL,
    Balls,
    BenchCamera,
    Told,
    board_poses,
    edit_image,
    edit_json,
    floor,
    image,
    looking_down,
    made_from,
    record_boards,
    record_bracket,
    record_planes,
    recorder,
    write_model,
    write_poses,
)

from sidelong.commissioning.applied import calibrated
from sidelong.commissioning.documents import (
    Document,
    HandEyeDocument,
    MaterialDocument,
    NoiseDocument,
    ProjectorDocument,
    ResponseDocument,
    SensingDocument,
    read_document,
    to_json,
)
from sidelong.commissioning.made import Captures, Made
from sidelong.commissioning.procedures import perform
from sidelong.commissioning.tasks import (
    HandEyeTask,
    MaterialTask,
    NoiseTask,
    ProjectorTask,
    ResponseTask,
    SensingTask,
    Task,
)
from sidelong.devices import CaptureRequest, Cell
from sidelong.errors import CalibrationError, DatasetError, ImageError, InputError, PoseError, UnknownNameError
from sidelong.evaluation.cases import true_objects
from sidelong.geometry.transforms import rotation_angle, transform
from sidelong.recipe import PlanningSettings, Recipe, build_stages
from sidelong.recorded.dataset import Dataset
from sidelong.recorded.writing import pose_to_mm
from sidelong.scan import scan
from sidelong.simulation.exposure import ExposureSettings
from sidelong.simulation.lighting import LightSettings
from sidelong.simulation.materials import MATERIALS
from sidelong.stopwatch import Stopwatch
from sidelong.types import FloatArray, Frame, Projector, View
from sidelong_drivers.replay import ReplayArm, ReplayCamera, ReplaySettings
from sidelong_drivers.simulated import SimulatedCamera, SimulatedCameraSettings

ROBI = Path(__file__).parents[2] / "data" / "robi"
FITTING = "Tube_fitting"
KNEE = ExposureSettings().knee
INTENSITY, VIGNETTING = LightSettings().projector_intensity, LightSettings().projector_vignetting
MATTE_K_D = MATERIALS["matte"].diffuse / np.pi
"""A Lambert surface sends albedo / pi of the irradiance into each direction; in E = k_d L cos that quotient is k_d."""
BRACKET_MS = (0.5, 1, 2, 4, 8, 16, 32)
PLANES = ((0.55, 0.0), (0.7, 0.2), (0.85, -0.15))
Edit = Callable[[Path], object]

# --- recordings, made once ---


def g_of_knee() -> FloatArray:
    """Return the true g(1..255): ln of the exposure x with Z = 255 (1 + k) x / (x + k)."""
    z = np.arange(1.0, 256.0)
    return np.log(z * KNEE / (255.0 * (1.0 + KNEE) - z))


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of one camera: bracket, planes, balls of one material and of two."""
    root = tmp_path_factory.mktemp("bench")
    record_bracket(root, Balls(("stainless",)).camera(), BRACKET_MS, Projector.WHITE)
    record_planes(root, PLANES, 0.012)
    Balls(("matte",)).record(root, "matte", 0.003)
    Balls(("stainless", "black_plastic")).record(root, "two", 0.003)
    return root


@dataclass(frozen=True)
class Example:
    """A task on a recording that carries it, done once: what it made, and what was told of it."""

    task: Task
    root: Path
    name: str | None
    documents: tuple[Document, ...]
    made: tuple[Made, ...]
    told: tuple[tuple[str, int, int], ...]

    @classmethod
    def of(cls, task: Task, root: Path, name: str | None = None, documents: tuple[Document, ...] = ()) -> Example:
        told = Told()
        made = made_from(root, task, name, documents, told)
        return cls(task, root, name, documents, made, tuple(told.calls))

    def again(self, progress: Callable[[str, int, int], None]) -> tuple[Made, ...]:
        return made_from(self.root, self.task, self.name, self.documents, progress)


@pytest.fixture(scope="module")
def examples(bench: Path, boards: Path) -> dict[str, Example]:
    """One of each task; each stands on those before it."""
    response = Example.of(ResponseTask(), bench)
    found = tuple(made.document for made in response.made)
    projector = Example.of(ProjectorTask(plane_k_d=MATTE_K_D), bench, None, found)
    light = (*found, *(made.document for made in projector.made))
    recorded: list[Example] = []
    for task in (ResponseTask(), MaterialTask(), SensingTask()):
        recorded.append(Example.of(task, ROBI, FITTING, tuple(each.made[0].document for each in recorded)))
    return {
        "response": response,
        "projector": projector,
        "material": Example.of(MaterialTask(), bench, "two", light),
        "hand_eye": Example.of(HandEyeTask(arm="ur10e"), boards),
        "noise": Example.of(NoiseTask(), bench),
        "sensing": recorded[2],
        "robi response": recorded[0],
        "robi material": recorded[1],
    }


@pytest.fixture(scope="module")
def light(examples: dict[str, Example]) -> tuple[Document, ...]:
    """Response and projector of the bench."""
    return tuple(examples[name].made[0].document for name in ("response", "projector"))


@pytest.fixture(scope="module")
def matte(bench: Path, light: tuple[Document, ...]) -> Made:
    (made,) = made_from(bench, MaterialTask(), "matte", light)
    return made


@pytest.fixture(scope="module")
def robi_chain(examples: dict[str, Example]) -> tuple[Made, ...]:
    """Response, material and sensing curve of the recorded scene, each made with those before it."""
    return tuple(examples[name].made[0] for name in ("robi response", "robi material", "sensing"))


@pytest.fixture(scope="module")
def boards(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("boards")
    record_boards(root, board_poses(8))
    return root


def material_of(made: Made) -> MaterialDocument:
    assert isinstance(made.document, MaterialDocument)
    return made.document


# --- response ---


def test_the_response_of_the_simulated_sensor_is_found_again(examples: dict[str, Example]) -> None:
    document = examples["response"].made[0].document
    assert isinstance(document, ResponseDocument)
    error = np.array(document.log_exposure[1:]) - g_of_knee()
    # 1.2 % of exposure where levels count, 10 % at the lowest ones, where a level is a third of the signal
    assert np.abs(error[15:240]).max() < 0.012
    assert np.abs(error).max() < 0.1
    assert document.device_serial == SERIAL
    assert document.exposures_s == pytest.approx([each * 1e-3 for each in BRACKET_MS])


def test_the_bracket_of_the_simulated_cell_gives_its_response(tmp_path: Path) -> None:
    camera = SimulatedCamera(SimulatedCameraSettings(width=320, height=256))
    with closing(camera):
        camera.open()
        record_bracket(tmp_path, camera, (3, 6, 12, 25, 50, 100, 200, 400, 800), Projector.OFF)
    (made,) = made_from(tmp_path, ResponseTask())
    assert isinstance(made.document, ResponseDocument)
    assert np.abs(np.array(made.document.log_exposure[1:]) - g_of_knee())[15:240].max() < 0.03
    assert made.document.device_serial == "simulated"
    assert made.document.warnings == ()


def test_the_recorded_bracket_gives_a_response_with_small_errors_and_hashed_files(
    robi_chain: tuple[Made, ...],
) -> None:
    document = robi_chain[0].document
    assert isinstance(document, ResponseDocument)
    assert document.residual_rms_grey < 3
    assert max(document.standard_error[16:240]) < 0.05
    assert (np.diff(document.log_exposure) > 0).all()
    names = {each.name for each in document.inputs}
    assert names == {
        f"{FITTING}/Calibration/Response/{name}" for name in ("times.json", *document.image_residuals_grey)
    }


# --- projector ---


def test_the_light_of_the_simulated_projector_is_found_again(examples: dict[str, Example]) -> None:
    document = examples["projector"].made[0].document
    assert isinstance(document, ProjectorDocument)
    assert document.intensity.value == pytest.approx(INTENSITY, rel=0.02)
    assert document.vignetting.value == pytest.approx(VIGNETTING, abs=0.05)
    assert document.fall_off_exponent.value == pytest.approx(2.0, abs=0.03)
    assert document.fall_off_exponent.identifiable
    assert document.uses == (examples["response"].made[0].document.id,)
    assert document.warnings == ()


def test_half_the_diffuse_share_is_twice_the_light(bench: Path, light: tuple[Document, ...]) -> None:
    response, first = light
    (made,) = made_from(bench, ProjectorTask(plane_k_d=MATTE_K_D / 2), documents=[response])
    second = made.document
    assert isinstance(first, ProjectorDocument)
    assert isinstance(second, ProjectorDocument)
    assert second.intensity.value == pytest.approx(2 * first.intensity.value, rel=1e-6)
    assert second.vignetting == first.vignetting


def test_one_distance_does_not_tell_the_fall_off_and_says_so(tmp_path: Path) -> None:
    record_planes(tmp_path, PLANES[:1], 0.012)
    (made,) = made_from(tmp_path, ProjectorTask(plane_k_d=MATTE_K_D))
    assert isinstance(made.document, ProjectorDocument)
    fall_off = made.document.fall_off_exponent
    assert (fall_off.value, fall_off.identifiable, fall_off.standard_error) == (2.0, False, None)
    assert "distances differ by a factor of 1.00, needs 1.2" in (fall_off.note or "")
    assert "fall-off 1/d^2.00 (not identified)" in made.summary


def test_a_plane_that_shines_is_refused(bench: Path, tmp_path: Path) -> None:
    # depth of a matte floor, and the white image of a shiny one
    root = copied(bench, tmp_path)
    shiny = BenchCamera([(floor("stainless"), np.eye(4))])
    recorder(shiny, tmp_path / "shiny", None, looking_down(*PLANES[0])).white([0.002])
    for kind in ("LEFT_white", "LEFT_off"):
        for suffix in (".bmp", ".json"):
            taken = tmp_path / f"shiny/Calibration/Phong/{kind}{suffix}"
            shutil.copyfile(taken, root / f"Calibration/Plane/{kind}_0{suffix}")
    for index in (1, 2):
        (root / f"Calibration/Plane/LEFT_white_{index}.bmp").unlink()
    with pytest.raises(CalibrationError, match=r"it shines, a highlight .* limit 5%: use a matte surface"):
        made_from(root, ProjectorTask(plane_k_d=MATTE_K_D))


# --- material ---


def test_a_matte_material_has_its_diffuse_share_and_no_highlight(matte: Made, light: tuple[Document, ...]) -> None:
    document = material_of(matte)
    assert document.k_d.value == pytest.approx(MATTE_K_D, rel=0.04)
    assert 0.99 * document.k_d.low < MATTE_K_D < 1.01 * document.k_d.high
    assert document.k_s.value < 0.01
    assert not document.n.identifiable
    assert document.uses == tuple(each.id for each in light)
    assert (document.light.intensity, document.light.vignetting) == pytest.approx((INTENSITY, VIGNETTING), rel=0.03)
    assert document.residual_rms_grey is not None
    assert document.residual_rms_grey < 3


def test_each_material_of_a_part_has_its_own_document(examples: dict[str, Example]) -> None:
    metal, plastic = (material_of(each) for each in examples["material"].made)
    assert (metal.material, plastic.material) == ("stainless", "black_plastic")
    assert {metal.part, plastic.part} == {"two"}
    # a GGX lobe is no Phong lobe: what must hold is that the metal mirrors, and the plastic does next to nothing
    assert metal.k_s.value > 0.2
    assert 5 < metal.n.value < 40
    assert 0.005 < metal.k_d.value < 0.05
    assert plastic.k_s.value < 0.03
    assert plastic.k_d.value < 0.015
    assert metal.id != plastic.id


def test_one_material_may_be_asked_for(bench: Path, light: tuple[Document, ...], examples: dict[str, Example]) -> None:
    (made,) = made_from(bench, MaterialTask(material="black_plastic"), "two", light)
    told = {"id", "created_at"}
    assert made.document.model_dump(exclude=told) == examples["material"].made[1].document.model_dump(exclude=told)


def test_what_stays_dark_beside_metal_that_shines_absorbs(bench: Path, tmp_path: Path) -> None:
    root = copied(bench, tmp_path)
    recorder(Balls(("stainless", "black_plastic")).camera(), root, "two").white([0.0003])
    metal, plastic = (material_of(each) for each in made_from(root, MaterialTask(), "two"))
    assert (metal.absorbing, plastic.absorbing) == (False, True)
    assert (plastic.k_d.value, plastic.k_s.value) == (0.0, 0.0)
    recipe = calibrated(Recipe(), [plastic], SERIAL)
    assert recipe.light.reflectances(("black_plastic",))[0].k_d == 0.0


def test_a_mask_does_for_poses_where_a_part_has_one_material(
    bench: Path, tmp_path: Path, matte: Made, light: tuple[Document, ...]
) -> None:
    root = copied(bench, tmp_path)
    folder = root / "matte/Calibration/Phong"
    (folder / "GT_world2obj.json").unlink()
    balls = Balls(("matte",))
    depth_m = balls.camera().capture_truth(BALLS_VIEW)
    edit_image(folder / "mask_parts.png", np.where(depth_m < BALLS_VIEW[2, 3] + 0.05, 255, 0).astype(np.uint8))
    (made,) = made_from(root, MaterialTask(), "matte", light)
    masked = material_of(made)
    assert masked.k_d.value == pytest.approx(material_of(matte).k_d.value, rel=0.02)
    assert "mask_parts.png" in {Path(each.name).name for each in masked.inputs}


def test_shifted_patterns_do_for_a_white_image(
    bench: Path, tmp_path: Path, matte: Made, light: tuple[Document, ...]
) -> None:
    root = copied(bench, tmp_path)
    scatter_dots(root / "matte/Calibration/Phong", count=16)
    (made,) = made_from(root, MaterialTask(), "matte", light)
    document = material_of(made)
    assert document.k_d.value == pytest.approx(material_of(matte).k_d.value, rel=0.02)
    assert not [warning for warning in document.warnings if "white pattern" in warning]
    assert sum("LEFT_pattern_" in each.name for each in document.inputs) == 17  # with the exposure's file


def test_the_light_of_a_bright_room_is_taken_off_where_a_dark_image_tells_it(
    tmp_path: Path, light: tuple[Document, ...]
) -> None:
    # a fifth of the light is the room's
    Balls(("matte",), dome=40.0).record(tmp_path, "matte", 0.003)
    told = made_from(tmp_path, MaterialTask(), "matte", light)[0]
    folder = tmp_path / "matte/Calibration/Phong"
    for file in {*folder.glob("*_off.*"), *folder.glob("RIGHT_*")}:
        file.unlink()
    untold = made_from(tmp_path, MaterialTask(), "matte", light)[0]
    assert material_of(told).k_d.value == pytest.approx(MATTE_K_D, rel=0.06)
    assert abs(material_of(untold).k_d.value / MATTE_K_D - 1.0) > 0.12
    assert any("no capture with the projector off" in warning for warning in untold.document.warnings)
    # half of them were the right camera's
    assert material_of(untold).samples < 0.6 * material_of(told).samples


def test_a_mask_beside_poses_leaves_pixels_out(
    bench: Path, tmp_path: Path, light: tuple[Document, ...], examples: dict[str, Example]
) -> None:
    root = copied(bench, tmp_path)
    mask = np.zeros((256, 320), dtype=np.uint8)
    mask[:128] = 255
    edit_image(root / "two/Calibration/Phong/mask_parts.png", mask)
    (made,) = made_from(root, MaterialTask(material="black_plastic"), "two", light)
    assert material_of(made).samples < 0.8 * material_of(examples["material"].made[1]).samples


def patchy(share: float, side_px: int) -> Edit:
    """Take that share of the sprayed depth away, in squares."""

    def edit(folder: Path) -> None:
        file = folder / "DEPTH_sprayed.png"
        with Image.open(file) as picture:
            counts = np.array(picture)
        rows, columns = (-(-size // side_px) for size in counts.shape)
        gone = np.random.default_rng(1).random((rows, columns)) < share
        gone = np.kron(gone, np.ones((side_px, side_px), dtype=np.bool_))[: counts.shape[0], : counts.shape[1]]
        Image.fromarray(np.where(gone, 0, counts).astype(np.uint16)).save(file)

    return edit


def test_depth_with_holes_still_gives_the_material(bench: Path, tmp_path: Path, light: tuple[Document, ...]) -> None:
    root = copied(bench, tmp_path)
    patchy(0.3, 24)(root / "matte/Calibration/Phong")
    (made,) = made_from(root, MaterialTask(), "matte", light)
    assert material_of(made).k_d.value == pytest.approx(MATTE_K_D, rel=0.06)


def test_depth_that_is_riddled_with_holes_is_refused_with_what_they_cost(
    bench: Path, tmp_path: Path, light: tuple[Document, ...]
) -> None:
    """Each hole counts as an edge: the depth of a matcher is wrong beside it."""
    root = copied(bench, tmp_path)
    patchy(0.3, 1)(root / "matte/Calibration/Phong")
    with pytest.raises(CalibrationError, match=r"no usable pixel.*\d+ edge|\d+ .*edge"):
        made_from(root, MaterialTask(), "matte", light)


def test_a_shorter_exposure_tells_of_the_highlight_that_saturates_in_a_longer_one(
    bench: Path, tmp_path: Path, light: tuple[Document, ...], examples: dict[str, Example]
) -> None:
    root = copied(bench, tmp_path)
    taking = recorder(Balls(("stainless", "black_plastic")).camera(), root, "two")
    files = {file.name for file in taking.white([0.024, 0.001])}
    assert {"LEFT_white.bmp", "LEFT_white_1.bmp", "RIGHT_white_1.bmp", "LEFT_off.bmp"} <= files
    (with_short,) = made_from(root, MaterialTask(material="stainless"), "two", light)
    taking.white([0.024])
    assert not list((root / "two/Calibration/Phong").glob("*_white_*"))
    (without,) = made_from(root, MaterialTask(material="stainless"), "two", light)
    both, one = material_of(with_short), material_of(without)
    assert "LEFT_white_1.bmp" in {Path(each.name).name for each in both.inputs}
    # of the highlight as a proper exposure has it
    k_s = material_of(examples["material"].made[0]).k_s.value
    assert one.k_s.high < 0.5 * k_s
    assert both.k_s.low < k_s < both.k_s.high
    assert both.k_d.value == pytest.approx(one.k_d.value, rel=0.25)


def test_the_part_of_the_simulated_cell_is_calibrated_by_what_it_records(
    tmp_path: Path, light: tuple[Document, ...]
) -> None:
    settings = SimulatedCameraSettings(part="hex_screw", count=4, serial=SERIAL)
    bare, sprayed = SimulatedCamera(settings), SimulatedCamera(settings.model_copy(update={"sprayed": True}))
    pose = transform(np.diag([1.0, -1.0, -1.0]), (0.5, 0.0, 0.55))
    with closing(bare), closing(sprayed):
        bare.open()
        sprayed.open()
        recorder(bare, tmp_path, "screw", pose).white([0.001])
        recorder(sprayed, tmp_path, "screw", pose).sprayed(0.012)
        write_model(tmp_path, "screw", bare.part)
        write_poses(tmp_path, "screw", bare.base_T_objects)
    (made,) = made_from(tmp_path, MaterialTask(), "screw", light)
    document = material_of(made)
    assert (document.material, document.part, document.absorbing) == ("plated", "screw", False)
    assert document.k_s.value > document.k_d.value
    assert document.samples > 300
    # such a part shows few normals: what they do not fix is said
    assert not document.k_s.identifiable
    assert any("no Phong surface" in warning for warning in document.warnings)


# --- sensing ---


def test_the_learned_curve_forecasts_views_it_has_not_seen_better_than_the_exponential(
    robi_chain: tuple[Made, ...],
) -> None:
    document = robi_chain[-1].document
    assert isinstance(document, SensingDocument)
    assert document.held_out
    assert document.scores.log_loss < 0.8 * document.exponential_scores.log_loss
    assert document.scores.expected_calibration_error < 0.1
    assert document.views == Dataset(ROBI).scene(FITTING, 1).names
    assert document.uses == tuple(each.document.id for each in robi_chain[:-1])
    # dark, lit, saturated
    assert document.curve.at(np.exp([-4.5, -1.0, 1.0])) == pytest.approx([0.1, 0.9, 0.0], abs=0.15)


def test_the_whole_chain_comes_back_from_its_files_and_fits_together(
    robi_chain: tuple[Made, ...], tmp_path: Path
) -> None:
    read: list[Document] = []
    for made in robi_chain:
        path = tmp_path / f"{made.document.id}.json"
        path.write_bytes(to_json(made.document))
        read.append(read_document(path))
    assert read == [made.document for made in robi_chain]
    recipe = calibrated(Recipe(), read, Dataset(ROBI).serial)
    assert recipe.calibrations == tuple(document.id for document in read)
    assert recipe.sensing.curve is not None
    assert recipe.light.materials["stainless"].k_d == material_of(robi_chain[1]).k_d.value


def test_a_curve_is_refused_without_the_calibrations_it_was_learned_with(robi_chain: tuple[Made, ...]) -> None:
    response, _, sensing = (made.document for made in robi_chain)
    with pytest.raises(CalibrationError, match=r"was made with material-[0-9a-f]{12}, which is not named beside it"):
        calibrated(Recipe(), [response, sensing], Dataset(ROBI).serial)


def test_a_scan_runs_with_the_whole_chain_and_plans_otherwise(robi_chain: tuple[Made, ...], tmp_path: Path) -> None:
    plain = Recipe(planning=PlanningSettings(max_views=1))
    with_chain = calibrated(plain, [made.document for made in robi_chain], Dataset(ROBI).serial)
    gains: list[float] = []
    for recipe in (plain, with_chain):
        first, last = scanned(recipe, tmp_path)
        assert last.recovered_px > 0
        assert last.completeness > first.completeness
        gains.append(last.predicted_gain_px)
    assert gains[1] > 0
    assert gains[0] != pytest.approx(gains[1], rel=0.01)


def scanned(recipe: Recipe, cache_dir: Path) -> Any:
    """Scan the recorded scene, its true poses in the place of detection, and return the steps."""
    dataset = Dataset(ROBI)
    scene, part = dataset.scene(FITTING, 1), dataset.part(FITTING)
    settings = ReplaySettings(root=ROBI, object=FITTING)
    camera, arm = ReplayCamera(settings), ReplayArm(settings)
    views = scene.views()
    with closing(camera), closing(arm):
        camera.open()
        arm.open()
        cell = Cell(camera, arm, np.eye(4), views[0], views)
        with build_stages(recipe, part, dataset.rig, cache_dir, objects=true_objects(scene, views[0])) as stages:
            return list(scan(cell, stages, recipe, Stopwatch()))


# --- hand-eye ---


def test_the_camera_on_the_flange_is_found_again(examples: dict[str, Example]) -> None:
    document = examples["hand_eye"].made[0].document
    assert isinstance(document, HandEyeDocument)
    found, board = (np.array(pose).reshape(4, 4) for pose in (document.flange_T_camera, document.base_T_board))
    assert np.linalg.norm(found[:3, 3] - FLANGE_T_CAMERA[:3, 3]) < 0.5e-3
    assert rotation_angle(found[:3, :3].T @ FLANGE_T_CAMERA[:3, :3]) < 1e-3
    assert np.linalg.norm(board[:3, 3] - BASE_T_BOARD[:3, 3]) < 1e-3
    assert document.poses == 8
    assert document.arm == "ur10e"
    assert set(document.residuals) == {f"LEFT_{index}.bmp" for index in range(8)}
    assert all(residual.used for residual in document.residuals.values())


def test_an_arm_that_errs_gives_larger_standard_errors(examples: dict[str, Example], tmp_path: Path) -> None:
    record_boards(tmp_path, board_poses(8), arm_noise_m=0.5e-3)
    exact, noisy = examples["hand_eye"].made[0].document, made_from(tmp_path, HandEyeTask())[0].document
    assert isinstance(exact, HandEyeDocument)
    assert isinstance(noisy, HandEyeDocument)
    assert max(noisy.translation_error_m) > 2 * max(exact.translation_error_m)
    found = np.array(noisy.flange_T_camera).reshape(4, 4)
    assert np.linalg.norm(found[:3, 3] - FLANGE_T_CAMERA[:3, 3]) < 2e-3


def test_an_image_without_the_board_is_left_out_with_the_reason(boards: Path, tmp_path: Path) -> None:
    root = copied(boards, tmp_path)
    file = root / "Calibration/HandEye/LEFT_5.bmp"
    edit_image(file, np.full_like(image(file), 90))
    (made,) = made_from(root, HandEyeTask())
    assert any("LEFT_5.bmp: left out" in warning and "no board" in warning for warning in made.document.warnings)
    assert isinstance(made.document, HandEyeDocument)
    assert made.document.poses == 7


def in_board(**changes: Any) -> Edit:
    return lambda folder: edit_json(folder / "board.json", **changes)


def in_poses(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Edit:
    def edit(folder: Path) -> None:
        poses = json.loads((folder / "poses.json").read_text())["poses"]
        edit_json(folder / "poses.json", poses=change(poses))

    return edit


def one_rotation(poses: dict[str, Any]) -> dict[str, Any]:
    """Give all poses the rotation of the first: the arm was moved, and never turned."""
    first = next(iter(poses.values()))
    return {name: [*first[:3], pose[3], *first[4:7], pose[7], *first[8:11], pose[11], *pose[12:]]
            for name, pose in poses.items()}  # fmt: skip


@pytest.mark.parametrize(
    ("edit", "kind", "message"),
    [
        (in_poses(lambda poses: dict(list(poses.items())[:2])), CalibrationError,
         r"2 of 2 images show the board, needs 3"),
        (in_poses(one_rotation), CalibrationError, r"arm poses hardly turn, .* deg .*, need 1\.15 deg about two axes"),
        (in_poses(lambda poses: poses | {"LEFT_2.bmp": [1.0] * 16}), PoseError, r"poses\.json: LEFT_2\.bmp: .*row"),
        (in_poses(lambda poses: poses | {"LEFT_9.bmp": poses["LEFT_1.bmp"]}), ImageError, r"LEFT_9\.bmp: .*missing"),
        (in_poses(lambda poses: poses | {"../a.bmp": poses["LEFT_1.bmp"]}), DatasetError, r"'\.\./a\.bmp' is no name"),
        (in_poses(lambda poses: dict(zip(poses, [*list(poses.values())[1:], poses["LEFT_0.bmp"]], strict=True))),
         CalibrationError, r"disagree by .* mm .* limits 5 mm .*in another order"),
        (lambda folder: edit_json(folder / "poses.json", unit="m"), CalibrationError, r"with positions in millimetres"),
        (lambda folder: edit_json(folder / "poses.json", unit="inch"), DatasetError, r"unit is 'inch', known are m"),
        (in_board(squares_x=5, squares_y=4), CalibrationError, r"0 of 8 images show the board, needs 3.*squares_x"),
        (in_board(square_m=0.045, marker_m=0.033), CalibrationError, r"0\.66\d* times as large.*measure square_m"),
        (in_board(dictionary="DICT_APRILTAG_36h11"), CalibrationError, r"no marker of DICT_APRILTAG_36h11 was found"),
        (in_board(dictionary="DICT_7X7"), CalibrationError, r"board\.json: dictionary: .*'DICT_7X7'"),
        (in_board(square_m=-1.0), CalibrationError, r"board\.json: square_m: .*greater than or equal to 0\.001.*-1\.0"),
        (lambda folder: (folder / "board.json").unlink(), DatasetError, r"board\.json: the file is missing"),
    ],
)  # fmt: skip
def test_boards_and_poses_that_do_not_fix_the_camera_are_refused(
    boards: Path, tmp_path: Path, edit: Edit, kind: type[InputError], message: str
) -> None:
    root = copied(boards, tmp_path)
    edit(root / "Calibration/HandEye")
    with pytest.raises(kind, match=message):
        made_from(root, HandEyeTask())


def test_a_camera_far_off_the_flange_is_refused(tmp_path: Path) -> None:
    # from one distance only, any scale of the arm's positions fits the images
    poses = board_poses(8)
    middle = np.array([0.12, 0.09, 0.0])
    for pose in poses:
        pose[:3, 3] = np.array([0.12, 0.0, 0.65]) - pose[:3, :3] @ middle
    record_boards(tmp_path, poses)
    edit_json(tmp_path / "Calibration/HandEye/poses.json", unit="m")
    with pytest.raises(
        CalibrationError, match=r"poses\.json: the camera would sit .* mm off the flange, limit 1500 mm"
    ):
        made_from(tmp_path, HandEyeTask())


# --- noise ---


def test_the_planes_of_the_projector_give_the_noise_of_depth(examples: dict[str, Example], bench: Path) -> None:
    document = examples["noise"].made[0].document
    assert isinstance(document, NoiseDocument)
    found = document.parameters["disparity_px"]
    assert found.identifiable
    assert document.noise.disparity_px == found.value
    camera = BenchCamera([(floor(), np.eye(4))])
    pose = looking_down(0.62, 0.1)
    depth_m = camera.capture(CaptureRequest(Projector.DOTS, 0.01, depth=True), pose).depth_m
    assert depth_m is not None
    ratio = (depth_m - camera.capture_truth(pose)) / document.noise.sigma_m(depth_m, camera.rig)
    assert 0.8 < np.nanstd(ratio) < 1.25
    assert {each.name for each in document.inputs} == {f"Calibration/Plane/DEPTH_{index}.png" for index in range(3)}
    assert (document.method, document.captures, document.image_px) == ("plate", len(PLANES), (320, 256))
    recipe = calibrated(Recipe(), [document], SERIAL)
    assert recipe.fusion.noise == document.noise


class NoisyCamera(BenchCamera):
    """Shows a wall whose depth is off by something else each time."""

    def __init__(self) -> None:
        super().__init__([(floor(), np.eye(4))])
        self._random = np.random.default_rng(8)

    def capture(self, request: CaptureRequest, base_T_camera: FloatArray) -> Frame:
        grey = np.full((256, 320), 90, dtype=np.uint8)
        depth_m = 0.6 + 0.5e-3 * self._random.normal(size=(256, 320))
        return Frame(View("wall", base_T_camera), grey, grey, depth_m, request.projector, request.exposure_s)


def test_repeated_shots_give_a_lower_bound_and_say_so(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    taking = recorder(NoisyCamera(), tmp_path, None)
    taking.repeats(0.01, 9, lambda done, total: None)
    files = taking.repeats(0.01, 6, lambda done, total: told.append((done, total)))
    assert told == [(done, 6) for done in range(6)]
    assert sorted(file.name for file in (tmp_path / "Calibration/Repeats").iterdir()) == [file.name for file in files]
    (made,) = made_from(tmp_path, NoiseTask(method="repeats"))
    document = made.document
    assert isinstance(document, NoiseDocument)
    assert (document.method, document.captures) == ("repeats", 6)
    rig = BenchCamera([(floor(), np.eye(4))]).rig
    expected_px = 0.5e-3 * rig.left.fx * rig.baseline_m / 0.6**2
    found = document.parameters["disparity_px"]
    assert found.low < expected_px < found.high
    assert any("a lower bound" in warning for warning in document.warnings)


@pytest.mark.parametrize(
    ("edit", "kind", "message"),
    [
        (lambda folder: [file.unlink() for file in folder.glob("DEPTH_*")], DatasetError, r"has no DEPTH_<i>\.png"),
        (shutil.rmtree, DatasetError, r"Plane: no such folder of captures"),
        (lambda folder: shutil.copyfile(folder / "DEPTH_0.png", folder / "DEPTH_2.png"), CalibrationError,
         r"DEPTH_2\.png: is the same as DEPTH_0\.png to the last bit"),
        (lambda folder: Image.fromarray(np.zeros((256, 320), np.uint16)).save(folder / "DEPTH_1.png"),
         CalibrationError, r"DEPTH_1\.png: 0 of 81920 px are measured, needs 2000"),
        (lambda folder: Image.fromarray(np.full((256, 320), 22400, np.uint16)).save(folder / "DEPTH_1.png"),
         CalibrationError, r"DEPTH_1\.png: the depth of its flat surface has no noise"),
        (lambda folder: (folder / "DEPTH_1.png").write_bytes(b"no picture"), ImageError, r"DEPTH_1\.png"),
    ],
)  # fmt: skip
def test_depth_maps_that_carry_no_noise_are_refused(
    bench: Path, tmp_path: Path, edit: Edit, kind: type[InputError], message: str
) -> None:
    root = copied(bench, tmp_path)
    edit(root / "Calibration/Plane")
    with pytest.raises(kind, match=message):
        made_from(root, NoiseTask())


# --- what all of them share ---


KINDS = pytest.mark.parametrize("kind", ["response", "projector", "material", "sensing", "hand_eye", "noise"])
WORKS = {
    "response": ("response",), "projector": ("projector",), "material": ("samples", "materials"),
    "sensing": ("views",), "hand_eye": ("images of the board",),
    "noise": ("depth maps",),
}  # fmt: skip


class EndedError(Exception):
    """Raised by a progress that asks for the end."""


@KINDS
def test_same_captures_give_the_same_numbers(kind: str, examples: dict[str, Example]) -> None:
    first = examples[kind].made
    second = examples[kind].again(Told())
    besides = {"id", "created_at"}
    assert [made.document.model_dump(exclude=besides) for made in first] == [
        made.document.model_dump(exclude=besides) for made in second
    ]
    assert [made.summary for made in first] == [made.summary for made in second]


@KINDS
def test_progress_is_told_from_first_to_last(kind: str, examples: dict[str, Example]) -> None:
    told = examples[kind].told
    assert tuple(dict.fromkeys(work for work, _, _ in told)) == WORKS[kind]
    for work in WORKS[kind]:
        done, totals = zip(*[(done, total) for name, done, total in told if name == work], strict=True)
        assert len(set(totals)) == 1
        assert list(done) == sorted(done)
        assert done[0] <= 1
        assert done[-1] == totals[0]


@KINDS
def test_each_calibration_has_a_picture_a_summary_and_its_files(kind: str, examples: dict[str, Example]) -> None:
    for made in examples[kind].made:
        with Image.open(io.BytesIO(made.picture)) as picture:
            assert picture.format == "PNG"
            assert 900 <= picture.width <= 2400
            assert 350 <= picture.height <= 1400
            # an empty figure has next to one grey level
            assert len(np.unique(np.asarray(picture.convert("L")))) > 20
        assert 20 < len(made.summary) < 400
        assert "\n" not in made.summary
        assert made.document.is_whole()
        assert made.document.inputs
        assert all((examples[kind].root / each.name).is_file() for each in made.document.inputs)


@KINDS
@pytest.mark.parametrize("share", [0.0, 0.6])
def test_what_progress_raises_ends_a_task_and_leaves_nothing(
    kind: str, share: float, examples: dict[str, Example]
) -> None:
    example = examples[kind]
    last, told, before = int(share * len(example.told)), Told(), files_of(example.root)

    def end(work: str, done: int, total: int) -> None:
        told(work, done, total)
        if len(told.calls) > last:
            raise EndedError

    with pytest.raises(EndedError):
        example.again(end)
    assert len(told.calls) == last + 1
    assert files_of(example.root) == before


def test_materials_come_one_by_one_so_that_an_end_keeps_those_made(bench: Path, light: tuple[Document, ...]) -> None:
    def end(work: str, done: int, total: int) -> None:
        if (work, done) == ("materials", 1):
            raise EndedError

    making: Iterator[Made] = perform(MaterialTask(), Captures(Dataset(bench), "two", Recipe(), light), end)
    assert material_of(next(making)).material == "stainless"
    with pytest.raises(EndedError):
        next(making)


def files_of(root: Path) -> dict[str, int]:
    return {str(file.relative_to(root)): file.stat().st_mtime_ns for file in root.rglob("*") if file.is_file()}


# --- what the recorder does not overwrite ---


class StillCamera(BenchCamera):
    """Shows grey without rendering."""

    def capture(self, request: CaptureRequest, base_T_camera: FloatArray) -> Frame:
        grey = np.full((256, 320), 90, dtype=np.uint8)
        depth_m = np.full((256, 320), 0.6)
        return Frame(View("still", base_T_camera), grey, grey, depth_m, request.projector, request.exposure_s)


def test_a_capture_never_takes_the_name_of_another(tmp_path: Path) -> None:
    taking = recorder(StillCamera([(floor(), np.eye(4))]), tmp_path, None, looking_down(0.6))
    first, second, third = (taking.board(0.1, Projector.OFF)[0] for _ in range(3))
    kept = third.read_bytes()
    first.unlink()
    (fourth,) = taking.board(0.1, Projector.OFF)
    assert fourth.name == "LEFT_3.bmp"
    assert third.read_bytes() == kept
    assert second.is_file()
    poses = json.loads((tmp_path / "Calibration/HandEye/poses.json").read_text())["poses"]
    assert poses["LEFT_3.bmp"] == pytest.approx(pose_to_mm(taking.base_T_flange))
    for expected in ("LEFT_white_0.bmp", "LEFT_white_1.bmp"):
        assert expected in {file.name for file in taking.plane(0.012)}
    (tmp_path / "Calibration/Plane/LEFT_white_0.bmp").unlink()
    assert "LEFT_white_2.bmp" in {file.name for file in taking.plane(0.012)}


# --- captures that cannot be used ---


def copied(root: Path, target: Path) -> Path:
    """Return a copy of a data set that may be changed."""
    folder = target / "copy"
    shutil.copytree(root, folder, copy_function=shutil.copyfile)
    return folder


def in_times(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Edit:
    def edit(folder: Path) -> None:
        times = json.loads((folder / "times.json").read_text())["times"]
        edit_json(folder / "times.json", times=change(times))

    return edit


def redrawn(pattern: str, change: Callable[[Any], Any]) -> Edit:
    """Change images."""

    def edit(folder: Path) -> None:
        files = sorted(folder.glob(pattern))
        assert files
        for file in files:
            edit_image(file, change(image(file)))

    return edit


def saturated(picture: Any) -> Any:
    return np.full_like(picture, 255)


def moved(picture: Any) -> Any:
    return np.roll(picture, 8, axis=1)


def sixteen_bits(picture: Any) -> Any:
    return picture.astype(np.uint16) * 256


def coloured(picture: Any) -> Any:
    return np.stack([picture, picture // 2, picture], axis=-1)


def smaller(picture: Any) -> Any:
    return picture[:100]


IMAGE_TROUBLES: list[tuple[Callable[[Any], Any], str]] = [
    (sixteen_bits, r"\.bmp: its pixels are of kind 'I;16', needs 8-bit grey ones"),
    (coloured, r"\.bmp: \d+ of its pixels have a colour, needs 8-bit grey ones"),
]


@pytest.mark.parametrize(
    ("edit", "kind", "message"),
    [
        (redrawn("*.bmp", saturated), CalibrationError,
         r"all images are saturated; of LEFT_0\.25ms\.bmp \(0\.25 ms\), the shortest, 100\.0%.*expose shorter"),
        (redrawn("*.bmp", np.zeros_like), CalibrationError,
         r"all images are dark; of LEFT_64ms\.bmp \(64 ms\), the longest, 100\.0%.*expose longer"),
        (in_times(lambda times: dict.fromkeys(times, 4)), CalibrationError,
         r"1 distinct exposures, needs 3: add exposures"),
        (in_times(lambda times: dict(list(times.items())[:2])), CalibrationError, r"2 distinct exposures, needs 3"),
        (in_times(lambda times: times | {"LEFT_8ms.bmp": 4}), CalibrationError,
         r"LEFT_8ms\.bmp \(4 ms\): disagrees with the other images: .* grey levels.*is its exposure wrong"),
        (in_times(lambda times: times | {"LEFT_8ms.bmp": 4, "LEFT_4ms.bmp": 8}), CalibrationError,
         r"LEFT_4ms\.bmp \(8 ms\): exposed 2 times as long as LEFT_8ms\.bmp.*were exposure times swapped"),
        (in_times(lambda times: times | {"LEFT_8ms.bmp": 0}), CalibrationError,
         r"LEFT_8ms\.bmp: the exposure is 0\.0 s, needs a positive"),
        (in_times(lambda times: times | {"LEFT_8ms.bmp": -1}), CalibrationError,
         r"LEFT_8ms\.bmp: the exposure is -0\.001 s"),
        (in_times(lambda times: times | {"LEFT_8ms.bmp": "8"}), DatasetError, r"times\.json: LEFT_8ms\.bmp is '8'"),
        (in_times(lambda times: times | {"LEFT_8ms.bmp": float("1e300")}), DatasetError, r"times\.json: LEFT_8ms\.bmp"),
        (in_times(lambda times: {}), CalibrationError, r"no images"),
        (in_times(lambda times: times | {"LEFT_9ms.bmp": 9}), ImageError, r"LEFT_9ms\.bmp: the image is missing"),
        (redrawn("LEFT_8ms.bmp", moved), CalibrationError,
         r"LEFT_8ms\.bmp \(8 ms\): disagrees .*did camera, scene or light change"),
        (redrawn("LEFT_8ms.bmp", smaller), ImageError, r"LEFT_8ms\.bmp: has shape \(100, 320\), needs that of"),
        *((redrawn("LEFT_8ms.bmp", change), ImageError, "LEFT_8ms" + message) for change, message in IMAGE_TROUBLES),
    ],
)  # fmt: skip
def test_a_bracket_that_carries_no_response_is_refused(
    tmp_path: Path, edit: Edit, kind: type[InputError], message: str
) -> None:
    root = copied(ROBI, tmp_path)
    edit(root / FITTING / "Calibration/Response")
    with pytest.raises(kind, match=message):
        made_from(root, ResponseTask(), FITTING)


def test_the_order_of_the_times_does_not_matter(tmp_path: Path, robi_chain: tuple[Made, ...]) -> None:
    root = copied(ROBI, tmp_path)
    in_times(lambda times: dict(sorted(times.items())))(root / FITTING / "Calibration/Response")
    (made,) = made_from(root, ResponseTask(), FITTING)
    assert isinstance(made.document, ResponseDocument)
    first = robi_chain[0].document
    assert isinstance(first, ResponseDocument)
    np.testing.assert_allclose(made.document.log_exposure, first.log_exposure, atol=1e-9)


def elsewhere(folder: Path) -> None:
    poses = {f"object_{index}": pose_to_mm(transform(np.eye(3), (5.0, 5.0, 5.0))) for index in range(3)}
    (folder / "GT_world2obj.json").write_text(json.dumps(poses))


def carried(folder: Path) -> None:
    """Say that the camera stood 2 mm beside when it took the sprayed depth."""
    about = json.loads((folder / "DEPTH_sprayed.json").read_text())
    about["cam_pose"][3] += 2.0
    edit_json(folder / "DEPTH_sprayed.json", **about)


def unlit(folder: Path) -> None:
    """Put what was seen with the projector off in the place of the white images: the lamp failed."""
    for side in ("LEFT", "RIGHT"):
        shutil.copyfile(folder / f"{side}_off.bmp", folder / f"{side}_white.bmp")


@pytest.mark.parametrize(
    ("edit", "kind", "message"),
    [
        (redrawn("*_white.bmp", saturated), CalibrationError,
         r"two: material stainless: samples: all \d+ are saturated.*expose less"),
        (redrawn("*_white.bmp", np.zeros_like), CalibrationError,
         r"LEFT_white\.bmp: at 3 ms 0 of 81920 px are more than 5 grey levels brighter .*needs 0\.1%.*Expose longer"),
        (unlit, CalibrationError, r"LEFT_white\.bmp: at 3 ms 0 of 81920 px .*did it show the white pattern"),
        (redrawn("LEFT_white.bmp", moved), CalibrationError,
         r"white image: .*moved by [789]\.\d px.*limit 2 px.*take both from"),
        (carried, CalibrationError, r"Phong: the camera moved 2 mm and 0 degrees .*limits 1 mm.*take both again"),
        (patchy(1.0, 1), CalibrationError, r"DEPTH_sprayed\.png: depth: 0 of 81920 px are measured"),
        (elsewhere, CalibrationError, r"0 pixels have both a material and depth.*check mask and depth"),
        (lambda folder: (folder / "GT_world2obj.json").unlink(), CalibrationError,
         r"two: has 2 materials \(stainless, black_plastic\);.*needed, in GT_world2obj\.json"),
        (lambda folder: (folder / "DEPTH_sprayed.png").unlink(), ImageError, r"sprayed\.png: the image is missing"),
        (lambda folder: (folder / "LEFT_white.json").unlink(), DatasetError, r"LEFT_white\.json: the file is missing"),
        (lambda folder: (folder / "LEFT_white.bmp").unlink(), ImageError, r"LEFT_white\.bmp: the image is missing"),
        (lambda folder: edit_json(folder / "LEFT_white.json", exposure_ms=0), DatasetError,
         r"LEFT_white\.json: exposure_ms is 0, needs a number greater than 0"),
        (lambda folder: edit_json(folder / "LEFT_white.json", cam_pose=[1.0]), PoseError,
         r"LEFT_white\.json: a pose needs 16 numbers"),
        (redrawn("LEFT_white.bmp", smaller), ImageError,
         r"LEFT_white\.bmp: the image is 320x100 px, cam/ says 320x256"),
        *((redrawn("LEFT_white.bmp", change), ImageError, message) for change, message in IMAGE_TROUBLES),
    ],
)  # fmt: skip
def test_captures_that_carry_no_material_are_refused(
    bench: Path, tmp_path: Path, light: tuple[Document, ...], edit: Edit, kind: type[InputError], message: str
) -> None:
    root = copied(bench, tmp_path)
    edit(root / "two/Calibration/Phong")
    with pytest.raises(kind, match=message):
        made_from(root, MaterialTask(), "two", light)


def test_a_white_image_of_the_recorded_scene_that_was_moved_is_refused(tmp_path: Path) -> None:
    root = copied(ROBI, tmp_path)
    redrawn("LEFT_white.bmp", moved)(root / FITTING / "Calibration/Phong")
    with pytest.raises(CalibrationError, match=r"white image: .*moved by \d+\.\d px.*limit"):
        made_from(root, MaterialTask(), FITTING)


@pytest.mark.parametrize(
    ("task", "name", "kind", "message"),
    [
        (MaterialTask(), None, CalibrationError, r"object: .*name the object"),
        (MaterialTask(), "nothing", DatasetError, r"nothing.Calibration.Phong and .*: no such folder of captures"),
        (MaterialTask(material="gold"), "two", CalibrationError, r"'gold' is none of two's: stainless, black_plastic"),
        (SensingTask(), None, CalibrationError, r"object: .*name the object"),
        (SensingTask(), "two", UnknownNameError, r"object 'two' is unknown, known are none"),
        (ResponseTask(), "two", None, ""),  # the device's own bracket serves all objects
        (HandEyeTask(), None, DatasetError, r"HandEye: no such folder of captures"),
        (
            NoiseTask(method="repeats"),
            "two",
            DatasetError,
            r"two.Calibration.Repeats and .*: no such folder of captures",
        ),
        (NoiseTask(), "two", None, ""),
    ],
)
def test_what_is_not_recorded_is_refused_by_name(
    bench: Path, task: Task, name: str | None, kind: type[InputError] | None, message: str
) -> None:
    if kind is None:
        assert made_from(bench, task, name)
        return
    with pytest.raises(kind, match=message):
        made_from(bench, task, name)


def test_a_part_without_mask_and_poses_is_refused(bench: Path, tmp_path: Path) -> None:
    root = copied(bench, tmp_path)
    (root / "matte/Calibration/Phong/GT_world2obj.json").unlink()
    with pytest.raises(CalibrationError, match=r"matte: .*needs GT_world2obj\.json or mask_parts\.png"):
        made_from(root, MaterialTask(), "matte")


def test_a_scene_that_is_not_recorded_carries_no_curve() -> None:
    with pytest.raises(UnknownNameError, match=r"scene 4 is unknown, known are 1"):
        made_from(ROBI, SensingTask(scene=4), FITTING)


def test_parts_too_small_for_normals_are_told_with_the_numbers(tmp_path: Path) -> None:
    settings = SimulatedCameraSettings(width=320, height=256)
    with closing(SimulatedCamera(settings)) as camera:
        camera.open()
        pose = transform(np.diag([1.0, -1.0, -1.0]), (0.5, 0.0, 0.69))
        recorder(camera, tmp_path, "small", pose).white([0.001])
        recorder(camera, tmp_path, "small", pose).sprayed(0.012)
        write_model(tmp_path, "small", camera.part)
        write_poses(tmp_path, "small", camera.base_T_objects)
    with pytest.raises(CalibrationError, match=r"small: .*of \d{3,} px on parts \d+ have depth.*look from nearer"):
        made_from(tmp_path, MaterialTask(), "small")


def bumpy(folder: Path) -> None:
    """Put the depth of balls in the place of the plane's."""
    shutil.copyfile(folder.parents[1] / "two/Calibration/Phong/DEPTH_sprayed.png", folder / "DEPTH_1.png")


@pytest.mark.parametrize(
    ("edit", "kind", "message"),
    [
        (redrawn("LEFT_white_1.bmp", saturated), CalibrationError,
         r"LEFT_white_1\.bmp: 0 pixels of the plane are usable, needs 500.*change the exposure"),
        (redrawn("LEFT_white_1.bmp", np.zeros_like), CalibrationError, r"LEFT_white_1\.bmp: 0 pixels .*at 10 or below"),
        (lambda folder: Image.fromarray(np.zeros((256, 320), np.uint16)).save(folder / "DEPTH_1.png"),
         CalibrationError, r"LEFT_white_1\.bmp: 0 pixels of the plane have depth, needs 500"),
        (bumpy, CalibrationError, r"LEFT_white_1\.bmp: its depth deviates from a plane by .* mm rms, limit 2\.00 mm"),
        (lambda folder: edit_json(folder / "LEFT_white_1.json", exposure_ms=0), DatasetError,
         r"LEFT_white_1\.json: exposure_ms is 0"),
        (lambda folder: (folder / "DEPTH_1.png").unlink(), ImageError, r"DEPTH_1\.png: the image is missing"),
        (lambda folder: [file.unlink() for file in folder.glob("LEFT_white_*")], DatasetError,
         r"Plane: has no LEFT_white_<i>\.bmp"),
        *((redrawn("LEFT_white_1.bmp", change), ImageError, message) for change, message in IMAGE_TROUBLES),
    ],
)  # fmt: skip
def test_planes_that_carry_no_light_are_refused(
    bench: Path, tmp_path: Path, edit: Edit, kind: type[InputError], message: str
) -> None:
    root = copied(bench, tmp_path)
    edit(root / "Calibration/Plane")
    with pytest.raises(kind, match=message):
        made_from(root, ProjectorTask(plane_k_d=MATTE_K_D))


def test_calibrations_of_another_device_are_refused(bench: Path, robi_chain: tuple[Made, ...]) -> None:
    documents = [robi_chain[0].document]
    message = re.escape(f"is of device '{documents[0].device_serial}', the camera is '{SERIAL}'")
    for task, name in ((ProjectorTask(plane_k_d=0.5), None), (MaterialTask(), "matte")):
        with pytest.raises(CalibrationError, match=message):
            made_from(bench, task, name, documents)


def scatter_dots(folder: Path, count: int) -> None:
    """Put images under random dots in the place of the white ones: each dot shows the white image, between is dark."""
    random = np.random.default_rng(2)
    about = json.loads((folder / "LEFT_white.json").read_text())
    for side in ("LEFT", "RIGHT"):
        lit, dark = image(folder / f"{side}_white.bmp"), image(folder / f"{side}_off.bmp")
        for index in range(count):
            dots = random.random(lit.shape) < 0.5
            edit_image(folder / f"{side}_pattern_{index}.bmp", np.where(dots, lit, dark))
        (folder / f"{side}_white.bmp").unlink()
        (folder / f"{side}_white.json").unlink()
    (folder / "LEFT_pattern_0.json").write_text(json.dumps(about))
