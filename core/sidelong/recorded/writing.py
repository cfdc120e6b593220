"""Writes recorded data in the layout that is read here: intrinsics, images, depth maps, poses."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from sidelong.errors import DatasetError
from sidelong.geometry.camera_model import PinholeCamera, StereoRig
from sidelong.recorded.dataset import Dataset
from sidelong.recorded.files import MM, read_json
from sidelong.types import FloatArray, GrayImage

DEPTH_UNIT_MM = 0.03125
LARGEST_COUNT = 2**16 - 1


def write_rig(root: Path, rig: StereoRig, serial: str) -> None:
    """Write ``cam/``; where it is there already it has to be of the same camera.

    Raises
    ------
    DatasetError
        The folder holds the recordings of another camera.
    OSError
        A file cannot be written.
    """
    folder = root / "cam"
    if folder.is_dir():
        recorded = Dataset(root)
        if recorded.serial != serial:
            raise DatasetError(f"{root}: holds recordings of camera {recorded.serial}, this one is {serial}")
        if recorded.rig.left != rig.left:
            raise DatasetError(
                f"{root}: holds recordings of {recorded.rig.left.width}x{recorded.rig.left.height} px with other "
                f"intrinsics than this camera, {serial}, {rig.left.width}x{rig.left.height} px, has now"
            )
        return
    folder.mkdir(parents=True)
    baseline_mm = rig.baseline_m / MM
    _write_intrinsics(folder / "Ensenso_DEPTH.yml", rig.left, depth_unit=DEPTH_UNIT_MM, baseline=baseline_mm)
    _write_intrinsics(folder / "Ensenso_LEFT.yml", rig.left)
    _write_intrinsics(folder / "Ensenso_RIGHT.yml", rig.right)
    about = {
        "serial": serial,
        "projector_in_left": pose_to_mm(rig.projector.left_T_projector),
        "projector_fov_x_deg": float(np.rad2deg(2 * rig.projector.half_width_rad)),
        "projector_fov_y_deg": float(np.rad2deg(2 * rig.projector.half_height_rad)),
    }
    write_json(folder / "rig.json", about)


def write_gray(path: Path, image: GrayImage) -> None:
    """Write an image (H, W) as BMP or PNG. Raises OSError."""
    from PIL import Image

    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(image).save(path)


def write_depth(path: Path, depth_m: FloatArray) -> None:
    """Write depth (H, W) as a 16-bit PNG; missing, and farther than it can hold, is 0. Raises OSError."""
    from PIL import Image

    counts = np.rint(depth_m / MM / DEPTH_UNIT_MM)
    held = (counts > 0) & (counts <= LARGEST_COUNT)
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(np.where(held, counts, 0).astype(np.uint16)).save(path)


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write an object as JSON. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content, indent=1, allow_nan=False))


def add_to_json(path: Path, name: str, **members: Any) -> None:
    """Add members to the object ``name`` of a JSON file, which is made where there is none.

    Raises
    ------
    DatasetError
        The file is there, but cannot be read.
    OSError
        It cannot be written.
    """
    content = dict(read_json(path)) if path.is_file() else {}
    write_json(path, content | {name: {**content.get(name, {}), **members}})


def pose_to_mm(base_T_camera: FloatArray) -> list[float]:
    """Return a pose as 16 numbers, row by row, its translation in millimetres."""
    pose = np.array(base_T_camera, dtype=np.float64)
    pose[:3, 3] /= MM
    return [float(entry) for entry in pose.ravel()]


def _write_intrinsics(path: Path, camera: PinholeCamera, **more: float) -> None:
    values = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")} | more
    path.write_text("".join(f"{name}: {value!r}\n" for name, value in values.items()))
