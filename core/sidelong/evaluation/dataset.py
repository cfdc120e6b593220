"""Recorded scenes in the layout of the ROBI data set (Yang et al. 2021), exactly as published.

::

    cam/Ensenso_{DEPTH,LEFT,RIGHT}.yml               intrinsics (px), baseline (mm), depth_unit (mm)
    cam/rig.json                                     optional: projector and exposures
    models/<Object>.stl (.ply, .obj, .off) and .json CAD model in mm; optional materials
    <Object>/Scene_<k>/GT_world2obj.json             {name: pose of the object in the world, 4x4 by rows, mm}
    <Object>/Scene_<k>/GT_Depth*/DEPTH_<view>.png    true depth, often of a part of the views only
    <Object>/Scene_<k>/Ensenso/list.txt              names of the views
                              /Depth/DEPTH_<view>.png .json                   depth, camera pose in the world (mm)
                              /Stereo/{LEFT,RIGHT}_<view>.bmp .json           projector off
                              /StereoPattern/, /StereoWhite/                  projector on: dots; white (not in ROBI)
    <Object>/Calibration/Phong/LEFT_white.bmp .json, GT_world2obj.json        optional: white capture of known poses

The world is the base frame. Millimetres and depth units become metres on the line that reads them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np

from sidelong.errors import DatasetError, ImageError, SettingsError, UnknownNameError
from sidelong.geometry.camera_model import LightProjector, PinholeCamera, StereoRig
from sidelong.geometry.mesh import Part, load_part
from sidelong.geometry.transforms import invert, rotation_angle, transform, validated_transform
from sidelong.types import FloatArray, Frame, GrayImage, Projector, View

MM = 1e-3
FOLDERS = {Projector.OFF: "Stereo", Projector.DOTS: "StereoPattern", Projector.WHITE: "StereoWhite"}
CAD_SUFFIXES = (".stl", ".ply", ".obj", ".off")
PROJECTOR_WIDTH_RAD = np.deg2rad(62.0)
"""Assumed where rig.json does not say: an Ensenso lights what its cameras see."""
LARGEST_NUMBER = 1e12
"""No length, angle or time in these files comes near; larger ones overflow somewhere."""
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
        return _number(self._intrinsics["DEPTH"], "depth_unit", self._yml("DEPTH")) * MM

    @cached_property
    def rig(self) -> StereoRig:
        """Cameras and projector. Raises DatasetError where a file of ``cam/`` is missing or cannot be used."""
        left, right = self._camera("LEFT"), self._camera("RIGHT")
        named = next((side for side in ("DEPTH", "LEFT", "RIGHT") if "baseline" in self._intrinsics[side]), "DEPTH")
        baseline_m = _number(self._intrinsics[named], "baseline", self._yml(named)) * MM
        try:
            return StereoRig(left, right, baseline_m, self._projector(baseline_m))
        except SettingsError as error:
            raise DatasetError(f"{self.root / 'cam'}: {error}") from error

    def exposure_s(self, projector: Projector) -> float | None:
        """Return the exposure of a kind of capture, None where the data set does not tell."""
        path = self.root / "cam/rig.json"
        exposures = _mapping(self._rig_file.get("exposure_ms", _NOTHING), path)
        name = "off" if projector is Projector.OFF else "pattern"
        return _number(exposures, name, path) * MM if name in exposures else None

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
        about = _json(image.with_suffix(".json"))
        view = View("white", _pose_m(about.get("cam_pose"), image.with_suffix(".json")))
        exposure_s = _number(about, "exposure_ms", image.with_suffix(".json")) * MM
        left = read_gray(image, self.rig.left)
        frame = Frame(view, left, None, None, Projector.WHITE, exposure_s)
        return WhiteCapture(frame, _object_poses(folder / "GT_world2obj.json"))

    def _camera(self, side: str) -> PinholeCamera:
        path, values = self._yml(side), self._intrinsics[side]
        width, height = (_count(values, name, path) for name in ("width", "height"))
        numbers = {name: _number(values, name, path, positive=False) for name in ("fx", "fy", "cx", "cy")}
        try:
            return PinholeCamera(width, height, **numbers)
        except SettingsError as error:
            raise DatasetError(f"{path}: {error}") from error

    def _projector(self, baseline_m: float) -> LightProjector:
        """Return the recorded projector; where there is none, one midway between the cameras that looks ahead."""
        path, about = self.root / "cam/rig.json", self._rig_file
        width_rad = float(PROJECTOR_WIDTH_RAD)
        if "projector_fov_x_deg" in about:
            width_rad = float(np.deg2rad(_number(about, "projector_fov_x_deg", path)))
        left_T_projector = transform(np.eye(3), (baseline_m / 2, 0.0, 0.0))
        if "projector_in_left" in about:
            left_T_projector = _pose_m(about["projector_in_left"], path)
        left = self._camera("LEFT")
        half_height_rad = float(np.arctan(np.tan(width_rad / 2) * left.height / left.width))
        return LightProjector(left_T_projector, width_rad / 2, half_height_rad)

    @cached_property
    def _rig_file(self) -> Mapping[str, Any]:
        path = self.root / "cam/rig.json"
        return _json(path) if path.is_file() else _NOTHING

    @cached_property
    def _intrinsics(self) -> Mapping[str, Mapping[str, Any]]:
        return {side: _yaml(self._yml(side)) for side in ("DEPTH", "LEFT", "RIGHT")}

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
        return View(name, _pose_m(_json(path).get("cam_pose"), path))

    def depth_m(self, name: str) -> FloatArray:
        """Read the measured depth (H, W) of a view, NaN where missing. Raises ImageError."""
        return self._depth(self._file("Depth", f"DEPTH_{name}.png"))

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
        about = _json(path) if path.is_file() else _NOTHING
        if "exposure_ms" in about:
            return _number(about, "exposure_ms", path) * MM
        return self.dataset.exposure_s(projector)

    @cached_property
    def base_T_objects(self) -> tuple[FloatArray, ...]:
        """True pose (4, 4) of each object. Raises DatasetError or PoseError."""
        return _object_poses(self.folder / "GT_world2obj.json")

    def true_depth_m(self, name: str) -> FloatArray | None:
        """Read the true depth (H, W) of a view, NaN where unknown; None where there is none. Raises ImageError."""
        path = self._true_depth_files.get(name)
        return None if path is None else self._depth(path)

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
                name = _nearest(_pose_m(_json(about).get("cam_pose"), about), views)
            if name is not None:
                files[name] = path
        return files

    def _file(self, folder: str, name: str) -> Path:
        return self.folder / "Ensenso" / folder / name

    def _depth(self, path: Path) -> FloatArray:
        counts = read_counts(path, self.dataset.rig.left)
        return np.where(counts > 0, counts * self.dataset.depth_unit_m, np.nan)


def read_gray(path: Path, camera: PinholeCamera) -> GrayImage:
    """Read an 8-bit grey image (H, W) of the camera's size. Raises ImageError."""
    return np.asarray(_picture(path, camera).convert("L"), dtype=np.uint8)


