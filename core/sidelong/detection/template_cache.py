"""Templates on disk: trained once for a mesh, a camera and settings, and checked before each use."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import zipfile
from dataclasses import asdict, fields
from pathlib import Path

import numpy as np

from sidelong.detection.settings import DetectionSettings
from sidelong.detection.templates import Progress, TemplateSet, train
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part

FORMAT = 1
"""Raise it when training or the files change."""
TRAINING_SETTINGS = {
    "view_step_deg", "roll_step_deg", "distance_m", "distance_ratio", "span_px", "num_features",
    "weak_threshold", "strong_threshold", "dark_cosine", "bright_cosine", "dark_level",
    "ground_level",
}  # fmt: skip
ARRAYS = ("class_index", "template_id", "axis_R_object", "distance_m", "centre_px")


def load_or_train(
    part: Part,
    camera: PinholeCamera,
    settings: DetectionSettings,
    cache_dir: Path,
    progress: Progress | None = None,
) -> TemplateSet:
    """Return the templates from ``cache_dir``; train and store them where they are missing or damaged.

    The entry appears under its name in one step, so a process that dies or a second one at work leaves no half entry.
    """
    entry = cache_dir / cache_key(part, camera, settings)
    stored = _read(entry)
    if stored is not None:
        return stored
    cache_dir.mkdir(parents=True, exist_ok=True)
    fresh = Path(tempfile.mkdtemp(prefix="training-", dir=cache_dir))
    try:
        _write(train(part, camera, settings, fresh, progress))
        shutil.rmtree(entry, ignore_errors=True)
        try:
            os.replace(fresh, entry)
        except OSError:
            # a folder that is not empty cannot be replaced: another process stored the same templates meanwhile
            if _read(entry) is None:
                raise
    finally:
        shutil.rmtree(fresh, ignore_errors=True)
    trained = _read(entry)
    if trained is None:
        raise OSError(f"{entry}: the templates just written do not read back")
    return trained


def cache_key(part: Part, camera: PinholeCamera, settings: DetectionSettings) -> str:
    """Return the entry's name: the part's and a digest of everything that shapes the templates."""
    digest = hashlib.sha256(part.vertices_m.tobytes() + part.triangles.astype(np.int64).tobytes())
    content = {
        "format": FORMAT,
        "camera": asdict(camera),
        "settings": settings.model_dump(include=TRAINING_SETTINGS),
    }
    digest.update(json.dumps(content, sort_keys=True).encode())
    safe = "".join(c if c.isalnum() else "_" for c in part.name)
    return f"{safe}-{digest.hexdigest()[:20]}"


def _write(templates: TemplateSet) -> None:
    """Write what is not in OpenCV's files beside them, with their digests."""
    folder = templates.folder
    np.savez(folder / "poses.npz", **{name: getattr(templates, name) for name in ARRAYS})
    digests = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in sorted(folder.iterdir())}
    rest = {f.name: getattr(templates, f.name) for f in fields(templates) if f.name not in (*ARRAYS, "folder")}
    (folder / "entry.json").write_text(json.dumps({"digests": digests, **rest}))


def _read(entry: Path) -> TemplateSet | None:
    """Return the entry, or None where it is missing or a file of it is not what was written."""
    try:
        content = json.loads((entry / "entry.json").read_text())
        for name, digest in content.pop("digests").items():
            # OpenCV's reader is not to be trusted with a damaged file
            if hashlib.sha256((entry / name).read_bytes()).hexdigest() != digest:
                return None
        content["classes"] = tuple(content["classes"])
        with np.load(entry / "poses.npz") as arrays:
            return TemplateSet(folder=entry, **content, **{name: arrays[name] for name in ARRAYS})
    except (OSError, ValueError, KeyError, TypeError, AttributeError, zipfile.BadZipFile):
        return None
