"""Templates on disk: trained once for a mesh, a camera and settings, and checked before each use."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
import zipfile
from dataclasses import asdict
from pathlib import Path

import numpy as np

from sidelong.detection.settings import DetectionSettings
from sidelong.detection.templates import FILE, Progress, TemplateSet, train
from sidelong.geometry.camera_model import PinholeCamera
from sidelong.geometry.mesh import Part

FORMAT = 2
"""Raise it when training or the files change."""
TRAINING_SETTINGS = {
    "view_step_deg", "roll_step_deg", "elevation_deg", "azimuth_deg", "roll_deg", "distance_m", "distance_ratio",
    "span_px", "cell_px", "strong_gradient", "dark_cosine", "bright_cosine", "dark_level", "ground_level",
}  # fmt: skip
AT_WORK = "training-"
"""Prefix of the folder of a training at work; the id of its process follows."""


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
    _remove_abandoned(cache_dir)
    fresh = Path(tempfile.mkdtemp(prefix=f"{AT_WORK}{os.getpid()}-", dir=cache_dir))
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
    symmetry = part.symmetry
    digest.update(np.round(symmetry.rotations, 6).tobytes())
    digest.update(repr((symmetry.ball, None if symmetry.axis is None else symmetry.axis.round(6).tolist())).encode())
    content = {
        "format": FORMAT,
        "camera": asdict(camera),
        "settings": settings.model_dump(include=TRAINING_SETTINGS),
    }
    digest.update(json.dumps(content, sort_keys=True).encode())
    safe = "".join(c if c.isalnum() else "_" for c in part.name)
    return f"{safe}-{digest.hexdigest()[:20]}"


def _remove_abandoned(cache_dir: Path) -> None:
    """Remove what trainings left behind whose process was killed."""
    for folder in cache_dir.glob(f"{AT_WORK}*"):
        process = folder.name.removeprefix(AT_WORK).split("-")[0]
        if not process.isdigit() or not _alive(int(process)):
            shutil.rmtree(folder, ignore_errors=True)


def _alive(process_id: int) -> bool:
    try:
        os.kill(process_id, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _write(templates: TemplateSet) -> None:
    """Write what is needed to check the file beside it."""
    digest = hashlib.sha256((templates.folder / FILE).read_bytes()).hexdigest()
    (templates.folder / "entry.json").write_text(json.dumps({"digest": digest, "focal_px": templates.focal_px}))


def _read(entry: Path) -> TemplateSet | None:
    """Return the entry, or None where it is missing or a file of it is not what was written."""
    try:
        content = json.loads((entry / "entry.json").read_text())
        if hashlib.sha256((entry / FILE).read_bytes()).hexdigest() != content["digest"]:
            return None
        with np.load(entry / FILE) as arrays:
            return TemplateSet(entry, float(content["focal_px"]), arrays["axis_R_object"], arrays["distance_m"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError, zipfile.BadZipFile):
        return None
