"""Results and scenes in the files of the BOP benchmark, whose toolkit is an independent scorer.

Formats: ``docs/bop_datasets_format.md`` of thodan/bop_toolkit and the rules of the BOP challenge. Millimetres,
rotations row by row, OpenCV camera axes; metres become millimetres on the line that writes.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sidelong.errors import ImageError
from sidelong.evaluation.silhouettes import Silhouette, box_of, silhouettes
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.geometry.symmetry import Symmetry
from sidelong.geometry.transforms import invert
from sidelong.recorded.dataset import Scene
from sidelong.recorded.files import MM, read_json
from sidelong.recorded.writing import DEPTH_UNIT_MM, write_depth, write_gray, write_json
from sidelong.types import BoolArray, DetectedObject, FloatArray, Projector

HEADER = "scene_id,im_id,obj_id,score,R,t,time"
NO_BOX = (-1, -1, -1, -1)


@dataclass(frozen=True)
class ImageId:
    """Which object of which image of which scene, by BOP's numbers."""

    scene: int
    image: int
    object: int = 1


def write_results(path: Path, images: Iterable[tuple[ImageId, Sequence[DetectedObject], float]]) -> None:
    """Write the most probable pose of each detected object as a row of a BOP results file.

    Parameters
    ----------
    images
        Each image with its objects and the seconds the image took; the score is the detector's.

    Raises
    ------
    OSError
        The file cannot be written.
    """
    rows = [HEADER]
    for of, objects, time_s in images:
        for best in (each.hypotheses[0] for each in objects):
            rotation = _spaced(best.camera_T_object[:3, :3])
            translation = _spaced(best.camera_T_object[:3, 3] / MM)
            rows.append(
                f"{of.scene},{of.image},{of.object},{float(best.score)!r},{rotation},{translation},{float(time_s)!r}"
            )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(rows) + "\n")


def export_scene(scene: Scene, folder: Path, object_id: int = 1, scene_id: int | None = None) -> None:
    """Write a recorded scene and its truth in BOP's layout: ``camera.json``, ``models/``, ``test/<scene>/``, targets.

    Images are numbered by their position in the scene's list; they are those with the projector off. Visibility is
    that of the true poses rendered together, without the bin; BOP's own script compares with the measured depth, which
    shiny parts lack. Other objects and scenes in the folder stay.

    Parameters
    ----------
    scene_id
        BOP's number of the scene; left out, that of the scene, which other objects' scenes may have as well.

    Raises
    ------
    ImageError, DatasetError, PoseError, MeshError
        A file of the scene is missing or cannot be used.
    OSError
        A file cannot be written.
    """
    part, camera = scene.dataset.part(scene.object), scene.dataset.rig.left
    write_model(folder / "models", part, object_id)
    write_json(
        folder / "camera.json",
        {"width": camera.width, "height": camera.height, "fx": camera.fx, "fy": camera.fy, "cx": camera.cx,
         "cy": camera.cy, "depth_scale": DEPTH_UNIT_MM},
    )  # fmt: skip
    scene_id = scene.number if scene_id is None else scene_id
    test = folder / "test" / f"{scene_id:06d}"
    cameras, truths, infos = dict[str, Any](), dict[str, Any](), dict[str, Any]()
    posed = [(part, base_T_object) for base_T_object in scene.base_T_objects]
    for image, view in enumerate(scene.views()):
        left = scene.image(view.name, Projector.OFF)
        if left is None:
            raise ImageError(f"{scene.folder}: view {view.name} has no left image with the projector off")
        depth_m = scene.depth_m(view.name)
        write_gray(test / "gray" / f"{image:06d}.png", left)
        write_depth(test / "depth" / f"{image:06d}.png", depth_m)
        camera_T_base = invert(view.base_T_camera)
        seen = silhouettes(posed, camera, view.base_T_camera)
        cameras[str(image)] = _camera(camera, camera_T_base)
        truths[str(image)] = [_truth(camera_T_base @ pose, object_id) for pose in scene.base_T_objects]
        infos[str(image)] = [_info(each, np.isfinite(depth_m)) for each in seen]
    write_json(test / "scene_camera.json", cameras)
    write_json(test / "scene_gt.json", truths)
    write_json(test / "scene_gt_info.json", infos)
    _write_targets(folder / "test_targets_bop19.json", scene, object_id, scene_id)


