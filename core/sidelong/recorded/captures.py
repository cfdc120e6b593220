"""Captures that calibrations are made from, as a data set holds them: files read and checked, nothing fitted.

::

    [<Object>/]Calibration/       of one object, or of the device for all of them; the object's own is looked for first
      Response/times.json         exposure bracket of a scene at rest: {"unit": "ms", "times": {image: time}}
      Phong/{LEFT,RIGHT}_white.bmp .json            white pattern; exposure_ms, cam_pose (mm). Instead of each image
           /{LEFT,RIGHT}_pattern_<i>.bmp            shifted dots are merged, their exposure is in LEFT_pattern_0.json
           /{LEFT,RIGHT}_white_<i>.bmp .json        optional: more exposures of the same
           /{LEFT,RIGHT}_off.bmp .json              optional: projector off, any exposure; the room's light
           /DEPTH_sprayed.png .json                 the same scene, sprayed: complete depth
           /mask_parts.png, GT_world2obj.json       optional: which pixels show parts; their poses (mm)
      Plane/LEFT_white_<i>.bmp .json, DEPTH_<i>.png matte plane under the white pattern, and its depth
           /LEFT_off_<i>.bmp .json                  optional: projector off
      Repeats/DEPTH_<i>.png                         depth of a scene at rest, again and again
      HandEye/board.json, poses.json, images        ChArUco board: {"unit": "mm", "poses": {image: base_T_flange}}
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sidelong.errors import CalibrationError, DatasetError, ImageError
from sidelong.geometry.transforms import invert, rotation_angle, validated_transform
from sidelong.recorded.dataset import SAME_PLACE_M, SAME_TURN_RAD, Dataset, object_poses
from sidelong.recorded.files import (
    MM,
    mapping_in,
    number_in,
    pose_from_mm,
    read_gray,
    read_json,
)
from sidelong.types import BoolArray, FloatArray, GrayImage

SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6}
METRES = {"m": 1.0, "mm": MM}


@dataclass(frozen=True, eq=False)
class Bracket:
    """One scene at several exposures: ``names`` of the images, ``images`` (H, W) each, ``exposures_s``, ``files``."""

    names: tuple[str, ...]
    images: tuple[GrayImage, ...]
    exposures_s: tuple[float, ...]
    files: tuple[Path, ...]


@dataclass(frozen=True, eq=False)
class ImagePair:
    """What the cameras see at one exposure: ``left`` (H, W), ``right`` likewise or None, ``exposure_s``."""

    left: GrayImage
    right: GrayImage | None
    exposure_s: float


@dataclass(frozen=True, eq=False)
class SprayedCapture:
    """A scene under the white pattern, and its complete depth once it was sprayed.

    Attributes
    ----------
    left, right
        The image (H, W) under the white pattern, or several under shifted dots whose maximum is one; ``right`` is
        empty where the right camera took none.
    exposure_s
        Of both.
    others
        The same under a white pattern at other exposures: what saturates in one is measured in another.
    room
        The same with the projector off, where it was taken.
    depth_m
        (H, W) in the left camera, NaN where missing.
    mask
        (H, W) pixels that show parts; None where nobody marked them.
    base_T_camera
        (4, 4) pose of the left camera.
    base_T_objects
        Poses of the parts; none where they are not known.
    files
        All files that were read.
    """

    left: tuple[GrayImage, ...]
    right: tuple[GrayImage, ...]
    exposure_s: float
    others: tuple[ImagePair, ...]
    room: ImagePair | None
    depth_m: FloatArray
    mask: BoolArray | None
    base_T_camera: FloatArray
    base_T_objects: tuple[FloatArray, ...]
    files: tuple[Path, ...]


@dataclass(frozen=True, eq=False)
class RecordedPlane:
    """A matte plane under the white pattern: ``left`` (H, W), ``exposure_s``, ``depth_m`` (H, W), ``room`` if taken."""

    name: str
    left: GrayImage
    exposure_s: float
    depth_m: FloatArray
    room: ImagePair | None


@dataclass(frozen=True, eq=False)
class BoardCaptures:
    """Images of a board from several poses of the arm.

    Attributes
    ----------
    board
        Its description, as ``board.json`` holds it.
    names, images
        One (H, W) image a pose.
    base_T_flanges
        (4, 4) pose of the flange for each image.
    files
        All files that were read.
    """

    board: Mapping[str, Any]
    names: tuple[str, ...]
    images: tuple[GrayImage, ...]
    base_T_flanges: tuple[FloatArray, ...]
    files: tuple[Path, ...]


@dataclass(frozen=True)
class CalibrationCaptures:
    """What a data set has recorded for calibrations.

    Attributes
    ----------
    dataset
        Intrinsics and depth unit are its.
    object
        Whose captures are looked for first; None for those of the device alone.
    """

    dataset: Dataset
    object: str | None = None

    def bracket(self) -> Bracket:
        """Read the exposure bracket; images of the right camera are left out where there are some of the left.

        Raises
        ------
        DatasetError, ImageError
            A file is missing or cannot be used.
        """
        path = self._folder("Response") / "times.json"
        about = read_json(path)
        unit = _unit(about, SECONDS, "ms", path)
        times = mapping_in(about.get("times"), path)
        lefts = [name for name in times if name.startswith("LEFT")]
        names = tuple(lefts or times)
        files = tuple(_beside(path, name) for name in names)
        return Bracket(
            names=names,
            images=tuple(read_gray(file) for file in files),
            # what a time may be is for the fit to say: it names the image and what to do
            exposures_s=tuple(number_in(times, name, path, positive=False) * unit for name in names),
            files=(path, *files),
        )

    def sprayed(self) -> SprayedCapture:
        """Read the white images and the sprayed depth of the same scene.

        Raises
        ------
        CalibrationError
            The camera moved between the two scans.
        DatasetError, ImageError, PoseError
            A file is missing or cannot be used.
        """
        folder = self._folder("Phong")
        left, left_files = self._lit(folder, "LEFT")
        about, depth_file = left_files[0].with_suffix(".json"), folder / "DEPTH_sprayed.png"
        base_T_camera = pose_from_mm(read_json(about).get("cam_pose"), about)
        depth_m = self.dataset.read_depth_m(depth_file)
        files = [*left_files, about, depth_file]
        if depth_file.with_suffix(".json").is_file():
            files.append(depth_file.with_suffix(".json"))
            base_T_depth = pose_from_mm(read_json(files[-1]).get("cam_pose"), files[-1])
            _check_at_rest(base_T_camera, base_T_depth, folder)
        right: tuple[GrayImage, ...] = ()
        if any(True for name in ("white", "pattern_*") for _ in folder.glob(f"RIGHT_{name}.bmp")):
            right, right_files = self._lit(folder, "RIGHT")
            files += right_files
        room, room_files = self._pair(folder, "off")
        files += room_files
        others: list[ImagePair] = []
        for image in sorted(folder.glob("LEFT_white_*.bmp"), key=_number_of):
            pair, pair_files = self._pair(folder, image.stem.removeprefix("LEFT_"))
            others += [pair] if pair is not None else []
            files += pair_files
        mask_file, poses_file = folder / "mask_parts.png", folder / "GT_world2obj.json"
        files += [file for file in (mask_file, poses_file) if file.is_file()]
        return SprayedCapture(
            left=left,
            right=right,
            exposure_s=_exposure_s(about),
            others=tuple(others),
            room=room,
            depth_m=depth_m,
            mask=read_gray(mask_file, self.dataset.rig.left) > 0 if mask_file.is_file() else None,
            base_T_camera=base_T_camera,
            base_T_objects=object_poses(poses_file) if poses_file.is_file() else (),
            files=tuple(files),
        )

    def planes(self) -> tuple[tuple[RecordedPlane, ...], tuple[Path, ...]]:
        """Read the captures of a matte plane, and return them with their files.

        Raises
        ------
        DatasetError, ImageError
            There is none, or a file cannot be used.
        """
        folder = self._folder("Plane")
        images = sorted(folder.glob("LEFT_white_*.bmp"))
        if not images:
            raise DatasetError(f"{folder}: has no LEFT_white_<i>.bmp")
        captures: list[RecordedPlane] = []
        files: list[Path] = []
        for image in images:
            name = image.stem.removeprefix("LEFT_white_")
            about, depth = image.with_suffix(".json"), folder / f"DEPTH_{name}.png"
            left = read_gray(image, self.dataset.rig.left)
            room, room_files = self._pair(folder, f"off_{name}")
            captures.append(RecordedPlane(name, left, _exposure_s(about), self.dataset.read_depth_m(depth), room))
            files += [image, about, depth, *room_files]
        return tuple(captures), tuple(files)

    def board(self) -> BoardCaptures:
        """Read images of a board and the poses of the arm that go with them.

        Raises
        ------
        DatasetError, ImageError, PoseError
            A file is missing or cannot be used.
        """
        folder = self._folder("HandEye")
        board_file, poses_file = folder / "board.json", folder / "poses.json"
        about = read_json(poses_file)
        unit = _unit(about, METRES, "mm", poses_file)
        poses = mapping_in(about.get("poses"), poses_file)
        files = tuple(_beside(poses_file, name) for name in poses)
        return BoardCaptures(
            board=read_json(board_file),
            names=tuple(poses),
            images=tuple(read_gray(file, self.dataset.rig.left) for file in files),
            base_T_flanges=tuple(_scaled(pose, unit, f"{poses_file}: {name}") for name, pose in poses.items()),
            files=(board_file, poses_file, *files),
        )

    def depth_files(self, kind: str) -> tuple[Path, ...]:
        """Return ``DEPTH_<i>.png`` of a kind of captures, by their numbers.

        Raises
        ------
        DatasetError
            There is no folder of this kind, or no such file in it.
        """
        folder = self._folder(kind)
        files = tuple(sorted(folder.glob("DEPTH_*.png"), key=lambda file: (len(file.name), file.name)))
        if not files:
            raise DatasetError(f"{folder}: has no DEPTH_<i>.png")
        return files

    def _folder(self, kind: str) -> Path:
        owners = [self.dataset.root / self.object] if self.object is not None else []
        folders = [owner / "Calibration" / kind for owner in (*owners, self.dataset.root)]
        found = next((folder for folder in folders if folder.is_dir()), None)
        if found is None:
            raise DatasetError(f"{' and '.join(map(str, folders))}: no such folder of captures")
        return found

    def _pair(self, folder: Path, name: str) -> tuple[ImagePair | None, list[Path]]:
        """Return the images of a name and their files; None and no files where there are none."""
        rig = self.dataset.rig
        left, right = folder / f"LEFT_{name}.bmp", folder / f"RIGHT_{name}.bmp"
        if not left.is_file():
            return None, []
        about = left.with_suffix(".json")
        files = [left, about] + ([right] if right.is_file() else [])
        right_image = read_gray(right, rig.right) if right.is_file() else None
        return ImagePair(read_gray(left, rig.left), right_image, _exposure_s(about)), files

    def _lit(self, folder: Path, side: str) -> tuple[tuple[GrayImage, ...], list[Path]]:
        """Return the image under the white pattern, or in its place those under shifted dots, and their files."""
        camera = self.dataset.rig.left if side == "LEFT" else self.dataset.rig.right
        white = folder / f"{side}_white.bmp"
        files = [white] if white.is_file() else sorted(folder.glob(f"{side}_pattern_*.bmp"), key=_number_of)
        if not files:
            raise ImageError(f"{white}: the image is missing, and there is no {side}_pattern_<i>.bmp in its place")
        return tuple(read_gray(file, camera) for file in files), files


def _exposure_s(about: Path) -> float:
    return number_in(read_json(about), "exposure_ms", about) * MM


def _number_of(path: Path) -> tuple[int, str]:
    ending = path.stem.rpartition("_")[2]
    return (int(ending) if ending.isdecimal() else 0, path.name)


def _unit(about: Mapping[str, Any], known: Mapping[str, float], usual: str, path: Path) -> float:
    unit = about.get("unit", usual)
    if unit not in known:
        raise DatasetError(f"{path}: unit is {unit!r:.40}, known are {', '.join(known)}")
    return known[unit]


def _beside(path: Path, name: str) -> Path:
    """Return a file of the same folder; a name is no path."""
    if Path(name).name != name:
        raise DatasetError(f"{path}: {name!r:.80} is no name of a file in its folder")
    return path.with_name(name)


def _scaled(numbers: Any, unit: float, name: str) -> FloatArray:
    pose = validated_transform(() if numbers is None else numbers, name)
    pose[:3, 3] *= unit
    return pose


def _check_at_rest(base_T_white: FloatArray, base_T_sprayed: FloatArray, folder: Path) -> None:
    apart = invert(base_T_white) @ base_T_sprayed
    moved_m, turned_rad = float(np.linalg.norm(apart[:3, 3])), rotation_angle(apart[:3, :3])
    if moved_m > SAME_PLACE_M or turned_rad > SAME_TURN_RAD:
        raise CalibrationError(
            f"{folder}: the camera moved {moved_m * 1e3:.3g} mm and {np.rad2deg(turned_rad):.3g} degrees between the "
            f"white image and the sprayed depth, limits {SAME_PLACE_M * 1e3:g} mm and "
            f"{np.rad2deg(SAME_TURN_RAD):.2g} degrees: take both again without moving it"
        )
