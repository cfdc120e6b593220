"""Recordings of a simulated device, in the layout that calibrations are made from."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from scipy.spatial.transform import Rotation

from sidelong.calibration.hand_eye.board import BoardSettings, render_board
from sidelong.commissioning.made import Captures, Made
from sidelong.commissioning.procedures import perform
from sidelong.commissioning.recording import Recorder
from sidelong.commissioning.tasks import Task
from sidelong.devices import CaptureRequest
from sidelong.geometry.mesh import Part, part_from_arrays
from sidelong.geometry.transforms import invert, rotation_about, transform
from sidelong.recipe import Recipe
from sidelong.recorded.dataset import Dataset
from sidelong.recorded.files import MM
from sidelong.recorded.writing import pose_to_mm, write_gray, write_json, write_rig
from sidelong.simulation.lighting import LightSettings
from sidelong.simulation.lofting import loft, rectangle_ring
from sidelong.simulation.rig import rig_for
from sidelong.simulation.sensor import ActiveStereoSensor, SensorSettings
from sidelong.types import FloatArray, Frame, GrayImage, IntArray, Projector, View

SERIAL = "N35-1"
BOARD = BoardSettings(squares_x=8, squares_y=6, square_m=0.03, marker_m=0.022)
FLANGE_T_CAMERA = transform(Rotation.from_rotvec([0.02, -0.03, 1.57]).as_matrix(), (0.03, -0.06, 0.11))
BASE_T_BOARD = transform(Rotation.from_rotvec([np.pi, 0.1, 0.0]).as_matrix(), (0.55, 0.1, 0.0))
BALL_RADIUS_M = 0.06
BALLS_M = ((0.0, 0.0), (0.15, 0.05), (0.1, -0.13))
"""Where the balls lie: they do not touch and mirror little of each other."""


def board_poses(
    count: int, tilt_rad: float = 0.25, distances_m: tuple[float, float] = (0.55, 0.75)
) -> list[FloatArray]:
    """Return poses camera_T_board that show the whole board, tilted and turned, from several distances."""
    random = np.random.default_rng(3)
    middle = np.array([BOARD.squares_x, BOARD.squares_y, 0.0]) * BOARD.square_m / 2
    poses: list[FloatArray] = []
    for _ in range(count):
        turn = Rotation.from_rotvec(random.normal(size=3) * tilt_rad * np.array([1.0, 1.0, 2.0])).as_matrix()
        # the left camera's axis passes left of its image's middle
        place = random.uniform((0.08, -0.05, distances_m[0]), (0.16, 0.05, distances_m[1]))
        poses.append(transform(turn, place - turn @ middle))
    return poses


def record_boards(root: Path, poses: list[FloatArray], arm_noise_m: float = 0.0) -> None:
    """Write images of a board and the arm's poses."""
    rig = rig_for(640, 512)
    write_rig(root, rig, SERIAL)
    folder = root / "Calibration" / "HandEye"
    write_json(folder / "board.json", BOARD.model_dump(mode="json"))
    random = np.random.default_rng(4)
    told: dict[str, list[float]] = {}
    for index, camera_T_board in enumerate(poses):
        name = f"LEFT_{index}.bmp"
        write_gray(folder / name, render_board(BOARD, rig.left, camera_T_board, noise_grey=1.0, seed=index))
        base_T_flange = BASE_T_BOARD @ invert(camera_T_board) @ invert(FLANGE_T_CAMERA)
        base_T_flange[:3, 3] += arm_noise_m * random.normal(size=3)
        told[name] = pose_to_mm(base_T_flange)
    write_json(folder / "poses.json", {"unit": "mm", "poses": told})


class BenchCamera:
    """A ``sidelong.devices.Camera`` over any simulated scene: the cell's own camera has its bin only."""

    name = "bench camera"

    serial = SERIAL

    def __init__(self, parts: Sequence[tuple[Part, FloatArray]], dome: float = LightSettings().dome) -> None:
        self.rig = rig_for(320, 256)
        self._sensor = ActiveStereoSensor(self.rig, parts, SensorSettings(light=LightSettings(dome=dome)))

    def open(self) -> None: ...

    def close(self) -> None: ...

    def capture(self, request: CaptureRequest, base_T_camera: FloatArray) -> Frame:
        shot = self._sensor.capture(base_T_camera, request.projector, request.exposure_s, request.depth)
        view = View("bench", base_T_camera)
        return Frame(view, shot.left, shot.right, shot.depth_m, request.projector, request.exposure_s)

    def capture_truth(self, base_T_camera: FloatArray) -> FloatArray:
        return self._sensor.true_depth_m(base_T_camera)


