"""The files of a scan: each written whole or not at all, with its checksum."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sidelong.detection.report import DetectionReport
from sidelong.evaluation.reliability import Reliability
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part
from sidelong.types import GrayImage, SceneModel, Step
from sidelong_service.depth_files import DepthFiles, intrinsics_of, npz
from sidelong_service.models import Artifact, Setup, ViewReport, rows_of
from sidelong_service.ply import ply

MEDIA_TYPES = {".png": "image/png", ".npz": "application/octet-stream", ".ply": "application/octet-stream",
               ".json": "application/json"}  # fmt: skip


@dataclass
class Record:
    """What a scan has gathered so far.

    Attributes
    ----------
    camera, part
        Intrinsics of the reference view, and what is looked for.
    setup
        What the scan runs with.
    image
        Reference image with the projector off.
    views
        One report a view.
    first, last
        The reference step, and the latest.
    reliability
        What was promised of each view beside what it gave.
    detection
        What detection did; None where it was left out.
    """

    camera: PinholeCamera
    part: Part
    setup: Setup
    image: GrayImage | None = None
    views: list[ViewReport] = field(default_factory=list[ViewReport])
    first: Step | None = None
    last: Step | None = None
    reliability: Reliability = field(default_factory=Reliability)
    detection: DetectionReport | None = None

    def add(self, step: Step) -> ViewReport:
        """Take a step in and return its report."""
        self.first, self.last = self.first or step, step
        self.reliability = self.reliability.add(step.forecast)
        report = ViewReport.of(step, self.first.view.base_T_camera)
        self.views.append(report)
        return report


def write_view(folder: Path, step: Step) -> Artifact:
    """Write what one view measured, as soon as it has: no later failure loses it."""
    arrays: dict[str, Any] = {"left": step.frame.left, "base_T_camera": step.view.base_T_camera}
    if step.frame.depth_m is not None:
        arrays["depth_m"] = step.frame.depth_m.astype(np.float32)
    return _write(folder / f"view_{step.index:02d}.npz", npz(arrays))


def write_results(
    folder: Path, record: Record, draw: Callable[[Record], Mapping[str, bytes]]
) -> list[Artifact]:  # fmt: skip
    """Write the completed depth and all that goes with it; nothing where there is no reference view yet."""
    step = record.last
    if step is None:
        return []
    depth = _depth_files(step, record)
    contents = {
        **depth.contents(),
        **_scene_files(step.scene),
        "poses.json": _poses(step, record),
        **draw(record),
        "report.json": _report(step, record, depth.legend()),
    }
    return [_write(folder / name, content) for name, content in contents.items()]


def _depth_files(step: Step, record: Record) -> DepthFiles:
    reference = _reference(record)
    image = record.image if record.image is not None else reference.frame.left
    names = [view.view for view in record.views]
    return DepthFiles(step.depth, record.camera, reference.view.base_T_camera, image, names)


def _scene_files(scene: SceneModel | None) -> dict[str, bytes]:
    """Return mesh and points of the whole bin, where the fusion models it."""
    if scene is None:
        return {}
    surface = scene.mesh()
    points_m, normals = surface.points_m, surface.normals
    return {
        "bin_mesh.ply": ply(points_m, normals, triangles=surface.triangles),
        "bin_cloud.ply": ply(points_m, normals),
    }


def _poses(step: Step, record: Record) -> bytes:
    """Return every hypothesis of every object: poses, probabilities, covariances."""
    base_T_camera = _reference(record).view.base_T_camera
    document = {
        "part": record.part.name,
        "diameter_m": record.part.diameter_m,
        "reference": _reference(record).view.name,
        "base_T_camera": rows_of(base_T_camera),
        "covariance": "turn about the part's centre (rad), then shift (m), along the axes of the reference camera",
        "objects": [
            {
                "visible_fraction": item.visible_fraction,
                "supporting_views": item.supporting_views,
                "hypotheses": [
                    {
                        "probability": each.probability,
                        "score": each.score,
                        "camera_T_object": rows_of(each.camera_T_object),
                        "base_T_object": rows_of(base_T_camera @ each.camera_T_object),
                        "covariance": None if each.covariance is None else rows_of(each.covariance),
                    }
                    for each in item.hypotheses
                ],
            }
            for item in step.objects
        ],
    }
    return json.dumps(document, indent=1, allow_nan=False).encode()


def _report(step: Step, record: Record, files: dict[str, Any]) -> bytes:
    document = {
        "finish_reason": step.stop,
        "completeness": step.completeness,
        "missing_px": step.missing_px,
        "recovered_px": step.recovered_px,
        "setup": record.setup.model_dump(mode="json", exclude={"recipe"}),
        "detection": None if record.detection is None else _detection(record.detection),
        "views": [view.model_dump(mode="json") for view in record.views],
        "reliability": record.reliability.report().model_dump(mode="json"),
        "recipe": record.setup.recipe,
        "K": intrinsics_of(record.camera).tolist(),
        "base_T_camera": _reference(record).view.base_T_camera.tolist(),
        **files,
    }
    return json.dumps(document, indent=1, allow_nan=False).encode()


def _detection(report: DetectionReport) -> dict[str, Any]:
    return {**asdict(report), "capped": report.capped}


def _reference(record: Record) -> Step:
    if record.first is None:
        raise ValueError("the record has no reference view yet")
    return record.first


def write_whole(path: Path, content: bytes) -> None:
    """Write a file under another name, then rename it: it is there whole, or not at all, even after a power cut.

    Raises
    ------
    OSError
        It cannot be written; nothing is left of it.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}.part")
    try:
        with draft.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        draft.replace(path)
    except BaseException:
        draft.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _write(path: Path, content: bytes) -> Artifact:
    write_whole(path, content)
    return Artifact(
        name=path.name,
        media_type=MEDIA_TYPES[path.suffix],
        size_bytes=len(content),
        sha256=hashlib.sha256(content).hexdigest(),
    )
