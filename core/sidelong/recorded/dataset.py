"""Recorded scenes in the layout of the ROBI data set (Yang et al. 2021), exactly as published.

::

    cam/Ensenso_{DEPTH,LEFT,RIGHT}.yml               intrinsics (px), baseline (mm), depth_unit (mm)
    cam/rig.json                                     optional: projector, exposures, serial number
    models/<Object>.stl (.ply, .obj, .off) and .json CAD model in mm; optional materials
    <Object>/Scene_<k>/GT_world2obj.json             {name: pose of the object in the world, 4x4 by rows, mm}
    <Object>/Scene_<k>/GT_Depth*/DEPTH_<view>.png    true depth, often of a part of the views only
    <Object>/Scene_<k>/Ensenso/list.txt              names of the views
                              /Depth/DEPTH_<view>.png .json                   depth, camera pose in the world (mm)
                              /Stereo/{LEFT,RIGHT}_<view>.bmp .json           projector off
                              /StereoPattern/, /StereoWhite/                  projector on: dots; white (not in ROBI)
    <Object>/Calibration/                            optional, see sidelong.recorded.captures

The world is the base frame. Millimetres and depth units become metres on the line that reads them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sidelong.devices import CaptureRequest
from sidelong.errors import DatasetError, ImageError, SettingsError, UnknownNameError
from sidelong.geometry.camera_model import LightProjector, PinholeCamera, StereoRig
from sidelong.geometry.mesh import Part, load_part
from sidelong.geometry.transforms import invert, rotation_angle, transform
from sidelong.recorded.files import (
    MM,
    count_in,
    mapping_in,
    number_in,
    pose_from_mm,
    read_counts,
    read_gray,
    read_json,
    read_yaml,
)
from sidelong.types import FloatArray, Frame, GrayImage, Projector, View

FOLDERS = {Projector.OFF: "Stereo", Projector.DOTS: "StereoPattern", Projector.WHITE: "StereoWhite"}
CAD_SUFFIXES = (".stl", ".ply", ".obj", ".off")
PROJECTOR_WIDTH_RAD = np.deg2rad(62.0)
"""Assumed where rig.json does not say: an Ensenso lights what its cameras see."""
_NOTHING: Mapping[str, Any] = {}
SAME_PLACE_M, SAME_TURN_RAD = 1e-3, 2e-3
"""How far the pose of a true depth map may be from that of its view: the arm came back to it, after spraying."""


class Dataset:
    """A folder of recorded objects.

    Parameters
    ----------
    root
        The folder.

    Raises
    ------
    UnknownNameError
        There is no such folder.
    """

    def __init__(self, root: Path) -> None:
        if not root.is_dir():
            raise UnknownNameError(f"{root}: no such data set folder")
        self.root = root

    @property
    def objects(self) -> tuple[str, ...]:
        """Names of the objects that have scenes."""
        return tuple(sorted({folder.parent.name for folder in self.root.glob("*/Scene_*") if folder.is_dir()}))

    def scenes(self, object_name: str) -> tuple[int, ...]:
        """Return the numbers of an object's scenes. Raises UnknownNameError."""
        if object_name not in self.objects:
            known = ", ".join(self.objects) or "none"
            raise UnknownNameError(f"{self.root}: object {object_name!r} is unknown, known are {known}")
        numbers = (folder.name.removeprefix("Scene_") for folder in (self.root / object_name).glob("Scene_*"))
        return tuple(sorted(int(number) for number in numbers if number.isdecimal()))

    def scene(self, object_name: str, number: int) -> Scene:
        """Return a scene. Raises UnknownNameError where there is none."""
        known = self.scenes(object_name)
        if number not in known:
            listed = ", ".join(map(str, known)) or "none"
            raise UnknownNameError(f"{self.root / object_name}: scene {number} is unknown, known are {listed}")
        return Scene(self, object_name, number)

    def part(self, object_name: str) -> Part:
        """Read the CAD model of an object.

        Raises
        ------
        UnknownNameError
            There is no file.
        MeshError
            It cannot be used.
        """
        stem = self.root / "models" / object_name
        files = [stem.with_name(stem.name + suffix) for suffix in CAD_SUFFIXES]
        return load_part(next((file for file in files if file.is_file()), files[0]))

    @cached_property
    def depth_unit_m(self) -> float:
        """Metres per count of the depth pictures. Raises DatasetError."""
        return number_in(self._intrinsics["DEPTH"], "depth_unit", self._yml("DEPTH")) * MM

    @cached_property
    def rig(self) -> StereoRig:
        """Cameras and projector. Raises DatasetError where a file of ``cam/`` is missing or cannot be used."""
        left, right = self._camera("LEFT"), self._camera("RIGHT")
        named = next((side for side in ("DEPTH", "LEFT", "RIGHT") if "baseline" in self._intrinsics[side]), "DEPTH")
        baseline_m = number_in(self._intrinsics[named], "baseline", self._yml(named)) * MM
        try:
            return StereoRig(left, right, baseline_m, self._projector(baseline_m))
        except SettingsError as error:
            raise DatasetError(f"{self.root / 'cam'}: {error}") from error

    @cached_property
    def serial(self) -> str:
        """Serial number of the camera: of ``rig.json``, else one made of the intrinsics, which no two cameras share."""
        given = self._rig_file.get("serial")
        if given is not None:
            return str(given)
        numbers = json.dumps([sorted(self._intrinsics[side].items()) for side in ("LEFT", "RIGHT")], default=str)
        return f"intrinsics-{hashlib.sha256(numbers.encode()).hexdigest()[:12]}"

    def read_depth_m(self, path: Path) -> FloatArray:
        """Read a depth picture (H, W) in the left camera, NaN where missing. Raises ImageError."""
        counts = read_counts(path, self.rig.left)
        return np.where(counts > 0, counts * self.depth_unit_m, np.nan)

    def exposure_s(self, projector: Projector) -> float | None:
        """Return the exposure of a kind of capture, None where the data set does not tell."""
        path = self.root / "cam/rig.json"
        exposures = mapping_in(self._rig_file.get("exposure_ms", _NOTHING), path)
        name = "off" if projector is Projector.OFF else "pattern"
        return number_in(exposures, name, path) * MM if name in exposures else None

    def white_capture(self, object_name: str) -> WhiteCapture | None:
        """Return the object's capture under a white pattern, None where it has none.

        Raises
        ------
        ImageError, DatasetError, PoseError
            A file of it cannot be used.
        """
        folder = self.root / object_name / "Calibration" / "Phong"
        image = folder / "LEFT_white.bmp"
        if not image.is_file():
            return None
        about = read_json(image.with_suffix(".json"))
        view = View("white", pose_from_mm(about.get("cam_pose"), image.with_suffix(".json")))
        exposure_s = number_in(about, "exposure_ms", image.with_suffix(".json")) * MM
        left = read_gray(image, self.rig.left)
        frame = Frame(view, left, None, None, Projector.WHITE, exposure_s)
        return WhiteCapture(frame, object_poses(folder / "GT_world2obj.json"))

    def _camera(self, side: str) -> PinholeCamera:
        path, values = self._yml(side), self._intrinsics[side]
        width, height = (count_in(values, name, path) for name in ("width", "height"))
        numbers = {name: number_in(values, name, path, positive=False) for name in ("fx", "fy", "cx", "cy")}
        try:
            return PinholeCamera(width, height, **numbers)
        except SettingsError as error:
            raise DatasetError(f"{path}: {error}") from error

    def _projector(self, baseline_m: float) -> LightProjector:
        """Return the recorded projector; where there is none, one midway between the cameras that looks ahead."""
        path, about = self.root / "cam/rig.json", self._rig_file
        width_rad = float(PROJECTOR_WIDTH_RAD)
        if "projector_fov_x_deg" in about:
            width_rad = float(np.deg2rad(number_in(about, "projector_fov_x_deg", path)))
        left_T_projector = transform(np.eye(3), (baseline_m / 2, 0.0, 0.0))
        if "projector_in_left" in about:
            left_T_projector = pose_from_mm(about["projector_in_left"], path)
        left = self._camera("LEFT")
        height_rad = 2 * float(np.arctan(np.tan(width_rad / 2) * left.height / left.width))
        if "projector_fov_y_deg" in about:
            height_rad = float(np.deg2rad(number_in(about, "projector_fov_y_deg", path)))
        return LightProjector(left_T_projector, width_rad / 2, height_rad / 2)

    @cached_property
    def _rig_file(self) -> Mapping[str, Any]:
        path = self.root / "cam/rig.json"
        return read_json(path) if path.is_file() else _NOTHING

    @cached_property
    def _intrinsics(self) -> Mapping[str, Mapping[str, Any]]:
        return {side: read_yaml(self._yml(side)) for side in ("DEPTH", "LEFT", "RIGHT")}

    def _yml(self, side: str) -> Path:
        return self.root / "cam" / f"Ensenso_{side}.yml"