@dataclass(frozen=True, eq=False)
class Balls:
    """Three balls above a matte floor: their normals point everywhere. The materials share them half and half."""

    materials: tuple[str, ...]
    dome: float = LightSettings().dome

    @property
    def part(self) -> Part:
        mesh = trimesh.creation.icosphere(subdivisions=5, radius=BALL_RADIUS_M)
        side = np.asarray(mesh.triangles_center[:, 0] > 0, dtype=np.intp) * (len(self.materials) > 1)
        order = np.argsort(side, kind="stable")
        triangles: IntArray = np.asarray(mesh.faces, dtype=np.intp)[order]
        return part_from_arrays("balls", np.asarray(mesh.vertices), triangles, side[order], self.materials)

    @property
    def base_T_objects(self) -> tuple[FloatArray, ...]:
        return tuple(transform(np.eye(3), (x, y, 0.0)) for x, y in BALLS_M)

    def camera(self, *, sprayed: bool = False) -> BenchCamera:
        part = self.part
        shown = replace(part, materials=("matte",) * len(part.materials)) if sprayed else part
        return BenchCamera([(floor(), ABOVE_FLOOR), *((shown, pose) for pose in self.base_T_objects)], self.dome)

    def record(self, root: Path, name: str, exposure_s: float) -> None:
        """Take white images and sprayed depth, and write CAD model and poses, as ``name``."""
        recorder(self.camera(), root, name).white([exposure_s])
        recorder(self.camera(sprayed=True), root, name).sprayed(0.012)
        write_model(root, name, self.part)
        write_poses(root, name, self.base_T_objects)


def looking_down(distance_m: float, tilt_rad: float = 0.0) -> FloatArray:
    """Return base_T_camera that looks down at the floor, the camera's axis at (0.05, 0, 0)."""
    turn = np.diag([1.0, -1.0, -1.0]) @ rotation_about((1, 0, 0), tilt_rad)
    return transform(turn, np.array([0.05, 0.0, 0.0]) - distance_m * turn[:, 2])


ABOVE_FLOOR = transform(np.eye(3), (0.0, 0.0, -BALL_RADIUS_M))
BALLS_VIEW = looking_down(0.65)


def floor(material: str = "matte") -> Part:
    """Return a square plate whose top is at z = 0."""
    return part_from_arrays("floor", *loft([rectangle_ring(1.6, 1.6, z) for z in (-0.01, 0.0)]), materials=(material,))


def recorder(camera: Any, root: Path, name: str | None, base_T_camera: FloatArray = BALLS_VIEW) -> Recorder:
    return Recorder(camera, base_T_camera @ invert(FLANGE_T_CAMERA), base_T_camera, root, name)


def record_bracket(root: Path, camera: Any, exposures_ms: Sequence[float], projector: Projector) -> None:
    recorder(camera, root, None).bracket([each * 1e-3 for each in exposures_ms], projector, lambda done, total: None)


def record_planes(root: Path, views: Sequence[tuple[float, float]], exposure_s: float, material: str = "matte") -> None:
    """Take a plane from (distance, tilt) each; the exposure is for 0.7 m and goes with the squared distance."""
    camera = BenchCamera([(floor(material), np.eye(4))])
    for distance_m, tilt_rad in views:
        pose = looking_down(distance_m, tilt_rad)
        recorder(camera, root, None, pose).plane(exposure_s * (distance_m / 0.7) ** 2)


def write_model(root: Path, name: str, part: Part) -> None:
    """Write a CAD model and its materials; the part's triangles are sorted by material."""
    folder = root / "models"
    folder.mkdir(parents=True, exist_ok=True)
    trimesh.Trimesh(part.vertices_m / MM, part.triangles, process=False).export(folder / f"{name}.stl")
    ends = np.cumsum([0, *np.bincount(part.triangle_material, minlength=len(part.materials))]).tolist()
    ranges = [[first, last, each] for first, last, each in zip(ends, ends[1:], part.materials, strict=False)]
    write_json(folder / f"{name}.json", {"unit": "mm", "face_ranges": ranges})


def write_poses(root: Path, name: str, base_T_objects: Sequence[FloatArray]) -> None:
    poses = {f"object_{index}": pose_to_mm(pose) for index, pose in enumerate(base_T_objects)}
    write_json(root / name / "Calibration" / "Phong" / "GT_world2obj.json", poses)


def image(path: Path) -> GrayImage:
    with Image.open(path) as picture:
        return np.asarray(picture.convert("L"), dtype=np.uint8)


def edit_image(path: Path, edited: Any) -> None:
    """Write an array in the place of an image."""
    # BMP holds no 16 bits; readers go by content
    Image.fromarray(edited).save(path, format="PNG")


def edit_json(path: Path, **changes: Any) -> None:
    write_json(path, json.loads(path.read_text()) | changes)


class Told:
    """Keeps what progress tells."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, int, int]] = []

    def __call__(self, work: str, done: int, total: int) -> None:
        self.calls.append((work, done, total))


def made_from(
    root: Path, task: Task, name: str | None = None, documents: Sequence[Any] = (), progress: Any = None
) -> tuple[Made, ...]:
    """Do a task on a data set."""
    captures = Captures(Dataset(root), name, Recipe(), tuple(documents))
    return tuple(perform(task, captures, progress or Told()))
