"""Make a smaller data set of a larger one in the same layout: fewer views, half the size, intrinsics scaled.

    python tests/data/reduce_dataset.py SOURCE TARGET OBJECT VIEW [VIEW ...]

Images are averaged over 2x2 pixels. A depth is the harmonic mean of the four where they lie within 2 mm of each other
(1/z is affine on a plane), else missing: a pixel across an edge has no depth. Images of the right camera and of the dot
pattern are kept for the first view only. The exposure bracket is cut to its middle instead: means of grey levels are no
grey levels of any light.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path

import cv2
import numpy as np
import yaml

SPREAD_MM = 2.0
BRACKET_CUT = (256, 320)


def reduce_image(source: Path, target: Path) -> None:
    image = cv2.imread(str(source), cv2.IMREAD_GRAYSCALE)
    cv2.imwrite(str(target), cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA))


def reduce_depth(source: Path, target: Path, unit_mm: float, fewest: int) -> None:
    counts = cv2.imread(str(source), cv2.IMREAD_UNCHANGED).astype(np.float64)
    four = np.stack([counts[i::2, j::2] for i in (0, 1) for j in (0, 1)])
    there = four > 0
    low, high = np.where(there, four, np.inf).min(axis=0), four.max(axis=0)
    good = (there.sum(axis=0) >= fewest) & (high - low <= SPREAD_MM / unit_mm)
    inverse = np.divide(1.0, four, out=np.zeros_like(four), where=there)
    mean = there.sum(axis=0) / np.maximum(inverse.sum(axis=0), 1e-12)
    cv2.imwrite(str(target), np.where(good, np.rint(mean), 0).astype(np.uint16))


def reduce_intrinsics(source: Path, target: Path) -> float | None:
    values = yaml.safe_load(source.read_text())
    for name in ("width", "height"):
        values[name] //= 2
    for name in ("fx", "fy"):
        values[name] /= 2
    for name in ("cx", "cy"):
        values[name] = (values[name] + 0.5) / 2 - 0.5
    target.write_text("".join(f"{name}: {value}\n" for name, value in values.items()))
    return values.get("depth_unit")


def main(source: Path, target: Path, name: str, views: list[str]) -> None:
    for folder in ("cam", "models"):
        (target / folder).mkdir(parents=True, exist_ok=True)
    units = [reduce_intrinsics(path, target / "cam" / path.name) for path in sorted((source / "cam").glob("*.yml"))]
    unit_mm = next(unit for unit in units if unit is not None)
    shutil.copy(source / "cam/rig.json", target / "cam")
    for path in (source / "models").glob(f"{name}.*"):
        shutil.copy(path, target / "models")
    scene = Path(name) / "Scene_1"
    for folder in ("GT_Depth", "Ensenso/Depth", "Ensenso/Stereo", "Ensenso/StereoPattern"):
        (target / scene / folder).mkdir(parents=True, exist_ok=True)
        for view in views:
            for path in sorted((source / scene / folder).glob(f"*_{view}.*")):
                if view != views[0] and (folder.endswith("Pattern") or path.name.startswith("RIGHT")):
                    continue
                copy = target / scene / folder / path.name
                if path.suffix == ".json":
                    shutil.copy(path, copy)
                elif path.suffix == ".png":
                    reduce_depth(path, copy, unit_mm, fewest=4 if folder == "GT_Depth" else 2)
                else:
                    reduce_image(path, copy)
    (target / scene / "Ensenso/list.txt").write_text("".join(f"{view}\n" for view in views))
    shutil.copy(source / scene / "GT_world2obj.json", target / scene)
    reduce_calibration(source / name / "Calibration", target / name / "Calibration", unit_mm)


def reduce_calibration(source: Path, target: Path, unit_mm: float) -> None:
    for kind in ("Phong", "Response"):
        (target / kind).mkdir(parents=True, exist_ok=True)
        for path in (source / kind).glob("*.json"):
            (target / kind / path.name).write_text(json.dumps(json.loads(path.read_text())))
    for side in ("LEFT", "RIGHT"):
        reduce_image(source / f"Phong/{side}_white.bmp", target / f"Phong/{side}_white.bmp")
    reduce_depth(source / "Phong/DEPTH_sprayed.png", target / "Phong/DEPTH_sprayed.png", unit_mm, fewest=4)
    mask = cv2.imread(str(source / "Phong/mask_parts.png"), cv2.IMREAD_GRAYSCALE)
    # a pixel that is a part's in part only is none of it
    whole = np.minimum.reduce([mask[i::2, j::2] for i in (0, 1) for j in (0, 1)])
    cv2.imwrite(str(target / "Phong/mask_parts.png"), whole)
    for path in (source / "Response").glob("*.bmp"):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        row, column = ((size - cut) // 2 for size, cut in zip(image.shape, BRACKET_CUT, strict=True))
        cut = image[row : row + BRACKET_CUT[0], column : column + BRACKET_CUT[1]]
        cv2.imwrite(str(target / "Response" / path.name), cut)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], sys.argv[4:])