def write_model(folder: Path, part: Part, object_id: int) -> None:
    """Write a part as ``obj_<id>.ply``, its size and symmetry to ``models_info.json``. Raises OSError, DatasetError."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "models_info.json"
    known = dict(read_json(path)) if path.is_file() else {}
    low, high = part.vertices_m.min(axis=0) / MM, part.vertices_m.max(axis=0) / MM
    info = {
        "diameter": part.diameter_m / MM,
        **{f"min_{axis}": float(value) for axis, value in zip("xyz", low, strict=True)},
        **{f"size_{axis}": float(value) for axis, value in zip("xyz", high - low, strict=True)},
        **symmetry_info(part.symmetry),
    }
    write_json(path, known | {str(object_id): info})
    _write_ply(folder / f"obj_{object_id:06d}.ply", part)


def symmetry_info(symmetry: Symmetry) -> dict[str, Any]:
    """Return ``symmetries_discrete`` and ``symmetries_continuous`` of ``models_info.json``, each where there is one.

    Of a ball BOP can say no more than three axes: it does not combine turns about different ones.
    """
    offset = [float(value) for value in symmetry.centre_m / MM]
    axes = np.eye(3) if symmetry.ball else np.zeros((0, 3)) if symmetry.axis is None else symmetry.axis[None]
    info: dict[str, Any] = {}
    if len(axes):
        info["symmetries_continuous"] = [{"axis": axis.tolist(), "offset": offset} for axis in axes]
    if len(symmetry.rotations) > 1:
        turns = [np.eye(4) for _ in symmetry.rotations[1:]]
        for turn, rotation in zip(turns, symmetry.rotations[1:], strict=True):
            turn[:3, :3], turn[:3, 3] = rotation, offset - rotation @ offset
        info["symmetries_discrete"] = [turn.ravel().tolist() for turn in turns]
    return info


def _camera(camera: PinholeCamera, camera_T_base: FloatArray) -> dict[str, Any]:
    return {
        "cam_K": [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0],
        "depth_scale": DEPTH_UNIT_MM,
        "cam_R_w2c": camera_T_base[:3, :3].ravel().tolist(),
        "cam_t_w2c": (camera_T_base[:3, 3] / MM).tolist(),
    }


def _truth(camera_T_object: FloatArray, object_id: int) -> dict[str, Any]:
    return {
        "cam_R_m2c": camera_T_object[:3, :3].ravel().tolist(),
        "cam_t_m2c": (camera_T_object[:3, 3] / MM).tolist(),
        "obj_id": object_id,
    }


def _info(seen: Silhouette, measured: BoolArray) -> dict[str, Any]:
    return {
        "px_count_all": seen.all_px,
        "px_count_valid": int((seen.covered & measured).sum()),
        "px_count_visib": int(seen.visible.sum()),
        "visib_fract": seen.visible_fraction,
        "bbox_obj": list(seen.box or NO_BOX),
        "bbox_visib": list(box_of(*np.nonzero(seen.visible)) or NO_BOX),
    }


def _write_targets(path: Path, scene: Scene, object_id: int, scene_id: int) -> None:
    """Write which objects to look for in which images, keeping those of other scenes and objects."""
    known: list[dict[str, int]] = json.loads(path.read_text()) if path.is_file() else []
    kept = [each for each in known if (each["scene_id"], each["obj_id"]) != (scene_id, object_id)]
    count = len(scene.base_T_objects)
    mine = [
        {"im_id": image, "inst_count": count, "obj_id": object_id, "scene_id": scene_id}
        for image in range(len(scene.names))
    ]
    path.write_text(json.dumps(kept + mine, indent=1))


def _write_ply(path: Path, part: Part) -> None:
    """Write an ASCII PLY in mm with normals at the vertices: means of those of their triangles, by area."""
    corners = part.vertices_m[part.triangles]
    weighted = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(part.vertices_m)
    np.add.at(normals, part.triangles, weighted[:, None, :])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.divide(normals, lengths, out=np.zeros_like(normals), where=lengths > 0)
    properties = "".join(f"property float {name}\n" for name in ("x", "y", "z", "nx", "ny", "nz"))
    with path.open("w") as file:
        file.write(f"ply\nformat ascii 1.0\nelement vertex {len(normals)}\n{properties}")
        file.write(f"element face {len(part.triangles)}\nproperty list uchar int vertex_indices\nend_header\n")
        np.savetxt(file, np.hstack([part.vertices_m / MM, normals]), fmt="%.7g")
        np.savetxt(file, np.column_stack([np.full(len(part.triangles), 3), part.triangles]), fmt="%d")


def _spaced(numbers: FloatArray) -> str:
    return " ".join(repr(float(number)) for number in numbers.ravel())
