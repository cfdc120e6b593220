"""Files of recorded captures: pictures, JSON, YAML, numbers and poses. Every refusal names the file and the field."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np

from sidelong.errors import DatasetError, ImageError
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.transforms import validated_transform
from sidelong.types import FloatArray, GrayImage

MM = 1e-3
LARGEST_NUMBER = 1e12
"""No length, angle or time in these files comes near; larger ones overflow somewhere."""


def read_gray(path: Path, camera: PinholeCamera | None = None) -> GrayImage:
    """Read an 8-bit grey image (H, W), of the camera's size where one is given.

    Raises
    ------
    ImageError
        The image is missing, damaged, of the wrong size, has more than 8 bits a pixel, or has colours.
    """
    picture = _picture(path, camera)
    if picture.mode in ("L", "1"):
        return np.asarray(picture.convert("L"), dtype=np.uint8)
    if picture.mode.startswith(("I", "F")):
        raise ImageError(f"{path}: its pixels are of kind {picture.mode!r}, needs 8-bit grey ones")
    channels = np.asarray(picture.convert("RGB"), dtype=np.uint8)
    coloured = int((np.ptp(channels, axis=2) > 0).sum())
    if coloured:
        raise ImageError(f"{path}: {coloured} of its pixels have a colour, needs 8-bit grey ones")
    return np.ascontiguousarray(channels[..., 0])


def read_counts(path: Path, camera: PinholeCamera) -> FloatArray:
    """Read a 16-bit grey picture (H, W) of the camera's size as numbers. Raises ImageError."""
    picture = _picture(path, camera)
    if not picture.mode.startswith("I"):
        raise ImageError(f"{path}: its pixels are of kind {picture.mode!r}, a depth map has 16-bit grey ones")
    return np.asarray(picture, dtype=np.float64)


def _picture(path: Path, camera: PinholeCamera | None) -> Any:
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
    if camera is not None and picture.size != (camera.width, camera.height):
        raise ImageError(
            f"{path}: the image is {picture.width}x{picture.height} px, cam/ says {camera.width}x{camera.height} px"
        )
    return picture


def pose_from_mm(numbers: Any, name: Path | str) -> FloatArray:
    """Read a pose in mm as metres. Raises PoseError."""
    pose = validated_transform(() if numbers is None else numbers, str(name))
    pose[:3, 3] *= MM
    return pose


def read_json(path: Path) -> Mapping[str, Any]:
    """Read an object of a JSON file. Raises DatasetError."""
    try:
        content = json.loads(path.read_text())
    except FileNotFoundError as error:
        raise DatasetError(f"{path}: the file is missing") from error
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: cannot be read as JSON: {error}") from error
    return mapping_in(content, path)


def read_yaml(path: Path) -> Mapping[str, Any]:
    """Read a mapping of a YAML file, OpenCV's kind too. Raises DatasetError."""
    import yaml

    try:
        # OpenCV writes a first line that YAML does not know
        lines = path.read_text().splitlines()
        return mapping_in(yaml.safe_load("\n".join(line for line in lines if not line.startswith("%YAML"))), path)
    except FileNotFoundError as error:
        raise DatasetError(f"{path}: the file is missing") from error
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise DatasetError(f"{path}: cannot be read as YAML: {error}") from error


def mapping_in(content: Any, path: Path) -> Mapping[str, Any]:
    """Return what has to be names with values. Raises DatasetError."""
    if not isinstance(content, dict):
        raise DatasetError(f"{path}: holds {type(content).__name__}, needs names with values")
    return cast("Mapping[str, Any]", content)


def number_in(values: Mapping[str, Any], name: str, path: Path, *, positive: bool = True) -> float:
    """Return a finite number of a file, greater than 0 unless said otherwise. Raises DatasetError."""
    value = values.get(name)
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= LARGEST_NUMBER:
        raise DatasetError(f"{path}: {name} is {value!r:.40}, needs a finite number")
    if positive and value <= 0:
        raise DatasetError(f"{path}: {name} is {value!r:.40}, needs a number greater than 0")
    return float(value)


def count_in(values: Mapping[str, Any], name: str, path: Path) -> int:
    """Return a whole number of a file, greater than 0. Raises DatasetError."""
    number = number_in(values, name, path)
    if number != int(number):
        raise DatasetError(f"{path}: {name} is {number!r}, needs a whole number")
    return int(number)