def read_counts(path: Path, camera: PinholeCamera) -> FloatArray:
    """Read a 16-bit grey picture (H, W) of the camera's size as numbers. Raises ImageError."""
    picture = _picture(path, camera)
    if not picture.mode.startswith("I"):
        raise ImageError(f"{path}: its pixels are of kind {picture.mode!r}, a depth map has 16-bit grey ones")
    return np.asarray(picture, dtype=np.float64)


def _picture(path: Path, camera: PinholeCamera) -> Any:
    """Decode a picture wholly and check its size: Pillow refuses truncated files, OpenCV fills them up."""
    from PIL import Image

    if not path.is_file():
        raise ImageError(f"{path}: the image is missing")
    try:
        # decoding alone overlooks the checksums and the end of a PNG: a third of all flipped bytes gave another depth
        with Image.open(path) as picture:
            picture.verify()
        with Image.open(path) as picture:
            picture.load()
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise ImageError(f"{path}: the image is truncated or damaged: {error}") from error
    if picture.size != (camera.width, camera.height):
        raise ImageError(
            f"{path}: the image is {picture.width}x{picture.height} px, cam/ says {camera.width}x{camera.height} px"
        )
    return picture


def _nearest(base_T_camera: FloatArray, views: tuple[View, ...]) -> str | None:
    """Return the name of the view at this pose, None where none is."""
    apart = [invert(view.base_T_camera) @ base_T_camera for view in views]
    distances_m = [float(np.linalg.norm(each[:3, 3])) for each in apart]
    index = int(np.argmin(distances_m))
    same = distances_m[index] <= SAME_PLACE_M and rotation_angle(apart[index][:3, :3]) <= SAME_TURN_RAD
    return views[index].name if same else None


def _object_poses(path: Path) -> tuple[FloatArray, ...]:
    return tuple(_pose_m(pose, f"{path}: {name}") for name, pose in _json(path).items())


def _pose_m(numbers: Any, name: Path | str) -> FloatArray:
    """Read a pose in mm as metres. Raises PoseError."""
    pose = validated_transform(() if numbers is None else numbers, str(name))
    pose[:3, 3] *= MM
    return pose


def _json(path: Path) -> Mapping[str, Any]:
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError as error:
        raise DatasetError(f"{path}: the file is missing") from error
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: cannot be read as JSON: {error}") from error
    return _mapping(content, path)


def _yaml(path: Path) -> Mapping[str, Any]:
    import yaml

    try:
        # OpenCV writes a first line that YAML does not know
        lines = path.read_text().splitlines()
        return _mapping(yaml.safe_load("\n".join(line for line in lines if not line.startswith("%YAML"))), path)
    except FileNotFoundError as error:
        raise DatasetError(f"{path}: the file is missing") from error
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise DatasetError(f"{path}: cannot be read as YAML: {error}") from error


def _mapping(content: Any, path: Path) -> Mapping[str, Any]:
    if not isinstance(content, dict):
        raise DatasetError(f"{path}: holds {type(content).__name__}, needs names with values")
    return cast("Mapping[str, Any]", content)


def _number(values: Mapping[str, Any], name: str, path: Path, *, positive: bool = True) -> float:
    value = values.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST_NUMBER:
        raise DatasetError(f"{path}: {name} is {value!r:.40}, needs a finite number")
    if positive and value <= 0:
        raise DatasetError(f"{path}: {name} is {value!r:.40}, needs a number greater than 0")
    return float(value)


def _count(values: Mapping[str, Any], name: str, path: Path) -> int:
    number = _number(values, name, path)
    if number != int(number):
        raise DatasetError(f"{path}: {name} is {number!r}, needs a whole number")
    return int(number)
