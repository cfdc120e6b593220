"""Copies of the recorded scene in which one thing is wrong."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

ROBI = Path(__file__).parents[1] / "data/robi"
SCENE = Path("Tube_fitting/Scene_1/Ensenso")
REFERENCE_DEPTH = SCENE / "Depth/DEPTH_view_4.png"
REFERENCE_POSE = SCENE / "Depth/DEPTH_view_4.json"
REFERENCE_IMAGE = SCENE / "Stereo/LEFT_view_4.bmp"
CAD_MODEL = Path("models/Tube_fitting.stl")
TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attributes", "<u2")])


def damaged(folder: Path, damage: Callable[[Path], None]) -> Path:
    """Return a data set like the recorded one, but for what ``damage`` does to it."""
    shutil.copytree(ROBI, folder, copy_function=os.symlink)
    damage(folder)
    return folder


def rewrite(path: Path, content: bytes) -> None:
    """Put a file in the place of a link: the original stays."""
    path.unlink()
    path.write_bytes(content)


def truncate_reference_depth(root: Path) -> None:
    content = (root / REFERENCE_DEPTH).read_bytes()
    rewrite(root / REFERENCE_DEPTH, content[: len(content) // 2])


def truncate_all_other_depths(root: Path) -> None:
    for path in (root / SCENE / "Depth").glob("DEPTH_*.png"):
        if path.name != REFERENCE_DEPTH.name:
            rewrite(path, path.read_bytes()[:2000])


def remove_reference_depth(root: Path) -> None:
    (root / REFERENCE_DEPTH).unlink()


def empty_reference_depth(root: Path) -> None:
    rewrite(root / REFERENCE_DEPTH, png(np.zeros((512, 640), np.uint16)))


def put_nan_into_a_pose(root: Path) -> None:
    content = json.loads((root / REFERENCE_POSE).read_text())
    content["cam_pose"][3] = float("nan")
    rewrite(root / REFERENCE_POSE, json.dumps(content).encode())


def scale_a_pose(root: Path) -> None:
    content = json.loads((root / REFERENCE_POSE).read_text())
    content["cam_pose"] = [2.0 * entry for entry in content["cam_pose"][:12]] + content["cam_pose"][12:]
    rewrite(root / REFERENCE_POSE, json.dumps(content).encode())


def remove_list_of_views(root: Path) -> None:
    (root / SCENE / "list.txt").unlink()


def remove_reference_image(root: Path) -> None:
    (root / REFERENCE_IMAGE).unlink()


def shrink_reference_image(root: Path) -> None:
    rewrite(root / REFERENCE_IMAGE, bmp(np.full((256, 320), 90, np.uint8)))


def grey_reference_image(root: Path) -> None:
    rewrite(root / REFERENCE_IMAGE, bmp(np.full((512, 640), 90, np.uint8)))


def break_intrinsics(root: Path) -> None:
    path = root / "cam/Ensenso_LEFT.yml"
    rewrite(path, path.read_bytes().replace(b"fx: 541.548523", b"fx: .nan"))


def write_mesh_in_metres(root: Path) -> None:
    header, triangles = read_stl(root / CAD_MODEL)
    triangles["corners"] *= 1e-3
    rewrite(root / CAD_MODEL, header + triangles.tobytes())


def open_mesh(root: Path) -> None:
    header, triangles = read_stl(root / CAD_MODEL)
    triangles["corners"][::10, 0] += 1.0
    rewrite(root / CAD_MODEL, header + triangles.tobytes())


def cut_mesh(root: Path) -> None:
    content = (root / CAD_MODEL).read_bytes()
    rewrite(root / CAD_MODEL, content[: len(content) // 2])


def read_stl(path: Path) -> tuple[bytes, Any]:
    content = path.read_bytes()
    return content[:84], np.frombuffer(content[84:], TRIANGLE).copy()


def png(counts: Any) -> bytes:
    return cv2.imencode(".png", counts)[1].tobytes()


def bmp(image: Any) -> bytes:
    return cv2.imencode(".bmp", image)[1].tobytes()