@dataclass(frozen=True, eq=False)
class WhiteCapture:
    """A capture under a white pattern, and ``base_T_object`` (4, 4) of each part in it."""

    frame: Frame
    base_T_objects: tuple[FloatArray, ...]


@dataclass(frozen=True, eq=False)
class Scene:
    """One recorded bin: its views, their images and depth maps, and the truth."""

    dataset: Dataset
    object: str
    number: int

    @property
    def folder(self) -> Path:
        """Where the scene lies."""
        return self.dataset.root / self.object / f"Scene_{self.number}"

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the views, in the order of the list. Raises DatasetError."""
        path = self.folder / "Ensenso" / "list.txt"
        if not path.is_file():
            raise DatasetError(f"{path}: the list of views is missing")
        names = tuple(dict.fromkeys(path.read_text(errors="replace").split()))
        strange = [name for name in names if not name.replace("_", "").replace("-", "").isalnum()]
        if not names or strange:
            raise DatasetError(f"{path}: {f'{strange[0]!r:.80} is no name of a view' if names else 'lists no view'}")
        return names

    def views(self) -> tuple[View, ...]:
        """Return all views. Raises DatasetError or PoseError where a pose is missing or cannot be used."""
        return tuple(self.view(name) for name in self.names)

    def view(self, name: str) -> View:
        """Return one view. Raises UnknownNameError, DatasetError or PoseError."""
        if name not in self.names:
            raise UnknownNameError(f"{self.folder}: view {name!r} is unknown, known are {', '.join(self.names)}")
        path = self._file("Depth", f"DEPTH_{name}.json")
        return View(name, pose_from_mm(read_json(path).get("cam_pose"), path))

    def depth_m(self, name: str) -> FloatArray:
        """Read the measured depth (H, W) of a view, NaN where missing. Raises ImageError."""
        return self.dataset.read_depth_m(self._file("Depth", f"DEPTH_{name}.png"))

    @property
    def depth_files(self) -> tuple[Path, ...]:
        """Files of the measured depth of all views."""
        return tuple(self._file("Depth", f"DEPTH_{name}.png") for name in self.names)

    def distance_range_m(self) -> tuple[float, float] | None:
        """Return the distances between which nearly all of the scene was measured; None where nothing was.

        Raises
        ------
        ImageError, DatasetError
            A depth map cannot be read.
        """
        ends: list[FloatArray] = []
        for name in self.names:
            depth_m = self.depth_m(name)[::4, ::4]
            if np.isfinite(depth_m).any():
                ends.append(np.percentile(depth_m[np.isfinite(depth_m)], (2, 98)))
        return (float(min(low for low, _ in ends)), float(max(high for _, high in ends))) if ends else None

    def image(self, name: str, projector: Projector, side: str = "LEFT") -> GrayImage | None:
        """Read an image (H, W) of a view, None where it was not recorded. Raises ImageError."""
        path = self._file(FOLDERS[projector], f"{side}_{name}.bmp")
        camera = self.dataset.rig.left if side == "LEFT" else self.dataset.rig.right
        return read_gray(path, camera) if path.is_file() else None

    def exposure_s(self, name: str, projector: Projector) -> float | None:
        """Return the exposure of an image, None where neither it nor the data set tells."""
        path = self._file(FOLDERS[projector], f"LEFT_{name}.json")
        about = read_json(path) if path.is_file() else _NOTHING
        if "exposure_ms" in about:
            return number_in(about, "exposure_ms", path) * MM
        return self.dataset.exposure_s(projector)

    def frame(self, view: View, request: CaptureRequest) -> Frame:
        """Return what was recorded at a view.

        A depth map needs no image: where no pattern image was recorded, ``left`` is the one with the projector off, and
        ``projector`` says so. The exposure is the recorded one, the requested one where the recording does not tell.

        Raises
        ------
        ImageError
            A file is missing, damaged or of the wrong size.
        """
        shown = request.projector
        left = self.image(view.name, shown)
        if left is None and request.depth:
            left = self.image(view.name, shown := Projector.OFF)
        if left is None:
            raise ImageError(f"{self.folder}: view {view.name} has no left image with the projector at {shown}")
        return Frame(
            view=view,
            left=left,
            right=self.image(view.name, shown, "RIGHT"),
            depth_m=self.depth_m(view.name) if request.depth else None,
            projector=shown,
            exposure_s=self.exposure_s(view.name, request.projector) or request.exposure_s,
        )

    @cached_property
    def base_T_objects(self) -> tuple[FloatArray, ...]:
        """True pose (4, 4) of each object. Raises DatasetError or PoseError."""
        return object_poses(self.folder / "GT_world2obj.json")

    def true_depth_m(self, name: str) -> FloatArray | None:
        """Read the true depth (H, W) of a view, NaN where unknown; None where there is none. Raises ImageError."""
        path = self._true_depth_files.get(name)
        return None if path is None else self.dataset.read_depth_m(path)

    @cached_property
    def _true_depth_files(self) -> dict[str, Path]:
        """Files of true depth by view. ROBI counts them anew in scenes 1-3, 6 and 7: where they tell, poses decide."""
        views = self.views()
        folders = sorted(folder for folder in self.folder.glob("GT_Depth*") if folder.is_dir())
        files: dict[str, Path] = {}
        for path in sorted(folders[0].glob("DEPTH_*.png")) if folders else ():
            about = path.with_suffix(".json")
            name: str | None = path.stem.removeprefix("DEPTH_")
            if about.is_file():
                name = _nearest(pose_from_mm(read_json(about).get("cam_pose"), about), views)
            if name is not None:
                files[name] = path
        return files

    def _file(self, folder: str, name: str) -> Path:
        return self.folder / "Ensenso" / folder / name


def _nearest(base_T_camera: FloatArray, views: tuple[View, ...]) -> str | None:
    """Return the name of the view at this pose, None where none is."""
    apart = [invert(view.base_T_camera) @ base_T_camera for view in views]
    distances_m = [float(np.linalg.norm(each[:3, 3])) for each in apart]
    index = int(np.argmin(distances_m))
    same = distances_m[index] <= SAME_PLACE_M and rotation_angle(apart[index][:3, :3]) <= SAME_TURN_RAD
    return views[index].name if same else None


def object_poses(path: Path) -> tuple[FloatArray, ...]:
    """Read named poses (mm) as (4, 4) in metres. Raises DatasetError or PoseError."""
    return tuple(pose_from_mm(pose, f"{path}: {name}") for name, pose in read_json(path).items())
